"""The same experiments on a real Ray cluster of several nodes on this machine, one of which is killed."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from sb3_saf.experiments import cli
from sb3_saf.experiments.cells import Choice, Protocol, Shard
from sb3_saf.experiments.definitions import find_experiment
from sb3_saf.experiments.engine import Ending, Job, JobFunction
from sb3_saf.experiments.on_ray import RayEngine, require_ray
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.run import Machine, Summary, run
from tests.experiments_jobs import InlineEngine, job, obey, read_table

CHOICE = Choice((0,), ("ippo", "mappo"))
#: Ray's own default is to wait some 15 s before it takes a silent node for dead.
IMPATIENT = {
    "health_check_initial_delay_ms": 0,
    "health_check_period_ms": 1_000,
    "health_check_timeout_ms": 3_000,
    "health_check_failure_threshold": 3,
}


# First: the cluster of another test answers for a moment after its end.
def test_no_cluster(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("ray")
    words = ["run", "joint", "--size", "smoke", "--address", "auto", "-f", str(tmp_path)]
    assert cli.main(words) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "no Ray cluster at --address auto" in error
    assert "start one with `ray start --head`" in error


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head that runs nothing and two nodes of one processor each."""
    pytest.importorskip("ray")
    require_ray()
    from ray.cluster_utils import Cluster

    head = {"num_cpus": 0, "include_dashboard": False, "_system_config": IMPATIENT}
    nodes = Cluster(initialize_head=True, head_node_args=head)
    for _ in range(2):
        nodes.add_node(num_cpus=1)
    yield nodes
    nodes.shutdown()


class NodeKiller:
    """
    An engine that kills a node a second after the first ending, when both nodes are busy again.

    :param cluster: whose node
    """

    def __init__(self, cluster: Any) -> None:
        self.cluster = cluster
        self.lost: list[Ending] = []

    def run(self, function: JobFunction, jobs: Sequence[Job], retries: int = 0) -> Iterator[Ending]:
        for number, ended in enumerate(RayEngine(self.cluster.address).run(function, jobs, retries)):
            if number == 0:
                # Not at once: the node that has ended the first cell gets its next only when this one has been taken.
                threading.Timer(1.0, self._kill).start()
            if ended.error is not None:
                self.lost.append(ended)
            yield ended

    def _kill(self) -> None:
        self.cluster.remove_node(self.cluster.list_all_nodes()[-1], allow_graceful=False)


# Tests of this module run in this order, for the last one leaves a node less.


def test_failures_and_deaths_on_ray(cluster: Any, tmp_path: Path) -> None:
    names = ["a", "fail", "die", f"die_once {tmp_path / 'd'}"]
    found: dict[str, list[Ending]] = {name: [] for name in names}
    for ended in RayEngine(cluster.address, cpus=0.5).run(obey, [job(name) for name in names], retries=1):
        found[ended.job.name].append(ended)
    assert [ended.result for ended in found["a"]] == [b"a"]
    assert "RuntimeError: fail has failed" in (found["fail"][-1].error or "")
    assert "lost by Ray (WorkerCrashedError)" in (found["die"][-1].error or "")
    assert [len(found[name]) for name in ("fail", "die")] == [2, 2]
    assert [ended.result for ended in found[names[3]]] == [None, b"second time"]


def test_the_table_is_that_of_this_machine_though_a_node_is_killed(cluster: Any, tmp_path: Path) -> None:
    engine, joint = NodeKiller(cluster), find_experiment("joint")
    machine = Machine(shared_disk=False)
    summary = run(joint, CHOICE, Protocol("smoke"), Results(tmp_path / "ray"), engine, machine, Shard())
    assert summary == Summary(9, [])
    assert engine.lost
    assert all("NodeDied" in (ended.error or "") and not ended.final for ended in engine.lost)
    run(joint, CHOICE, Protocol("smoke"), Results(tmp_path / "here"), InlineEngine(), Machine(), Shard())
    ray, here = (read_table(tmp_path / name / "joint" / "table.csv") for name in ("ray", "here"))
    assert len(ray) == 9
    assert ray == here
    assert (tmp_path / "ray/cells/TeamSupport-c2-h2/mappo/seed-0/model.zip").exists()


def test_cells_that_fit_on_no_node_of_a_fresh_ray() -> None:
    pytest.importorskip("ray")
    with pytest.raises(ValueError, match=r"a cell wants 1 CPUs and 3 GPUs of one node, .* lower --cpus-per-cell or"):
        list(RayEngine(gpus=3, workers=1).run(obey, [job("a")]))


def test_ray_is_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    assert cli.main(["run", "joint", "--size", "smoke", "--ray", "-f", str(tmp_path)]) == 2
    assert capsys.readouterr().err == (
        "python -m sb3_saf.experiments run: error: --ray needs Ray, which is not installed: pip install "
        "'sb3-saf[ray]', or leave --ray out to run in processes of this machine\n"
    )
