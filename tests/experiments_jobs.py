"""Helpers for the tests of experiments: engines without the package's own workers, readers of tables."""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import psutil

from sb3_saf.experiments.cell import Job, run_job
from sb3_saf.experiments.engines import Engine

#: Columns that differ between two runs of the same cells; all others are equal, bit for bit.
TIME_COLUMNS = ("processor_seconds", "wall_seconds_training", "wall_seconds_test")
#: A worker without the package's imports, which does what ``order.txt`` in its folder says.
WORKER = (sys.executable, str(Path(__file__).parent / "experiments_worker.py"))


class InlineEngine(Engine):
    """
    Runs jobs in this process, where everything is imported already; records the requests.

    :param work: replaces training and testing
    """

    def __init__(self, work: Callable[[Path], None] = run_job) -> None:
        self.jobs: list[Job] = []
        self.with_model: list[bool] = []
        self._work = work

    @property
    def slots(self) -> int:
        return 1

    def submit(self, folder: Path) -> Future[None]:
        self.jobs.append(Job.read(folder))
        self.with_model.append((folder / "model.zip").exists())
        done: Future[None] = Future()
        try:
            self._work(folder)
            done.set_result(None)
        except Exception as error:
            done.set_exception(error)
        return done

    def close(self) -> None:
        pass


def order(folder: Path, name: str, words: str) -> Path:
    """Make the folder of a job for :data:`WORKER`."""
    (folder / name).mkdir(parents=True)
    (folder / name / "order.txt").write_text(words)
    return folder / name


def read_table(path: Path) -> list[dict[str, str]]:
    """Return a table's rows without the columns of times."""
    with path.open(encoding="utf-8", newline="") as file:
        return [{key: row[key] for key in row if key not in TIME_COLUMNS} for row in csv.DictReader(file)]


def is_running(pid: int) -> bool:
    """Whether a process runs; a zombie does not."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def wait_until(condition: Callable[[], Any], seconds: float = 120) -> None:
    """Wait for a condition that other processes fulfil."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.02)
