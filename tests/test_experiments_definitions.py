"""The paper's experiments: what is in each, and what does not fit."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from sb3_saf.experiments.cells import Cell, Choice, Grid, Protocol, Shard, expand, merge
from sb3_saf.experiments.definitions import EXPERIMENTS, RANDOM, Level, View, find_experiment

THREE_SEEDS = Choice((0, 1, 2))
PAPER = Protocol("paper")


def grid_of(name: str, protocol: Protocol = PAPER, choice: Choice = THREE_SEEDS) -> Grid:
    return expand(find_experiment(name), choice, protocol)


def trained(grid: Grid) -> list[Cell]:
    return [cell for cell in grid.cells if cell.is_trained]


def test_every_row_of_the_paper_has_a_name() -> None:
    assert list(EXPERIMENTS) == [
        "coordination",
        "heterogeneity",
        "joint",
        "ablation",
        "ood-coordination",
        "ood-heterogeneity",
        "ood-ablation",
        "qplex",
        "parameters",
    ]


#: Methods x tasks x levels x three seeds, and the levels that a random team plays.
SIZES = [
    ("coordination", 3 * 3 * 3 * 3, 3 * 3 * 3),
    ("heterogeneity", 3 * 3 * 5 * 3, 3 * 5 * 3),
    ("joint", 3 * 1 * 3 * 3, 3 * 3),
    ("ablation", 4 * 3 * 7 * 3, 3 * 7 * 3),
    ("ood-coordination", 3 * 2 * 1 * 3, 2 * 3 * 3),
    ("ood-heterogeneity", 3 * 2 * 1 * 3, 2 * 5 * 3),
    ("ood-ablation", 2 * 2 * 2 * 3, 2 * 7 * 3),
]


@pytest.mark.parametrize(("name", "n_trained", "n_random"), SIZES)
def test_number_of_cells(name: str, n_trained: int, n_random: int) -> None:
    grid = grid_of(name)
    assert len(trained(grid)) == n_trained
    assert len(grid.cells) - n_trained == n_random
    assert len({cell.id for cell in grid.cells}) == len(grid.cells)
    assert grid.left_out == []


def test_levels_of_the_paper() -> None:
    levels = {name: [setting.train for setting in find_experiment(name).settings] for name, *_ in SIZES}
    assert levels["coordination"] == [(1, 1), (2, 1), (3, 1)]
    assert levels["heterogeneity"] == [(1, 1), (1, 2), (1, 3), (1, 4), (1, 5)]
    assert levels["joint"] == [(2, 2), (3, 3), (4, 4)]
    assert sorted(levels["ablation"]) == sorted({*levels["coordination"], *levels["heterogeneity"]})


def test_out_of_distribution_trains_once_and_tests_at_all_levels() -> None:
    cells = trained(grid_of("ood-heterogeneity", choice=Choice((5,), ("saf",))))
    assert [(cell.task, cell.level) for cell in cells] == [("TeamTogether", (1, 2)), ("TeamSupport", (1, 2))]
    assert [cell.tests for cell in cells] == [tuple(Level(1, h) for h in (1, 2, 3, 4, 5))] * 2


def test_paper_size_is_the_papers() -> None:
    grid = grid_of("ablation")
    for cell in trained(grid):
        settings = PAPER.settings(cell)
        assert settings.game_steps == 10_000_000
        assert settings.env_kwargs["n_agents"] == 10
        assert (settings.env_kwargs["coordination"], settings.env_kwargs["heterogeneity"]) == cell.level
    assert PAPER.episodes == 32


def test_qplex_has_five_agents_at_every_size() -> None:
    cells = [
        Cell("qplex", task, level, 0, (level,), find_experiment("qplex").n_agents)
        for task in find_experiment("qplex").tasks
        for level in [Level(1, 1)]
    ]
    assert find_experiment("qplex").methods == ("qplex", "qplex-pool")
    for cell in cells:
        as_ippo = replace(cell, method="ippo")
        assert PAPER.settings(as_ippo).n_agents == 5
        assert "-n5/" in cell.id


def test_random_teams_play_every_tested_level_once() -> None:
    cells = [cell for cell in grid_of("ood-coordination", choice=Choice((4,))).cells if not cell.is_trained]
    assert Counter((cell.task, cell.level) for cell in cells) == {
        (task, Level(c, 1)): 1 for task in ("TeamTogether", "TeamSupport") for c in (1, 2, 3)
    }


def test_levels_that_do_not_fit_are_named_with_the_reason() -> None:
    three_agents = replace(PAPER, overrides={"env_kwargs": {"n_agents": 2}})
    grid = grid_of("coordination", three_agents)
    assert {cell.level.coordination for cell in grid.cells} == {1, 2}
    assert [(left.task, left.test) for left in grid.left_out] == [
        (task, (3, 1)) for task in find_experiment("coordination").tasks
    ]
    assert str(grid.left_out[0]) == (
        "TeamTogether: training at c=3, h=1 is left out: coordination must be an integer from 1 to 2 "
        "(1 <= coordination <= n_agents), got 3"
    )


def test_tests_that_do_not_fit_leave_the_training_alone() -> None:
    narrow = replace(PAPER, overrides={"env_kwargs": {"grid_size": 6, "n_treasures": 2}})
    grid = grid_of("ood-heterogeneity", narrow)
    assert {cell.tests for cell in trained(grid)} == {tuple(Level(1, h) for h in (1, 2, 3, 4))}
    assert {(left.level, left.test) for left in grid.left_out} == {((1, 2), (1, 5))}
    assert "the test at c=1, h=5 after training at c=1, h=2 is left out" in str(grid.left_out[0])


def test_nothing_fits() -> None:
    with pytest.raises(ValueError, match=r"no level of joint fits the size 'paper': .*coordination"):
        grid_of("joint", replace(PAPER, overrides={"env_kwargs": {"n_agents": 1}}))


def test_experiments_share_cells() -> None:
    together = merge([*grid_of("coordination").cells, *grid_of("ood-coordination").cells])
    alone = grid_of("coordination").cells
    assert len(together) == len(alone)
    shared = next(cell for cell in together if cell.id == "TeamSupport-c2-h1/saf/seed-0")
    assert set(shared.tests) == {(1, 1), (2, 1), (3, 1)}


def test_unknown_names() -> None:
    with pytest.raises(ValueError, match=r"unknown experiment 'coordinaton' \(did you mean 'coordination'\?\)"):
        find_experiment("coordinaton")
    with pytest.raises(ValueError, match=r"unknown method 'mapo' \(did you mean 'mappo'\?\)"):
        grid_of("coordination", choice=Choice((0,), ("mapo",)))


@pytest.mark.parametrize("count", [1, 2, 3, 7, 200])
def test_shards_are_a_partition(count: int) -> None:
    cells = grid_of("coordination").cells
    parts = [Shard(index, count).of(cells) for index in range(1, count + 1)]
    assert sorted(cell.id for part in parts for cell in part) == sorted(cell.id for cell in cells)


def test_shards_have_all_methods() -> None:
    cells = grid_of("coordination").cells
    for index in (1, 2, 3):
        counts = Counter(cell.method for cell in Shard(index, 3).of(cells))
        assert counts == {"saf": 9, "mappo": 9, "ippo": 9, RANDOM: 9}


@pytest.mark.parametrize("text", ["0/3", "4/3", "3", "1/0", "a/b", "-1/2", "1/2/3"])
def test_bad_shards(text: str) -> None:
    with pytest.raises(ValueError, match=r"expected a part such as 3/8"):
        Shard.parse(text)


def test_views_show_what_belongs_to_them() -> None:
    inside, outside = (
        View("coordination", (Level(1, 1), Level(2, 1))),
        View("coordination", (Level(1, 1),), Level(2, 1)),
    )
    assert inside.shows(Level(1, 1), Level(1, 1))
    assert not inside.shows(Level(2, 1), Level(1, 1))
    assert outside.shows(Level(2, 1), Level(1, 1))
    assert not outside.shows(Level(1, 1), Level(1, 1))


@pytest.mark.parametrize(
    ("name", "levels", "trains", "tests"),
    [
        ("heterogeneity", (5, 1, 3), {(1, 1), (1, 3), (1, 5)}, {(1, 1), (1, 3), (1, 5)}),
        ("coordination", (2,), {(2, 1)}, {(2, 1)}),
        ("ood-coordination", (1, 3), {(2, 1)}, {(1, 1), (3, 1)}),
        ("ablation", (3,), {(3, 1), (1, 3)}, {(3, 1), (1, 3)}),
        ("ablation", (4,), {(1, 4)}, {(1, 4)}),
    ],
)
def test_some_levels_only(
    name: str, levels: tuple[int, ...], trains: set[tuple[int, int]], tests: set[tuple[int, int]]
) -> None:
    cells = grid_of(name, choice=Choice((0,), levels=levels)).cells
    assert {cell.level for cell in cells if cell.is_trained} == trains
    assert {level for cell in cells for level in cell.tests} == tests
    assert {cell.id for cell in cells} < {cell.id for cell in grid_of(name, choice=Choice((0,))).cells}


def test_levels_that_are_not_there_are_refused() -> None:
    with pytest.raises(ValueError, match="coordination has no level 4 on its dials; there are 1, 2, 3"):
        grid_of("coordination", choice=Choice((0,), levels=(1, 4)))
