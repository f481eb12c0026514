"""
Folder of results (``docs/experiments.md``, "Cells"): cells, each a folder of a run, which appears at once when the cell
is finished, the configuration of all cells, and for each experiment what was requested, for missing cells in reports.
"""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import filelock
import msgspec
import numpy as np

from sb3_saf.evaluation import EvaluationResult
from sb3_saf.experiments.definitions import (
    EXPERIMENTS,
    Cell,
    Experiment,
    Level,
    RunConfig,
    Selection,
    own_experiment,
)
from sb3_saf.teams.checks import unknown_name
from sb3_saf.teams.files import differences, plain, read_json, try_lock, write_json, write_text
from sb3_saf.training.folders import CURVE, RUN_FILE, Run, finish_run

MODEL: Final = "model.zip"
BEST_MODEL: Final = "best_model.zip"
EVALUATIONS: Final = "evaluations.csv"
#: Tested policies, and how they act. Untrained teams have one, the best.
BEST, LAST, DRAWN, MOST_LIKELY = "best", "last", "drawn", "most likely"
T = TypeVar("T")


@dataclass(frozen=True)
class Play:
    """
    Test of a policy: what was measured. Means, intervals and rates are computed from it.

    :param policy: :data:`BEST` or :data:`LAST`
    :param actions: :data:`DRAWN` or :data:`MOST_LIKELY`
    :param returns: team return of each episode
    :param lengths: game steps of each episode
    :param successes: whether each episode was won; empty if the games do not report it
    :param agent_means: mean own return of each agent
    """

    policy: str
    actions: str
    returns: list[float]
    lengths: list[int]
    successes: list[bool]
    agent_means: list[float]
    wall_seconds: float

    @property
    def evaluation(self) -> EvaluationResult:
        """Mean, interval and success rate."""
        return EvaluationResult(self.returns, self.lengths, tuple(self.successes))


@dataclass(frozen=True)
class LevelResult:
    """
    Tests at a level.

    :param max_return: the largest possible team return, if known
    :param plays: tests; the first is the primary one, of the best policy with actions as in training
    """

    level: dict[str, Any]
    n_agents: int
    max_return: int | None
    plays: list[Play]

    @property
    def evaluation(self) -> EvaluationResult:
        """Absolute metric: the primary test."""
        return self.plays[0].evaluation


def write_evaluations(folder: Path) -> None:
    """Replace ``evaluations.npz`` of a run by ``evaluations.csv``: a row for each evaluation, with exact floats."""
    path = folder / "evaluations.npz"
    if not path.exists():  # done before
        return
    lines = ["game_steps,return_mean,success_rate,length_mean,returns"]
    with np.load(path, allow_pickle=False) as arrays:
        steps, returns, lengths = arrays["game_steps"], arrays["results"], arrays["ep_lengths"]
        won = arrays["successes"].mean(axis=1).tolist() if "successes" in arrays else [""] * len(steps)
    for step, episodes, rate, length in zip(steps.tolist(), returns.tolist(), won, lengths.mean(axis=1), strict=True):
        episode_returns = " ".join(f"{value:.12g}" for value in episodes)
        lines.append(f"{step},{float(np.mean(episodes))!r},{rate},{float(length)!r},{episode_returns}")
    write_text(folder / EVALUATIONS, "\n".join(lines) + "\n")
    path.unlink()


@dataclass(frozen=True)
class _OwnExperiment:
    envs: list[str]
    vary: dict[str, list[Any]]


class Results:
    """Folder of results. Damaged files count as missing, and are recorded in :attr:`damaged`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        #: Errors of damaged files, by file or by cell's folder.
        self.damaged: dict[Path, str] = {}

    def _read(self, path: Path, kind: type[T]) -> T | None:
        """Return the content of a file; None if it is missing or invalid."""
        if not path.exists():
            return None
        try:
            return msgspec.convert(read_json(path), kind)
        except ValueError as error:
            self.damaged[path] = str(error) if str(path) in str(error) else f"{path}: {error}"
            return None

    # Settings

    def config(self) -> RunConfig | None:
        """Return the configuration of the folder's cells; None for a folder without results."""
        return self._read(self.folder / "settings.json", RunConfig)

    def agree(self, config: RunConfig, cells: Iterable[Cell] = ()) -> None:
        """Check that the folder and its finished cells have these settings; the ValueError contains the differences."""
        stored = self.config()
        if stored is not None and (changed := differences(plain(asdict(stored)), plain(asdict(config)))):
            raise ValueError(
                f"the results in {self.folder} have other settings: {changed}; run with theirs, or choose another "
                "folder with -f"
            )
        for cell in cells:
            if (run := self.run(cell)) is None:
                continue
            wanted = config.describe(cell)
            if changed := differences({name: run.description[name] for name in wanted}, wanted):
                raise ValueError(
                    f"{run.folder} was trained with other settings: {changed}; restore them, delete that cell, or "
                    "choose another folder with -f"
                )

    def save_config(self, config: RunConfig) -> None:
        """Write the configuration of the folder's cells, unless it exists."""
        if self.config() is None:
            write_json(self.folder / "settings.json", asdict(config))

    # Finished cells

    def cell_folder(self, cell: Cell) -> Path:
        """Return the folder of a cell, which may not exist yet."""
        return self.folder / "cells" / cell.id

    def run(self, cell: Cell) -> Run | None:
        """Return the run of a finished cell; None if it is missing, or its files have changed since."""
        run = Run(self.cell_folder(cell))
        if not run.folder.exists():
            return None
        try:
            kinds = {"wall_seconds": float, "processor_seconds": float}
            wrong = [name for name, kind in kinds.items() if not isinstance(run.finished().get(name), kind)]
            damage = [f"{run.folder} has no {name}" for name in wrong]
            files = (RUN_FILE, MODEL, BEST_MODEL, CURVE, EVALUATIONS) if cell.is_trained else (RUN_FILE,)
            damage += [text for name in files if (text := run.damage(name)) is not None]
            assert damage or run.description
        except ValueError as error:
            damage = [str(error)]
        if damage:
            self.damaged[run.folder] = "; ".join(damage)
            return None
        return run

    def test(self, cell: Cell, level: Level) -> LevelResult | None:
        """Return the result of a test; None before it, or if its file has changed since."""
        run, name = self.run(cell), f"tests/{level.slug}.json"
        if run is None or name not in run.finished()["files"]:
            return None
        path = run.folder / name
        if (damage := run.damage(name)) is not None:
            self.damaged[path] = damage
            return None
        result = self._read(path, LevelResult)
        if result is None:
            return None
        n_episodes = run.description["options"]["episodes"]
        for returns in [play.returns for play in result.plays] or [[]]:
            if len(returns) != n_episodes or not all(map(math.isfinite, returns)):
                self.damaged[path] = f"{path} must have {n_episodes} finite returns, got {returns}"
                return None
        return result

    def missing_tests(self, cell: Cell) -> tuple[Level, ...]:
        """Return the levels at which a cell has not been tested; all of them if it is not trained."""
        return tuple(level for level in cell.tests if self.test(cell, level) is None)

    # Running cells

    def unfinished(self, cell: Cell) -> Path:
        """Return the working folder of a cell, which keeps its checkpoints if it is killed."""
        return self.folder / "unfinished" / cell.id

    def failure(self, cell: Cell) -> Path | None:
        """Return the file with the error of a failed cell; None if it has not failed."""
        path = self.unfinished(cell) / "error.txt"
        return path if path.exists() else None

    def lock(self, cell: Cell) -> filelock.BaseFileLock | None:
        """Lock a cell against other runs; None if another run has the lock. It is released at the process's end."""
        return try_lock(self.folder / ".locks" / f"{cell.id.replace('/', '_')}.lock")

    def publish(self, cell: Cell) -> None:
        """Move the result of an attempt to the cell's folder: a new folder, or further tests of a finished one."""
        result, target = self.unfinished(cell) / "result", self.cell_folder(cell)
        if (run := self.run(cell)) is not None:
            (target / "tests").mkdir(exist_ok=True)
            for name in [f"tests/{path.name}" for path in target.glob("tests/*")]:
                if run.damage(name) is not None:  # or finish_run would take it for what was tested
                    (target / name).unlink()
            for path in (result / "tests").iterdir():
                os.replace(path, target / "tests" / path.name)
            finish_run(target)
        else:
            target.parent.mkdir(parents=True, exist_ok=True)
            if target.exists():  # damaged; if interrupted between these lines, the cell is run again
                kept = self.folder / "damaged" / f"{cell.id}_{time.time_ns()}"
                kept.parent.mkdir(parents=True, exist_ok=True)
                os.replace(target, kept)
            if (log := self.unfinished(cell) / "log.txt").exists() and log.stat().st_size:  # warnings of resumptions
                os.replace(log, result / log.name)
                finish_run(result)
            os.replace(result, target)
        folder = self.unfinished(cell)
        shutil.rmtree(folder, ignore_errors=True)
        for parent in folder.parents[: len(Path(cell.id).parts)]:
            with suppress(OSError):  # not empty: other cells are running
                parent.rmdir()

    # Requested selections

    def add_selection(self, experiment: Experiment, selection: Selection) -> None:
        """Store a requested selection."""
        folder = self.folder / experiment.name / "selections"
        if experiment.name not in EXPERIMENTS:
            write_json(folder.parent / "experiment.json", _own(experiment))
        content = plain(asdict(selection))
        name = hashlib.sha256(repr(content).encode()).hexdigest()[:12]
        write_json(folder / f"{name}.json", content)

    def selections(self, experiment: str) -> list[Selection]:
        """Return all requested selections."""
        paths = sorted((self.folder / experiment / "selections").glob("[!.]*.json"))
        return sorted((one for path in paths if (one := self._read(path, Selection)) is not None), key=astuple)

    def check_experiment(self, experiment: Experiment) -> None:
        """Check that no other experiment has the same name here; the ValueError contains the differences."""
        stored = self._read(self.folder / experiment.name / "experiment.json", _OwnExperiment)
        if stored is not None and (changed := differences(asdict(stored), _own(experiment))):
            raise ValueError(
                f"{self.folder} has another experiment {experiment.name!r}: {changed}; write another name before --env"
            )

    def experiment(self, name: str) -> Experiment:
        """Return an experiment of the paper, or a user's one in this folder; ValueError names the nearest one."""
        if name in EXPERIMENTS:
            return EXPERIMENTS[name]
        path = self.folder / name / "experiment.json"
        stored = self._read(path, _OwnExperiment)
        if path in self.damaged:
            raise ValueError(f"{self.damaged[path]}; the same run command writes it anew")
        if stored is not None:
            return own_experiment(name, stored.envs, stored.vary)
        own = [path.parent.name for folder in ("", "../*/") for path in self.folder.glob(f"{folder}*/experiment.json")]
        raise unknown_name("experiment", name, [one for one in (*own, *EXPERIMENTS) if one != name])


def _own(experiment: Experiment) -> dict[str, Any]:
    """Return a user's experiment as plain data."""
    return plain({"envs": experiment.envs, "vary": experiment.vary})
