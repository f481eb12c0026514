"""What the tests of the experiments run: small jobs for worker processes, an engine without any, readers of tables."""

from __future__ import annotations

import csv
import os
import signal
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from sb3_saf.experiments.engine import Ending, Job, JobFunction, ending, guarded


class InlineEngine:
    """Jobs in this process, where everything is imported already; keeps what it was asked."""

    def __init__(self) -> None:
        self.payloads: list[Any] = []

    def run(self, function: JobFunction, jobs: Sequence[Job], retries: int = 0) -> Iterator[Ending]:
        for job in jobs:
            self.payloads.append(job.payload())
            yield ending(job, 1, 0, *guarded(function, self.payloads[-1]))


def job(name: str) -> Job:
    """A job whose payload is its name."""
    return Job(name, partial(str, name))


def obey(name: str) -> bytes:
    """Do what the name says; ``*_once`` only the first time, which a file remembers."""
    verb, _, path = name.partition(" ")
    if verb.endswith("_once"):
        if Path(path).exists():
            return b"second time"
        Path(path).touch()
    if verb.startswith("fail"):
        raise RuntimeError(f"{name} has failed")
    if verb.startswith("die"):
        os.kill(os.getpid(), signal.SIGKILL)
    if verb.startswith("exit"):
        os._exit(3)
    if verb == "sleep":
        Path(path).write_text(str(os.getpid()))
        time.sleep(600)
    if verb == "variable":
        return os.environ[path].encode()
    return name.encode()


def read_table(path: Path) -> list[dict[str, str]]:
    """A table's rows without the columns that tell times."""
    from sb3_saf.experiments.table import WALL_COLUMNS  # worker processes import this module, and need no tables

    with path.open(encoding="utf-8", newline="") as file:
        return [{key: row[key] for key in row if key not in WALL_COLUMNS} for row in csv.DictReader(file)]


def is_running(pid: int) -> bool:
    """Whether a process lives; one that nobody has waited for yet does not."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return False
    return stat.rpartition(")")[2].split()[0] != "Z"


def wait_until(condition: Any, seconds: float = 120) -> None:
    """Wait for something that other processes do."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.02)
