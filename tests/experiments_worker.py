"""A worker for tests: follows ``order.txt`` in its folder, without importing this project."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path


def save(*_: object) -> None:
    """Write a last checkpoint, as a training does."""
    (folder / "checkpoint").touch()
    sys.exit(143)


def note_control_c(*_: object) -> None:
    """Record a Ctrl-C, which should not reach a worker."""
    (folder / "interrupted").touch()


folder = Path(sys.argv[-1])
verb, _, argument = (folder / "order.txt").read_text().partition(" ")
if verb == "fail":
    raise RuntimeError(argument)
if verb == "die":
    os.kill(os.getpid(), signal.SIGKILL)
if verb == "exit":
    os._exit(3)
if verb == "sleep":
    signal.signal(signal.SIGTERM, save)
    signal.signal(signal.SIGINT, note_control_c)
    (folder / "pid").write_text(str(os.getpid()))
    time.sleep(600)
if verb == "variable":
    print(os.environ[argument])
(folder / "result").mkdir()
