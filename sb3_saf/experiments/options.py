"""The command line's options, and what they mean."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any, Final, TypeVar

from hecogrid_envs.task import check_task
from sb3_saf.experiments.cells import Choice, Protocol
from sb3_saf.experiments.definitions import DEFAULT_SEEDS, Level
from sb3_saf.experiments.engine import Engine
from sb3_saf.experiments.local import LocalEngine
from sb3_saf.experiments.on_ray import RayEngine, require_ray
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.run import Machine
from sb3_saf.training.algorithms import ALGOS
from sb3_saf.training.commands import KeyValues
from sb3_saf.training.devices import check_device
from sb3_saf.training.names import unknown_name
from sb3_saf.training.seeds import check_seed
from sb3_saf.training.yaml_files import SIZES, Size

PROGRAM: Final = "python -m sb3_saf.experiments"
DEFAULT_SIZE: Final[Size] = "small"

Number = TypeVar("Number", int, float, None)


def add_choice(parser: argparse.ArgumentParser) -> None:
    """What part of an experiment is meant, and where its results are."""
    group = parser.add_argument_group("what")
    group.add_argument("--size", choices=SIZES, help=f"default: that of the folder, or {DEFAULT_SIZE}")
    group.add_argument("-f", "--folder", type=Path, help="of the results; default: runs/experiments/SIZE")
    group.add_argument("--seeds", type=int, nargs="+", default=[], help="default: 0 1 2 (smoke: 0 1)")
    group.add_argument("--methods", nargs="+", default=[], metavar="ALGO", help="default: the experiment's")
    group.add_argument("--tasks", nargs="+", default=[], metavar="TASK", help="default: the experiment's")
    group.add_argument("--levels", type=int, nargs="+", default=[], help="on its dials, such as 1 3 5; default: all")


def add_protocol(parser: argparse.ArgumentParser) -> None:
    """What is the same for all cells."""
    group = parser.add_argument_group("how cells are trained and tested (the same for all cells of a folder)")
    group.add_argument("-n", "--game-steps", type=int, help="steps of the game to train for; default: the size's")
    pairs: dict[str, Any] = {"nargs": "+", "action": KeyValues, "default": {}, "metavar": "KEY:VALUE"}
    group.add_argument("--env-kwargs", **pairs, help="parameters of the game, beside the levels")
    group.add_argument("-params", "--hyperparams", **pairs, help="in the place of the zoo's, for all methods")
    group.add_argument("--episodes", type=int, default=32, help="team episodes of each test")
    group.add_argument("--deterministic", action="store_true", help="test with the most likely actions")


def add_machine(parser: argparse.ArgumentParser) -> None:
    """Where cells run."""
    group = parser.add_argument_group("where cells run")
    group.add_argument("--workers", type=int, help="cells at the same time; default: as many as cores allow")
    group.add_argument("--threads", type=int, default=1, help="threads of each worker")
    group.add_argument("--device", default="auto", help="as Stable-Baselines3 takes it")


def add_engine(parser: argparse.ArgumentParser) -> None:
    """How a run goes on."""
    group = parser.add_argument_group("running")
    group.add_argument("--retries", type=int, default=1, help="further attempts for a cell that fails or is killed")
    group.add_argument(
        "--resume",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="cells that were killed go on, exactly, from their last checkpoint (the default); --no-resume starts them "
        "over. On Ray they always start over",
    )
    group.add_argument("--shard", default="1/1", metavar="I/N", help="run only the I-th of N parts")
    group.add_argument("--tensorboard", action="store_true", help="keep TensorBoard logs in the cells' folders")
    group.add_argument("--ray", action="store_true", help="on Ray instead of processes of this machine")
    group.add_argument("--address", help="of a running Ray cluster, or 'auto' to find it; implies --ray")
    group.add_argument("--cpus-per-cell", type=float, default=1, help="on Ray")
    group.add_argument("--gpus-per-cell", type=float, default=0, help="on Ray; with 0.25 four cells share one")


def add_rate(parser: argparse.ArgumentParser) -> None:
    """What a plan would measure."""
    parser.add_argument("--rate", type=float, help="game steps per second of one worker, instead of measuring")


def positive(name: str, value: Number) -> Number:
    """
    A number above 0, or None.

    :raises ValueError: for any other
    """
    if value is not None and not value > 0:
        raise ValueError(f"{name} must be above 0, got {value:g}")
    return value


def size_of(options: argparse.Namespace) -> Size:
    """The size that was named, that of the folder, or the default."""
    if options.size is not None:
        size: Size = options.size
        return size
    stored = None if options.folder is None else Results(options.folder).protocol()
    return DEFAULT_SIZE if stored is None else stored.size


def results_of(options: argparse.Namespace) -> Results:
    """The folder of results, which may not be there yet."""
    return Results(options.folder or Path("runs", "experiments", size_of(options)))


def existing_results_of(options: argparse.Namespace) -> Results:
    """
    The folder of results.

    :raises ValueError: if there is none
    """
    results = results_of(options)
    remedy = f"run it first: {PROGRAM} run {options.name} --size {size_of(options)} -f {results.folder}"
    if not results.folder.is_dir():
        raise ValueError(f"there is no folder {results.folder}; name another with -f, or {remedy}")
    if results.protocol() is None or not results.requests(options.name):
        raise ValueError(f"{results.folder} has no results of {options.name!r}; {remedy}")
    return results


def choice_of(options: argparse.Namespace) -> Choice:
    """The part of the experiment to run."""
    wanted = wanted_of(options)
    return Choice(wanted.seeds or DEFAULT_SEEDS[size_of(options)], wanted.methods, wanted.tasks, wanted.levels)


def wanted_of(options: argparse.Namespace) -> Choice:
    """
    What was named; empty for what was not.

    :raises ValueError: for names that do not exist
    """
    for method in options.methods:
        if method not in ALGOS:
            raise unknown_name("method", method, ALGOS)
    return Choice(
        tuple(dict.fromkeys(check_seed(seed) for seed in options.seeds)),
        tuple(dict.fromkeys(options.methods)),
        tuple(dict.fromkeys(check_task(task.removesuffix("-v0")) for task in options.tasks)),
        tuple(dict.fromkeys(options.levels)),
    )


def protocol_of(options: argparse.Namespace) -> Protocol:
    """How cells are trained and tested."""
    overrides = dict(options.hyperparams)
    if options.game_steps is not None:
        overrides["game_steps"] = positive("--game-steps", options.game_steps)
    for dial in Level._fields:
        if dial in options.env_kwargs:
            raise ValueError(f"{dial} is what the experiment turns; leave it out of --env-kwargs")
    if options.env_kwargs:
        overrides["env_kwargs"] = options.env_kwargs
    return Protocol(size_of(options), overrides, positive("--episodes", options.episodes), options.deterministic)


def machine_of(options: argparse.Namespace) -> Machine:
    """How cells run."""
    threads = positive("--threads", options.threads)
    if options.retries < 0:
        raise ValueError(f"--retries must be 0 or more, got {options.retries}")
    return Machine(
        check_device(options.device),
        threads,
        options.retries,
        options.tensorboard,
        not _is_on_ray(options),
        options.resume,
    )


def engine_of(options: argparse.Namespace) -> Engine:
    """
    What runs cells.

    :raises ValueError: if Ray is asked for and not installed
    """
    if not _is_on_ray(options):
        return LocalEngine(workers_of(options), options.threads)
    require_ray()
    cpus = positive("--cpus-per-cell", options.cpus_per_cell)
    return RayEngine(options.address, cpus, options.gpus_per_cell, positive("--workers", options.workers))


def _is_on_ray(options: argparse.Namespace) -> bool:
    return bool(options.ray) or options.address is not None


def workers_of(options: argparse.Namespace) -> int:
    """Cells at the same time on this machine."""
    if options.workers is not None:
        return positive("--workers", options.workers)
    return max(1, available_cores() // positive("--threads", options.threads))


def available_cores() -> int:
    """Cores that this process may use, which a batch system may have limited."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
