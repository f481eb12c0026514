"""Command line: ``list``, ``plan``, ``run``, ``report``, ``check``, ``publish``, ``teams``."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from sb3_saf.checkpoints.learning import handled
from sb3_saf.experiments.definitions import (
    DEFAULT_SEEDS,
    EXPERIMENTS,
    MODULE,
    PROGRAM,
    Experiment,
    RunConfig,
    Selection,
    Shard,
    own_experiment,
)
from sb3_saf.experiments.engines import Engine, LocalEngine, RayEngine
from sb3_saf.experiments.results import Results
from sb3_saf.suites.registry import find_environment, folder_name
from sb3_saf.teams.checks import check_seed, unknown_name
from sb3_saf.training.commands import (
    OneLineParser,
    add_key_values,
    at_least,
    check_device,
    require,
    run_command,
    user_errors,
)
from sb3_saf.training.folders import TEAMS, check_team, missing_package, python_command, team_names
from sb3_saf.training.yaml_files import SIZES, Size

DEFAULT_SIZE: Final[Size] = "small"
#: The protocol of the size smoke, which is for trying commands.
_SMOKE: Final = {"episodes": 16, "eval_freq": 200, "eval_episodes": 2}


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run the command line.

    :return: 0 for success, 1 if cells failed or differ
    :raises SystemExit: with 2 if the command was invalid, 130 if it was interrupted
    """
    options = _parser().parse_args(arguments)
    if options.command == "cell":  # its errors go to error.txt with a traceback
        return _cell(options)
    return run_command(f"{PROGRAM} {options.command}", lambda: user_errors()(options.function)(options))


# Options


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(prog=PROGRAM, description="Grids of trainings: the paper's by name, and your own.")
    commands = parser.add_subparsers(dest="command", required=True, parser_class=OneLineParser, metavar="COMMAND")
    commands.add_parser("list", help="the paper's experiments").set_defaults(function=_list)
    for name, function, text in (
        ("plan", _plan, "cells, game steps and, once cells are finished, the time that is left"),
        ("run", _run, "run what is missing"),
        ("report", _report, "figures and a page of tables, of whatever is there"),
    ):
        command = commands.add_parser(name, help=text, description=text)
        command.set_defaults(function=function)
        _add_selection(command)
        if function is _report:
            text = "folders of published results to draw beside these"
            command.add_argument("--beside", type=Path, nargs="+", default=[], help=text)
        else:
            _add_config(command)
            _add_machine(command)
    check = commands.add_parser("check", help="run a finished cell again and compare the numbers")
    check.set_defaults(function=_check)
    check.add_argument(
        "cell", type=Path, metavar="FOLDER/CELL", help="such as runs/x/cells/TeamSupport-c1-h1/saf/seed-0"
    )
    check.add_argument("--device", default="auto", help="as Stable-Baselines3 takes it")
    publish = commands.add_parser("publish", help="write the best teams of a folder for others to play")
    publish.set_defaults(function=_publish)
    publish.add_argument("folder", type=Path, metavar="FOLDER", help="as -f of `run`")
    publish.add_argument("target", type=Path, metavar="TEAMS", help="folder of the teams, such as trained_teams")
    publish.add_argument("--only", default="*", metavar="PATTERN", help="of their names, such as 'TeamSupport-*/saf'")
    teams = commands.add_parser("teams", help="play published teams again and compare with the rows of their tables")
    teams.set_defaults(function=_teams)
    teams.add_argument("folder", type=Path, nargs="?", default=TEAMS, metavar="TEAMS", help="default: trained_teams")
    cell = commands.add_parser("cell", help="what `run` starts for each cell: do the job of a folder")
    cell.add_argument("cell", type=Path, metavar="FOLDER", help="with a job.json")
    cell.add_argument("--until-stdin-closes", action="store_true", help="end when whoever started this ends")
    return parser


def _add_selection(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", nargs="?", metavar="NAME", help=f"one of {', '.join(EXPERIMENTS)}, or your own")
    group = parser.add_argument_group("what")
    group.add_argument(
        "--env", nargs="+", default=[], help="a grid of your own on these environments, as sb3_saf.train takes them"
    )
    add_key_values(
        group,
        "--vary",
        metavar="KEY:[VALUES]",
        help="a parameter of these environments and its values, such as N:[2,3]",
    )
    group.add_argument("--size", choices=SIZES, help=f"default: that of the folder, or {DEFAULT_SIZE}")
    group.add_argument("-f", "--folder", type=Path, help="of the results; default: runs/experiments/SIZE, or /NAME")
    group.add_argument("--seeds", type=int, nargs="+", default=[], help=f"default: {' '.join(map(str, DEFAULT_SEEDS))}")
    group.add_argument("--methods", nargs="+", default=[], metavar="ALGO", help="default: the experiment's")
    group.add_argument("--tasks", nargs="+", default=[], metavar="TASK", help="default: the experiment's")
    group.add_argument(
        "--levels", nargs="+", default=[], help="on its axes, such as 1 3 5, of training and tests; default: all"
    )


def _add_config(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(seeds=list(DEFAULT_SEEDS))
    group = parser.add_argument_group("how cells are trained and tested (the same for all cells of a folder)")
    group.add_argument(
        "-n", "--game-steps", type=at_least(1), help="game steps, of all games together; default: the size's"
    )
    add_key_values(group, "--env-kwargs", help="parameters of the environment, beside the levels")
    add_key_values(group, "-params", "--hyperparams", help="in the place of zoo_configs', for all methods")
    group.add_argument("--episodes", type=at_least(1), help="team episodes of each test; by default 512, smoke: 16")
    group.add_argument(
        "--eval-freq", type=at_least(1), help="game steps between evaluations during training; by default 20 a run"
    )
    group.add_argument(
        "--eval-episodes", type=at_least(1), help="team episodes of each evaluation; by default 32, smoke: 2"
    )


def _add_machine(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("where and how cells run")
    group.add_argument("--workers", type=at_least(1), help="cells at the same time; default: as many as cores allow")
    group.add_argument("--threads", type=at_least(1), default=1, help="threads of each worker")
    group.add_argument("--device", default="auto", help="as Stable-Baselines3 takes it")
    group.add_argument(
        "--retries", type=at_least(0), default=1, help="further attempts for a cell that fails or is killed"
    )
    group.add_argument(
        "--resume",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="cells that were killed go on, exactly, from their last checkpoint (the default), or start over",
    )
    group.add_argument("--shard", default="1/1", metavar="I/N", help="run only the I-th of N parts")
    group.add_argument("--tensorboard", action="store_true", help="keep TensorBoard logs in the cells' folders")
    group.add_argument("--ray", action="store_true", help="on Ray instead of processes of this machine")
    group.add_argument("--address", help="of a running Ray cluster, or 'auto' to find it; implies --ray")
    group.add_argument("--cpus-per-cell", type=float, default=1, help="on Ray")
    group.add_argument("--gpus-per-cell", type=float, default=0, help="on Ray; with 0.25 four cells share one")


# Interpretation of the options


def _subject(options: argparse.Namespace) -> tuple[Experiment, Results, Selection]:
    """Return the experiment, the folder of its results, and the selected part; ValueError for unknown names."""
    if options.name is None and len(options.env) != 1:
        what, example = "name an experiment", "coordination, or --env mpe2.simple_spread_v3"
        if options.env:
            what, example = "several environments need a name before --env", f"mine --env {' '.join(options.env)}"
        raise ValueError(f"{what}: {python_command(MODULE)} {options.command} {example}")
    # An environment names the grid on it.
    name = folder_name(options.env[0] if options.name is None else options.name).removesuffix("-v0")
    results = Results(options.folder or Path("runs", "experiments", _size(options) if name in EXPERIMENTS else name))
    if options.env:
        experiment = own_experiment(name, tuple(dict.fromkeys(options.env)), options.vary)
    elif options.vary:
        raise ValueError("--vary is for a grid of your own: give its environments with --env")
    else:
        experiment = results.experiment(name)
    envs = []
    for task in options.tasks:
        env_id = task if task in experiment.envs else find_environment(task).id
        # The paper's experiments accept any of HECOGrid's tasks.
        if env_id not in experiment.envs and experiment.name not in EXPERIMENTS:
            raise unknown_name("environment of this experiment", task, experiment.envs)
        envs.append(env_id)
    selection = Selection(
        tuple(dict.fromkeys(check_seed(seed) for seed in options.seeds)),
        tuple(dict.fromkeys(options.methods)),
        tuple(dict.fromkeys(envs)),
        tuple(dict.fromkeys(options.levels)),
    )
    return experiment, results, selection


def _size(options: argparse.Namespace) -> Size:
    """Return the given size, that of the folder, or the default."""
    stored = None if options.folder is None else Results(options.folder).config()
    return options.size or (DEFAULT_SIZE if stored is None else stored.size)


def _config(options: argparse.Namespace, experiment: Experiment) -> RunConfig:
    """Return the configuration of the run."""
    overrides = dict(options.hyperparams)
    if options.game_steps is not None:
        overrides["game_steps"] = options.game_steps
    varied = {name for view in experiment.views for level in view.levels for name in level.env_kwargs}
    if env_kwargs := {**(overrides.get("env_kwargs") or {}), **options.env_kwargs}:
        overrides["env_kwargs"] = env_kwargs
    for name in env_kwargs:
        if name in varied:
            raise ValueError(f"{name} is what the experiment varies; leave it out of --env-kwargs")
    size = _size(options)
    given = {name: getattr(options, name) for name in _SMOKE if getattr(options, name) is not None}
    return RunConfig(size, overrides, **((_SMOKE if size == "smoke" else {}) | given))


def _engine(options: argparse.Namespace) -> Engine:
    """Return the engine that runs cells; ValueError if Ray is requested and not installed, or not running."""
    if not (options.ray or options.address is not None):
        # A batch system may have limited the cores of this process.
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        return LocalEngine(options.workers or max(1, cores // options.threads), options.threads)
    if options.cpus_per_cell <= 0:
        raise ValueError(f"--cpus-per-cell must be above 0, got {options.cpus_per_cell:g}")
    return RayEngine(options.address, options.cpus_per_cell, options.gpus_per_cell, options.workers)


# Commands


def _list(options: argparse.Namespace) -> int:
    for experiment in EXPERIMENTS.values():
        print(f"{experiment.name:<19}{experiment.question}")
        tasks = ", ".join(env.removesuffix("-v0") for env in experiment.envs)
        for line in (f"{', '.join(experiment.methods)} on {tasks}", *map(str, experiment.views)):
            print(f"{'':<19}  {line}")
    return 0


def _plan(options: argparse.Namespace) -> int:
    from sb3_saf.experiments.run import make_plan

    experiment, results, selection = _subject(options)
    print(make_plan(experiment, selection, _config(options, experiment), results, Shard.parse(options.shard)))
    return 0


def _run(options: argparse.Namespace) -> int:
    experiment, results, selection = _subject(options)
    require("pandas")
    from sb3_saf.experiments.run import CellOptions, run

    config, shard = _config(options, experiment), Shard.parse(options.shard)
    how = CellOptions(
        check_device(options.device), options.threads, options.retries, options.tensorboard, options.resume
    )
    try:
        with handled({signal.SIGTERM}, signal.default_int_handler):  # batch systems send it before they kill
            summary = run(experiment, selection, config, results, _engine(options), how, shard)
    except KeyboardInterrupt:
        print(
            "\ninterrupted: workers have ended, finished cells and checkpoints are kept; the same command continues",
            file=sys.stderr,
        )
        raise
    print(f"table: {results.folder / experiment.name / 'runs.csv'}")
    if summary.failed:
        print(f"{len(summary.failed)} cells failed; the same command tries them again", file=sys.stderr)
        return 1
    print(f"next: {python_command(MODULE)} report {experiment.name} -f {results.folder}")
    return 0


def _report(options: argparse.Namespace) -> int:
    experiment, results, selection = _subject(options)
    name = experiment.name
    require("pandas", "matplotlib", "rliable")
    remedy = f"run it first: {python_command(MODULE)} run {name} --size {_size(options)} -f {results.folder}"
    if results.config() is None or not results.selections(name):
        damaged = "".join(f" ({error})" for error in results.damaged.values())
        raise ValueError(f"{results.folder} has no results of {name!r}{damaged}; name another with -f, or {remedy}")
    from sb3_saf.experiments.report import write_report
    from sb3_saf.experiments.tables import read_results

    report = write_report(experiment, results, selection, [read_results(path, name) for path in options.beside])
    print(f"page: {results.folder / name / 'report.md'}")
    print(f"figures: {', '.join(report.figures)}")
    if report.missing:
        print(f"{len(report.missing)} of {len(report.cells)} cells are missing; the page names them", file=sys.stderr)
    return 0


def _check(options: argparse.Namespace) -> int:
    from sb3_saf.experiments.cell import check_cell

    check = check_cell(options.cell, check_device(options.device))
    if check.equal:
        print(f"equal, bit for bit: {', '.join(check.equal)}")
    for difference in check.different:
        print(f"different: {difference}")
    if check.software:
        print(f"software has changed: {check.software}")
    return 1 if check.different else 0


def _publish(options: argparse.Namespace) -> int:
    require("pandas")
    from sb3_saf.experiments.tables import publish

    for name in publish(options.folder, options.target, options.only):
        print(options.target / name)
    return 0


def _teams(options: argparse.Namespace) -> int:
    failed = 0
    for name in team_names(options.folder):
        try:
            missing = missing_package(name, options.folder)
            print(f"{name}: not played, {missing}" if missing else check_team(name, options.folder))
        except ValueError as error:
            failed = 1
            print(error, file=sys.stderr)
    return failed


def _cell(options: argparse.Namespace) -> int:
    from sb3_saf.experiments.cell import run_job

    if options.until_stdin_closes:
        threading.Thread(target=_end_with_stdin, daemon=True).start()
    run_job(options.cell)
    return 0


def _end_with_stdin() -> None:
    """End this process when its parent has ended for any reason."""
    while os.read(0, 1024):
        pass
    os._exit(1)
