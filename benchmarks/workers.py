"""
Run baselines in separate processes.

Requests and answers are one line of JSON each. So baselines may use other versions of NumPy and Gymnasium than this
project, may crash without affecting other rows, and use only one core (JAX would use all). ``python -m
benchmarks.workers NAME`` is the process.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import zlib
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from benchmarks.baselines import BASELINES
from benchmarks.rates import one_line, rate

ROOT = Path(__file__).resolve().parents[1]
#: Interpreters of baselines whose requirements conflict with this project's.
INTERPRETERS = Path(sys.prefix) / "baselines"


def interpreter(name: str) -> Path:
    """
    Return the interpreter of a baseline.

    :param name: key of ``BASELINES``
    """
    baseline = BASELINES[name]
    return INTERPRETERS / baseline.distribution / "bin" / "python" if baseline.isolated else Path(sys.executable)


def is_installed(name: str) -> bool:
    """
    Check whether the baseline can be started.

    :param name: key of ``BASELINES``
    """
    baseline = BASELINES[name]
    if baseline.isolated:
        return (interpreter(name).parents[1] / ".installed").exists()
    return find_spec(baseline.module or baseline.distribution) is not None


class Worker:
    """
    A baseline in a separate process.

    :param name: key of ``BASELINES``
    :raises ImportError: if it is not installed
    :raises RuntimeError: if its process ends before it is ready, with the last line of its output
    """

    def __init__(self, name: str) -> None:
        self.name = name
        if not is_installed(name):
            raise ImportError(f"{BASELINES[name].distribution} is not installed: see benchmarks/README.md")
        self._folder = tempfile.TemporaryDirectory(prefix="baseline-")
        self._messages = Path(self._folder.name, "stderr")
        with self._messages.open("w") as stderr:
            self._process = subprocess.Popen(
                [interpreter(name), "-m", "benchmarks.workers", name],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                text=True,
                # PufferLib creates a link in the current folder, so that must not be the repository.
                cwd=self._folder.name,
                env={**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"},
            )
        try:
            self.version = str(self._answer()["version"])
        except RuntimeError:
            self.close()
            raise

    def measure(self, seconds: float) -> dict[str, Any]:
        """
        Measure its rate.

        :param seconds: minimum
        :return: ``rate`` in agent-steps/s, ``shape`` and ``checksum`` of the observations of the last step
        :raises RuntimeError: if its process has ended, with the last line of its output
        """
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(seconds) + "\n")
            self._process.stdin.flush()
        return self._answer()

    def rate(self, seconds: float) -> float:
        """Agent-steps per second, see :meth:`measure`."""
        return float(self.measure(seconds)["rate"])

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._process.wait()
            written = self._messages.read_text().strip().splitlines() or ["no message"]
            raise RuntimeError(f"its process ended with {self._process.returncode}: {written[-1]}")
        return json.loads(line)

    def close(self) -> None:
        """End the process."""
        if self._process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.close()
        self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._folder.cleanup()

    def __enter__(self) -> Worker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def serve(name: str) -> None:
    """
    Create a baseline and answer requests until there are no more.

    :param name: key of ``BASELINES``
    """
    answers = os.fdopen(os.dup(1), "w")
    # Output of libraries must not mix with the answers.
    os.dup2(2, 1)
    keep_to_one_core()
    baseline = BASELINES[name]
    stepper = baseline.make()
    stepper.work()

    def answer(**values: Any) -> None:
        print(json.dumps(values), file=answers, flush=True)

    answer(version=installed_version(baseline.distribution))
    for line in sys.stdin:
        found = rate(stepper.work, json.loads(line))
        views = np.ascontiguousarray(stepper.observe())
        answer(rate=found, shape=views.shape, checksum=zlib.crc32(views.tobytes()))


def keep_to_one_core() -> None:
    """Use one core only, if the system supports it; call this before libraries start their threads."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def installed_version(distribution: str) -> str:
    """Return the installed version; unknown for packages built by hand."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "unknown"


def main() -> None:
    """Serve; on an error, print one line to stderr."""
    try:
        serve(sys.argv[1])
    except Exception as error:
        sys.exit(one_line(error))


if __name__ == "__main__":
    main()
