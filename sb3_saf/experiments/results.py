"""
The folder of results. One cell is one folder, which appears at once and complete, or not at all.

    settings.json                    the protocol, the same for every cell
    cells/TeamTogether-c2-h1/saf/seed-0/
        config.json                  everything that decides the result, but the seed
        command.txt                  trains it again
        versions.json  status.json   what it ran on; how it ended and what it cost
        curve.csv  model.zip         returns of the training episodes; the model
        tests/c2-h1.json             returns of the test episodes
        error.txt                    in the place of all this for a cell that failed
    unfinished/                          checkpoints of cells that are at work, or were killed at it
    coordination/requests/*.json     what somebody asked for, so that a report knows what is missing
    coordination/table.csv           one row per cell and test level, made from the cells
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, astuple
from pathlib import Path
from typing import Any, Final

import filelock

from sb3_saf.experiments.cells import Cell, Choice, Protocol, Shard
from sb3_saf.experiments.definitions import Level
from sb3_saf.experiments.files import differences, pack_texts, plain, read_json, to_json, unpack, write_text

FINISHED: Final = "finished"
FAILED: Final = "failed"


class Results:
    """
    A folder of results.

    :param folder: made when something is written
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        #: Unfinished files, on the same disk, so that a rename moves them; nothing there is a result.
        self.scratch = folder / "scratch"

    # The protocol

    def protocol(self) -> Protocol | None:
        """What the folder's cells have in common; None for a folder without results."""
        stored = read_json(self.folder / "settings.json")
        return None if stored is None else Protocol(**stored)

    def agree(self, protocol: Protocol) -> None:
        """
        Write the protocol down, or check that it is the one that is there.

        :raises ValueError: with what differs
        """
        stored, wanted = read_json(self.folder / "settings.json"), plain(asdict(protocol))
        if stored is None:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_text(self.folder / "settings.json", to_json(wanted))
        elif stored != wanted:
            raise ValueError(
                f"the results in {self.folder} have other settings: {differences(stored, wanted)}; run with theirs, or "
                "choose another folder with -f"
            )

    def agree_on(self, cells: Iterable[Cell], protocol: Protocol) -> None:
        """
        Check that finished cells were trained with the settings of today.

        :raises ValueError: with what differs
        """
        for cell in cells:
            if not self.is_finished(cell):
                continue
            stored, wanted = self.config(cell), config_of(cell, protocol)
            if stored != wanted:
                raise ValueError(
                    f"{self.cell_folder(cell)} was trained with other settings: {differences(stored, wanted)}; restore "
                    "them, delete that cell, or choose another folder with -f"
                )

    # Cells

    def cell_folder(self, cell: Cell) -> Path:
        """Where a cell is, or will be."""
        return self.folder / "cells" / cell.id

    def unfinished(self, cell: Cell) -> Path:
        """Checkpoints of a training that has not reached its end."""
        return self.folder / "unfinished" / cell.id

    def status(self, cell: Cell) -> dict[str, Any]:
        """How a cell ended; empty if it has not."""
        return read_json(self.cell_folder(cell) / "status.json") or {}

    def config(self, cell: Cell) -> dict[str, Any]:
        """What a cell was trained with; empty before."""
        return read_json(self.cell_folder(cell) / "config.json") or {}

    def versions(self, cell: Cell) -> dict[str, str]:
        """What a cell ran on; empty before."""
        return read_json(self.cell_folder(cell) / "versions.json") or {}

    def is_finished(self, cell: Cell) -> bool:
        """Whether a cell is trained."""
        return self.status(cell).get("state") == FINISHED

    def missing_tests(self, cell: Cell) -> tuple[Level, ...]:
        """Levels that a cell has not been tested at; all of them if it is not trained."""
        if not self.is_finished(cell):
            return cell.tests
        return tuple(level for level in cell.tests if not self._test_file(cell, level).exists())

    def _test_file(self, cell: Cell, level: Level) -> Path:
        return self.cell_folder(cell) / "tests" / f"{level.slug}.json"

    def test(self, cell: Cell, level: Level) -> dict[str, Any] | None:
        """What a test has found; None before it."""
        return read_json(self._test_file(cell, level)) if self.is_finished(cell) else None

    def model(self, cell: Cell) -> bytes | None:
        """A trained model's file; None before it, and for random teams."""
        path = self.cell_folder(cell) / "model.zip"
        return path.read_bytes() if self.is_finished(cell) and path.exists() else None

    def add(self, cell: Cell, archive: bytes) -> None:
        """
        Take a cell in: as a new folder, or its further tests into the folder that is there.

        :param archive: from :func:`pack`
        """
        with self._unpacked(archive) as fresh:
            if not self.is_finished(cell):
                self._replace_cell(cell, fresh)
                self._forget_checkpoints(cell)
                return
            tests = self.cell_folder(cell) / "tests"
            tests.mkdir(exist_ok=True)
            for path in (fresh / "tests").iterdir():
                os.replace(path, tests / path.name)
            (self.cell_folder(cell) / "error.txt").unlink(missing_ok=True)

    def add_failure(self, cell: Cell, protocol: Protocol, error: str) -> None:
        """
        Say in a cell's folder why it failed; the next run tries again.

        A trained cell whose further test failed stays trained.
        """
        if self.is_finished(cell):
            write_text(self.cell_folder(cell) / "error.txt", error)
            return
        files = {
            "config.json": to_json(config_of(cell, protocol)),
            "status.json": to_json({"state": FAILED}),
            "error.txt": error,
        }
        with self._unpacked(pack_texts(files)) as fresh:
            self._replace_cell(cell, fresh)

    def _forget_checkpoints(self, cell: Cell) -> None:
        folder = self.unfinished(cell)
        shutil.rmtree(folder, ignore_errors=True)
        for parent in folder.parents[: len(Path(cell.id).parts)]:
            with suppress(OSError):  # others are at work beside it
                parent.rmdir()

    def _replace_cell(self, cell: Cell, fresh: Path) -> None:
        target = self.cell_folder(cell)
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists():  # a failure; cut off between these two lines, the cell starts over
            shutil.rmtree(target)
        os.replace(fresh, target)

    @contextmanager
    def _unpacked(self, archive: bytes) -> Iterator[Path]:
        """The files of an archive, on the disk of the results so that a rename moves them."""
        self.scratch.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self.scratch, ignore_cleanup_errors=True) as folder:
            fresh = Path(folder) / "cell"
            unpack(archive, fresh)
            yield fresh

    # Requests

    def add_request(self, experiment: str, choice: Choice) -> None:
        """Remember what was asked for."""
        text = to_json(plain(asdict(choice)))
        name = hashlib.sha256(text.encode()).hexdigest()[:12]
        folder = self.folder / experiment / "requests"
        folder.mkdir(parents=True, exist_ok=True)
        write_text(folder / f"{name}.json", text)

    def requests(self, experiment: str) -> list[Choice]:
        """Everything that was asked for."""
        paths = (self.folder / experiment / "requests").glob("*.json")
        stored = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
        choices = [Choice(**{key: tuple(value) for key, value in entry.items()}) for entry in stored]
        return sorted(choices, key=astuple)

    # Only one run at a time

    @contextmanager
    def locked(self, shard: Shard) -> Iterator[None]:
        """
        Keep a second run of the same cells away, and clear away what a killed one left unfinished.

        :raises ValueError: if there is one
        """
        part = f"{shard.index}-of-{shard.count}"
        lock = filelock.FileLock(self.folder / f".lock-{part}")
        try:
            lock.acquire(timeout=0)
        except filelock.Timeout:
            raise ValueError(
                f"another process is running part {shard} of {self.folder}; wait for it, divide the cells among "
                "processes with --shard 1/2 and --shard 2/2, or choose another folder with -f"
            ) from None
        self.scratch = self.folder / "scratch" / part
        shutil.rmtree(self.scratch, ignore_errors=True)
        self.scratch.mkdir(parents=True)
        try:
            yield
        finally:
            shutil.rmtree(self.scratch, ignore_errors=True)
            lock.release()


def config_of(cell: Cell, protocol: Protocol) -> dict[str, Any]:
    """
    Everything that decides a cell's result, but its seed, which its folder names.

    :return: plain data, as it comes back from a file
    """
    settings = protocol.settings(cell).as_dict()
    if not cell.is_trained:
        settings = {"algo": cell.method, "env": settings["env"], "env_kwargs": settings["env_kwargs"]}
    test = {"episodes": protocol.episodes, "deterministic": protocol.deterministic}
    return plain({**settings, "test": test})
