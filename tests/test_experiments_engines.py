"""Cells in local processes: failures, deaths, interruptions; test_experiments_run tests the real worker."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

from sb3_saf.experiments.engines import THREAD_VARIABLES, LocalEngine
from tests.experiments_jobs import WORKER, is_running, order, wait_until


def test_failures_and_deaths_leave_the_others_alone(tmp_path: Path) -> None:
    orders = {"a": "work", "fail": "fail no luck", "die": "die", "exit": "exit", "b": "work"}
    with LocalEngine(2, command=WORKER) as engine:
        futures = {name: engine.submit(order(tmp_path, name, words)) for name, words in orders.items()}
        errors = {name: future.exception(timeout=60) for name, future in futures.items()}
    assert errors["a"] is errors["b"] is None
    assert all((tmp_path / name / "result").is_dir() for name in "ab")
    assert str(errors["fail"]).startswith("Traceback") and str(errors["fail"]).endswith("RuntimeError: no luck\n")
    assert "the worker process died (SIGKILL; if the machine ran out of memory, use fewer --workers)" in str(
        errors["die"]
    )
    assert "the worker process died (exit code 3)" in str(errors["exit"])


def test_workers_have_the_threads_that_they_are_given(tmp_path: Path) -> None:
    with LocalEngine(2, threads=3, command=WORKER) as engine:
        for name in THREAD_VARIABLES:
            engine.submit(order(tmp_path, name, f"variable {name}")).result(timeout=60)
    assert all((tmp_path / name / "log.txt").read_text() == "3\n" for name in THREAD_VARIABLES)


DRIVER = """
    import signal
    from pathlib import Path
    from sb3_saf.experiments.engines import LocalEngine
    from tests.experiments_jobs import WORKER, order

    # A shell lets what it runs in the background ignore the signal.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with LocalEngine(1, command=WORKER) as engine:
            future = engine.submit(order(Path({folder!r}), "a", "sleep"))
            print("submitted", flush=True)
            future.result()
    except KeyboardInterrupt:
        print("interrupted")
"""


def test_control_c_is_for_the_driver_alone(tmp_path: Path) -> None:
    """A terminal sends it to every process of the group, but workers should write a checkpoint instead."""
    root = str(Path(__file__).parents[1])
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(DRIVER.format(folder=str(tmp_path)))],
        env={**os.environ, "PYTHONPATH": root},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    pid = tmp_path / "a" / "pid"
    wait_until(lambda: pid.exists() and pid.read_text())
    assert process.stdout is not None
    assert process.stdout.readline() == "submitted\n"  # Python drops a signal that arrives in some of its callbacks
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert (out, err, process.returncode) == ("interrupted\n", "", 0)
    assert not is_running(int(pid.read_text()))
    assert (tmp_path / "a" / "checkpoint").exists() and not (tmp_path / "a" / "interrupted").exists()


def test_a_cell_ends_with_the_process_that_started_it(tmp_path: Path) -> None:
    """In any case: the system closes the other end of the pipe."""
    code = "import threading, time; from sb3_saf.experiments.cli import _end_with_stdin as end;"
    code += "threading.Thread(target=end, daemon=True).start(); print('up', flush=True); time.sleep(600)"
    worker = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert worker.stdin is not None and worker.stdout is not None
    worker.stdout.readline()
    time.sleep(0.1)
    assert worker.poll() is None
    worker.stdin.close()
    assert worker.wait(timeout=20) == 1
    worker.stdout.close()
