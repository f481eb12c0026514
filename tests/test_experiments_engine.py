"""Jobs in processes of this machine: failures, deaths, interruptions."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from sb3_saf.experiments.engine import Ending
from sb3_saf.experiments.local import THREAD_VARIABLES, LocalEngine
from tests.experiments_jobs import is_running, job, obey, wait_until


def endings(*names: str, workers: int = 2, retries: int = 0) -> dict[str, list[Ending]]:
    found: dict[str, list[Ending]] = {name: [] for name in names}
    for ended in LocalEngine(workers).run(obey, [job(name) for name in names], retries):
        found[ended.job.name].append(ended)
    return found


def test_failures_and_deaths_leave_the_others_alone() -> None:
    names = ["a", "fail", "die", "b", "exit", "c", "d"]
    found = endings(*names)
    assert {name: found[name][0].result for name in "abcd"} == {name: name.encode() for name in "abcd"}
    assert all(len(found[name]) == 1 and found[name][0].final for name in names)
    errors = {name: found[name][0].error or "" for name in ("fail", "die", "exit")}
    assert errors["fail"].startswith("Traceback")
    assert errors["fail"].endswith("RuntimeError: fail has failed\n")
    assert "the worker process died (SIGKILL; if the machine ran out of memory, use fewer --workers)" in errors["die"]
    assert "the worker process died (exit code 3)" in errors["exit"]


def test_retries(tmp_path: Path) -> None:
    names = [f"fail_once {tmp_path / 'f'}", f"die_once {tmp_path / 'd'}", "fail"]
    found = endings(*names, workers=1, retries=1)
    for name in names[:2]:
        assert [(ended.attempt, ended.final, ended.result) for ended in found[name]] == [
            (1, False, None),
            (2, True, b"second time"),
        ]
    assert [(ended.attempt, ended.final, ended.result) for ended in found["fail"]] == [
        (1, False, None),
        (2, True, None),
    ]


def test_workers_have_the_threads_that_they_are_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    names = [f"variable {name}" for name in THREAD_VARIABLES]
    found = {ended.job.name: ended.result for ended in LocalEngine(1, threads=3).run(obey, [job(n) for n in names])}
    assert found == dict.fromkeys(names, b"3")
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "NUMBA_NUM_THREADS" not in os.environ


def test_closing_ends_the_workers(tmp_path: Path) -> None:
    note = tmp_path / "pid"
    running = LocalEngine(2).run(obey, [job(f"sleep {note}"), job("a")])
    assert next(running).result == b"a"
    wait_until(lambda: note.exists() and note.read_text())
    running.close()  # type: ignore[attr-defined]
    assert not is_running(int(note.read_text()))


DRIVER = """
    from sb3_saf.experiments.local import LocalEngine
    from tests.experiments_jobs import job, obey

    if __name__ == "__main__":
        try:
            list(LocalEngine(1).run(obey, [job("sleep {note}")]))
        except KeyboardInterrupt:
            print("interrupted")
"""


@pytest.fixture
def driver(tmp_path: Path) -> tuple[subprocess.Popen[str], int]:
    """A process whose worker sleeps, and the worker."""
    note, script = tmp_path / "pid", tmp_path / "driver.py"
    script.write_text(textwrap.dedent(DRIVER.format(note=note)))
    process = subprocess.Popen(
        [sys.executable, str(script)],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    wait_until(lambda: note.exists() and note.read_text())
    return process, int(note.read_text())


def test_a_killed_driver_leaves_no_worker(driver: tuple[subprocess.Popen[str], int]) -> None:
    process, worker = driver
    process.kill()
    process.communicate()
    wait_until(lambda: not is_running(worker), seconds=20)


def test_a_worker_has_control_c_blocked(driver: tuple[subprocess.Popen[str], int]) -> None:
    process, worker = driver
    status = Path(f"/proc/{worker}/status")
    if not status.exists():
        pytest.skip("no /proc")
    mask = next(line for line in status.read_text().splitlines() if line.startswith("SigBlk:"))
    process.kill()
    process.communicate()
    assert int(mask.split()[1], 16) >> (signal.SIGINT - 1) & 1


def test_control_c_is_the_drivers_alone(driver: tuple[subprocess.Popen[str], int]) -> None:
    process, worker = driver
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does it: to every process of the group
    out, err = process.communicate(timeout=240)
    assert (out, err, process.returncode) == ("interrupted\n", "", 0)
    assert not is_running(worker)
