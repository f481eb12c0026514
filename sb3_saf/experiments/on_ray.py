"""Jobs on a Ray cluster, or on a Ray started on this machine. Results travel through Ray, over no shared disk."""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Final

from sb3_saf.experiments.engine import Ending, Job, JobFunction, ending, guarded

#: Jobs that wait in the cluster for each that could run: enough for it to grow, too few to fill its memory.
_QUEUED_PER_SLOT: Final = 2
_FEWEST_QUEUED: Final = 64


@dataclass(frozen=True)
class RayEngine:
    """
    Jobs as Ray tasks.

    :param address: of a running cluster, ``"auto"`` to find it; None to start Ray on this machine
    :param cpus: of each job
    :param gpus: of each job; may be a fraction, so that several share one
    :param workers: processors of a Ray that is started here; None for all
    """

    address: str | None = None
    cpus: float = 1
    gpus: float = 0
    workers: int | None = None

    def run(self, function: JobFunction, jobs: Sequence[Job], retries: int = 0) -> Iterator[Ending]:
        """Run all jobs; see :class:`~sb3_saf.experiments.engine.Engine`."""
        ray = require_ray()
        with self._connected(ray):
            self._check_resources(ray)
            # Attempts are counted here, so that those of failures and of lost nodes are the same ones.
            task = ray.remote(num_cpus=self.cpus, num_gpus=self.gpus, max_retries=0)(guarded)
            queue = deque((job, 1) for job in jobs)
            running: dict[Any, Any] = {}
            try:
                while queue or running:
                    while queue and len(running) < self._most_at_once(ray):
                        job, attempt = queue.popleft()
                        running[task.remote(function, job.payload())] = job, attempt
                    (done, *_), _ = ray.wait(list(running), num_returns=1)
                    job, attempt = running.pop(done)
                    ended = ending(job, attempt, retries, *_answer(ray, done))
                    if not ended.final:
                        queue.append((job, attempt + 1))
                    yield ended
            finally:
                for reference in running:
                    ray.cancel(reference, force=True)

    @contextmanager
    def _connected(self, ray: ModuleType) -> Iterator[None]:
        """A connection of our own, unless the caller has one."""
        if ray.is_initialized():
            yield
            return
        options: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
        if self.address is None:
            options |= {"num_cpus": self.workers, "include_dashboard": False}
        try:
            ray.init(address=self.address or "local", **options)
        except ConnectionError as error:
            raise ValueError(
                f"no Ray cluster at --address {self.address} ({_first_line(error)}); start one with `ray start "
                "--head`, or leave --address out to start Ray on this machine"
            ) from None
        try:
            yield
        finally:
            ray.shutdown()

    def _check_resources(self, ray: ModuleType) -> None:
        """
        A job that fits on no node would wait for ever.

        :raises ValueError: if no node can come that has room; a cluster may still grow, so there it is only said
        """
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if any(node.get("CPU", 0) >= self.cpus and node.get("GPU", 0) >= self.gpus for node in nodes):
            return
        largest = ", ".join(f"{node.get('CPU', 0):g} CPUs and {node.get('GPU', 0):g} GPUs" for node in nodes)
        message = f"a cell wants {self.cpus:g} CPUs and {self.gpus:g} GPUs of one node, the nodes have {largest}"
        if self.address is None:
            raise ValueError(f"{message}; lower --cpus-per-cell or --gpus-per-cell")
        print(f"{message}: waiting for a node that is large enough", file=sys.stderr)

    def _most_at_once(self, ray: ModuleType) -> int:
        """Jobs to hand to the cluster."""
        resources = ray.cluster_resources()
        slots = resources.get("CPU", 0) / self.cpus
        if self.gpus:
            slots = min(slots, resources.get("GPU", 0) / self.gpus)
        return max(_FEWEST_QUEUED, int(_QUEUED_PER_SLOT * slots))


def _answer(ray: ModuleType, reference: Any) -> tuple[bytes | None, str | None]:
    """A job's result and error; a lost worker or node is an error too."""
    try:
        answer: tuple[bytes | None, str | None] = ray.get(reference)
    except ray.exceptions.RayError as error:
        return None, f"{error}\n\nlost by Ray ({type(error).__name__}): {_first_line(error)}\n"
    return answer


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__).rstrip(".")


def require_ray() -> ModuleType:
    """
    Ray, quiet.

    :raises ValueError: if it is not installed
    """
    # Nothing is reported to anybody, and a future default is taken now, about which Ray would warn.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        import ray
    except ImportError:
        raise ValueError(
            "--ray needs Ray, which is not installed: pip install 'sb3-saf[ray]', or leave --ray out to run in "
            "processes of this machine"
        ) from None
    return ray
