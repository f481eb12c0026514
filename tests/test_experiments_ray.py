"""Experiments on a real Ray cluster of several nodes on this machine, one of which is killed."""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import psutil
import pytest

from sb3_saf.experiments import cli
from sb3_saf.experiments.cell import Job, run_job
from sb3_saf.experiments.definitions import EXPERIMENTS, Cell, RunConfig, Selection
from sb3_saf.experiments.engines import RayEngine, _run_on_ray, inputs_of, require_ray
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.run import Summary, run
from sb3_saf.teams.files import read_json
from tests.experiments_jobs import InlineEngine, read_table, wait_until
from tests.test_experiments_run import assert_same_weights
from tests.test_training_commands import failed

CHOICE = Selection((0,), ("ippo",), (), ("2", "3"))
SMOKE = RunConfig("smoke", episodes=32, eval_freq=200, eval_episodes=2)
#: By default, Ray waits about 15 s before it considers a silent node dead.
IMPATIENT = {
    "health_check_initial_delay_ms": 0,
    "health_check_period_ms": 1_000,
    "health_check_timeout_ms": 3_000,
    "health_check_failure_threshold": 3,
}


# First: the cluster of another test still answers for a moment after it was stopped.
def test_no_cluster(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("ray")
    words = ["run", "joint", "--size", "smoke", "--address", "auto", "-f", str(tmp_path)]
    error = failed(words, capsys, cli.main)
    assert "no Ray cluster at --address auto" in error
    assert "start one with `ray start --head`" in error


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Start a head node that runs no jobs and two nodes with one processor each."""
    pytest.importorskip("ray")
    require_ray()
    from ray.cluster_utils import Cluster

    head = {"num_cpus": 0, "include_dashboard": False, "_system_config": IMPATIENT}
    nodes = Cluster(initialize_head=True, head_node_args=head)
    for _ in range(2):
        nodes.add_node(num_cpus=1)
    yield nodes
    nodes.shutdown()


class NodeKiller(RayEngine):
    """
    An engine that kills a node as soon as the node runs a cell after the first cell has finished.

    :param cluster: with the node
    """

    def __init__(self, cluster: Any) -> None:
        super().__init__(cluster.address)
        self.cluster = cluster
        self.lost: list[BaseException] = []
        self._killer = threading.Thread(target=self._kill, daemon=True)

    def submit(self, folder: Path) -> Future[None]:
        future = super().submit(folder)
        future.add_done_callback(self._note)
        return future

    def _note(self, future: Future[None]) -> None:
        if (error := future.exception()) is not None:
            self.lost.append(error)
        elif self._killer.ident is None:
            self._killer.start()

    def _kill(self) -> None:
        node = self.cluster.list_all_nodes()[-1]
        (raylet,) = (psutil.Process(info.process.pid) for info in node.all_processes["raylet"])
        workers: list[psutil.Process] = []

        def is_any_caught() -> bool:
            workers.extend(filter(is_caught, raylet.children(recursive=True)))
            return bool(workers)

        wait_until(is_any_caught)
        self.cluster.remove_node(node, allow_graceful=False)
        for worker in workers:
            worker.kill()


def is_caught(worker: psutil.Process) -> bool:
    """
    Suspend a worker that runs a cell; return whether it does.

    A worker outlives its node for a moment, in which it may finish the cell and send the result.
    """
    if not is_cell(worker):
        return False
    worker.suspend()
    if is_cell(worker):
        return True
    worker.resume()
    return False


def is_cell(process: psutil.Process) -> bool:
    """Return whether a process runs a cell; Ray names workers after the task that they run."""
    try:
        return process.name().startswith("ray::_run_on_ray")
    except psutil.NoSuchProcess:
        return False


def test_the_table_is_that_of_this_machine_though_a_node_is_killed(cluster: Any, tmp_path: Path) -> None:
    joint, engine = EXPERIMENTS["joint"], NodeKiller(cluster)
    assert run(joint, CHOICE, SMOKE, Results(tmp_path / "ray"), engine) == Summary(4, [], [])
    assert engine.lost
    assert all("NodeDied" in str(error) for error in engine.lost)
    run(joint, CHOICE, SMOKE, Results(tmp_path / "here"), InlineEngine())
    ray, here = (read_table(tmp_path / name / "joint" / "runs.csv") for name in ("ray", "here"))
    assert len(ray) == 4
    assert ray == here
    assert (tmp_path / "ray/cells/TeamSupport-c2-h2/ippo/seed-0/model.zip").exists()


#: Starts Ray as ``--ray`` does, asks for GPUs that it does not have, and prints the addresses on which it listens.
LISTENING = """
import psutil
from sb3_saf.experiments.engines import RayEngine

with RayEngine(workers=1):
    try:
        RayEngine(gpus=3, workers=1)
    except ValueError as error:
        print(error)
    processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
    numbers = {process.pid for process in processes}
    sockets = [socket for socket in psutil.net_connections("inet") if socket.pid in numbers]
print(*{socket.laddr.ip for socket in sockets if socket.status == psutil.CONN_LISTEN})
"""


def test_ray_on_this_machine_listens_on_localhost_only_and_knows_its_size() -> None:
    pytest.importorskip("ray")
    result = subprocess.run([sys.executable, "-c", LISTENING], capture_output=True, text=True, check=True, timeout=200)
    error, line = result.stdout.splitlines()
    assert re.match(r"a cell wants 1 CPUs and 3 GPUs of one node, .* lower --cpus-per-cell or", error)
    addresses = line.split()
    assert addresses
    assert all(address.rpartition(":")[2].startswith("127.") or address == "::1" for address in addresses), addresses


def test_a_cell_whose_worker_is_killed_goes_on_from_its_checkpoint_and_a_job_that_is_none_fails(
    cluster: Any, tmp_path: Path
) -> None:
    whole, killed = (tmp_path / name for name in ("whole", "killed"))
    for folder in (whole, killed):
        folder.mkdir()
        ippo(1_000, 500).write(folder)
    run_job(whole)
    with RayEngine(cluster.address) as engine:
        first = engine.submit(killed)
        wait_until((killed / "result" / "monitor.csv").exists)
        before = set(killed.glob("result/checkpoints/*.ckpt"))
        wait_until(lambda: set(killed.glob("result/checkpoints/*.ckpt")) - before)
        for process in psutil.process_iter(["name"]):
            if is_cell(process):
                process.kill()
        assert "died" in str(first.exception(timeout=200))
        time.sleep(1)  # the times are in whole seconds
        second = time.strftime("%Y-%m-%dT%H:%M:%S%z")
        engine.submit(killed).result(timeout=200)
        no_job = tmp_path / "no job"
        no_job.mkdir()
        (no_job / "job.json").write_text("[]")
        error = engine.submit(no_job).exception(timeout=200)
    assert "no job.json of an unfinished cell" in str(error).splitlines()[-1]
    assert read_json(killed / "result" / "finished.json")["started"] < second
    assert_same_weights(whole / "result" / "model.zip", killed / "result" / "model.zip")


def ippo(game_steps: int, eval_freq: int) -> Job:
    experiment = EXPERIMENTS["joint"]
    (level, *_) = experiment.tests()
    config = RunConfig("smoke", {"game_steps": game_steps}, 32, eval_freq, 2)
    return Job(Cell("ippo", experiment.envs[0], level, 0, (level,)), config)


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a job that was done on this machine."""
    folder = tmp_path_factory.mktemp("here")
    ippo(40, 40).write(folder)
    run_job(folder)
    return folder


@pytest.mark.parametrize(("is_shared", "is_trained"), [(True, False), (False, False), (False, True)])
def test_a_node_works_in_the_folder_that_it_sees(is_shared: bool, is_trained: bool, here: Path, tmp_path: Path) -> None:
    """On such a node, killed cells resume; to and from other nodes, trained models and results are sent."""
    folder = tmp_path / "there"
    folder.mkdir()
    ippo(40, 40).write(folder)
    for model in (here / "result").glob("*.zip") if is_trained else ():
        shutil.copy(model, folder)
    archive = _run_on_ray(str(folder if is_shared else tmp_path / "x"), inputs_of(folder))
    assert (archive is None) == is_shared
    if archive is not None:
        zipfile.ZipFile(io.BytesIO(archive)).extractall(folder)
    ours, theirs = ((of / "result" / "tests/c2-h2.json").read_text() for of in (here, folder))
    assert ours.partition('"wall')[0] == theirs.partition('"wall')[0]
    assert (folder / "result" / "run.json").exists() != is_trained
    assert (folder / "log.txt").exists()


def test_ray_is_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    assert failed(["run", "joint", "--size", "smoke", "--ray", "-f", str(tmp_path)], capsys, cli.main) == (
        "python -m sb3_saf.experiments run: error: --ray needs Ray, which is not installed: pip install "
        "'sb3-saf[ray]', or leave --ray out to run in processes of this machine"
    )
