"""
Folder of results. A finished cell is one folder, which is created atomically.

    settings.json                    configuration of all cells
    cells/TeamTogether-c2-h1/saf/seed-0/
        cell.json  config.json       the cell; everything that determines its result
        command.txt                  command that reproduces it
        versions.json  status.json   commit and software; cost
        curve.csv  model.zip         returns of the training episodes; the model
        tests/c2-h1.json             returns of the test episodes
    unfinished/TeamTogether-c2-h1/saf/seed-1/
        job.json  training/          the job; checkpoints and monitor of the training
        error.txt  log.txt           error and log of the last attempt
    coordination/experiment.json     a user's experiment
    coordination/selections/*.json   requested selections, for missing cells in reports
    coordination/table.csv           one row per cell and test level, made from the cells
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, astuple
from pathlib import Path
from typing import Any, Final

import filelock

from sb3_saf.experiments.definitions import EXPERIMENTS, Experiment, Level, find_experiment, own_experiment
from sb3_saf.experiments.files import differences, plain, read_json, write_json
from sb3_saf.experiments.grid import Cell, RunConfig, Selection

Types = Mapping[str, type | tuple[type, ...]]

#: Required entries of files with their types.
_SETTINGS: Final[Types] = {"size": str, "overrides": dict, "episodes": int, "deterministic": bool}
_STATUS: Final[Types] = {"wall_seconds": float, "processor_seconds": float}
_SELECTION: Final[Types] = {"seeds": list, "methods": list, "envs": list, "levels": list}
_TEST: Final[Types] = {
    **{"level": dict, "n_agents": int, "max_return": (int, type(None)), "evaluation_seed": int},
    **{"returns": list, "return_mean": float, "return_low": float, "return_high": float, "wall_seconds": float},
}


class Results:
    """
    Folder of results. Damaged files count as missing, and are recorded in :attr:`damaged`.

    :param folder: created at the first write
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        #: Errors of damaged files, by file.
        self.damaged: dict[Path, str] = {}

    def _read(self, path: Path, types: Types) -> dict[str, Any] | None:
        """Return the content of a file; None if it is missing or invalid."""
        try:
            content = read_json(path)
            wrong = [name for name, kind in types.items() if content and not isinstance(content.get(name), kind)]
            if wrong or content == {}:
                raise ValueError(f"{path} has no {', '.join(wrong or types)}")
        except ValueError as error:
            self.damaged[path] = str(error)
            return None
        return content

    # Settings

    def config(self) -> RunConfig | None:
        """Return the configuration of the folder's cells; None for a folder without results."""
        stored = self._read(self.folder / "settings.json", _SETTINGS)
        return None if stored is None else RunConfig(**{name: stored[name] for name in _SETTINGS})

    def agree(self, config: RunConfig, cells: Iterable[Cell] = ()) -> None:
        """Check that the folder and its finished cells have these settings; the ValueError contains the differences."""
        stored = self.config()
        if stored is not None and plain(asdict(stored)) != plain(asdict(config)):
            changed = differences(asdict(stored), plain(asdict(config)))
            raise ValueError(
                f"the results in {self.folder} have other settings: {changed}; run with theirs, or choose another "
                "folder with -f"
            )
        for cell in cells:
            if self.is_finished(cell) and (found := self.cell_config(cell)) != (wanted := config.describe(cell)):
                raise ValueError(
                    f"{self.cell_folder(cell)} was trained with other settings: {differences(found, wanted)}; restore "
                    "them, delete that cell, or choose another folder with -f"
                )

    def save_config(self, config: RunConfig) -> None:
        """Write the configuration of the folder's cells, unless it exists."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.config() is None:
            write_json(self.folder / "settings.json", plain(asdict(config)))

    # Finished cells

    def cell_folder(self, cell: Cell) -> Path:
        """Return the folder of a cell, which may not exist yet."""
        return self.folder / "cells" / cell.id

    def status(self, cell: Cell) -> dict[str, Any] | None:
        """Return the cost of a cell; None if it is not finished."""
        return self._read(self.cell_folder(cell) / "status.json", _STATUS)

    def cell_config(self, cell: Cell) -> dict[str, Any]:
        """Return the settings of a trained cell; empty before training."""
        return self._read(self.cell_folder(cell) / "config.json", {"algo": str}) or {}

    def versions(self, cell: Cell) -> dict[str, str]:
        """Return the software and hardware of a trained cell; empty before training."""
        return self._read(self.cell_folder(cell) / "versions.json", {"python": str}) or {}

    def is_finished(self, cell: Cell) -> bool:
        """Return whether a cell is trained."""
        return self.status(cell) is not None and bool(self.cell_config(cell))

    def test(self, cell: Cell, level: Level) -> dict[str, Any] | None:
        """Return the result of a test; None before it."""
        path = self.cell_folder(cell) / "tests" / f"{level.slug}.json"
        found = self._read(path, _TEST) if self.is_finished(cell) else None
        if found is not None and not (found["returns"] and all(isinstance(value, float) for value in found["returns"])):
            self.damaged[path] = f"{path} has no returns"
            return None
        return found

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
        folder = self.folder / ".locks"
        folder.mkdir(parents=True, exist_ok=True)
        lock = filelock.FileLock(folder / f"{cell.id.replace('/', '_')}.lock")
        try:
            lock.acquire(timeout=0)
        except filelock.Timeout:
            return None
        return lock

    def publish(self, cell: Cell) -> None:
        """Move the result of an attempt to the cell's folder: a new folder, or further tests of a finished one."""
        result, target = self.unfinished(cell) / "result", self.cell_folder(cell)
        if self.is_finished(cell):
            (target / "tests").mkdir(exist_ok=True)
            for path in (result / "tests").iterdir():
                os.replace(path, target / "tests" / path.name)
        else:
            target.parent.mkdir(parents=True, exist_ok=True)
            if target.exists():  # damaged; if interrupted between these two lines, the cell is run again
                shutil.rmtree(target)
            os.replace(result, target)
        self.forget(cell)

    def forget(self, cell: Cell) -> None:
        """Remove the working folder of an unfinished cell."""
        folder = self.unfinished(cell)
        shutil.rmtree(folder, ignore_errors=True)
        for parent in folder.parents[: len(Path(cell.id).parts)]:
            with suppress(OSError):  # not empty: other cells are running
                parent.rmdir()

    # Requested selections

    def add_selection(self, experiment: Experiment, selection: Selection) -> None:
        """Store a requested selection."""
        folder = self.folder / experiment.name / "selections"
        folder.mkdir(parents=True, exist_ok=True)
        if experiment.name not in EXPERIMENTS:
            write_json(folder.parent / "experiment.json", _own(experiment))
        content = plain(asdict(selection))
        name = hashlib.sha256(repr(content).encode()).hexdigest()[:12]
        write_json(folder / f"{name}.json", content)

    def selections(self, experiment: str) -> list[Selection]:
        """Return all requested selections."""
        paths = sorted((self.folder / experiment / "selections").glob("*.json"))
        stored = [found for path in paths if (found := self._read(path, _SELECTION)) is not None]
        return sorted((Selection(**{name: tuple(entry[name]) for name in _SELECTION}) for entry in stored), key=astuple)

    def check_experiment(self, experiment: Experiment) -> None:
        """Check that no other experiment has the same name here; the ValueError contains the differences."""
        stored = self._read(self.folder / experiment.name / "experiment.json", {"envs": list, "vary": dict})
        if stored is not None and stored != _own(experiment):
            raise ValueError(
                f"{self.folder} has another experiment {experiment.name!r}: {differences(stored, _own(experiment))}; "
                "write another name before --env"
            )

    def experiment(self, name: str) -> Experiment:
        """Return an experiment of the paper, or a user's one in this folder; ValueError names the nearest one."""
        if name in EXPERIMENTS:
            return EXPERIMENTS[name]
        path = self.folder / name / "experiment.json"
        stored = self._read(path, {"envs": list, "vary": dict})
        if path in self.damaged:
            raise ValueError(f"{self.damaged[path]}; the same run command writes it anew")
        return find_experiment(name) if stored is None else own_experiment(name, stored["envs"], stored["vary"])


def _own(experiment: Experiment) -> dict[str, Any]:
    """Return a user's experiment as plain data."""
    vary = {view.parameter: [view.position(level) for level in view.levels] for view in experiment.views}
    vary.pop("", None)
    return plain({"envs": experiment.envs, "vary": vary})
