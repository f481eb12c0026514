"""Scripted teams on levels with a known answer."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks import scripted
from benchmarks.scripted_teams import TEAMS
from hecogrid_envs.batch import GameBatch
from hecogrid_envs.constants import Direction
from hecogrid_envs.params import HECOGridParams
from tests.levels import State, level

WEST = int(Direction.WEST)
SCRIPTED = ("7 x 7 views", "full sight")


Agent = tuple[int, int, int, bool]


def collected(name: str, task: str, state: State, max_cycles: int, **params: Any) -> int:
    """Return what a team has collected after some steps."""
    size, n_agents = len(state["walls"]), len(state["agent_pos"])
    params |= {"n_agents": n_agents, "grid_size": size, "max_cycles": max_cycles}
    batch = GameBatch(task, HECOGridParams(n_treasures=0, n_keys=0, clutter_density=0.0, **params))
    batch.reset(seeds=[0])
    batch.set_state(state)
    return scripted.play(name, batch, seed=0)


def first_return(name: str, task: str, state: State, **params: Any) -> int:
    """Return the steps after which a team has the first treasure."""
    return next(steps for steps in range(1, 50) if collected(name, task, state, steps, **params))


ALONE = level("######\n#....#\n#....#\n#.<#$#\n#....#\n######")


@pytest.mark.parametrize("heterogeneity", [1, 3])
def test_full_sight_takes_the_shortest_path(heterogeneity: int) -> None:
    """Zones change the meaning of actions, not their number."""
    assert first_return("full sight", "TeamSupport", ALONE, heterogeneity=heterogeneity) == 7


def test_views_do_not_reach_behind_the_agent() -> None:
    """A treasure two cells behind is not seen; one two cells ahead is, and is reached directly."""
    wall = "#######\n" * 3
    seen = level(f"{wall}#$.>.$#\n{wall}")
    batch = GameBatch("TeamSupport", HECOGridParams(1, 7, n_treasures=0, clutter_density=0.0))
    batch.reset(seeds=[0])
    batch.set_state(seen)
    assert batch.fields_of_view()[0, [1, 5], 3].tolist() == [False, True]
    assert first_return("7 x 7 views", "TeamSupport", seen) == 2
    one_left = level(f"{wall}#$.>..#\n{wall}")
    assert first_return("full sight", "TeamSupport", one_left) == 4
    assert first_return("7 x 7 views", "TeamSupport", one_left) > 4


def beside_a_treasure(*others: Agent, key: str = ".") -> State:
    """Return a level with an agent that faces a treasure, optionally others, and optionally a key behind it."""
    empty = "#......#\n"
    return level(f"########\n{empty * 2}#{key}>$...#\n{empty * 3}########", others)


@pytest.mark.parametrize(
    ("task", "coordination", "others", "steps"),
    [
        ("TeamSupport", 1, [], 1),
        ("TeamSupport", 2, [(5, 3, WEST, False)], 1),
        ("TeamSupport", 3, [(5, 3, WEST, False), (6, 4, WEST, False)], 2),
        ("TeamTogether", 2, [(6, 3, WEST, False)], 3),
        ("TeamTogether", 3, [(6, 3, WEST, False), (6, 4, WEST, False)], 5),
    ],
)
@pytest.mark.parametrize("name", SCRIPTED)
def test_agents_meet_at_a_treasure(name: str, task: str, coordination: int, others: list[Agent], steps: int) -> None:
    """The nearest agent waits for those that are farther away: on the treasure, or within two cells of it."""
    state = beside_a_treasure(*others)
    assert first_return(name, task, state, coordination=coordination, agent_order="index") == steps


@pytest.mark.parametrize("name", SCRIPTED)
def test_a_key_comes_first(name: str) -> None:
    """Two turns to the key, pickup, two turns back, one step; views reach one row behind the agent."""
    assert first_return(name, "KeyForTreasure", beside_a_treasure(key="k")) == 6


def test_the_command_writes_its_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rows for every level and team, printed and in a file; teams with full sight collect more."""
    path = tmp_path / "scale.csv"
    line = f"scripted --tasks TeamSupport --coordination 1 --games 4 --csv {path}"
    monkeypatch.setattr(sys, "argv", line.split())
    scripted.main()
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(scripted.SIZES) * len(TEAMS)
    assert len(capsys.readouterr().out.splitlines()) == 2 + len(rows)
    for grid_size in ("15", "22", "30"):
        means = [float(row["mean"]) for row in rows if row["grid_size"] == grid_size]
        assert means == sorted(means)
        assert means[0] < means[1] / 2
