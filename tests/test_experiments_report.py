"""``run`` and ``report`` of the coordination experiment as a user types them, and what reports say."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from sb3_saf.experiments import cli
from sb3_saf.experiments.cells import Protocol
from sb3_saf.experiments.comparisons import compare
from sb3_saf.experiments.definitions import EXPERIMENTS
from sb3_saf.experiments.frames import read_results
from sb3_saf.experiments.options import protocol_of
from sb3_saf.experiments.page import _protocol_words
from sb3_saf.experiments.page_tables import losses
from sb3_saf.experiments.selection import complete
from sb3_saf.training.statistics import Estimate, mean_over_seeds
from tests.experiments_jobs import InlineEngine, read_table

pytest.importorskip("rliable")
#: Seconds, of a busy machine too: the first test waits for 72 cells.
pytestmark = pytest.mark.timeout(900)
LEVELS = [f"{task}-c{c}-h1" for task in ("TeamTogether", "TeamSupport", "KeyForTreasure") for c in (1, 2, 3)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``run coordination --size smoke`` in two processes, as the README has it."""
    path = tmp_path_factory.mktemp("coordination")
    assert cli.main(["run", "coordination", "--size", "smoke", "--workers", "2", "-f", str(path)]) == 0
    return path


def report(folder: Path, *words: str) -> str:
    assert cli.main(["report", "coordination", "-f", str(folder), *words]) == 0
    return (folder / "coordination" / "report.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    """``report coordination``."""
    return report(folder)


def test_coordination_from_the_command_line(folder: Path, page: str) -> None:
    assert len(read_table(folder / "coordination" / "table.csv")) == 4 * 9 * 2
    assert "missing" not in page
    names = {"levels-coordination.png", "aggregates.png", *(f"curve-{level}.png" for level in LEVELS)}
    assert {path.name for path in (folder / "coordination").glob("*.png")} == names
    assert all(f"({name})" in page for name in names)
    assert "Size `smoke`: 4 agents, 6 treasures, 400 game steps of training. saf, mappo, ippo and a random team" in page


def test_numbers_of_the_page_are_those_of_the_table(folder: Path, page: str) -> None:
    table = pd.read_csv(folder / "coordination" / "table.csv")
    runs = table[(table.method == "saf") & (table.task == "TeamSupport") & (table.coordination == 1)]
    low, high = stats.t.interval(0.95, 1, loc=runs.return_mean.mean(), scale=runs.return_mean.sem())
    assert f"| saf | {runs.return_mean.mean():.2f} [{low:.2f}, {high:.2f}] |" in page
    every = np.sort(table[table.method == "mappo"].score)
    # Of 18 scores, the middle half: four and a half from each end are left out, rounded as scipy does.
    assert f"{stats.trim_mean(every, 0.25):.3f} [" in page.split("## Aggregates")[1].split("## ")[0]


def test_losses_are_shares_of_the_first_level(page: str) -> None:
    rows = [
        (method, seed, c, 4.0 - c if method == "saf" else 0.0)
        for method in ("saf", "ippo")
        for seed in (0, 1)
        for c in (1, 2, 3)
    ]
    table = pd.DataFrame(rows, columns=["method", "seed", "coordination", "return_mean"])
    table["return_mean"] += table["seed"] * (table["coordination"] == 1) * (table["method"] == "saf")
    table = table.assign(task="TeamSupport", heterogeneity=1, train_heterogeneity=1)
    table["train_coordination"] = table["coordination"]
    text = losses(table, EXPERIMENTS["coordination"].views[0])
    # Seed 0 has 3, 2, 1 treasures, seed 1 has 4, 2, 1.
    second, third = (mean_over_seeds([100 * (1 - each / 3), 100 * (1 - each / 4)]) for each in (2, 1))
    cells = " | ".join(f"{e.value:.0f} [{e.low:.0f}, {e.high:.0f}]" for e in (second, third))
    assert text.splitlines()[-2:] == [f"| TeamSupport | saf | {cells} |", "| TeamSupport | ippo | – | – |"]
    assert "## Loss by coordination" in page
    assert losses(table, EXPERIMENTS["ood-coordination"].views[0]) == ""


def test_options_of_the_page_are_read_as_they_were() -> None:
    overrides = {
        "env_kwargs": {"observation": "rgb"},
        "clip_range_vf": None,
        "policy_kwargs": {"n_slots": 3},
        "n_epochs": 1,
    }
    options = cli._parser().parse_args(["run", "joint", *_protocol_words(Protocol("smoke", overrides, 8, True))])
    assert protocol_of(options) == Protocol("smoke", overrides, 8, True)


def test_two_seeds_name_no_winner(page: str) -> None:
    rows = [
        line for line in page.splitlines() if line.count("|") == 9 and "saf against" not in line and "---" not in line
    ]
    verdicts = [line.split(" | ")[-1] for line in rows]
    assert verdicts == ["no winner: fewer than 3 seeds |"] * (9 * 3)


def test_the_page_repeats_itself(folder: Path, page: str, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert report(folder) == page
    printed = capsys.readouterr()
    assert f"page: {folder / 'coordination' / 'report.md'}" in printed.out
    assert printed.err == ""


def test_commands_of_the_page(folder: Path, page: str) -> None:
    assert f"python -m sb3_saf.experiments run coordination --size smoke --seeds 0 1 -f {folder}" in page
    assert page.count("python -m sb3_saf.train --algo ") == 54


def test_part_of_an_experiment(folder: Path, tmp_path: Path) -> None:
    part = shutil.copytree(folder, tmp_path / "part")
    page = report(part, "--methods", "ippo", "--tasks", "TeamSupport", "--seeds", "1")
    assert "ippo and a random team, seeds 1." in page
    assert "TeamTogether" not in page.split("## Run it again")[0]


def test_some_levels_of_an_experiment(folder: Path, tmp_path: Path) -> None:
    part = shutil.copytree(folder, tmp_path / "part")
    page = report(part, "--levels", "1", "3", "--tasks", "TeamSupport").split("## Run it again")[0]
    assert "| TeamSupport | c=1, h=1 | c=3, h=1 | seeds |" in page
    assert "curve-TeamSupport-c3-h1.png" in page and "curve-TeamSupport-c2-h1.png" not in page


def test_results_as_tables(folder: Path) -> None:
    tests, curves = read_results(folder, "coordination")
    stored = pd.read_csv(folder / "coordination" / "table.csv")
    pd.testing.assert_frame_equal(tests, stored[list(tests.columns)])
    assert len(curves.groupby(["method", "task", "level", "seed"])) == 3 * 9 * 2
    last = curves.groupby(["method", "task", "level", "seed"])["game_steps"].max()
    assert set(last) == {400}


def test_results_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="has no finished cell of 'joint'; run it first"):
        read_results(tmp_path, "joint")
    with pytest.raises(ValueError, match="unknown experiment 'jont'"):
        read_results(tmp_path, "jont")


def test_partial_results(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    partial = tmp_path / "partial"
    shutil.copytree(folder, partial)
    shutil.rmtree(partial / "cells" / "TeamTogether-c1-h1" / "saf")
    failed = partial / "cells" / "TeamSupport-c1-h1" / "mappo" / "seed-0"
    (failed / "status.json").write_text(json.dumps({"state": "failed"}))
    page = report(partial)
    assert "**3 of 72 cells are missing**" in page
    assert "- saf TeamTogether c=1, h=1 seed 1: not run yet" in page
    assert f"- mappo TeamSupport c=1, h=1 seed 0: failed, see `{failed / 'error.txt'}`" in page
    assert "| saf | – |" in page
    assert "the seeds 1, which all methods have" in page
    assert "3 of 72 cells are missing; the page names them" in capsys.readouterr().err


def table_of(values: list[float]) -> pd.DataFrame:
    return pd.DataFrame({"seed": range(len(values)), "return_mean": values})


def test_a_winner_needs_intervals_apart() -> None:
    low, high = [1.0, 1.1, 1.2], [3.0, 3.1, 3.3]
    above = compare(table_of(high), table_of(low))
    assert above is not None
    assert (above.seeds, above.verdict) == ([0, 1, 2], "higher")
    assert above.difference.value == pytest.approx(np.mean(high) - np.mean(low))
    below = compare(table_of(low), table_of(high))
    assert below is not None and below.verdict == "lower"
    near = compare(table_of([1.0, 1.1, 1.2]), table_of([1.1, 1.2, 1.3]))
    # The differences agree to the last digit, but the intervals overlap.
    assert near is not None
    assert near.difference.high < 0
    assert near.verdict == "no winner: intervals overlap"


def test_two_seeds_that_agree_are_no_proof() -> None:
    found = compare(table_of([1.0, 1.0]), table_of([2.0, 2.0]))
    assert found is not None
    assert found.first == Estimate(1.0, 1.0, 1.0)
    assert found.verdict == "no winner: fewer than 3 seeds"


def test_only_common_seeds_are_compared() -> None:
    found = compare(table_of([1.0, 2.0, 3.0]), pd.DataFrame({"seed": [2, 1, 7], "return_mean": [5.0, 4.0, 9.0]}))
    assert found is not None
    assert (found.seeds, found.first.value, found.second.value, found.difference.value) == ([1, 2], 2.5, 4.5, -2.0)
    assert compare(table_of([1.0]), pd.DataFrame({"seed": [5], "return_mean": [1.0]})) is None


def test_aggregates_compare_like_with_like() -> None:
    rows = [("saf", 0, "a"), ("saf", 0, "b"), ("saf", 1, "a"), ("saf", 1, "b"), ("saf", 1, "c")]
    rows += [("ippo", 0, "a"), ("ippo", 0, "b"), ("ippo", 1, "a")]
    kept = complete(pd.DataFrame(rows, columns=["method", "seed", "stratum"]))
    assert list(kept.itertuples(index=False, name=None)) == [rows[0], rows[1], rows[5], rows[6]]
    apart = pd.DataFrame([("saf", 0, "a"), ("ippo", 0, "b")], columns=["method", "seed", "stratum"])
    assert complete(apart).empty


@pytest.mark.parametrize("name", ["joint", "ablation", "ood-ablation"])
def test_other_experiments_run_and_report(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One method, one seed: nothing is known of spreads, and the page says so by leaving intervals out."""
    monkeypatch.setattr(cli, "engine_of", lambda options: InlineEngine())
    monkeypatch.chdir(tmp_path)
    words = ["--size", "smoke", "--methods", "ippo", "--tasks", "TeamSupport", "--seeds", "0"]
    assert cli.main(["run", name, *words, "--hyperparams", "n_epochs:1", "--game-steps", "80"]) == 0
    assert cli.main(["report", name, "--size", "smoke"]) == 0
    results = tmp_path / "runs" / "experiments" / "smoke" / name
    page = (results / "report.md").read_text(encoding="utf-8")
    charts = {path.name for path in results.glob("levels-*.png")}
    assert charts == {f"levels-{view.axis.replace(' = ', '-')}.png" for view in EXPERIMENTS[name].views}
    for view in EXPERIMENTS[name].views:
        trained = "" if view.train is None else f", trained at {view.train}"
        assert f"## Team return by {view.axis}{trained}" in page
    assert "nan" not in page and "inf" not in page
    assert "--hyperparams n_epochs:1" in page and "--game-steps 80" in page
