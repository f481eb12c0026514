"""Jobs on this machine: processes that live as long as the run, so that imports are paid once in each."""

from __future__ import annotations

import multiprocessing as mp
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Final, cast

from sb3_saf.experiments.engine import Ending, Job, JobFunction, ending, guarded

#: Read by libraries when they are imported; sums of other numbers of threads come out in another order.
THREAD_VARIABLES: Final = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
#: Seconds that a worker has to end.
_PATIENCE: Final = 5.0


class _Worker:
    """
    One process and the job that it has.

    :param threads: of its libraries
    """

    def __init__(self, threads: int) -> None:
        context = mp.get_context("spawn")  # forks of a process with threads may hang
        ours, theirs = context.Pipe()
        self.connection: Connection[Any, Any] = ours
        self.process: BaseProcess = context.Process(target=_serve, args=(theirs,), daemon=True)
        self.job: Job | None = None
        self.attempt = 0
        with pinned(threads), _interrupts_kept_from_children():
            self.process.start()
        theirs.close()

    def give(self, function: JobFunction, job: Job, attempt: int) -> None:
        """Start a job; a worker that has died is found when its answer is read."""
        self.job, self.attempt = job, attempt
        with suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send((function, job.payload()))

    def answer(self) -> tuple[bytes | None, str | None]:
        """The job's result and error; a dead process is an error too."""
        try:
            reply: tuple[bytes | None, str | None] = self.connection.recv()
        except (EOFError, ConnectionResetError):
            self.process.join(_PATIENCE)
            return None, f"the worker process died ({_death(self.process.exitcode)})\n"
        return reply

    def end(self) -> None:
        """Make sure that the process is gone."""
        self.process.terminate()
        self.process.join(_PATIENCE)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.connection.close()


class LocalEngine:
    """
    Jobs in processes of this machine.

    :param workers: processes
    :param threads: of each process
    """

    def __init__(self, workers: int, threads: int = 1) -> None:
        self.workers = workers
        self.threads = threads

    def run(self, function: JobFunction, jobs: Sequence[Job], retries: int = 0) -> Iterator[Ending]:
        """Run all jobs; see :class:`~sb3_saf.experiments.engine.Engine`."""
        queue = deque((job, 1) for job in jobs)
        workers: list[_Worker] = []
        try:
            while queue or any(worker.job for worker in workers):
                self._assign(function, queue, workers)
                for worker in _ready(workers):
                    job, attempt = worker.job, worker.attempt
                    assert job is not None
                    result, error = worker.answer()
                    worker.job = None
                    if not worker.process.is_alive():
                        workers.remove(worker)
                        worker.end()
                    ended = ending(job, attempt, retries, result, error)
                    if not ended.final:
                        queue.append((job, attempt + 1))
                    yield ended
        finally:
            for worker in workers:
                worker.end()

    def _assign(self, function: JobFunction, queue: deque[tuple[Job, int]], workers: list[_Worker]) -> None:
        """Give jobs to idle workers, new ones if there are too few."""
        while queue:
            idle = next((worker for worker in workers if worker.job is None), None)
            if idle is None:
                if len(workers) >= self.workers:
                    return
                idle = _Worker(self.threads)
                workers.append(idle)
            idle.give(function, *queue.popleft())


def _ready(workers: Sequence[_Worker]) -> list[_Worker]:
    """Workers with an answer, or whose process has died; waits for one."""
    busy = [worker for worker in workers if worker.job is not None]
    signs = wait([sign for worker in busy for sign in (worker.connection, worker.process.sentinel)])
    return [worker for worker in busy if worker.connection in signs or worker.process.sentinel in signs]


def _serve(connection: Connection[Any, Any]) -> None:
    """A worker's life: take a job, answer, until nobody asks."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            function, payload = cast("tuple[Callable[[Any], bytes], Any]", connection.recv())
        except EOFError:
            return
        connection.send(guarded(function, payload))


def _end_with_parent() -> None:
    """A killed driver leaves no worker behind, not even in the middle of a job."""
    parent = mp.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


def _death(exit_code: int | None) -> str:
    if exit_code is None or exit_code >= 0:
        return f"exit code {exit_code}"
    name = signal.Signals(-exit_code).name
    hint = "; if the machine ran out of memory, use fewer --workers" if name == "SIGKILL" else ""
    return f"{name}{hint}"


@contextmanager
def pinned(threads: int) -> Iterator[None]:
    """Environment variables as children are to inherit them."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _interrupts_kept_from_children() -> Iterator[None]:
    """Ctrl-C reaches every process of a terminal; children inherit that it is blocked and leave it to the driver."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # starting a child does it too, and unblocks SIGINT while it is at it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
