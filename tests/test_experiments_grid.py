"""The paper's experiments and custom ones: what is in each, what does not fit, listing, planning, one-line errors."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from sb3_saf.experiments import cli
from sb3_saf.experiments.definitions import (
    EXPERIMENTS,
    RANDOM,
    Cell,
    Level,
    RunConfig,
    Selection,
    Shard,
    expand,
    merge,
    own_experiment,
)
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.run import run
from tests.experiments_jobs import InlineEngine
from tests.test_training_commands import failed

THREE_SEEDS = Selection((0, 1, 2))
PAPER = RunConfig("paper")


def at(coordination: int, heterogeneity: int) -> Level:
    return Level.of(coordination=coordination, heterogeneity=heterogeneity)


def grid_of(name: str, config: RunConfig = PAPER, selection: Selection = THREE_SEEDS) -> list[Cell]:
    return expand(EXPERIMENTS[name], selection, config)


def trained(cells: list[Cell]) -> list[Cell]:
    return [cell for cell in cells if cell.is_trained]


#: Methods x tasks x levels x three seeds, and the levels of the random team.
SIZES = {
    "coordination": (3 * 3 * 3 * 3, 3 * 3 * 3),
    "heterogeneity": (3 * 3 * 5 * 3, 3 * 5 * 3),
    "joint": (3 * 1 * 3 * 3, 3 * 3),
    "ablation": (5 * 3 * 7 * 3, 3 * 7 * 3),
    "ood-coordination": (3 * 2 * 1 * 3, 2 * 3 * 3),
    "ood-heterogeneity": (3 * 2 * 1 * 3, 2 * 5 * 3),
    "ood-ablation": (3 * 2 * 2 * 3, 2 * 7 * 3),
    "qplex": (2 * 3 * 3 * 3, 3 * 3 * 3),
}


def test_every_row_of_the_paper_has_a_name() -> None:
    assert list(EXPERIMENTS) == list(SIZES)


@pytest.mark.parametrize(("name", "n_trained", "n_random"), [(name, *counts) for name, counts in SIZES.items()])
def test_number_of_cells(name: str, n_trained: int, n_random: int) -> None:
    cells = grid_of(name)
    assert len(trained(cells)) == n_trained
    assert len(cells) - n_trained == n_random
    assert len({cell.id for cell in cells}) == len(cells)


def test_a_random_team_that_is_asked_for_is_tested_once() -> None:
    """In unseen levels it would be there for the training level too, with seeds counted twice."""
    asked = [Selection((0, 1), methods, ("TeamSupport-v0",)) for methods in (("saf", "random"), ("saf",), ("random",))]
    both, without, alone = (grid_of("ood-coordination", selection=one) for one in asked)
    assert both == without
    assert alone == [cell for cell in without if not cell.is_trained]


def test_levels_of_the_paper() -> None:
    levels = {name: list(EXPERIMENTS[name].tests()) for name in SIZES}
    assert levels["coordination"] == [at(1, 1), at(2, 1), at(3, 1)]
    assert levels["heterogeneity"] == [at(1, h) for h in (1, 2, 3, 4, 5)]
    assert levels["joint"] == [at(2, 2), at(3, 3), at(4, 4)]
    assert set(levels["ablation"]) == {*levels["coordination"], *levels["heterogeneity"]}
    assert levels["qplex"] == [Level.of(coordination=c, heterogeneity=1, n_agents=5) for c in (1, 2, 3)]
    cells = trained(grid_of("ood-heterogeneity", selection=Selection((5,), ("saf",))))
    assert [(cell.task, cell.level) for cell in cells] == [("TeamTogether", at(1, 2)), ("TeamSupport", at(1, 2))]
    assert [cell.tests for cell in cells] == [tuple(levels["heterogeneity"])] * 2


@pytest.mark.parametrize("name", ["ablation", "ood-ablation"])
def test_ablations_have_the_papers_form_beside_the_shared_one(name: str) -> None:
    """The paper's SAF without pool has an actor for each agent."""
    methods = {cell.method for cell in trained(grid_of(name))}
    assert {"saf", "saf-no-pool", "saf-paper-no-pool"} <= methods


def test_paper_size_is_the_papers() -> None:
    for cell in trained(grid_of("ablation", selection=Selection((0,), ("saf",)))):
        settings = PAPER.settings(cell)
        assert settings.game_steps == 10_000_000
        assert settings.n_agents == 10
        assert {name: settings.env_kwargs[name] for name in cell.level.env_kwargs} == cell.level.env_kwargs
    assert (PAPER.episodes, PAPER.eval_freq, PAPER.eval_episodes) == (512, None, 32)
    (cell, *_) = grid_of("qplex")
    assert PAPER.settings(cell).n_agents == 5
    assert cell.id == "TeamTogether-c1-h1-n5/qplex/seed-0"


def test_levels_that_do_not_fit_are_errors() -> None:
    two = replace(PAPER, overrides={"env_kwargs": {"n_agents": 2}})
    with pytest.raises(
        ValueError, match=r"TeamTogether at c=3, h=1 cannot be made in the size 'paper': .*got 3; .*--levels"
    ):
        grid_of("coordination", two)
    cells = grid_of("coordination", two, replace(THREE_SEEDS, levels=("1", "2")))
    assert {cell.level for cell in cells} == {at(1, 1), at(2, 1)}
    narrow = replace(PAPER, overrides={"env_kwargs": {"grid_size": 6, "n_treasures": 2}})
    with pytest.raises(ValueError, match="at c=1, h=5 cannot be made"):  # a test
        grid_of("ood-heterogeneity", narrow)


def test_experiments_share_cells() -> None:
    alone = grid_of("coordination")
    together = merge([*alone, *grid_of("ood-coordination")])
    assert len(together) == len(alone)
    shared = next(cell for cell in together if cell.id == "TeamSupport-c2-h1/saf/seed-0")
    assert set(shared.tests) == {at(1, 1), at(2, 1), at(3, 1)}


def test_shards_are_a_partition_and_have_all_methods() -> None:
    cells = grid_of("coordination")
    for count in (1, 2, 7, 200):
        parts = [Shard(number, count).of(cells) for number in range(1, count + 1)]
        assert sorted(cell.id for part in parts for cell in part) == sorted(cell.id for cell in cells)
    for number in (1, 2, 3):
        counts = Counter(cell.method for cell in Shard(number, 3).of(cells))
        assert counts == {"saf": 9, "mappo": 9, "ippo": 9, RANDOM: 9}


@pytest.mark.parametrize("text", ["0/3", "4/3", "3", "1/0", "a/b", "-1/2", "1/2/3"])
def test_bad_shards(text: str) -> None:
    with pytest.raises(ValueError, match=r"expected a part such as 3/8"):
        Shard.parse(text)


@pytest.mark.parametrize(
    ("name", "levels", "trains", "tests"),
    [
        ("heterogeneity", "513", {at(1, 1), at(1, 3), at(1, 5)}, {at(1, 1), at(1, 3), at(1, 5)}),
        ("coordination", "2", {at(2, 1)}, {at(2, 1)}),
        ("ood-coordination", "13", {at(2, 1)}, {at(1, 1), at(3, 1)}),
        ("ablation", "3", {at(3, 1), at(1, 3)}, {at(3, 1), at(1, 3)}),
        ("ablation", "4", {at(1, 4)}, {at(1, 4)}),
    ],
)
def test_some_levels_only(name: str, levels: str, trains: set[Level], tests: set[Level]) -> None:
    part = Selection((0,), levels=tuple(levels))
    cells = grid_of(name, selection=part)
    assert {cell.level for cell in cells if cell.is_trained} == trains
    assert {level for cell in cells for level in cell.tests} == tests
    everything = grid_of(name, selection=Selection((0,)))
    assert {cell.id for cell in everything if part.has(cell, EXPERIMENTS[name])} == {cell.id for cell in cells}


def test_levels_that_are_not_there_are_refused() -> None:
    with pytest.raises(ValueError, match="coordination has no level 4 on its axes; there are 1, 2, 3"):
        grid_of("coordination", selection=Selection((0,), levels=("1", "4")))


def test_an_experiment_of_ones_own() -> None:
    spread = own_experiment("mine", ["TeamSupport-v0", "a.b:c"], {"max_cycles": [5, 9]})
    assert spread.tests() == {Level.of(max_cycles=value): (Level.of(max_cycles=value),) for value in (5, 9)}
    assert Cell("saf", "a.b:c", Level.of(max_cycles=5), 0).id == "a.b-c-max_cycles5/saf/seed-0"
    assert Cell("saf", "a.b:c", Level(), 0).id == "a.b-c-default/saf/seed-0"
    with pytest.raises(ValueError, match="--vary cannot take level, a column of the tables"):
        own_experiment("mine", ["a"], {"level": [1, 2]})
    with pytest.raises(ValueError, match="span"):
        own_experiment("mine", ["a"], {"span": [1, 2]})
    with pytest.raises(ValueError, match="--vary takes one parameter, got a, b"):
        own_experiment("mine", ["a.b"], {"a": [1], "b": [2]})
    with pytest.raises(ValueError, match="expects numbers or words, such as a:"):
        own_experiment("mine", ["a.b"], {"a": ["../x"]})
    for alike in ([1, True], [2, "2"]):
        with pytest.raises(ValueError, match="--vary a expects different values, got"):
            own_experiment("mine", ["a.b"], {"a": alike})
    for name in ("joint", "../x", ""):
        with pytest.raises(ValueError, match="needs a name of letters"):
            own_experiment(name, ["a.b"], {})


# --- commands ---------------------------------------------------------------------------------------------------------


def output(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert cli.main(words) == 0
    return capsys.readouterr().out


def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    printed = output(capsys, "list")
    for experiment in EXPERIMENTS.values():
        assert re.search(rf"^{experiment.name} +{re.escape(experiment.question)}$", printed, re.MULTILINE)
    assert "saf, mappo, ippo on TeamTogether, TeamSupport\n" in printed
    assert "trained at c=2, h=1, tested at c=1, h=1; c=2, h=1; c=3, h=1" in printed


def test_plan_lists_cells_and_totals(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["plan", "ood-coordination", "--size", "paper", "-f", str(tmp_path / "new")]
    tested = "tested at c=1, h=1; c=2, h=1; c=3, h=1"
    assert output(capsys, *words).splitlines() == [
        "ood-coordination, size paper: robustness to unseen coordination",
        f"            TeamTogether, c=2, h=1, {tested}: saf mappo ippo, seeds 0 1 2",
        f"            TeamSupport, c=2, h=1, {tested}: saf mappo ippo, seeds 0 1 2",
        "cells       18 to train (3 methods x 2 settings x 3 seeds), 0 of them finished",
        "tests       72 to play, of 512 team episodes each, random teams included",
        "game steps  180,000,000 left of 180,000,000 (10,000,000 a cell)",
    ]
    assert not (tmp_path / "new").exists()
    # It takes what `run` takes.
    part = output(capsys, *words, "--shard", "2/3", "--workers", "2", "--device", "cpu")
    assert "cells       6 to train" in part and "60,000,000 left of 60,000,000" in part


def test_plan_counts_what_is_finished(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    config = RunConfig("smoke", {"game_steps": 40}, 2, 40, 2)
    run(EXPERIMENTS["joint"], Selection((0,), ("ippo",), (), ("2", "3")), config, Results(tmp_path), InlineEngine())
    capsys.readouterr()
    words = ["plan", "joint", "-f", str(tmp_path), "-n", "40", "--episodes", "2", "--eval-freq", "40"]
    words += ["--levels", "2", "3", "--methods", "ippo", "--seeds", "0"]
    printed = output(capsys, *words, "1")
    assert "cells       4 to train (1 methods x 2 settings x 2 seeds), 2 of them finished" in printed
    assert "game steps  80 left of 160 (40 a cell)" in printed
    assert re.search(
        r"rate +[\d,]+ game steps/s of one worker in the finished cells\ntime +about 0:\d\d:\d\d \(h:mm:ss\) of one",
        printed,
    )
    assert "game steps  0 left of 80" in output(capsys, *words)


BAD = {
    ("run", "coordinaton"): "unknown experiment 'coordinaton' (did you mean 'coordination'?)",
    ("run",): "name an experiment: ",
    ("run", "--env", "TeamSupport-v0", "a.b"): "experiments run mine --env TeamSupport-v0 a.b",
    ("run", "joint", "--env", "TeamSupport-v0"): "an experiment of your own needs a name",
    ("run", "..", "--env", "TeamSupport-v0"): "an experiment of your own needs a name",
    ("run", "cells", "--env", "TeamSupport-v0"): "an experiment of your own needs a name",
    ("run", "joint", "--vary", "a:[1]"): "--vary is for a grid of your own: give its environments with --env",
    ("plan", "joint", "--methods", "safe"): "unknown method 'safe' (did you mean 'saf'?)",
    ("run", "joint", "--tasks", "TeamSuport"): "unknown environment 'TeamSuport' (did you mean 'TeamSupport'",
    ("run", "joint", "--game-steps", "0"): "argument -n/--game-steps: must be at least 1, got 0",
    ("run", "joint", "--env-kwargs", "coordination:2"): "coordination is what the experiment varies; leave it out of",
    ("report", "joint", "-f", "empty"): "empty has no results of 'joint'; name another with -f, or run it first: ",
    ("run", "joint", "--size", "huge"): "argument --size: invalid choice",
    ("run", "joint", "-params", "policy_kwargs:{n_slots: 4}"): "unknown argument of MAPPOPolicy 'n_slots'",
    ("run", "joint", "-params", "env_kwargs:{coordination: 2}"): "coordination is what the experiment varies; leave it",
    ("run", "joint", "--methods", "saf-paper", "-params", "policy_kwargs:{n_slots: 6}"): "saf-paper sets policy_kwargs",
    ("fly",): "argument COMMAND: invalid choice",
    ("check",): "the following arguments are required: FOLDER/CELL",
    ("check", "empty"): "expected RESULTS/cells/TASK-LEVEL/METHOD/seed-N",
}


@pytest.mark.parametrize(("words", "message"), BAD.items(), ids=lambda value: " ".join(value)[:40])
def test_one_line_errors(
    words: tuple[str, ...],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    assert message in failed(words, capsys, cli.main)
    assert [*Path().iterdir()] == [Path("empty")]  # nothing that would refuse the corrected command


def test_random_teams_play_the_games_of_the_methods() -> None:
    games = {"env_wrapper": [{"supersuit.dtype_v0": {"dtype": "float64"}}], "team_reward": "sum"}
    config = RunConfig("smoke", {**games, "learning_rate": 0.1})
    trained, untrained = (Cell(method, "TeamSupport-v0", Level(), 0, (Level(),)) for method in ("mappo", RANDOM))
    assert all(
        config.settings(cell).wrapping[key] == value for cell in (trained, untrained) for key, value in games.items()
    )
    assert {**config.describe(untrained)["settings"], **games} == config.describe(untrained)["settings"]
    with pytest.raises(ValueError, match="statistics of normalize"):
        RunConfig("smoke", {"normalize": {}}).settings(trained)
