"""Reports, complete or incomplete, of the paper's experiments and of custom ones."""

from __future__ import annotations

import math
import shlex
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from scipy import stats

from sb3_saf.experiments import cli
from sb3_saf.experiments.definitions import EXPERIMENTS, RunConfig, Selection, expand, own_experiment
from sb3_saf.experiments.report import Content, known, losses
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.run import run
from sb3_saf.experiments.tables import Frames, beside, complete, frame_of_curves, marl_eval, read_results, seconds_at
from sb3_saf.teams.files import read_json, write_json
from sb3_saf.training.figures import draw_curves
from sb3_saf.training.folders import finish_run
from sb3_saf.training.statistics import learning_curve, mean_over_seeds
from tests.experiments_jobs import InlineEngine, read_table
from tests.test_training_commands import failed

pytest.importorskip("rliable")
TASKS = ("TeamTogether", "TeamSupport")
LEVELS = [f"{task}-c{c}-h1" for task in TASKS for c in (1, 2)]
N_CELLS = (2 + 1) * len(LEVELS) * 2


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create a finished run of two tasks and two methods."""
    path = tmp_path_factory.mktemp("coordination")
    selection = Selection((0, 1), ("saf", "ippo"), tuple(f"{task}-v0" for task in TASKS), ("1", "2"))
    config = RunConfig("smoke", {"n_epochs": 1, "game_steps": 80}, 16, 40, 2)
    assert run(EXPERIMENTS["coordination"], selection, config, Results(path), InlineEngine()).finished == N_CELLS
    return path


@pytest.fixture(scope="module", autouse=True)
def _few_resamples() -> Iterator[None]:
    """Draw fewer bootstrap samples: no test reads the ends of their intervals."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sb3_saf.training.statistics.N_RESAMPLES", 100)
        yield


def report(folder: Path, *words: str, name: str = "coordination") -> str:
    assert cli.main(["report", name, "-f", str(folder), *words]) == 0
    return (folder / name / "report.md").read_text(encoding="utf-8")


def part_of(page: str, heading: str) -> str:
    """Return the text below a heading that starts with the given words."""
    return page.split(f"## {heading}")[1].split("\n## ")[0]


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    return report(folder)


def test_the_page_has_all_figures_and_what_was_run(folder: Path, page: str) -> None:
    assert len(read_table(folder / "coordination" / "runs.csv")) == N_CELLS
    assert "missing" not in page
    names = {
        "levels-coordination.png",
        "differences-coordination.png",
        "aggregates.png",
        *(f"curve-{level}.png" for level in LEVELS),
    }
    assert {path.name for path in (folder / "coordination").glob("*.png")} == names
    assert all(f"({name})" in page for name in names)
    assert "Size `smoke`: 4 agents, 6 treasures, 80 game steps of training. saf, ippo and a random team" in page
    assert "over 16 new games with drawn actions, the same for all methods of a seed" in page
    again = (
        "run coordination --size smoke --game-steps 80 --hyperparams n_epochs:1 --eval-freq 40 --eval-episodes 2 "
        "--episodes 16 --seeds 0 1 --methods saf ippo --levels 1 2 --tasks TeamTogether-v0 TeamSupport-v0"
    )
    assert f"python -m sb3_saf.experiments {again} -f {folder}" in page
    assert page.count("python -m sb3_saf.train --algo ") == 2 * len(LEVELS) * 2


def test_numbers_of_the_page_are_those_of_the_table(folder: Path, page: str) -> None:
    table = pd.read_csv(folder / "coordination" / "runs.csv")
    runs = table[(table.method == "saf") & (table.task == "TeamSupport") & (table.coordination == 1)]
    low, high = stats.t.interval(0.95, 1, loc=runs.return_mean.mean(), scale=runs.return_mean.sem())
    assert f"| SAF | {runs.return_mean.mean():.2f} [{low:.2f}, {high:.2f}] |" in page
    every = np.sort(table[table.method == "ippo"].score)
    assert f"{stats.trim_mean(every, 0.25):.3f} [" in page.split("## Aggregates")[1].split("## ")[0]
    rows = [
        line
        for line in part_of(page, "Paired").splitlines()
        if line.count("|") == 10 and "against" not in line and "---" not in line
    ]
    assert [line.split(" | ")[-1] for line in rows] == ["fewer than 3 pairs |"] * (2 * len(LEVELS))


def test_losses_are_shares_of_the_easiest_level(page: str) -> None:
    rows = [
        (method, seed, c, 4.0 - c if method == "saf" else 0.0)
        for method in ("saf", "ippo")
        for seed in (0, 1)
        for c in (1, 2, 3)
    ]
    table = pd.DataFrame(rows, columns=["method", "seed", "coordination", "return_mean"])
    table["return_mean"] += table["seed"] * (table["coordination"] == 1) * (table["method"] == "saf")
    levels = [f"c{c}-h1" for c in table["coordination"]]
    table = table.assign(task="TeamSupport", level=levels, train_level=levels)
    text = losses(table, EXPERIMENTS["coordination"].views[0])
    # Seed 0 has 3, 2, 1 treasures, seed 1 has 4, 2, 1.
    second, third = (mean_over_seeds([100 * (1 - each / 3), 100 * (1 - each / 4)]) for each in (2, 1))
    cells = " | ".join(f"{e.value:.0f} [{e.low:.0f}, {e.high:.0f}]" for e in (second, third))
    assert text.splitlines()[-2:] == [f"| TeamSupport | SAF | {cells} |", "| TeamSupport | IPPO, shared | – | – |"]
    assert "## Loss by coordination" in page
    assert losses(table, EXPERIMENTS["ood-coordination"].views[0]) == ""
    view = EXPERIMENTS["coordination"].views[0]
    assert losses(table, view._replace(levels=view.levels[::-1])) == text
    of_agents = own_experiment("mine", ["TeamSupport-v0"], {"n_agents": [1, 2]}).views[0]
    assert losses(table.assign(level=[level.replace("c", "n")[:2] for level in levels]), of_agents) == ""


def test_results_as_tables(folder: Path) -> None:
    tests, curves = read_results(folder, "coordination")
    texts = {"game": str, "training": str, "commit": str}
    stored = pd.read_csv(folder / "coordination" / "runs.csv", float_precision="round_trip", dtype=texts)
    pd.testing.assert_frame_equal(tests, stored, check_exact=True, check_dtype=False)
    kept = pd.read_csv(folder / "coordination" / "curves.csv", float_precision="round_trip")
    pd.testing.assert_frame_equal(curves, kept, check_exact=True)
    last = curves.groupby(["method", "task", "level", "coordination", "seed"])["game_steps"].max()
    assert len(last) == 2 * len(LEVELS) * 2 and set(last) == {80}
    assert (curves["processor_seconds"] > 0).all()
    # Of 4 games of 10 steps, the first end before the first evaluation and the last before the last.
    spent = curves[curves["game_steps"] == 80].set_index(["method", "task", "level", "seed"])["processor_seconds"]
    trained = tests[tests["game_steps"] > 0].groupby(["method", "task", "train_level", "seed"])["processor_seconds"]
    assert spent.to_dict() == pytest.approx(trained.first().to_dict())


def test_evaluations_have_times_of_their_own() -> None:
    """Games end in other steps, and the last rollout goes beyond the steps that were asked for."""
    steps = pd.Series([20, 80, 102])
    training = pd.DataFrame({"game_steps": [40, 90, 96], "processor_seconds": [1.0, 2.0, 2.2]})
    assert seconds_at(steps, training, 2.5).tolist() == pytest.approx([0.5, 1.8, 2.5])
    training["game_steps"] = [40, 90, 104]
    assert seconds_at(steps, training, 2.5).tolist() == pytest.approx([0.5, 1.8, 2 + 0.2 * 12 / 14])


def test_results_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="has no results of 'joint': expected a folder of cells, or runs"):
        read_results(tmp_path, "joint")
    with pytest.raises(ValueError, match="has no results of 'my grid': expected a folder of cells, or runs"):
        read_results(tmp_path, "my grid")
    for folder in ("mine", "other"):
        (tmp_path / folder / folder).mkdir(parents=True)
    (tmp_path / "mine" / "mine" / "experiment.json").touch()  # an experiment of another folder
    with pytest.raises(ValueError, match="unknown experiment 'mine'; there is coordination"):
        Results(tmp_path / "other").experiment("mine")
    for name in ("runs.csv", "curves.csv"):
        (tmp_path / name).write_text("method,task,train_level,level,seed,return_mean,score\nsaf,a,b,b,0,1.0,1.0\n")
    with pytest.raises(ValueError, match="n_agents, max_return, game_steps is missing"):
        read_results(tmp_path, "joint")


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write empty files for figures, in a test of the text."""
    monkeypatch.setattr(Figure, "savefig", lambda figure, path: path.touch())


@pytest.mark.usefixtures("no_pictures")
def test_partial_results(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    part = shutil.copytree(folder, tmp_path / "part")
    shutil.rmtree(part / "cells" / "TeamTogether-c1-h1" / "saf")
    damaged, failed = (part / folder / "TeamSupport-c1-h1" / "ippo" / "seed-0" for folder in ("cells", "unfinished"))
    (damaged / "finished.json").write_text("")
    other = damaged.parent / "seed-1"
    (other / "curve.csv").write_text("x,y\n1,2\n")
    failed.mkdir(parents=True)
    (failed / "error.txt").write_text("out of luck")
    (part / "coordination" / "selections" / ".writing-0-a.json").touch()  # as left by SIGKILL
    page = report(part)
    assert ".writing" not in page
    assert f"**4 of {N_CELLS} cells are missing**" in page
    assert "- saf TeamTogether c=1, h=1 seed 1: not run yet" in page
    assert f"- ippo TeamSupport c=1, h=1 seed 0: failed, see `{failed / 'error.txt'}`" in page
    assert f"- damaged: {damaged / 'finished.json'} cannot be read: " in page
    assert f"- damaged: {other / 'curve.csv'} has changed since the run was finished" in page
    assert "| SAF | – |" in page
    assert f"4 of {N_CELLS} cells are missing; the page names them" in capsys.readouterr().err


@pytest.mark.usefixtures("no_pictures")
def test_commits_and_settings_that_differ_are_in_the_warning(folder: Path, page: str, tmp_path: Path) -> None:
    assert "**Cells differ" not in page
    part = shutil.copytree(folder, tmp_path / "part")
    cell = part / "cells" / "TeamSupport-c1-h1" / "saf" / "seed-0"
    description = read_json(cell / "run.json")
    description["versions"]["commit"] = "another"
    description["settings"]["hyperparams"]["learning_rate"] = 0.123
    write_json(cell / "run.json", description)
    finish_run(cell)
    assert "**Cells differ in commit, settings of training.**" in report(
        part, "--tasks", "TeamSupport", "--levels", "1"
    )


def test_a_killed_report_leaves_the_old_one(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = shutil.copytree(folder, tmp_path / "part")
    words = ("--tasks", "TeamSupport", "--levels", "1")
    report(part, *words, "--seeds", "0")
    before = {path.name: path.read_bytes() for path in (part / "coordination").iterdir() if path.is_file()}
    count = [0]

    def killed_at_the_third(self: Figure, path: Path) -> None:
        count[0] += 1
        if count[0] == 3:
            raise KeyboardInterrupt
        path.touch()

    monkeypatch.setattr(Figure, "savefig", killed_at_the_third)
    with pytest.raises(SystemExit, match="130"):
        cli.main(["report", "coordination", "-f", str(part), *words])
    assert {path.name: path.read_bytes() for path in (part / "coordination").iterdir() if path.is_file()} == before


def test_seeds_that_were_never_measured_at_the_same_time_have_no_curve() -> None:
    apart = pd.DataFrame({"method": "saf", "seed": [0, 0, 1, 1], "game_steps": [1.0, 2.0, 3.0, 4.0], "score": 1.0})
    assert learning_curve(apart).empty
    draw_curves(apart)


@pytest.mark.usefixtures("no_pictures")
def test_published_results_are_listed_beside_ones_own(folder: Path, tmp_path: Path) -> None:
    """Only the two files are needed; own cells, other games and trainings of another length are left alone."""
    for name in ("runs.csv", "curves.csv"):
        (tmp_path / "published" / "coordination").mkdir(parents=True, exist_ok=True)
        table = pd.read_csv(folder / "coordination" / name)
        others = table[table["method"] == "ippo"].assign(method="theirs")
        longer = others.assign(method="longer", **({"game_steps": 99} if name == "runs.csv" else {}))
        larger = others.assign(method="larger", n_agents=50)
        path = tmp_path / "published" / "coordination" / name
        pd.concat([table, others, longer, larger]).to_csv(path, index=False)
    mine = shutil.copytree(folder, tmp_path / "mine")
    words = ("--tasks", "TeamSupport", "--levels", "1", "--beside")
    page = report(mine, *words, str(tmp_path / "published"))
    row = part_of(page, "Team return by").split("| theirs |")[1].splitlines()[0]
    assert f"| IPPO, shared |{row}" in page  # equal numbers
    assert "longer" not in page and "larger" not in page and "the same for all methods of a seed" in page
    assert report(mine, *words, str(tmp_path / "published" / "coordination")) == page
    assert set(pd.read_csv(mine / "coordination" / "runs.csv")["method"]) == {"saf", "ippo", "random"}
    (tmp_path / "published" / "coordination" / "runs.csv").write_text("a,b\n1,2\n")
    with pytest.raises(SystemExit, match="2"):
        report(mine, *words, str(tmp_path / "published"))


def test_marl_eval_gets_means_over_the_episodes_of_complete_runs(folder: Path) -> None:
    """The format that ``marl_eval.utils.data_processing_utils.data_process_pipeline`` reads."""
    frames = read_results(folder, "coordination")
    content = marl_eval(frames, "hecogrid")["hecogrid"]
    assert set(content) == {f"{level.replace('-', '_').lower()}" for level in LEVELS}
    assert all(list(methods) == ["saf", "ippo"] for methods in content.values())
    assert all(list(runs) == ["seed_0", "seed_1"] for methods in content.values() for runs in methods.values())
    run = content["teamsupport_c1_h1"]["saf"]["seed_1"]
    assert list(run) == ["step_0", "step_1", "absolute_metrics"]
    assert [run[step]["step_count"] for step in ("step_0", "step_1")] == [40, 80]
    test = read_json(folder / "cells" / "TeamSupport-c1-h1" / "saf" / "seed-1" / "tests" / "c1-h1.json")["plays"][0]
    assert run["absolute_metrics"] == {
        "return": [pytest.approx(np.mean(test["returns"]))],
        "score": [pytest.approx(np.mean(test["returns"]) / 6)],
    }
    # Where the largest return is not known, scores are shares of the range of all returns.
    of_range = Frames(frames.tests.assign(max_return=np.nan), frames.curves)
    means = frames.tests[frames.tests["level"] == "c1-h1"]["return_mean"]
    run = marl_eval(of_range, "x")["x"]["teamsupport_c1_h1"]["saf"]["seed_1"]
    for step in ("step_0", "absolute_metrics"):
        (value,), (score,) = run[step]["return"], run[step]["score"]
        assert score == pytest.approx((value - means.min()) / (means.max() - means.min()))
    seldom = frames.curves[(frames.curves["method"] != "ippo") | (frames.curves["game_steps"] == 80)]
    seldom = seldom.assign(game_steps=seldom["game_steps"].mask(seldom["method"] == "ippo", 60))
    run = marl_eval(Frames(frames.tests, seldom), "x")["x"]["teamsupport_c1_h1"]["saf"]["seed_1"]
    own = frames.curves.query("method == 'saf' and task == 'TeamSupport' and level == 'c1-h1' and seed == 1")["score"]
    assert list(run) == ["step_0", "absolute_metrics"] and run["step_0"]["step_count"] == 60
    assert run["step_0"]["return"] == [pytest.approx(own.mean())]  # half way between 40 and 80
    longer = seldom.assign(game_steps=seldom["game_steps"].where(seldom["level"] == "c1-h1", 10 * seldom["game_steps"]))
    run = marl_eval(Frames(frames.tests, longer), "x")["x"]["teamsupport_c2_h1"]["ippo"]["seed_1"]
    assert list(run) == ["step_0", "absolute_metrics"] and run["step_0"]["step_count"] == 600
    lacking = Frames(frames.tests[(frames.tests["method"] != "ippo") | (frames.tests["seed"] == 0)], frames.curves)
    assert list(marl_eval(lacking, "x")["x"]["teamsupport_c1_h1"]["saf"]) == ["seed_0"]


def test_published_results_of_other_games_are_left_out(folder: Path) -> None:
    theirs = read_results(folder, "coordination")
    mine = Frames(theirs.tests[theirs.tests["method"] == "saf"].assign(method="mine"), theirs.curves.iloc[:0])
    assert set(beside(mine, theirs).tests["method"]) == {"mine", "saf", "ippo", "random"}
    alone = Frames(theirs.tests[theirs.tests["method"] == "random"], frame_of_curves(Results(folder), []))
    assert set(beside(mine, alone).tests["method"]) == {"mine", "random"}
    for other in ({"max_return": 100}, {"game": "larger grid"}):
        with pytest.warns(UserWarning, match=r"published results are of other games .* 80 game steps: none is beside"):
            assert set(beside(mine, Frames(theirs.tests.assign(**other), theirs.curves)).tests["method"]) == {"mine"}


@pytest.mark.parametrize("told", [True, False])
def test_published_trainings_with_other_settings_have_names_of_their_own(folder: Path, told: bool) -> None:
    published = read_results(folder, "coordination")
    mine = Frames(published.tests[published.tests["seed"] == 0], published.curves[published.curves["seed"] == 0])
    assert set(beside(mine, published).tests["method"]) == {"saf", "ippo", "random"}
    tests = published.tests.drop(columns="training")
    saf = tests["method"] == "saf"
    theirs = Frames(
        tests.assign(training=published.tests["training"].mask(saf, "other")) if told else tests, published.curves
    )
    again = tests.assign(episodes=2, training=published.tests["training"])  # with another number of test games
    assert {"saf (published)", "ippo (published)"} <= set(beside(mine, Frames(again, theirs.curves)).tests["method"])
    both = beside(mine, theirs)
    counts = both.tests.groupby("method")["seed"].nunique().to_dict()
    names = {"saf": 1, "saf (published)": 2, "random": 2}
    assert counts == names | ({"ippo": 2} if told else {"ippo": 1, "ippo (published)": 2})
    assert set(both.curves["method"]) == set(counts) - {"random"}
    third = Frames(theirs.tests[saf].assign(training="third"), theirs.curves)
    more = beside(both, third).tests.groupby("method")["seed"].nunique().to_dict()
    assert more == counts | {"saf (published, 2)": 2}


def test_aggregates_compare_like_with_like() -> None:
    rows = [("saf", 0, "a"), ("saf", 0, "b"), ("saf", 1, "a"), ("saf", 1, "b"), ("saf", 1, "c")]
    rows += [("ippo", 0, "a"), ("ippo", 0, "b"), ("ippo", 1, "a")]
    kept = complete(pd.DataFrame(rows, columns=["method", "seed", "stratum"]))
    assert list(kept.itertuples(index=False, name=None)) == [rows[0], rows[1], rows[5], rows[6]]
    apart = pd.DataFrame([("saf", 0, "a"), ("ippo", 0, "b")], columns=["method", "seed", "stratum"])
    assert complete(apart).empty


def test_results_stand_beside_what_is_known_of_the_same_games(tmp_path: Path) -> None:
    experiment, results = EXPERIMENTS["coordination"], Results(tmp_path)
    config, cells = RunConfig("small"), expand(experiment, Selection((0,), ("saf",)), RunConfig("small"))
    rows: list[tuple[Any, ...]] = [("TeamSupport", "saf", "c2-h1", "c2-h1", math.nan, 17.0, 200_000)]
    names = ["task", "method", "train_level", "level", "success_rate", "return_mean", "game_steps"]
    frames = Frames(pd.DataFrame(rows, columns=names), pd.DataFrame())
    text = known(Content(experiment, config, results, cells, [], frames, []))
    line = "TeamSupport, c=2, h=1, SAF: return, sum over agents: 17; random 1.38; script that sees 7 x 7 tiles 17.03"
    assert [part[2:] for part in text.splitlines()[2:]] == [line]
    unseen = expand(EXPERIMENTS["ood-coordination"], Selection((0,), ("saf",), ("TeamSupport",)), config)
    rows = [("TeamSupport", "saf", "c2-h1", "c1-h1", math.nan, 9.0, 200_000)]
    frames = Frames(pd.DataFrame(rows, columns=names), pd.DataFrame())
    text = known(Content(EXPERIMENTS["ood-coordination"], config, results, unseen, [], frames, []))
    assert "TeamSupport, c=1, h=1 (trained at c=2, h=1), SAF: return, sum over agents: 9; random" in text


def test_a_suites_task_has_a_slash(tmp_path: Path) -> None:
    pytest.importorskip("mpe2")
    env, name = "mpe/simple_spread_v3", "spread"
    config = RunConfig("smoke", {"game_steps": 24, "n_envs": 2, "n_steps": 3, "n_minibatches": 1}, 2, 12, 2)
    experiment = own_experiment(name, [env], {"max_cycles": [3]})
    run(experiment, Selection((0,), ("ippo",)), config, Results(tmp_path), InlineEngine())
    assert cli.main(["report", name, "-f", str(tmp_path)]) == 0
    assert (tmp_path / name / "curve-mpe-simple_spread_v3-max_cycles3.png").is_file()


@pytest.mark.usefixtures("no_pictures")
def test_an_environment_of_ones_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Any environment of ``sb3_saf.train``, with a varied parameter."""
    monkeypatch.chdir(tmp_path)
    env, name = "tests.toy_envs:CounterEnv", "tests.toy_envs-CounterEnv"
    folder = Path("runs", "experiments", name)
    config = RunConfig("smoke", {"game_steps": 24, "n_envs": 2, "n_steps": 3, "n_minibatches": 1}, 2, 12, 2)
    experiment = own_experiment(name, [env], {"max_cycles": [3, 5]})
    run(experiment, Selection((0,), ("ippo",)), config, Results(folder), InlineEngine())
    assert cli.main(["report", env]) == 0
    page = (folder / name / "report.md").read_text(encoding="utf-8")
    assert "2 agents, 24 game steps of training. ippo and a random team" in page
    assert "| tests.toy_envs:CounterEnv | max_cycles=3 | max_cycles=5 | seeds |" in page
    table = pd.read_csv(folder / name / "runs.csv")
    assert table["score"].between(0, 1).all() and table["max_return"].isna().all()
    assert cli.main(["report", env, "--beside", str(folder)]) == 0
    assert f"nowhere has no results of '{name}': expected" in failed(
        ["report", env, "--beside", "nowhere"], capsys, cli.main
    )
    # The printed command runs as printed, and finds everything finished.
    (again,) = (line for line in page.splitlines() if line.startswith("python -m sb3_saf.experiments run"))
    assert cli.main([*shlex.split(again)[3:], "--workers", "1"]) == 0
    assert "4 finished, 0 to run" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):  # another experiment of that name
        cli.main(["run", "--env", env, "--vary", "max_cycles:[4]", "--seeds", "0"])
    with pytest.raises(SystemExit, match="2"):
        cli.main(["report", "counter", "-f", str(folder)])
    assert name in capsys.readouterr().err
    # One of two environments, whose other rewards make it another game.
    two = own_experiment("two", [env, "tests.toy_envs:LazyEnv"], {})
    shared = replace(config, overrides={**config.overrides, "team_reward": "mean"})
    run(two, Selection((0,), ("ippo",), envs=(env,)), shared, Results(Path("two")), InlineEngine())
    assert cli.main(["report", "two", "-f", "two"]) == 0
    assert f"--tasks {env} -f two" in Path("two", "two", "report.md").read_text(encoding="utf-8")
    assert not set(read_results(Path("two"), "two").tests["game"]) & set(table["game"])
