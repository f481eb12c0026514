"""Worker code: training and testing of one cell in the folder of its job."""

from __future__ import annotations

import contextlib
import shlex
import shutil
import socket
import subprocess
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import set_random_seed

from sb3_saf import RandomPolicy, evaluate_team
from sb3_saf.checkpoints.store import CheckpointFolder
from sb3_saf.experiments.definitions import Level
from sb3_saf.experiments.files import plain, read_json, write_json
from sb3_saf.experiments.grid import Cell, RunConfig
from sb3_saf.teams.checks import evaluation_seed
from sb3_saf.teams.errors import CheckpointError
from sb3_saf.teams.vec_env import require_n_agents
from sb3_saf.training.folders import software_versions
from sb3_saf.training.run import CHECKPOINTS, RunOptions, load_parameters, train

#: Maximum number of points of a learning curve.
CURVE_POINTS: Final = 100
#: Checkpoints of a training, from which another worker continues if this one is killed.
CHECKPOINTS_PER_CELL: Final = 20


@dataclass(frozen=True)
class Job:
    """
    Job of a worker.

    :param cell: cell to train, unless the folder has its model, and to test
    :param config: configuration of the run
    :param device: as in SB3
    :param threads: threads of torch
    :param tensorboard: whether to keep TensorBoard logs of the training
    """

    cell: Cell
    config: RunConfig
    device: str = "auto"
    threads: int = 1
    tensorboard: bool = False

    def write(self, folder: Path) -> None:
        """Write the job into its folder."""
        write_json(folder / "job.json", {**plain(asdict(self)), "cell": plain(self.cell.as_dict())})

    @classmethod
    def read(cls, folder: Path) -> Job:
        """Read the job of a folder; ValueError if there is none."""
        content = read_json(folder / "job.json")
        if content is None:
            raise ValueError(f"there is no job.json in {folder}; expected an unfinished cell of `experiments run`")
        return cls(
            **{**content, "cell": Cell.from_dict(content["cell"]), "config": RunConfig(**content["config"])},
        )


def run_job(folder: Path) -> None:
    """
    Do the job in ``FOLDER/job.json``: train, unless ``FOLDER/model.zip`` exists, and test.

    A killed job continues on the next call from the last checkpoint in ``FOLDER/training``.

    :param folder: folder of the job; the finished cell, or only its further tests, are written to ``FOLDER/result``
    """
    job = Job.read(folder)
    th.set_num_threads(job.threads)
    result = folder / "result"
    shutil.rmtree(result, ignore_errors=True)
    (result / "tests").mkdir(parents=True)
    cell, model = job.cell, None
    if (folder / "model.zip").exists():
        model = _load(job, folder / "model.zip")
    else:
        if cell.is_trained:
            model = _train(job, folder / "training", result)
        _describe(job, result, model)
    for level in cell.tests:
        write_json(result / "tests" / f"{level.slug}.json", play(cell, job.config, level, model))


def _train(job: Job, folder: Path, result: Path) -> BaseAlgorithm:
    """Train a model and write its files to the result, or load it if it was finished before."""
    settings = job.config.settings(job.cell)
    status = folder / "status.json"
    if status.exists():
        model = _load(job, folder / "model.zip")
    else:
        started = time.strftime("%Y-%m-%dT%H:%M:%S%z")
        clock = TrainingClock(settings.game_steps / (2 * CURVE_POINTS))
        _forget_unreadable(folder)
        options = RunOptions(
            checkpoint_freq=max(1, settings.game_steps // CHECKPOINTS_PER_CELL),
            tensorboard_log=folder / "tb" if job.tensorboard else None,
            device=job.device,
        )
        model = train(settings, job.cell.seed, folder, options, [clock])
        # Only the curve of monitor.csv is kept, which has hundreds of thousands of lines at the paper's size.
        (folder / "curve.csv").write_text(curve(folder / "monitor.csv", clock.points, settings.n_envs))
        _, processor, wall = clock.points[-1]
        seconds = {"wall_seconds": float(wall), "processor_seconds": float(processor)}
        write_json(status, {"started": started, **seconds, "threads": job.threads})
    for name in ("status.json", "curve.csv", "model.zip"):
        shutil.copy(folder / name, result / name)
    if job.tensorboard:
        shutil.copytree(folder / "tb", result / "tb")
    return model


def _forget_unreadable(folder: Path) -> None:
    """Remove the training if this version cannot read any of its checkpoints."""
    try:
        CheckpointFolder(folder / CHECKPOINTS).newest()
    except CheckpointError as error:
        print(f"Beginning anew: {error}")
        shutil.rmtree(folder)


def _load(job: Job, path: Path) -> BaseAlgorithm:
    """Return the model that was trained before; only numbers are read from its file."""
    settings = job.config.settings(job.cell)
    env = settings.make_env(job.cell.seed)
    model = settings.make_model(env, job.cell.seed, device=job.device)
    load_parameters(model, path)
    env.close()
    return model


def _describe(job: Job, result: Path, model: BaseAlgorithm | None) -> None:
    """Write a cell's description, software versions and, for a random team, zero cost."""
    write_json(result / "cell.json", job.cell.as_dict())
    write_json(result / "config.json", job.config.describe(job.cell))
    write_json(result / "versions.json", versions(model))
    if model is None:
        write_json(result / "status.json", {"wall_seconds": 0.0, "processor_seconds": 0.0, "threads": job.threads})
    else:
        (result / "command.txt").write_text(command(job.cell, job.config) + "\n", encoding="utf-8")


class TrainingClock(BaseCallback):
    """
    Record processor time and wall time against game steps, also over resumed trainings.

    :param every_game_steps: minimum game steps between two points
    """

    def __init__(self, every_game_steps: float) -> None:
        super().__init__()
        self.every_game_steps = every_game_steps
        self._points: list[tuple[float, float, float]] = []
        self._before = (0.0, 0.0)
        self._started = (0.0, 0.0)

    @property
    def points(self) -> npt.NDArray[np.float64]:
        """Game steps, processor seconds of this process, and wall seconds since the start, (K, 3)."""
        return np.array(self._points, dtype=np.float64).reshape(-1, 3)

    def _on_training_start(self) -> None:
        self._started = (time.process_time(), time.perf_counter())

    def _on_rollout_start(self) -> None:
        # Rollouts of off-policy algorithms are a few steps each.
        if not self._points or self._game_steps() >= self._points[-1][0] + self.every_game_steps:
            self._record()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self._record()

    def _record(self) -> None:
        self._points.append((self._game_steps(), *self._seconds()))

    def _game_steps(self) -> float:
        return self.num_timesteps / require_n_agents(self.training_env)

    def _seconds(self) -> tuple[float, float]:
        now = (time.process_time(), time.perf_counter())
        processor, wall = (b + n - s for b, n, s in zip(self._before, now, self._started, strict=True))
        return processor, wall

    def checkpoint_state(self) -> dict[str, Any]:
        """Return the points and the time until now, as plain data."""
        return {"points": self.points, "seconds": np.array(self._seconds())}

    def load_checkpoint_state(self, state: dict[str, Any]) -> None:
        """Restore a state of :meth:`checkpoint_state`."""
        self._points = [(float(a), float(b), float(c)) for a, b, c in state["points"]]
        self._before = (float(state["seconds"][0]), float(state["seconds"][1]))


def curve(monitor: Path, clock: npt.NDArray[np.float64], n_games: int) -> str:
    """
    Condense the training episodes to mean team returns over equal intervals of game steps.

    :param monitor: a TeamMonitor's file, in the order in which episodes ended
    :param clock: points of a :class:`TrainingClock`
    :param n_games: E, minimum episodes of an interval
    :return: CSV of the game steps and the processor seconds at each interval's end, mean return, and number of episodes
    """
    episodes = np.atleast_1d(np.genfromtxt(monitor, delimiter=",", skip_header=1, names=True))
    lines = ["game_steps,processor_seconds,mean_return,episodes"]
    if episodes.size:
        game_steps = np.cumsum(episodes["l"]).astype(np.int64)
        n_points = max(1, min(CURVE_POINTS, len(episodes) // n_games))
        for part in np.array_split(np.arange(len(episodes)), n_points):
            end = game_steps[part[-1]]
            seconds = np.interp(end, clock[:, 0], clock[:, 1])
            lines.append(f"{end},{seconds:.3f},{float(episodes['r'][part].mean())!r},{len(part)}")
    return "\n".join(lines) + "\n"


def play(cell: Cell, config: RunConfig, level: Level, model: BaseAlgorithm | None) -> dict[str, Any]:
    """
    Test at a level; the games depend on the cell's seed and the level only, so all methods play the same ones.

    :param model: None for a random team
    :return: plain data
    """
    settings = config.settings(cell, level)
    clock = time.perf_counter()
    env = settings.make_env(cell.seed, evaluation=True, n_envs=config.episodes)
    # Sampled actions must not depend on the training or on other tests.
    set_random_seed(cell.seed)
    player: Any = RandomPolicy(env.action_space, seed=cell.seed) if model is None else model
    deterministic = config.deterministic or not settings.spec.draws_actions
    result = evaluate_team(player, env, config.episodes, deterministic)
    env.close()
    low, high = result.interval()
    return {
        "level": level.env_kwargs,
        "n_agents": settings.n_agents,
        "max_return": settings.env_kwargs.get("n_treasures"),
        "evaluation_seed": evaluation_seed(cell.seed),
        "return_mean": result.mean,
        "return_low": low,
        "return_high": high,
        "returns": result.returns,
        "success_rate": result.success_rate,
        "wall_seconds": time.perf_counter() - clock,
    }


def command(cell: Cell, config: RunConfig) -> str:
    """Return the command that trains a cell again."""
    words = ["python", "-m", "sb3_saf.train", "--algo", cell.method, "--env", cell.env]
    return shlex.join([*words, *config.words(cell.level), "--seed", str(cell.seed)])


def versions(model: BaseAlgorithm | None) -> dict[str, str]:
    """Return the software versions and hardware of a cell."""
    device = {} if model is None else {"device": str(model.device)}
    return {**software_versions(), **device, "host": socket.gethostname(), "commit": _commit()}


def _commit() -> str:
    """Return the commit of the checkout, if there is one."""
    words = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        done = subprocess.run(words, cwd=Path(__file__).parent, capture_output=True, text=True, check=True, timeout=10)
        return done.stdout.strip()
    return "unknown"
