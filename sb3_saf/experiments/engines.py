"""
Engines that run cells: in processes of this machine, or on Ray.

An engine takes the folder of a job and returns a future of :mod:`concurrent.futures`. On this machine every cell has
its own process, ``python -m sb3_saf.experiments cell FOLDER``, so that a crash does not affect other cells. A
``ProcessPoolExecutor`` would lose all running cells if one worker dies.
"""

from __future__ import annotations

import contextlib
import io
import os
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from abc import abstractmethod
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any, Final

#: Read by libraries at import; the number of threads changes the order of summation.
THREAD_VARIABLES: Final = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
#: Command that does the job of a folder, and ends with its parent.
CELL_COMMAND: Final = (sys.executable, "-m", "sb3_saf.experiments", "cell", "--until-stdin-closes")
#: Time limit in seconds for a process to write its last checkpoint and end.
_PATIENCE: Final = 30.0
#: Maximum characters of a failed cell's log to keep.
_LOG_TAIL: Final = 20_000
#: Jobs submitted to a Ray cluster per slot: enough for autoscaling, too few to fill its memory.
_QUEUED_PER_SLOT: Final = 2
_FEWEST_QUEUED: Final = 64


class Engine(contextlib.AbstractContextManager["Engine"]):
    """Base of engines that run jobs. A context manager; leaving it ends running jobs."""

    @property
    @abstractmethod
    def slots(self) -> int:
        """Jobs to hand over at the same time."""

    @abstractmethod
    def submit(self, folder: Path) -> Future[None]:
        """
        Start a job.

        :param folder: folder with ``job.json``
        :return: future that is done when ``FOLDER/result`` exists
        """

    @abstractmethod
    def close(self) -> None:
        """End running jobs."""

    def __exit__(self, *_: object) -> None:
        self.close()


class LocalEngine(Engine):
    """
    Engine with processes of this machine.

    :param command: command to which the folder of a job is appended
    """

    def __init__(self, workers: int, threads: int = 1, command: Sequence[str] = CELL_COMMAND) -> None:
        self.workers = workers
        self._command = command
        self._environment = {**os.environ, **dict.fromkeys(THREAD_VARIABLES, str(threads))}
        self._waiting = ThreadPoolExecutor(workers)
        self._processes: dict[Path, subprocess.Popen[bytes]] = {}

    @property
    def slots(self) -> int:
        """Jobs to hand over at the same time."""
        return self.workers

    def submit(self, folder: Path) -> Future[None]:
        """Start a job; see :meth:`Engine.submit`."""
        with (folder / "log.txt").open("ab") as log:
            # A new session: Ctrl-C in a terminal must reach this process only.
            self._processes[folder] = subprocess.Popen(
                [*self._command, str(folder)],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=self._environment,
                start_new_session=True,
            )
        return self._waiting.submit(self._wait, folder)

    def _wait(self, folder: Path) -> None:
        with self._processes[folder] as process:
            code = process.wait()
        if code:
            with (folder / "log.txt").open(encoding="utf-8", errors="replace") as log:
                text = log.read()[-_LOG_TAIL:]
            death = f"exit code {code}" if code > 0 else signal.Signals(-code).name
            hint = "; if the machine ran out of memory, use fewer --workers" if death == "SIGKILL" else ""
            raise RuntimeError(text if code == 1 and text else f"{text}\nthe worker process died ({death}{hint})\n")

    def close(self) -> None:
        """End the processes: SIGTERM lets them write a last checkpoint."""
        for process in self._processes.values():
            process.terminate()
        end = time.monotonic() + _PATIENCE
        for process in self._processes.values():
            try:
                process.wait(max(0.0, end - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
        self._waiting.shutdown()


class RayEngine(Engine):
    """
    Engine with tasks of a Ray cluster, or of a Ray started on this machine.

    A task with access to its job's folder works in it, so that another task can continue from its checkpoints. Without
    a shared disk the job's files are sent through Ray, and a lost cell starts over.

    :param address: address of a running cluster, ``"auto"`` to find it; None to start Ray on this machine
    :param cpus: processors of each job
    :param gpus: GPUs of each job; may be a fraction, so that several share one
    :param workers: processors of a Ray that is started here; None for all
    """

    def __init__(
        self, address: str | None = None, cpus: float = 1, gpus: float = 0, workers: int | None = None
    ) -> None:
        self.cpus = cpus
        self.gpus = gpus
        self._ray = require_ray(is_local=address is None)
        self._is_ours = not self._ray.is_initialized()
        self._references: list[Any] = []
        if self._is_ours:
            options: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
            if address is None:
                options |= {"num_cpus": workers, "include_dashboard": False}
            try:
                self._ray.init(address=address or "local", **options)
            except ConnectionError as error:
                raise ValueError(
                    f"no Ray cluster at --address {address} ({_first_line(error)}); start one with `ray start "
                    "--head`, or leave --address out to start Ray on this machine"
                ) from None
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        if not any(node.get("CPU", 0) >= cpus and node.get("GPU", 0) >= gpus for node in nodes):
            largest = ", ".join(f"{node.get('CPU', 0):g} CPUs and {node.get('GPU', 0):g} GPUs" for node in nodes)
            message = f"a cell wants {cpus:g} CPUs and {gpus:g} GPUs of one node, the nodes have {largest}"
            if address is None:
                self.close()
                raise ValueError(f"{message}; lower --cpus-per-cell or --gpus-per-cell")
            # A cluster may grow.
            print(f"{message}: waiting for a node that is large enough", file=sys.stderr)
        # The run counts attempts, so that failures and lost nodes count alike.
        self._task = self._ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=0)(_run_on_ray)

    @property
    def slots(self) -> int:
        """Jobs to hand over at the same time."""
        resources = self._ray.cluster_resources()
        slots = resources.get("CPU", 0) / self.cpus
        if self.gpus:
            slots = min(slots, resources.get("GPU", 0) / self.gpus)
        return max(_FEWEST_QUEUED, int(_QUEUED_PER_SLOT * slots))

    def submit(self, folder: Path) -> Future[None]:
        """Start a job; see :meth:`Engine.submit`."""
        reference = self._task.remote(str(folder.resolve()), inputs_of(folder))
        self._references.append(reference)
        done: Future[None] = Future()
        reference.future().add_done_callback(lambda answer: self._settle(done, answer, folder))
        return done

    def _settle(self, done: Future[None], answer: Future[bytes | None], folder: Path) -> None:
        """Set the result or error of a task on the future."""
        try:
            if (error := answer.exception()) is not None:
                is_lost = not isinstance(error, self._ray.exceptions.RayTaskError)
                lost = f"\n\nlost by Ray ({type(error).__name__}): {_first_line(error)}\n" if is_lost else ""
                raise RuntimeError(f"{error}{lost}")
            if (archive := answer.result()) is not None:
                with zipfile.ZipFile(io.BytesIO(archive)) as packed:
                    packed.extractall(folder)
            done.set_result(None)
        except Exception as problem:
            done.set_exception(problem)

    def close(self) -> None:
        """Cancel the tasks, and end a Ray that was started or connected to here."""
        for reference in self._references:
            self._ray.cancel(reference, force=True)
        if self._is_ours:
            self._ray.shutdown()


def inputs_of(folder: Path) -> dict[str, bytes]:
    """Return the files that a node needs for a job: the job, and the models of a trained cell that is to be tested."""
    return {path.name: path.read_bytes() for path in (folder / "job.json", *folder.glob("*.zip"))}


def _run_on_ray(name: str, inputs: dict[str, bytes]) -> bytes | None:
    """Do a job on a node; return its result as an archive, or None if it was written to the folder directly."""
    from sb3_saf.experiments.cell import run_job

    folder = Path(name)
    with contextlib.ExitStack() as stack:
        is_shared = all((folder / file).exists() and (folder / file).read_bytes() == inputs[file] for file in inputs)
        if not is_shared:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            for file, content in inputs.items():
                (folder / file).write_bytes(content)
        log = stack.enter_context((folder / "log.txt").open("a", encoding="utf-8"))
        with contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
            run_job(folder)
        if is_shared:
            return None
        log.flush()
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:  # models are compressed already
            for path in (folder / "log.txt", *sorted((folder / "result").rglob("*"))):
                if path.is_file():
                    archive.write(path, path.relative_to(folder))
        return buffer.getvalue()


def _first_line(error: BaseException) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__).rstrip(".")


def require_ray(is_local: bool = False) -> ModuleType:
    """
    Import Ray with quiet settings.

    :param is_local: whether it runs on this machine only; it then listens on localhost only
    :raises ValueError: if it is not installed
    """
    # No usage statistics are sent, and a future default is set now, about which Ray would warn.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    if is_local:  # Read when Ray is imported: 0 is its default on systems other than Linux.
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    try:
        import ray
    except ImportError:
        raise ValueError(
            "--ray needs Ray, which is not installed: pip install 'sb3-saf[ray]', or leave --ray out to run in "
            "processes of this machine"
        ) from None
    return ray
