"""Running experiments: what is kept, what is never run again, what happens to a killed run."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import zipfile
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_saf.experiments import cli
from sb3_saf.experiments.cell import Job, curve, run_job
from sb3_saf.experiments.definitions import Level, find_experiment
from sb3_saf.experiments.files import differences
from sb3_saf.experiments.grid import Cell, RunConfig, Selection, Shard
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.run import CellOptions, Summary, run
from sb3_saf.suites.hecogrid import NativeVecEnv
from sb3_saf.teams.checks import evaluation_seed
from sb3_saf.training.train import main as train_main
from tests.experiments_jobs import InlineEngine, is_running, read_table, wait_until

SMOKE = RunConfig("smoke")
#: Two methods that train fast, and a random team, at two levels of ``joint``.
TWO = Selection((0, 1), ("ippo", "mappo"), (), ("2", "3"))
N_CELLS = 2 * 2 * 2 + 2 * 2
ONE = Selection((0,), ("ippo",), (), ("2",))


def run_inline(
    folder: Path,
    selection: Selection = TWO,
    name: str = "joint",
    config: RunConfig = SMOKE,
    shard: Shard = Shard(),  # noqa: B008 (immutable)
    engine: InlineEngine | None = None,
    retries: int = 0,
) -> tuple[Summary, InlineEngine]:
    engine = engine or InlineEngine()
    options = CellOptions(retries=retries)
    return run(find_experiment(name), selection, config, Results(folder), engine, options, shard), engine


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a finished run, read-only."""
    folder = tmp_path_factory.mktemp("undisturbed")
    summary, engine = run_inline(folder)
    assert summary == Summary(N_CELLS, [], [])
    assert len(engine.jobs) == N_CELLS
    return folder


def cell_of(folder: Path, method: str = "mappo", seed: int = 1, level: int = 2) -> Path:
    return folder / "cells" / f"TeamSupport-c{level}-h{level}" / method / f"seed-{seed}"


def test_the_table_has_a_row_for_each_cell_and_level(undisturbed: Path) -> None:
    table = read_table(undisturbed / "joint" / "table.csv")
    assert len(table) == N_CELLS
    keys = {(row["method"], row["coordination"], row["heterogeneity"], row["seed"]) for row in table}
    assert keys == {(m, c, c, s) for m in ("ippo", "mappo", "random") for c in "23" for s in "01"}
    for row in table:
        returns = [float(value) for value in row["returns"].split(" ")]
        assert len(returns) == int(row["episodes"]) == 32
        assert float(row["return_mean"]) == pytest.approx(sum(returns) / 32)
        assert float(row["return_low"]) <= float(row["return_mean"]) <= float(row["return_high"])
        assert float(row["score"]) == pytest.approx(float(row["return_mean"]) / 6)
        assert row["game_steps"] == ("0" if row["method"] == "random" else "400")
        assert int(row["evaluation_seed"]) == evaluation_seed(int(row["seed"]))
    at_two = {(row["method"], row["seed"]): row["returns"] for row in table if row["coordination"] == "2"}
    assert len(set(at_two.values())) == len(at_two)  # seeds and methods differ


def test_a_cell_has_everything_to_be_understood_and_trained_again(undisturbed: Path) -> None:
    folder = cell_of(undisturbed)
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    described = ("cell.json", "command.txt", "config.json", "status.json", "versions.json")
    assert names == {*described, "curve.csv", "model.zip", "tests/c2-h2.json"}
    config, versions, status = (
        json.loads((folder / f"{n}.json").read_text()) for n in ("config", "versions", "status")
    )
    assert (config["algo"], config["game_steps"], config["env_kwargs"]["coordination"]) == ("mappo", 400, 2)
    assert (config["seed"], config["test"]) == (1, {"episodes": 32, "deterministic": False})
    assert versions["torch"] == th.__version__ and versions["commit"]
    assert status["processor_seconds"] > 0 and status["wall_seconds"] > 0
    points = np.genfromtxt(folder / "curve.csv", delimiter=",", names=True)
    assert points.dtype.names == ("game_steps", "processor_seconds", "mean_return", "episodes")
    assert points["game_steps"][-1] == 400
    assert (np.diff(points["processor_seconds"]) >= 0).all()
    assert points["processor_seconds"][-1] == pytest.approx(status["processor_seconds"], abs=0.01)


def test_the_command_trains_the_same_model(undisturbed: Path, tmp_path: Path) -> None:
    command = (cell_of(undisturbed) / "command.txt").read_text().split()
    assert command[:3] == ["python", "-m", "sb3_saf.train"]
    extra = ["-f", str(tmp_path), "--num-threads", "1", "--no-progress"]
    train_main([*command[3:], *extra])
    (trained,) = tmp_path.glob("mappo/*/TeamSupport-v0.zip")
    assert_same_weights(trained, cell_of(undisturbed) / "model.zip")


def assert_same_weights(first: Path, second: Path) -> None:
    theirs, ours = (PPO.load(path).policy.state_dict() for path in (first, second))
    assert list(theirs) == list(ours)
    assert all(th.equal(theirs[name], ours[name]) for name in ours)


def test_finished_cells_are_never_run_again(undisturbed: Path) -> None:
    table = (undisturbed / "joint" / "table.csv").read_bytes()
    summary, engine = run_inline(undisturbed)
    assert (summary, engine.jobs) == (Summary(0, [], []), [])
    assert (undisturbed / "joint" / "table.csv").read_bytes() == table


def test_cells_depend_on_nothing_but_themselves(undisturbed: Path, tmp_path: Path) -> None:
    """In reverse order, in two parts, after other cells: the same numbers."""
    for number in (2, 1):
        run_inline(tmp_path, Selection((1, 0), ("mappo", "ippo"), (), ("3",)), shard=Shard(number, 2))
    ours, theirs = (read_table(folder / "joint" / "table.csv") for folder in (tmp_path, undisturbed))
    assert sorted(map(str, ours)) == sorted(str(row) for row in theirs if row["coordination"] == "3")


def test_a_killed_run_leaves_no_worker_and_continues(undisturbed: Path, tmp_path: Path) -> None:
    """With the real workers; one of them is killed too, and its cell retried."""
    words = ["joint", "--size", "smoke", "--methods", "ippo", "--levels", "2", "--seeds", "0", "1", "--workers", "1"]
    words += ["-f", str(tmp_path)]
    process = subprocess.Popen([sys.executable, "-m", "sb3_saf.experiments", "run", *words], stdout=subprocess.DEVNULL)
    wait_until(lambda: list(tmp_path.glob("unfinished/*/*/*/job.json")))
    subprocess.run(["kill", "-9", str(worker_of(process.pid))], check=True)
    wait_until(lambda: len(list(tmp_path.glob("cells/*/*/*"))) >= 1)
    worker = worker_of(process.pid)
    process.kill()
    process.wait()
    wait_until(lambda: not is_running(worker), seconds=20)
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("cells/*/*/*/status.json")}
    assert 1 <= len(kept) < 4
    run_inline(tmp_path, replace(ONE, seeds=(0, 1)))
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    rows = read_table(undisturbed / "joint" / "table.csv")
    known = [row for row in rows if row["method"] != "mappo" and row["coordination"] == "2"]
    assert read_table(tmp_path / "joint" / "table.csv") == known


def worker_of(driver: int) -> int:
    """Wait for the process of a driver's worker. Never 0, which kill takes for the whole group of the tests."""
    children = Path(f"/proc/{driver}/task/{driver}/children")
    workers: list[int] = []

    def has_worker() -> bool:
        found = children.read_text().split() if children.exists() else []
        workers[:] = [int(pid) for pid in found if b"cell" in Path(f"/proc/{pid}/cmdline").read_bytes()]
        return bool(workers)

    wait_until(has_worker)
    return workers[0]


def test_a_trained_cell_is_tested_further_without_training(tmp_path: Path) -> None:
    """Cells trained for one experiment are only tested for another. An untrained QPLEX would act at random."""
    one, short = Selection((0,), ("qplex",), ("TeamSupport-v0",)), replace(SMOKE, overrides={"game_steps": 40})
    run_inline(tmp_path / "both", one, "coordination", short)
    summary, engine = run_inline(tmp_path / "both", one, "ood-coordination", short)
    assert (summary.finished, engine.with_model) == (1, [True])
    levels = (Level.of(coordination=1, heterogeneity=1), Level.of(coordination=3, heterogeneity=1))
    assert [(job.cell.method, job.cell.tests) for job in engine.jobs] == [("qplex", levels)]
    run_inline(tmp_path / "alone", one, "ood-coordination", short)
    both, alone = (read_table(tmp_path / name / "ood-coordination" / "table.csv") for name in ("both", "alone"))
    assert both == alone
    assert [row["coordination"] for row in both if row["method"] == "qplex"] == ["1", "2", "3"]
    assert {row["train_coordination"] for row in both if row["method"] == "qplex"} == {"2"}


def job_in(folder: Path, method: str = "ippo", tests: int = 1, **options: Any) -> Path:
    """Create the folder of a job: a cell at c=2 of TeamSupport."""
    folder.mkdir(parents=True)
    levels = [Level.of(coordination=c, heterogeneity=1) for c in (2, 1)]
    cell = Cell(method, "TeamSupport-v0", levels[0], 0, tuple(levels[:tests]))
    Job(cell, options.pop("config", SMOKE), **options).write(folder)
    return folder


def test_tensorboard_of_a_cell_has_the_inside_of_its_policy(tmp_path: Path) -> None:
    short = replace(SMOKE, overrides={"game_steps": 40})
    run_job(job_in(tmp_path / "cell", config=short, tensorboard=True))
    (file,) = (tmp_path / "cell" / "result").rglob("events.*")
    assert "critic/explained_variance" in EventAccumulator(str(file)).Reload().Tags()["scalars"]


def work_badly(folder: Path) -> None:
    if Job.read(folder).cell.method == "mappo":
        raise RuntimeError("out of luck")
    run_job(folder)


def test_a_failed_cell_says_why_and_is_tried_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    both = replace(ONE, methods=("mappo", "ippo"))
    summary, engine = run_inline(tmp_path, both, engine=InlineEngine(work_badly), retries=1)
    assert (summary.finished, [cell.method for cell in summary.failed]) == (2, ["mappo"])
    assert [job.cell.method for job in engine.jobs] == ["mappo", "ippo", "random", "mappo"]
    printed = capsys.readouterr().out
    assert "mappo TeamSupport c=2, h=2 seed 0: attempt 1 failed, trying again: out of luck" in printed
    assert "mappo TeamSupport c=2, h=2 seed 0: FAILED: out of luck; see " in printed
    results, (failed,) = Results(tmp_path), summary.failed
    error = results.failure(failed)
    assert error is not None and "out of luck" in error.read_text()
    assert len(read_table(tmp_path / "joint" / "table.csv")) == 2
    assert run_inline(tmp_path, both)[0] == Summary(1, [], [])
    assert results.failure(failed) is None
    assert len(read_table(tmp_path / "joint" / "table.csv")) == 3


def test_exit_codes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(folder: Path) -> None:
        raise KeyboardInterrupt

    words = ["run", "joint", "--size", "smoke", "--seeds", "0", "--levels", "2", "--retries", "0", "-f", str(tmp_path)]
    for work, method, code, message in (
        (work_badly, "mappo", 1, "1 cells failed; the same command tries them again"),
        (interrupted, "mappo", 130, "finished cells and checkpoints are kept; the same command continues"),
        (work_badly, "ippo", 0, ""),
    ):
        monkeypatch.setattr(cli, "_engine", lambda options, work=work: InlineEngine(work))
        assert cli.main([*words, "--methods", method]) == code
        assert message in capsys.readouterr().err


def refused(folder: Path, config: RunConfig) -> str:
    with pytest.raises(ValueError, match="was") as error:
        run_inline(folder, TWO, config=config)
    return str(error.value)


def test_other_settings_are_refused(undisturbed: Path) -> None:
    message = refused(undisturbed, replace(SMOKE, overrides={"game_steps": 800, "learning_rate": 1e-3}))
    assert "overrides.game_steps was None, now 800" in message
    assert "overrides.learning_rate was None, now 0.001" in message
    assert "size was 'smoke', now 'small'" in refused(undisturbed, RunConfig("small"))
    assert "episodes was 32, now 8" in refused(undisturbed, replace(SMOKE, episodes=8))


def test_changed_files_of_zoo_configs_are_refused(undisturbed: Path, tmp_path: Path) -> None:
    """The YAML differs from the one with which the cell was trained."""
    folder = shutil.copytree(undisturbed, tmp_path / "copy")
    path = cell_of(folder) / "config.json"
    config = json.loads(path.read_text())
    config["hyperparams"]["n_epochs"] = 9
    path.write_text(json.dumps(config))
    assert "hyperparams.n_epochs was 9, now 2; restore them, delete that cell" in refused(folder, SMOKE)


def test_differences() -> None:
    old, new = {"a": 1, "b": {"c": 2, "d": 3}, "e": {}}, {"a": 1, "b": {"c": 4, "f": 5}, "e": {}}
    assert differences(old, new) == "b.c was 2, now 4, b.d was 3, now None, b.f was None, now 5"
    assert differences(old, new, most=1) == "b.c was 2, now 4, and 2 more"


class Interloper(InlineEngine):
    """
    Starts another run in the same folder during its first cell.

    :param folder: of the results
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder
        self.other: Summary | None = None

    def submit(self, folder: Path) -> Future[None]:
        if self.other is None:
            self.other, _ = run_inline(self.folder, replace(ONE, seeds=(0, 1)), shard=Shard(1, 2))
        return super().submit(folder)


def test_runs_at_once_divide_the_cells(undisturbed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """``run`` and ``run --shard 1/2`` in one folder: each cell is run by only one of them."""
    engine = Interloper(tmp_path)
    summary, _ = run_inline(tmp_path, replace(ONE, seeds=(0, 1)), engine=engine)
    assert engine.other is not None
    assert (engine.other.finished, len(engine.other.elsewhere)) == (1, 1)  # the other one of two is running
    assert (summary.finished, len(summary.elsewhere)) == (3, 1)
    assert "1 cells were left to another run" in capsys.readouterr().out
    ours = read_table(tmp_path / "joint" / "table.csv")
    theirs = read_table(undisturbed / "joint" / "table.csv")
    assert ours == [row for row in theirs if row["method"] != "mappo" and row["coordination"] == "2"]


DAMAGED = ["", "[]", "{}", '{"state": 1}', "[" * 100_000, "\x00", "not JSON"]


@pytest.mark.parametrize("content", DAMAGED)
@pytest.mark.parametrize("name", ["status.json", "config.json", "tests/c2-h2.json"])
def test_damaged_files_are_read_as_missing(name: str, content: str, undisturbed: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(undisturbed, tmp_path / "copy")
    level = Level.of(coordination=2, heterogeneity=2)
    cell, path = Cell("mappo", "TeamSupport-v0", level, 1, (level,)), cell_of(folder) / name
    assert not Results(folder).missing_tests(cell)
    path.write_text(content)
    results = Results(folder)
    assert results.missing_tests(cell) == (level,) and list(results.damaged) == [path]


def test_damaged_files_are_named_and_their_cells_run_again(
    undisturbed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(undisturbed, tmp_path / "copy")
    names = ("status.json", "config.json", "tests/c2-h2.json")
    damaged = [cell_of(folder, "ippo", 0) / names[0], cell_of(folder, "ippo", 1) / names[1], cell_of(folder) / names[2]]
    for path in damaged:
        path.write_text("not JSON")
    capsys.readouterr()
    summary, engine = run_inline(folder)
    assert summary == Summary(3, [], [])
    printed = capsys.readouterr().out
    assert all(str(path) in printed for path in damaged)
    assert sorted(engine.with_model) == [False, False, True]
    assert read_table(folder / "joint" / "table.csv") == read_table(undisturbed / "joint" / "table.csv")
    assert_same_weights(cell_of(folder, "ippo", 0) / "model.zip", cell_of(undisturbed, "ippo", 0) / "model.zip")


@pytest.mark.parametrize("content", ["", "{}", "[" * 100_000])
def test_damaged_settings_are_named_and_written_anew(
    content: str, undisturbed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(undisturbed, tmp_path / "copy")
    (folder / "settings.json").write_text(content)
    (folder / "joint" / "selections" / "other.json").write_text(content)
    with pytest.raises(SystemExit, match="2"):
        cli.main(["report", "joint", "-f", str(folder)])
    error = capsys.readouterr().err
    assert str(folder / "settings.json") in error and error.count("\n") == 1
    assert run_inline(folder)[0] == Summary(0, [], [])
    assert str(folder / "settings.json") in capsys.readouterr().out
    assert (folder / "settings.json").read_text() == (undisturbed / "settings.json").read_text()


def test_a_cell_appears_at_once_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If interrupted while its files are moved, it does not exist."""

    def cut_off(source: Path, target: Path) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr("sb3_saf.experiments.results.os.replace", cut_off)
        with pytest.raises(KeyboardInterrupt):
            run_inline(tmp_path, ONE)
    assert not list(tmp_path.glob("cells/*/*/seed-0"))
    summary, _ = run_inline(tmp_path, ONE)
    assert summary.finished == 2


def test_curve(tmp_path: Path) -> None:
    """Five episodes of 10 steps, two games: two points, of at least two episodes each."""
    path = tmp_path / "monitor.csv"
    path.write_text("#{}\nr,l,t\n1,10,0\n2,10,0\n6,10,0\n4,10,0\n8,10,0\n")
    clock = np.array([[0, 0, 0], [20, 4, 9], [50, 7, 20]])
    assert (
        curve(path, clock, 2) == "game_steps,processor_seconds,mean_return,episodes\n30,5.000,3.0,3\n50,7.000,6.0,2\n"
    )


def struck_at(monkeypatch: pytest.MonkeyPatch, step: int | None) -> list[int]:
    """Count the steps of vector environments; simulate the death of the process at one of them."""
    played, play = [0], NativeVecEnv.step_wait

    def counted(self: NativeVecEnv) -> Any:
        played[0] += 1
        if played[0] == step:
            raise RuntimeError("struck")
        return play(self)

    monkeypatch.setattr(NativeVecEnv, "step_wait", counted)
    return played


def attempt(folder: Path, step: int | None = None) -> int:
    """Do a job; if a step is given, die at this step; return the number of steps played."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        played = struck_at(monkeypatch, step)
        if step is None:
            run_job(folder)
        else:
            with pytest.raises(RuntimeError, match="struck"):
                run_job(folder)
        return played[0]


@pytest.mark.parametrize("method", ["saf", "qplex"])
def test_a_cell_that_was_killed_goes_on_from_its_checkpoint(method: str, tmp_path: Path) -> None:
    short = replace(SMOKE, overrides={"game_steps": 200})
    whole, killed = (job_in(tmp_path / name, method, tests=2, config=short) for name in ("whole", "killed"))
    n_steps = attempt(whole)
    n_tested = 2 * 10  # two tests, episodes of 10 steps
    first = attempt(killed, (n_steps - n_tested) * 2 // 3)
    second = attempt(killed, (n_steps - n_tested) // 3 + 15)  # in a test: the trained model is kept
    rest = attempt(killed)
    assert rest == n_tested
    assert first + second < n_steps + (n_steps - n_tested) / 2
    assert what_counts(whole / "result") == what_counts(killed / "result")


def what_counts(cell_folder: Path) -> dict[str, Any]:
    """Return everything in a cell's folder except times."""
    tests = {path.name: json.loads(path.read_text())["returns"] for path in (cell_folder / "tests").iterdir()}
    files = sorted(str(path.relative_to(cell_folder)) for path in cell_folder.rglob("*") if path.is_file())
    with zipfile.ZipFile(cell_folder / "model.zip") as model:
        weights = model.read("policy.pth")
    texts = [(cell_folder / name).read_text() for name in ("config.json", "command.txt")]
    points = np.genfromtxt(cell_folder / "curve.csv", delimiter=",", names=True)
    assert (np.diff(points["processor_seconds"]) >= 0).all()
    curve = [points[name].tolist() for name in ("game_steps", "mean_return", "episodes")]
    return {"tests": tests, "files": files, "weights": weights, "texts": texts, "curve": curve}


def test_checkpoints_of_other_settings_are_left_alone_and_finished_cells_keep_none(tmp_path: Path) -> None:
    results = Results(tmp_path)
    with pytest.MonkeyPatch.context() as monkeypatch:
        struck_at(monkeypatch, 15)
        summary, _ = run_inline(tmp_path, ONE)
    (failed, *_) = summary.failed
    folder = results.unfinished(failed)
    assert list(folder.glob("training/checkpoints/*.ckpt"))
    (folder / "config.json").write_text("{}")  # as if the settings had been different
    run_inline(tmp_path, ONE)
    assert results.is_finished(failed) and not (tmp_path / "unfinished").exists()


def test_a_cell_can_be_checked(undisturbed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shutil.copytree(undisturbed, tmp_path / "copy")
    cell, other = cell_of(folder), cell_of(folder, seed=0)
    assert cli.main(["check", str(cell)]) == 0
    assert capsys.readouterr().out == "equal, bit for bit: returns at c=2, h=2, learning curve, weights\n"
    shutil.copy(other / "model.zip", cell)
    test = json.loads((cell / "tests" / "c2-h2.json").read_text())
    test["returns"][3] += 1
    (cell / "tests" / "c2-h2.json").write_text(json.dumps(test))
    assert cli.main(["check", str(cell)]) == 1
    printed = capsys.readouterr().out
    assert "equal, bit for bit: learning curve\n" in printed
    assert "different: returns at c=2, h=2: mean" in printed and "different: weights: differ by up to" in printed
    with pytest.raises(SystemExit, match="2"):
        cli.main(["check", str(folder)])
    assert "is no finished cell; expected RESULTS/cells/TASK-LEVEL/METHOD/seed-N" in capsys.readouterr().err
