"""Running: what is kept, what is never run again, what happens to a run that is killed."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch as th
from stable_baselines3 import PPO
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from hecogrid_envs.vec_env import NativeVecEnv
from sb3_saf.experiments import cli
from sb3_saf.experiments import run as run_module
from sb3_saf.experiments.cells import Cell, Choice, Protocol, Shard
from sb3_saf.experiments.definitions import Level, find_experiment
from sb3_saf.experiments.files import differences, unpack
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.run import Machine, Summary, run
from sb3_saf.experiments.table import Row
from sb3_saf.experiments.work import Work, curve, do
from sb3_saf.training.seeds import evaluation_seed
from tests.experiments_jobs import InlineEngine, read_table, wait_until

SMOKE = Protocol("smoke")
#: Two methods that are made in no time, and a random team, at the three levels of ``joint``.
TWO = Choice((0, 1), ("ippo", "mappo"))
N_CELLS = 2 * 3 * 2 + 3 * 2


def run_inline(
    folder: Path,
    choice: Choice = TWO,
    name: str = "joint",
    protocol: Protocol = SMOKE,
    shard: Shard = Shard(),  # noqa: B008 (immutable)
) -> tuple[Summary, list[Work]]:
    engine = InlineEngine()
    summary = run(find_experiment(name), choice, protocol, Results(folder), engine, Machine(), shard)
    return summary, engine.payloads


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, for reading only."""
    folder = tmp_path_factory.mktemp("undisturbed")
    summary, works = run_inline(folder)
    assert summary == Summary(N_CELLS, [])
    assert len(works) == N_CELLS
    return folder


def saf_like(folder: Path, method: str = "mappo", seed: int = 1, level: int = 2) -> Path:
    return folder / "cells" / f"TeamSupport-c{level}-h{level}" / method / f"seed-{seed}"


def test_the_table_has_a_row_for_each_cell_and_level(undisturbed: Path) -> None:
    table = read_table(undisturbed / "joint" / "table.csv")
    assert len(table) == N_CELLS
    keys = {(row["method"], row["coordination"], row["heterogeneity"], row["seed"]) for row in table}
    assert keys == {(m, c, c, s) for m in ("ippo", "mappo", "random") for c in "234" for s in "01"}
    for row in table:
        returns = [float(value) for value in row["returns"].split(" ")]
        assert len(returns) == int(row["episodes"]) == 32
        assert float(row["return_mean"]) == pytest.approx(sum(returns) / 32)
        assert float(row["return_low"]) <= float(row["return_mean"]) <= float(row["return_high"])
        assert float(row["score"]) == pytest.approx(float(row["return_mean"]) / 6)
        assert row["game_steps"] == ("0" if row["method"] == "random" else "400")
        assert int(row["evaluation_seed"]) == evaluation_seed(int(row["seed"]))
    assert set(Row._fields) - set(table[0]) == {"wall_seconds_training", "wall_seconds_test"}


def test_a_cell_has_everything_to_be_understood_and_trained_again(undisturbed: Path) -> None:
    folder = saf_like(undisturbed)
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    files = ("command.txt", "config.json", "curve.csv", "model.zip", "status.json", "versions.json")
    assert names == {*files, "tests/c2-h2.json"}
    config = json.loads((folder / "config.json").read_text())
    assert (config["algo"], config["game_steps"], config["env_kwargs"]["coordination"]) == ("mappo", 400, 2)
    assert config["test"] == {"episodes": 32, "deterministic": False}
    assert json.loads((folder / "versions.json").read_text())["torch"] == th.__version__
    assert json.loads((folder / "status.json").read_text())["state"] == "finished"
    lines = (folder / "curve.csv").read_text().splitlines()
    assert lines[0] == "game_steps,mean_return,episodes"
    assert lines[-1].startswith("400,")


def test_the_command_trains_the_same_model(undisturbed: Path, tmp_path: Path) -> None:
    pytest.importorskip("rl_zoo3")
    command = (saf_like(undisturbed) / "command.txt").read_text().split()
    assert command[:3] == ["python", "-m", "sb3_saf.train"]
    extra = ["-f", str(tmp_path), "--num-threads", "1", "--no-progress"]
    subprocess.run([sys.executable, *command[1:], *extra], check=True, capture_output=True)
    (trained,) = tmp_path.glob("mappo/*/TeamSupport-v0.zip")
    theirs, ours = (PPO.load(path).policy.state_dict() for path in (trained, saf_like(undisturbed) / "model.zip"))
    assert list(theirs) == list(ours)
    assert all(th.equal(theirs[name], ours[name]) for name in ours)


def test_seeds_and_methods_differ(undisturbed: Path) -> None:
    returns = {
        (row["method"], row["seed"]): row["returns"]
        for row in read_table(undisturbed / "joint" / "table.csv")
        if row["coordination"] == "2"
    }
    assert len(set(returns.values())) == len(returns)


def test_the_table_grows_with_what_is_asked_for(undisturbed: Path, tmp_path: Path) -> None:
    for seed in (0, 1):
        run_inline(tmp_path, Choice((seed,), ("ippo", "mappo")))
    ours, theirs = (read_table(folder / "joint" / "table.csv") for folder in (tmp_path, undisturbed))
    assert ours == theirs


def test_finished_cells_are_never_run_again(undisturbed: Path) -> None:
    table = (undisturbed / "joint" / "table.csv").read_bytes()
    assert run_inline(undisturbed) == (Summary(0, []), [])
    assert (undisturbed / "joint" / "table.csv").read_bytes() == table


def test_cells_depend_on_nothing_but_themselves(undisturbed: Path, tmp_path: Path) -> None:
    """In the other order, in two parts, after other cells: the same numbers."""
    for index in (2, 1):
        run_inline(tmp_path, Choice((1, 0), ("mappo", "ippo")), shard=Shard(index, 2))
    ours, theirs = (read_table(folder / "joint" / "table.csv") for folder in (tmp_path, undisturbed))
    assert sorted(map(str, ours)) == sorted(map(str, theirs))


def test_a_killed_run_continues(undisturbed: Path, tmp_path: Path) -> None:
    words = ["joint", "--size", "smoke", "--methods", "ippo", "mappo", "--workers", "2", "-f", str(tmp_path)]
    process = subprocess.Popen([sys.executable, "-m", "sb3_saf.experiments", "run", *words], stdout=subprocess.DEVNULL)
    wait_until(lambda: len(list(tmp_path.glob("cells/*/*/*"))) >= 3)
    process.kill()
    process.wait()
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("cells/*/*/*/status.json")}
    assert 3 <= len(kept) < N_CELLS
    assert not (tmp_path / "joint" / "table.csv").exists()
    assert cli.main(["run", *words]) == 0
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert read_table(tmp_path / "joint" / "table.csv") == read_table(undisturbed / "joint" / "table.csv")
    assert list((tmp_path / "scratch").iterdir()) == []


def test_a_trained_cell_is_tested_further_without_training(tmp_path: Path) -> None:
    """``ood-coordination`` after ``coordination`` finds its cells trained, and gets what it would get alone."""
    choice = Choice((0,), ("ippo",), ("TeamSupport",))
    run_inline(tmp_path / "both", choice, "coordination")
    summary, works = run_inline(tmp_path / "both", choice, "ood-coordination")
    assert summary == Summary(1, [])
    assert [(work.cell.method, work.tests, work.model is not None) for work in works] == [
        ("ippo", (Level(1, 1), Level(3, 1)), True)
    ]
    run_inline(tmp_path / "alone", choice, "ood-coordination")
    both, alone = (read_table(tmp_path / name / "ood-coordination" / "table.csv") for name in ("both", "alone"))
    assert both == alone
    assert [row["coordination"] for row in both if row["method"] == "ippo"] == ["1", "2", "3"]
    assert {row["train_coordination"] for row in both if row["method"] == "ippo"} == {"2"}


def test_a_loaded_model_of_qplex_does_not_explore(tmp_path: Path) -> None:
    """A fresh QPLEX would take random actions only."""
    choice, short = Choice((0,), ("qplex",), ("TeamSupport",)), replace(SMOKE, overrides={"game_steps": 40})
    run_inline(tmp_path / "both", choice, "coordination", short)
    _, works = run_inline(tmp_path / "both", choice, "ood-coordination", short)
    assert [work.model is not None for work in works] == [True]
    run_inline(tmp_path / "alone", choice, "ood-coordination", short)
    both, alone = (read_table(tmp_path / name / "ood-coordination" / "table.csv") for name in ("both", "alone"))
    assert both == alone


def test_tensorboard_of_a_cell_has_the_inside_of_its_policy(tmp_path: Path) -> None:
    cell = Cell("ippo", "TeamSupport", Level(1, 1), 0, (Level(1, 1),))
    archives = [
        do(Work(cell, replace(SMOKE, overrides={"game_steps": 40}), cell.tests, tensorboard=on, scratch=str(tmp_path)))
        for on in (True, False)
    ]
    for name, archive in zip(("with", "without"), archives, strict=True):
        unpack(archive, tmp_path / name)
    (file,) = (tmp_path / "with").rglob("events.*")
    assert "critic/explained_variance" in EventAccumulator(str(file)).Reload().Tags()["scalars"]
    theirs, ours = (PPO.load(tmp_path / name / "model.zip").policy.state_dict() for name in ("with", "without"))
    assert all(th.equal(theirs[name], ours[name]) for name in ours)


def _train_badly(work: Work) -> bytes:
    if work.cell.method == "mappo":
        raise RuntimeError("out of luck")
    return good_work(work)


good_work = do


def test_a_failed_cell_says_why_and_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    choice = Choice((0,), ("mappo", "ippo"))
    monkeypatch.setattr(run_module, "do", _train_badly)
    summary, _ = run_inline(tmp_path, choice)
    assert (summary.finished, [cell.method for cell in summary.failed]) == (6, ["mappo"] * 3)
    assert "mappo TeamSupport c=2, h=2 seed 0: FAILED: RuntimeError: out of luck; see " in capsys.readouterr().out
    folder = saf_like(tmp_path, seed=0)
    assert "RuntimeError: out of luck" in (folder / "error.txt").read_text()
    assert len(read_table(tmp_path / "joint" / "table.csv")) == 6
    monkeypatch.undo()
    summary, _ = run_inline(tmp_path, choice)
    assert summary == Summary(3, [])
    assert not (folder / "error.txt").exists()
    assert len(read_table(tmp_path / "joint" / "table.csv")) == 9


def test_exit_code_of_failures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run_module, "do", _train_badly)
    monkeypatch.setattr(cli, "engine_of", lambda options: InlineEngine())
    words = ["run", "joint", "--size", "smoke", "--seeds", "0", "-f", str(tmp_path), "--methods"]
    assert cli.main([*words, "mappo"]) == 1
    assert capsys.readouterr().err.splitlines()[-1] == "3 cells failed; the same command tries them again"
    assert cli.main([*words, "ippo"]) == 0


def _interrupted(work: Work) -> bytes:
    raise KeyboardInterrupt


def test_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(run_module, "do", _interrupted)
    monkeypatch.setattr(cli, "engine_of", lambda options: InlineEngine())
    assert cli.main(["run", "joint", "--size", "smoke", "-f", str(tmp_path)]) == 130
    assert "finished cells and checkpoints are kept; the same command continues" in capsys.readouterr().err


def _refused(folder: Path, protocol: Protocol) -> str:
    with pytest.raises(ValueError, match="was") as error:
        run_inline(folder, TWO, protocol=protocol)
    return str(error.value)


def test_other_settings_are_refused(undisturbed: Path) -> None:
    message = _refused(undisturbed, replace(SMOKE, overrides={"game_steps": 800, "learning_rate": 1e-3}))
    assert "overrides.game_steps was None, now 800" in message
    assert "overrides.learning_rate was None, now 0.001" in message
    assert "size was 'smoke', now 'small'" in _refused(undisturbed, Protocol("small"))
    assert "episodes was 32, now 8" in _refused(undisturbed, replace(SMOKE, episodes=8))


def test_changed_files_of_the_zoo_are_refused(undisturbed: Path, tmp_path: Path) -> None:
    """As if the YAML had said something else when the cell was trained."""
    cell = Cell("ippo", "TeamSupport", Level(2, 2), 0, (Level(2, 2),))
    results = Results(tmp_path)
    run_inline(tmp_path, Choice((0,), ("ippo",)))
    path = results.cell_folder(cell) / "config.json"
    config = json.loads(path.read_text())
    config["hyperparams"]["n_epochs"] = 9
    path.write_text(json.dumps(config))
    assert "hyperparams.n_epochs was 9, now 2; restore them, delete that cell" in _refused(tmp_path, SMOKE)


def test_differences() -> None:
    old, new = {"a": 1, "b": {"c": 2, "d": 3}, "e": {}}, {"a": 1, "b": {"c": 4, "f": 5}, "e": {}}
    assert differences(old, new) == "b.c was 2, now 4, b.d was 3, now None, b.f was None, now 5"
    assert differences(old, new, most=1) == "b.c was 2, now 4, and 2 more"


def test_a_second_run_of_the_same_cells_is_refused(tmp_path: Path) -> None:
    results = Results(tmp_path)
    with results.locked(Shard()):
        with pytest.raises(ValueError, match="another process is running part 1/1"):
            run_inline(tmp_path)
        run_inline(tmp_path, Choice((0,), ("ippo",)), shard=Shard(1, 6))


def test_a_cell_appears_at_once_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut off while its files are written, it is not there."""
    results = Results(tmp_path)
    cell = Cell("ippo", "TeamSupport", Level(2, 2), 0, (Level(2, 2),))

    def cut_off(source: Path, target: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sb3_saf.experiments.results.os.replace", cut_off)
    with pytest.raises(KeyboardInterrupt):
        results.add_failure(cell, SMOKE, "error")
    assert not results.cell_folder(cell).exists()


def test_curve(tmp_path: Path) -> None:
    """Five episodes of 10 steps, two games: two points, of at least two episodes each."""
    path = tmp_path / "monitor.csv"
    path.write_text("#{}\nr,l,t\n1,10,0\n2,10,0\n6,10,0\n4,10,0\n8,10,0\n")
    assert curve(path, 2) == "game_steps,mean_return,episodes\n30,3.0,3\n50,6.0,2\n"


def struck_at(monkeypatch: pytest.MonkeyPatch, step: int | None) -> list[int]:
    """Count the steps that vector environments play; at one of them the process dies, as far as anybody can tell."""
    played, play = [0], NativeVecEnv.step_wait

    def counted(self: NativeVecEnv) -> Any:
        played[0] += 1
        if played[0] == step:
            raise RuntimeError("struck")
        return play(self)

    monkeypatch.setattr(NativeVecEnv, "step_wait", counted)
    return played


@pytest.mark.parametrize("method", ["saf", "qplex"])
def test_a_cell_that_was_killed_goes_on_from_its_checkpoint(method: str, tmp_path: Path) -> None:
    cell = Cell(method, "TeamSupport", Level(2, 1), 0, (Level(2, 1), Level(1, 1)))
    work = Work(cell, SMOKE, cell.tests, unfinished=str(tmp_path / "unfinished"))

    def attempt(work: Work, step: int | None = None) -> tuple[bytes | None, int]:
        with pytest.MonkeyPatch.context() as monkeypatch:
            played = struck_at(monkeypatch, step)
            if step is None:
                return do(work), played[0]
            with pytest.raises(RuntimeError, match="struck"):
                do(work)
            return None, played[0]

    whole, n_steps = attempt(replace(work, unfinished=None))
    n_tested = 2 * 20
    attempt(work, n_steps // 3)
    attempt(work, n_steps // 3)
    killed, n_rest = attempt(work)
    assert n_rest - n_tested < (n_steps - n_tested) / 2
    folders = tmp_path / "undisturbed", tmp_path / "killed"
    for archive, folder in zip((whole, killed), folders, strict=True):
        assert archive is not None
        unpack(archive, folder)
    assert what_counts(folders[0]) == what_counts(folders[1])


def what_counts(cell_folder: Path) -> dict[str, Any]:
    """All that a cell's folder tells but times."""
    tests = {path.name: json.loads(path.read_text())["returns"] for path in (cell_folder / "tests").iterdir()}
    files = sorted(str(path.relative_to(cell_folder)) for path in cell_folder.rglob("*") if path.is_file())
    with zipfile.ZipFile(cell_folder / "model.zip") as model:
        weights = model.read("policy.pth")
    texts = [(cell_folder / name).read_text() for name in ("curve.csv", "config.json", "command.txt")]
    return {"tests": tests, "files": files, "weights": weights, "texts": texts}


def test_checkpoints_of_other_settings_are_left_alone_and_finished_cells_keep_none(tmp_path: Path) -> None:
    experiment = find_experiment("joint")
    results, choice = Results(tmp_path), Choice((0,), ("ippo",), ("TeamSupport",))
    with pytest.MonkeyPatch.context() as monkeypatch:
        struck_at(monkeypatch, 15)
        summary = run(experiment, choice, SMOKE, results, InlineEngine(), Machine(retries=0), Shard())
    (failed,) = summary.failed
    folder = results.unfinished(failed)
    assert list(folder.glob("checkpoints/*.ckpt"))
    (folder / "config.json").write_text("{}")  # as if the settings had been others
    run(experiment, choice, SMOKE, results, InlineEngine(), Machine(retries=0), Shard())
    assert results.is_finished(failed) and not (tmp_path / "unfinished").exists()
