"""Running experiments: what is kept, what is never run again, what happens to a killed run."""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_saf import EvaluationResult, TeamMonitor
from sb3_saf.experiments import cli
from sb3_saf.experiments.cell import Job, play, run_job
from sb3_saf.experiments.definitions import EXPERIMENTS, RANDOM, Cell, Level, RunConfig, Selection, Shard
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.run import CellOptions, Summary, run
from sb3_saf.experiments.tables import requested
from sb3_saf.teams.files import differences, read_json, write_json
from sb3_saf.teams.vec_env import game_seeds_of
from sb3_saf.training.folders import finish_run
from sb3_saf.training.train import main as train_main
from tests.experiments_jobs import InlineEngine, is_running, read_table, wait_until
from tests.toy_envs import Game

SMOKE = RunConfig("smoke", {"game_steps": 120, "learning_rate": 0.01}, episodes=32, eval_freq=60, eval_episodes=2)
#: Two methods that train fast, and a random team, at a level of ``joint``.
TWO = Selection((0, 1), ("ippo", "mappo"), (), ("2",))
N_CELLS = 2 * 2 + 2
ONE = Selection((0,), ("ippo",), (), ("2",))
CELL = "TeamSupport-c2-h2/mappo/seed-1"


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
    return run(EXPERIMENTS[name], selection, config, Results(folder), engine, options, shard), engine


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a finished run, read-only."""
    folder = tmp_path_factory.mktemp("undisturbed")
    summary, engine = run_inline(folder)
    assert summary == Summary(N_CELLS, [], [])
    assert len(engine.jobs) == N_CELLS
    return folder


def cell_of(folder: Path) -> Path:
    return folder / "cells" / CELL


def copied_from(folder: Path) -> Callable[[Path], None]:
    """Return the work of an engine that takes the results of cells from a finished run in the place of training."""

    def copy(job: Path) -> None:
        shutil.copytree(folder / "cells" / Job.read(job).cell.id, job / "result")

    return copy


def test_the_table_has_a_row_for_each_cell_and_level(undisturbed: Path) -> None:
    table = read_table(undisturbed / "joint" / "runs.csv")
    assert len(table) == N_CELLS
    keys = {(row["method"], row["coordination"], row["heterogeneity"], row["seed"]) for row in table}
    assert keys == {(m, "2", "2", s) for m in ("ippo", "mappo", "random") for s in "01"}
    for row in table:
        test = read_json(undisturbed / "cells" / row["cell"] / "tests" / f"{row['level']}.json")
        plays = {(play["policy"], play["actions"]): play["returns"] for play in test["plays"]}
        assert {len(returns) for returns in plays.values()} == {int(row["episodes"])} == {32}
        assert float(row["return_mean"]) == pytest.approx(np.mean(plays["best", "drawn"]))
        assert float(row["return_sd"]) == pytest.approx(np.std(plays["best", "drawn"], ddof=1))
        if row["method"] != "random":
            assert float(row["return_last"]) == pytest.approx(np.mean(plays["last", "drawn"]))
            assert float(row["return_most_likely"]) == pytest.approx(np.mean(plays["best", "most likely"]))
            assert float(row["return_last_most_likely"]) == pytest.approx(np.mean(plays["last", "most likely"]))
        own = [float(value) for value in row["agent_returns"].split(" ")]
        assert len(own) == 4 and sum(own) == pytest.approx(float(row["return_mean"]))
        assert float(row["return_low"]) <= float(row["return_mean"]) <= float(row["return_high"])
        assert float(row["score"]) == pytest.approx(float(row["return_mean"]) / 6)
        assert row["game_steps"] == ("0" if row["method"] == "random" else "120")
    assert len({(row["return_mean"], row["return_sd"]) for row in table}) == N_CELLS  # seeds and methods differ


def test_a_cell_has_everything_to_be_understood_and_trained_again(undisturbed: Path) -> None:
    folder = cell_of(undisturbed)
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    models = {"model.zip", "best_model.zip"}
    assert names == {"run.json", "curve.csv", "evaluations.csv", *models, "tests/c2-h2.json", "finished.json"}
    description, finished = read_json(folder / "run.json"), read_json(folder / "finished.json")
    settings = description["settings"]
    assert (settings["algo"], settings["game_steps"], settings["env_kwargs"]["coordination"]) == ("mappo", 120, 2)
    protocol = {"episodes": 32, "eval_freq": 60, "eval_episodes": 2}
    assert description["seed"] == 1
    assert description["options"] == {"method": "mappo", "level": {"coordination": 2, "heterogeneity": 2}, **protocol}
    assert description["versions"]["torch"] == th.__version__ and description["versions"]["commit"]
    assert finished["processor_seconds"] > 0 and finished["wall_seconds"] > 0
    assert set(finished["files"]) == names - {"finished.json"}
    points = np.genfromtxt(folder / "curve.csv", delimiter=",", names=True)
    assert points.dtype.names == ("game_steps", "processor_seconds", "score", "episodes")
    assert points["game_steps"][-1] == 120
    assert (np.diff(points["processor_seconds"]) >= 0).all()
    assert points["processor_seconds"][-1] == pytest.approx(finished["processor_seconds"], abs=0.1)


def test_the_command_trains_the_same_model(undisturbed: Path, tmp_path: Path) -> None:
    command = read_json(cell_of(undisturbed) / "run.json")["command"].split()
    assert command[:3] == ["python", "-m", "sb3_saf.train"]
    extra = ["-f", str(tmp_path), "--num-threads", "1", "--no-progress"]
    train_main([*command[3:], *extra])
    (trained,) = tmp_path.glob("mappo/*/TeamSupport-v0.zip")
    assert_same_weights(trained, cell_of(undisturbed) / "model.zip")


def assert_same_weights(first: Path, second: Path) -> None:
    theirs, ours = (PPO.load(path).policy.state_dict() for path in (first, second))
    assert list(theirs) == list(ours)
    assert all(th.equal(theirs[name], ours[name]) for name in ours)


def test_evaluations_do_not_change_the_training(undisturbed: Path, tmp_path: Path) -> None:
    """With others, or fewer: the same last policy, bit for bit, and the same learning curve."""
    run_inline(tmp_path, replace(TWO, seeds=(1,), methods=("mappo",)), config=replace(SMOKE, eval_freq=20))
    for folder, steps in ((undisturbed, [60, 120]), (tmp_path, [20, 60, 100, 120])):
        evaluations = read_table(cell_of(folder) / "evaluations.csv")
        assert [int(row["game_steps"]) for row in evaluations] == steps
        best = max(evaluations, key=lambda row: float(row["return_mean"]))
        (table_row,) = (row for row in read_table(folder / "joint" / "runs.csv") if row["cell"] == CELL)
        assert table_row["best_game_steps"] == best["game_steps"]
    assert_same_weights(cell_of(undisturbed) / "model.zip", cell_of(tmp_path) / "model.zip")


def test_training_evaluations_and_tests_have_games_of_their_own(tmp_path: Path, monkeypatch: Any) -> None:
    """No game of a run has the seed of another kind; every method is tested on the same games."""
    seeds: dict[str, list[set[Any]]] = {"reset": []}
    reset = TeamMonitor.reset

    def noted(self: TeamMonitor) -> Any:
        seeds["reset"].append(set(game_seeds_of(self) or ()))
        return reset(self)

    monkeypatch.setattr(TeamMonitor, "reset", noted)
    config = replace(SMOKE, episodes=40)
    run_job(job_in(tmp_path / "cell", config=config))
    training, evaluation, *tests = seeds["reset"][0], seeds["reset"][1], *seeds["reset"][3:]
    assert not training & evaluation and not (training | evaluation) & set().union(*tests)
    assert [len(games) for games in tests] == [32, 32] * 4 and tests[0] != tests[1] and tests[:2] == tests[2:4]
    seeds["reset"].clear()
    run_job(job_in(tmp_path / "other", "mappo", config=config))
    assert seeds["reset"][3:] == tests


def test_finished_cells_are_never_run_again(undisturbed: Path) -> None:
    table = (undisturbed / "joint" / "runs.csv").read_bytes()
    summary, engine = run_inline(undisturbed)
    assert (summary, engine.jobs) == (Summary(0, [], []), [])
    assert (undisturbed / "joint" / "runs.csv").read_bytes() == table


def test_cells_depend_on_nothing_but_themselves(undisturbed: Path, tmp_path: Path) -> None:
    """In reverse order, in two parts, after other cells: the same numbers."""
    for number in (2, 1):
        run_inline(tmp_path, replace(TWO, seeds=(1,), methods=("mappo", "ippo")), shard=Shard(number, 2))
    ours, theirs = (read_table(folder / "joint" / "runs.csv") for folder in (tmp_path, undisturbed))
    assert sorted(map(str, ours)) == sorted(str(row) for row in theirs if row["seed"] == "1")


def test_a_killed_run_leaves_no_worker_and_continues(undisturbed: Path, tmp_path: Path) -> None:
    """With the real workers; one of them is killed too, and its cell retried."""
    words = ["joint", "--size", "smoke", "--methods", "ippo", "--levels", "2", "--seeds", "0", "1", "--workers", "1"]
    words += ["-f", str(tmp_path), "--episodes", "32", "-n", "120", "--eval-freq", "60", "--eval-episodes", "2"]
    words += ["-params", "learning_rate:0.01"]
    process = subprocess.Popen([sys.executable, "-m", "sb3_saf.experiments", "run", *words], stdout=subprocess.DEVNULL)
    wait_until(lambda: list(tmp_path.glob("unfinished/*/*/*/job.json")))
    subprocess.run(["kill", "-9", str(worker_of(process.pid))], check=True)
    wait_until(lambda: len(list(tmp_path.glob("cells/*/*/*"))) >= 1)
    worker = worker_of(process.pid)
    process.kill()
    process.wait()
    wait_until(lambda: not is_running(worker), seconds=20)
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("cells/*/*/*/finished.json")}
    assert 1 <= len(kept) < 4
    run_inline(tmp_path, replace(ONE, seeds=(0, 1)))
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    rows = read_table(undisturbed / "joint" / "runs.csv")
    known = [row for row in rows if row["method"] != "mappo"]
    assert read_table(tmp_path / "joint" / "runs.csv") == known


def worker_of(driver: int) -> int:
    """Wait for the process of a driver's worker. Never 0, which kill takes for the whole group of the tests."""
    workers: list[int] = []

    def has_worker() -> bool:
        with suppress(psutil.Error):  # one that has just ended
            workers[:] = [child.pid for child in psutil.Process(driver).children() if "cell" in child.cmdline()]
        return bool(workers)

    wait_until(has_worker)
    return workers[0]


def test_a_trained_cell_is_tested_further_without_training(tmp_path: Path) -> None:
    """Cells trained for one experiment are only tested for another. An untrained QPLEX would act at random."""
    one, short = (
        Selection((0,), ("qplex",), ("TeamSupport-v0",)),
        replace(SMOKE, overrides={"game_steps": 40}, episodes=8),
    )
    run_inline(tmp_path / "both", one, "coordination", short)
    summary, engine = run_inline(tmp_path / "both", one, "ood-coordination", short)
    assert (summary.finished, engine.with_model) == (1, [True])
    levels = (Level.of(coordination=1, heterogeneity=1), Level.of(coordination=3, heterogeneity=1))
    assert [(job.cell.method, job.cell.tests) for job in engine.jobs] == [("qplex", levels)]
    run_inline(tmp_path / "alone", one, "ood-coordination", short)
    both, alone = (read_table(tmp_path / name / "ood-coordination" / "runs.csv") for name in ("both", "alone"))
    assert both == alone
    assert [row["coordination"] for row in both if row["method"] == "qplex"] == ["1", "2", "3"]
    assert {row["train_coordination"] for row in both if row["method"] == "qplex"} == {"2"}
    (cell,) = (tmp_path / "alone" / "cells").glob("*/qplex/seed-0")
    (cell / "tests" / "c3-h1.json").write_text("")
    for levels_shown, missing in (([], "not tested yet at c=3, h=1"), (["--levels", "1"], "")):
        assert cli.main(["report", "ood-coordination", "-f", str(tmp_path / "alone"), *levels_shown]) == 0
        page = (tmp_path / "alone" / "ood-coordination" / "report.md").read_text(encoding="utf-8")
        assert "are missing" in page and missing in page if missing else "are missing" not in page


def job_in(folder: Path, method: str = "ippo", tests: int = 1, **options: Any) -> Path:
    """Create the folder of a job: a cell at c=2 of TeamSupport."""
    folder.mkdir(parents=True)
    levels = [Level.of(coordination=c, heterogeneity=1) for c in (2, 1)]
    cell = Cell(method, "TeamSupport-v0", levels[0], 0, tuple(levels[:tests]))
    Job(cell, options.pop("config", SMOKE), **options).write(folder)
    return folder


def test_tensorboard_of_a_cell_has_the_inside_of_its_policy(tmp_path: Path) -> None:
    short = replace(SMOKE, overrides={"game_steps": 40}, episodes=8)
    run_job(job_in(tmp_path / "cell", config=short, tensorboard=True))
    (file,) = (tmp_path / "cell" / "result").rglob("events.*")
    assert "critic/explained_variance" in EventAccumulator(str(file)).Reload().Tags()["scalars"]


def test_a_failed_cell_says_why_and_is_tried_again(
    undisturbed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    work, both = copied_from(undisturbed), replace(ONE, methods=("mappo", "ippo"))

    def work_badly(folder: Path) -> None:
        if Job.read(folder).cell.method == "mappo":
            raise RuntimeError("out of luck")
        work(folder)

    summary, engine = run_inline(tmp_path, both, engine=InlineEngine(work_badly), retries=1)
    assert (summary.finished, [cell.method for cell in summary.failed]) == (2, ["mappo"])
    assert [job.cell.method for job in engine.jobs] == ["mappo", "ippo", "random", "mappo"]
    printed = capsys.readouterr().out
    assert "mappo TeamSupport c=2, h=2 seed 0: attempt 1 failed, trying again: out of luck" in printed
    assert "mappo TeamSupport c=2, h=2 seed 0: FAILED: out of luck; see " in printed
    results, (failed,) = Results(tmp_path), summary.failed
    error = results.failure(failed)
    assert error is not None and "out of luck" in error.read_text()
    assert len(read_table(tmp_path / "joint" / "runs.csv")) == 2
    assert run_inline(tmp_path, both, engine=InlineEngine(work))[0] == Summary(1, [], [])
    assert results.failure(failed) is None
    assert len(read_table(tmp_path / "joint" / "runs.csv")) == 3


def test_a_cell_that_diverges_is_one_line_and_the_exit_code_is_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "LocalEngine", lambda *_: InlineEngine())
    words = ["run", "joint", "--size", "smoke", "--seeds", "0", "--levels", "2", "--methods", "ippo", "-n", "80"]
    words += ["--episodes", "2", "--retries", "0"]
    words += ["-f", str(tmp_path), "-params", "learning_rate:1.0e30"]
    assert cli.main(words) == 1
    printed = capsys.readouterr()
    assert "ippo TeamSupport c=2, h=2 seed 0: FAILED: " in printed.out
    assert "1 cells failed; the same command tries them again" in printed.err


def refused(folder: Path, config: RunConfig) -> str:
    with pytest.raises(ValueError, match="was") as error:
        run_inline(folder, TWO, config=config)
    return str(error.value)


def test_other_settings_are_refused(undisturbed: Path) -> None:
    message = refused(undisturbed, replace(SMOKE, overrides={"game_steps": 800, "gamma": 0.9}))
    assert "overrides.game_steps was 120, now 800" in message
    assert "overrides.gamma was None, now 0.9" in message
    assert "size was 'smoke', now 'small'" in refused(undisturbed, RunConfig("small"))
    assert "episodes was 32, now 8" in refused(undisturbed, replace(SMOKE, episodes=8))


def test_of_two_starts_with_other_settings_one_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other one has written its settings since this one looked for them."""
    config = Results.config
    monkeypatch.setattr(Results, "config", lambda results: None)
    monkeypatch.setattr(Results, "save_config", lambda *_: monkeypatch.setattr(Results, "config", config))
    write_json(tmp_path / "settings.json", asdict(replace(SMOKE, eval_freq=20)))
    engine = InlineEngine()
    with pytest.raises(ValueError, match="have other settings: eval_freq was 20, now 60"):
        run_inline(tmp_path, engine=engine)
    assert not engine.jobs


def test_changed_files_of_zoo_configs_are_refused(undisturbed: Path, tmp_path: Path) -> None:
    """The YAML differs from the one with which the cell was trained."""
    folder = shutil.copytree(undisturbed, tmp_path / "copy")
    description = read_json(cell_of(folder) / "run.json")
    description["settings"]["hyperparams"]["n_epochs"] = 9
    write_json(cell_of(folder) / "run.json", description)
    finish_run(cell_of(folder))
    assert "hyperparams.n_epochs was 9, now 2; restore them, delete that cell" in refused(folder, SMOKE)
    with pytest.raises(ValueError, match="n_epochs was 9, now 2"):  # the report would have both
        run_inline(folder, replace(TWO, seeds=(2,)))


def test_a_changed_test_is_not_taken_for_good_by_a_further_one(undisturbed: Path, tmp_path: Path) -> None:
    results = Results(shutil.copytree(undisturbed, tmp_path / "copy"))
    cell = next(cell for cell in requested(EXPERIMENTS["joint"], results) if cell.id == CELL)
    (test,) = (results.cell_folder(cell) / "tests").iterdir()
    test.write_text(test.read_text() + " ")
    (results.unfinished(cell) / "result" / "tests").mkdir(parents=True)
    results.publish(cell)
    assert results.run(cell) is not None and results.missing_tests(cell) == cell.tests


def test_the_log_of_a_cell_is_one_of_its_files(undisturbed: Path, tmp_path: Path) -> None:
    """It says which resumptions were not exact."""
    results = Results(shutil.copytree(undisturbed, tmp_path / "copy"))
    cell = next(cell for cell in requested(EXPERIMENTS["joint"], results) if cell.id == CELL)
    unfinished = results.unfinished(cell)
    unfinished.mkdir(parents=True)
    shutil.move(results.cell_folder(cell), unfinished / "result")
    (unfinished / "log.txt").write_text("resumed from a damaged checkpoint\n")
    results.publish(cell)
    run = results.run(cell)
    assert run is not None and run.damage("log.txt") is None
    (run.folder / "log.txt").unlink()
    assert run.damage("log.txt") is not None


def test_a_worker_that_ends_without_results_has_failed(tmp_path: Path) -> None:
    summary, _ = run_inline(tmp_path, ONE, engine=InlineEngine(lambda folder: None))
    assert not summary.finished and [cell.method for cell in summary.failed] == ["ippo", RANDOM]


def test_differences() -> None:
    old, new = {"a": 1, "b": {"c": 2, "d": 3}, "e": {}}, {"a": 1, "b": {"c": 4, "f": 5}, "e": {}}
    assert differences(old, new) == "b.c was 2, now 4, b.d was 3, now None, b.f was None, now 5"
    assert differences(old, new, most=1) == "b.c was 2, now 4, and 2 more"


class Interloper(InlineEngine):
    """
    Starts another run in the same folder during its first cell.

    :param folder: of the results
    :param work: of both
    """

    def __init__(self, folder: Path, work: Callable[[Path], None]) -> None:
        super().__init__(work)
        self.folder = folder
        self.other: Summary | None = None

    def submit(self, folder: Path) -> Future[None]:
        if self.other is None:
            engine = InlineEngine(self._work)
            self.other, _ = run_inline(self.folder, replace(ONE, seeds=(0, 1)), shard=Shard(1, 2), engine=engine)
        return super().submit(folder)


def test_runs_at_once_divide_the_cells(undisturbed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """``run`` and ``run --shard 1/2`` in one folder: each cell is run by only one of them."""
    engine = Interloper(tmp_path, copied_from(undisturbed))
    summary, _ = run_inline(tmp_path, replace(ONE, seeds=(0, 1)), engine=engine)
    assert engine.other is not None
    assert (engine.other.finished, len(engine.other.elsewhere)) == (1, 1)  # the other one of two is running
    assert (summary.finished, len(summary.elsewhere)) == (3, 1)
    assert "1 cells were left to another run" in capsys.readouterr().out
    ours = read_table(tmp_path / "joint" / "runs.csv")
    theirs = read_table(undisturbed / "joint" / "runs.csv")
    assert ours == [row for row in theirs if row["method"] != "mappo"]


def edited(**changes: Any) -> Callable[[Path], None]:
    """Change entries of a JSON file."""
    return lambda path: write_json(path, {**read_json(path), **changes})


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def write(content: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(content)


def relisted(path: Path) -> None:
    """Replace a return by NaN, also in the list of files: as if the games had paid it."""
    edited(plays=with_last_return(path, float("nan")))(path)
    finish_run(path.parents[1])


def with_last_return(path: Path, value: float) -> list[dict[str, Any]]:
    """Return the tests of a file with another last return."""
    *others, last = read_json(path)["plays"]
    return [*others, {**last, "returns": [*last["returns"][:-1], value]}]


DAMAGE: dict[str, Any] = {
    "model.zip cut": ("model.zip", cut),
    "curve.csv cut": ("curve.csv", cut),
    "evaluations.csv cut": ("evaluations.csv", cut),
    "run.json edited": ("run.json", edited(seed=5)),
    "finished.json empty": ("finished.json", write("")),
    "finished.json nested": ("finished.json", write("[" * 100_000)),
    "finished.json missing": ("finished.json", Path.unlink),
    "mean edited": ("tests/c2-h2.json", edited(return_mean=99.0)),
    "returns not finite": ("tests/c2-h2.json", relisted),
    "test missing": ("tests/c2-h2.json", Path.unlink),
}


#: Really trained or tested again; the others take what they would find.
REPEATED = ("model.zip cut", "test missing")


@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_cells_are_named_and_run_again(
    kind: str, undisturbed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, damage = DAMAGE[kind]
    folder, level = shutil.copytree(undisturbed, tmp_path / "copy"), Level.of(coordination=2, heterogeneity=2)
    cell = Cell("mappo", "TeamSupport-v0", level, 1, (level,))
    assert not Results(folder).missing_tests(cell)
    damage(cell_of(folder) / name)
    assert Results(folder).missing_tests(cell) == (level,)
    engine = InlineEngine() if kind in REPEATED else InlineEngine(copied_from(undisturbed))
    summary, _ = run_inline(folder, engine=engine)
    assert (summary, engine.with_model) == (Summary(1, [], []), [name.startswith("tests/")])
    assert str(cell_of(folder)) in capsys.readouterr().out
    assert read_table(folder / "joint" / "runs.csv") == read_table(undisturbed / "joint" / "runs.csv")
    assert_same_weights(cell_of(folder) / "model.zip", cell_of(undisturbed) / "model.zip")
    # Nothing that was found is removed.
    assert len(list(folder.glob("damaged/*/*/seed-1_*"))) == (not name.startswith("tests/"))


def test_a_game_that_pays_nan_in_a_test_fails_the_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_saf.experiments.cell.play_test", lambda *_: EvaluationResult([float("nan")], [1]))
    summary, _ = run_inline(tmp_path, ONE)
    assert summary.finished == 0 and len(summary.failed) == 2
    monkeypatch.undo()
    assert run_inline(tmp_path, ONE)[0] == Summary(2, [], [])


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


def struck_at(monkeypatch: pytest.MonkeyPatch, step: int | None) -> list[int]:
    """Count the steps of vector environments; simulate the death of the process at one of them."""
    played, play = [0], TeamMonitor.step_wait

    def counted(self: TeamMonitor) -> Any:
        played[0] += 1
        if played[0] == step:
            raise RuntimeError("struck")
        return play(self)

    monkeypatch.setattr(TeamMonitor, "step_wait", counted)
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


@pytest.mark.parametrize("method", ["mappo", "qplex"])
def test_a_cell_that_was_killed_goes_on_from_its_checkpoint(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = replace(SMOKE, overrides={"game_steps": 200}, eval_freq=200)
    whole, killed = (job_in(tmp_path / name, method, tests=2, config=short) for name in ("whole", "killed"))
    n_steps = attempt(whole)
    n_tests = 2 if method == "qplex" else 4  # best and last policy, drawn and most likely actions
    n_tested = 2 * n_tests * 10  # at two levels, episodes of 10 steps
    first = attempt(killed, (n_steps - n_tested) * 2 // 3)
    # run.json names the versions with which the training began.
    monkeypatch.setattr("sb3_saf.training.folders.software_versions", lambda: {"commit": "another"})
    second = attempt(killed, (n_steps - n_tested) // 3 + 10 * n_tests + 15)  # at the second level: the first is kept
    rest = attempt(killed)
    assert rest == n_tested // 2
    assert first + second < n_steps + (n_steps - n_tested) / 2
    assert what_counts(whole / "result") == what_counts(killed / "result")


def what_counts(cell_folder: Path) -> dict[str, Any]:
    """Return everything in a cell's folder except times."""
    tests = {path.name: untimed(path) for path in (cell_folder / "tests").iterdir()}
    files = sorted(str(path.relative_to(cell_folder)) for path in cell_folder.rglob("*") if path.is_file())
    weights = [zipfile.ZipFile(cell_folder / name).read("policy.pth") for name in ("model.zip", "best_model.zip")]
    points = np.genfromtxt(cell_folder / "curve.csv", delimiter=",", names=True)
    assert (np.diff(points["processor_seconds"]) >= 0).all()
    curve = [points[name].tolist() for name in ("game_steps", "score", "episodes")]
    description = (cell_folder / "run.json").read_text()
    evaluations = (cell_folder / "evaluations.csv").read_text()
    return {**{"tests": tests, "files": files, "weights": weights}, "run": description, "curve": [curve, evaluations]}


def untimed(path: Path) -> Any:
    """Return the content of a test's file without its times."""
    content = read_json(path)
    return {**content, "plays": [{**play, "wall_seconds": 0} for play in content["plays"]]}


def test_a_cell_killed_after_its_model_was_saved_does_not_train_anew(tmp_path: Path) -> None:
    """Checkpoints go last."""
    short = replace(SMOKE, overrides={"game_steps": 200}, eval_freq=200)
    whole, killed = (job_in(tmp_path / name, config=short) for name in ("whole", "killed"))
    n_steps = attempt(whole)

    def killed_here(folder: Path, **cost: Any) -> None:
        raise RuntimeError("struck")

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("sb3_saf.training.run.finish_run", killed_here)
        with pytest.raises(RuntimeError, match="struck"):
            run_job(killed)
    assert (killed / "result" / "model.zip").exists()
    (killed / "result" / "tests" / ".writing-0-c2-h1.json").touch()  # as left by SIGKILL
    assert attempt(killed) <= n_steps / 2
    assert what_counts(whole / "result") == what_counts(killed / "result")
    assert len(list((killed / "result" / "tests").iterdir())) == 1


def test_checkpoints_of_other_settings_are_left_alone_and_finished_cells_keep_none(tmp_path: Path) -> None:
    results = Results(tmp_path)
    with pytest.MonkeyPatch.context() as monkeypatch:
        struck_at(monkeypatch, 15)
        summary, _ = run_inline(tmp_path, ONE)
    (failed, *_) = summary.failed
    result = results.unfinished(failed) / "result"
    assert list(result.glob("checkpoints/*.ckpt"))
    write_json(result / "run.json", {**read_json(result / "run.json"), "seed": 7})  # as if it were another's
    run_inline(tmp_path, ONE)
    assert results.run(failed) is not None and not (tmp_path / "unfinished").exists()
    assert not list(tmp_path.glob("cells/*/*/*/checkpoints"))


def with_weights(path: Path, change: Callable[[th.Tensor], th.Tensor]) -> None:
    """Change the last tensor of the policy in a model's file, and list the file anew."""
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    tensors = th.load(io.BytesIO(content["policy.pth"]), weights_only=True)
    name = list(tensors)[-1]
    tensors[name] = change(tensors[name])
    buffer = io.BytesIO()
    th.save(tensors, buffer)
    with zipfile.ZipFile(path, "w") as archive:
        for entry, data in {**content, "policy.pth": buffer.getvalue()}.items():
            archive.writestr(entry, data)
    finish_run(path.parent)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda tensor: tensor, ""),
        (lambda tensor: tensor * float("nan"), "was 'torch.float32 of shape "),
        (lambda tensor: tensor.double(), "torch.float64"),
        (lambda tensor: tensor.reshape(1, *tensor.shape), "of shape (1, "),
    ],
)
def test_a_cell_can_be_checked(
    change: Any,
    words: str,
    undisturbed: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if words:  # the first case trains again
        monkeypatch.setattr("sb3_saf.experiments.cell.run_job", copied_from(undisturbed))
    cell = cell_of(shutil.copytree(undisturbed, tmp_path / "copy"))
    with_weights(cell / "model.zip", change)
    assert cli.main(["check", str(cell)]) == bool(words)
    printed = capsys.readouterr().out
    equal = "returns at c=2, h=2, learning curve, evaluations, best weights"
    assert f"equal, bit for bit: {equal}{'' if words else ', weights'}\n" in printed
    assert words in printed.partition("different: weights: ")[2]


def test_a_check_sees_edited_numbers(undisturbed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shutil.copytree(undisturbed, tmp_path / "copy")
    cell = cell_of(folder)
    test = cell / "tests" / "c2-h2.json"
    edited(plays=with_last_return(test, 99.0), return_mean=99.0)(test)
    with pytest.raises(SystemExit, match="2"):
        cli.main(["check", str(folder)])
    assert "expected RESULTS/cells/TASK-LEVEL/METHOD/seed-N" in capsys.readouterr().err
    assert cli.main(["check", str(cell)]) == 1
    printed = capsys.readouterr().out
    assert "equal, bit for bit: learning curve, evaluations, best weights, weights\n" in printed
    assert "c2-h2.json has changed" in printed and "return_mean was 99.0, now None" in printed


class BoundedEnv(Game):
    """Agents are paid their actions: up to 1, and up to 10. Treasures are no share of them."""

    def __init__(self, n_treasures: int = 3) -> None:
        self.n_treasures = n_treasures

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Box(0, 1 if agent == "a" else 10, (1,), np.float32)

    def change(self, out: list[Any]) -> None:
        out[1] = {agent: float(action[0]) for agent, action in self.actions.items()}


def test_random_teams_draw_within_the_bounds_of_each_agent(tmp_path: Path) -> None:
    cell = Cell(RANDOM, "tests.test_experiments_run:BoundedEnv", Level.of(), 0, (Level.of(),))
    result = play(Job(cell, RunConfig("smoke", episodes=128)), Level.of(n_treasures=7), tmp_path)
    np.testing.assert_allclose(result.plays[0].agent_means, [4 * 0.5, 4 * 5], rtol=0.1)
    assert result.max_return is None  # only HECOGrid's is its number of treasures
