"""What happens in a worker process: one cell is trained and tested, and its files come back as an archive."""

from __future__ import annotations

import contextlib
import shlex
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import set_random_seed

from sb3_saf import RandomPolicy, evaluate_team, resumable_learn
from sb3_saf.checkpoints.store import CheckpointFolder
from sb3_saf.experiments.cells import Cell, Protocol
from sb3_saf.experiments.definitions import Level
from sb3_saf.experiments.files import pack, read_json, to_json, write_text
from sb3_saf.experiments.results import FINISHED, config_of
from sb3_saf.training.commands import option_words
from sb3_saf.training.inspection import inspection
from sb3_saf.training.seeds import evaluation_seed
from sb3_saf.training.versions import software_versions

#: Points of a learning curve at most.
CURVE_POINTS: Final = 100
#: Checkpoints of a training, from which another worker goes on if this one is killed.
CHECKPOINTS: Final = 20


@dataclass(frozen=True)
class Work:
    """
    What one worker is to do.

    :param cell: to train and test
    :param protocol: how
    :param tests: levels to test at
    :param model: the file of a model that is trained already; None to train
    :param device: as SB3 takes it
    :param threads: of torch
    :param tensorboard: whether to keep TensorBoard logs of the training
    :param scratch: folder for unfinished files; None for the machine's temporary folder
    :param unfinished: folder that outlives this worker, for checkpoints from which another one goes on; None for none
    """

    cell: Cell
    protocol: Protocol
    tests: tuple[Level, ...]
    model: bytes | None = None
    device: str = "auto"
    threads: int = 1
    tensorboard: bool = False
    scratch: str | None = None
    unfinished: str | None = None


def do(work: Work) -> bytes:
    """
    Train, unless the model is there, and test.

    :return: an archive of the cell's folder, or of its new tests alone
    """
    th.set_num_threads(work.threads)
    with tempfile.TemporaryDirectory(dir=work.scratch, prefix="cell-") as name:
        folder = Path(name)
        with (folder / "log.txt").open("w", encoding="utf-8") as log, contextlib.ExitStack() as stack:
            stack.enter_context(contextlib.redirect_stdout(log))
            stack.enter_context(contextlib.redirect_stderr(log))
            _fill(folder, work)
        if not (folder / "log.txt").stat().st_size:
            (folder / "log.txt").unlink()
        return pack(folder)


def _fill(folder: Path, work: Work) -> None:
    cell, protocol = work.cell, work.protocol
    started, clock = time.strftime("%Y-%m-%dT%H:%M:%S%z"), time.perf_counter()
    model: BaseAlgorithm | None = None
    if cell.is_trained:
        model = _load(work, folder) if work.model is not None else _train(work, folder)
    seconds = time.perf_counter() - clock
    (folder / "tests").mkdir()
    for level in work.tests:
        _write(folder / "tests" / f"{level.slug}.json", to_json(play(cell, protocol, level, model)))
    if work.model is None:
        _write(folder / "config.json", to_json(config_of(cell, protocol)))
        _write(folder / "versions.json", to_json(versions(model)))
        status = {"state": FINISHED, "started": started, "wall_seconds": seconds, "threads": work.threads}
        _write(folder / "status.json", to_json(status))
        if cell.is_trained:
            _write(folder / "command.txt", command(cell, protocol) + "\n")


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _train(work: Work, folder: Path) -> BaseAlgorithm:
    """A trained model, which leaves its file and its learning curve."""
    settings = work.protocol.settings(work.cell)
    with _training_folder(work) as place:
        env = settings.make_env(work.cell.seed, monitor_dir=place)
        logs = str(place / "tb") if work.tensorboard else None
        model = settings.make_model(env, work.cell.seed, device=work.device, tensorboard_log=logs)
        look = inspection(settings, work.cell.seed) if work.tensorboard else None
        resumable_learn(
            model,
            settings.total_timesteps,
            place / "checkpoints",
            look,
            every_game_steps=max(1, settings.game_steps // CHECKPOINTS),
            keep=2,
            tb_log_name=work.cell.method,
        )
        env.close()
        if look is not None:
            look.eval_env.close()
        # Of monitor.csv, hundreds of thousands of lines at the paper's size, the curve is kept.
        _write(folder / "curve.csv", curve(place / "monitor.csv", settings.n_envs))
        if work.tensorboard:
            shutil.copytree(place / "tb", folder / "tb")
    model.save(folder / "model.zip")
    return model


@contextlib.contextmanager
def _training_folder(work: Work) -> Iterator[Path]:
    """Where training writes; a folder that outlives this worker is emptied if it is not of the same settings."""
    if work.unfinished is None:
        with tempfile.TemporaryDirectory(dir=work.scratch, prefix="training-") as name:
            yield Path(name)
        return
    folder, config = Path(work.unfinished), config_of(work.cell, work.protocol)
    if not _can_go_on(folder, config):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        write_text(folder / "config.json", to_json(config))
    yield folder


def _can_go_on(folder: Path, config: dict[str, Any]) -> bool:
    try:
        return (
            read_json(folder / "config.json") == config
            and CheckpointFolder(folder / "checkpoints").newest() is not None
        )
    except ValueError as error:  # no checkpoint can be read, or this version cannot
        print(f"Beginning anew: {error}")
        return False


def _load(work: Work, folder: Path) -> BaseAlgorithm:
    """The model that was trained before; only numbers are taken from its file."""
    assert work.model is not None
    settings = work.protocol.settings(work.cell)
    env = settings.make_env(work.cell.seed)
    model = settings.make_model(env, work.cell.seed, device=work.device)
    path = folder / "trained.zip"
    path.write_bytes(work.model)
    model.set_parameters(str(path), device=work.device)
    path.unlink()
    return model


def curve(monitor: Path, n_games: int) -> str:
    """
    Condense the training episodes: the mean team return of equal stretches of game steps.

    :param monitor: a TeamMonitor's file, in the order in which episodes ended
    :param n_games: E; a stretch has at least so many episodes
    :return: CSV of the game steps at the end of each stretch, the mean return, and the number of episodes
    """
    episodes = np.atleast_1d(np.genfromtxt(monitor, delimiter=",", skip_header=1, names=True))
    if not episodes.size:
        return "game_steps,mean_return,episodes\n"
    lines = ["game_steps,mean_return,episodes"]
    game_steps = np.cumsum(episodes["l"]).astype(np.int64)
    for part in np.array_split(np.arange(len(episodes)), _points(len(episodes), n_games)):
        lines.append(f"{game_steps[part[-1]]},{float(episodes['r'][part].mean())!r},{len(part)}")
    return "\n".join(lines) + "\n"


def _points(n_episodes: int, n_games: int) -> int:
    return max(1, min(CURVE_POINTS, n_episodes // n_games))


def play(cell: Cell, protocol: Protocol, level: Level, model: BaseAlgorithm | None) -> dict[str, Any]:
    """
    Test at a level; the games depend on the cell's seed and the level alone, so all methods play the same ones.

    :param model: None for a random team
    :return: plain data
    """
    settings = protocol.settings(cell, level)
    clock = time.perf_counter()
    env = settings.make_env(cell.seed, evaluation=True, n_envs=protocol.episodes)
    # Sampled actions must depend neither on the training nor on other tests.
    set_random_seed(cell.seed)
    player: Any = RandomPolicy(env.action_space, seed=cell.seed) if model is None else model
    deterministic = protocol.deterministic or not settings.spec.draws_actions
    result = evaluate_team(player, env, protocol.episodes, deterministic)
    env.close()
    low, high = result.interval()
    return {
        "coordination": level.coordination,
        "heterogeneity": level.heterogeneity,
        "n_agents": settings.n_agents,
        "n_treasures": settings.env_kwargs["n_treasures"],
        "evaluation_seed": evaluation_seed(cell.seed),
        "return_mean": result.mean,
        "return_low": low,
        "return_high": high,
        "returns": result.returns,
        "wall_seconds": time.perf_counter() - clock,
    }


def command(cell: Cell, protocol: Protocol) -> str:
    """The command that trains a cell again."""
    settings = protocol.settings(cell)
    words = ["python", "-m", "sb3_saf.train", "--algo", cell.method, "--env", settings.env_id]
    words += ["--size", protocol.size, "--seed", str(cell.seed)]
    env_kwargs = {**protocol.overrides.get("env_kwargs", {}), **cell.env_kwargs(cell.level)}
    own = {key: value for key, value in protocol.overrides.items() if key not in ("env_kwargs", "game_steps")}
    words += [*option_words("--env-kwargs", env_kwargs), *option_words("--hyperparams", own)]
    if "game_steps" in protocol.overrides:
        words += ["--game-steps", str(protocol.overrides["game_steps"])]
    return shlex.join(words)


def versions(model: BaseAlgorithm | None) -> dict[str, str]:
    """What a cell ran on."""
    device = {} if model is None else {"device": str(model.device)}
    return {**software_versions(), **device, "host": socket.gethostname(), "commit": _commit()}


def _commit() -> str:
    """The checkout's commit, if this runs from one."""
    try:
        result = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
            timeout=10,
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return result.stdout.strip()
