"""Benchmarks: scripted teams on levels with a known answer, the diagnosis of trained teams."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import sb3_saf
from benchmarks import diagnosis, scripted
from benchmarks.scripted_teams import TEAMS
from hecogrid_envs.batch import GameBatch
from hecogrid_envs.constants import Direction
from hecogrid_envs.params import HECOGridParams
from sb3_saf.experiments.definitions import Cell, Level, RunConfig
from sb3_saf.experiments.results import Results
from sb3_saf.teams.checks import evaluation_seed
from sb3_saf.training.folders import TEST_GAMES, write_run
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
    """Rows for every level and team, printed and in a file; teams that see more collect more."""
    path = tmp_path / "scripted.csv"
    monkeypatch.setattr(sys, "argv", f"scripted --tasks TeamSupport --coordination 1 --games 2 --csv {path}".split())
    scripted.main()
    rows = pd.read_csv(path)
    assert rows["team"].tolist() == list(TEAMS)
    assert len(capsys.readouterr().out.splitlines()) == 2 + len(rows)
    returns = rows["return_mean"].tolist()
    assert returns == sorted(returns)
    assert returns[0] < returns[1] / 2


def test_scripts_play_the_test_games_of_trained_teams() -> None:
    """The 33rd game is the first of the second batch of :func:`sb3_saf.training.folders.play_test`."""
    env = sb3_saf.make_team_env("TeamSupport-v0", n_envs=TEST_GAMES)
    batch = GameBatch("TeamSupport", HECOGridParams())
    games = list(scripted.test_games(7, TEST_GAMES + 2))
    for test, rows in ((0, games[:TEST_GAMES]), (1, games[TEST_GAMES:])):
        env.seed(evaluation_seed(7, test=test))
        env.reset()
        for number, game in enumerate(rows):
            batch.reset(seeds=[game])
            walls = env.env_method("get_state", indices=[number * batch.params.n_agents])[0]["walls"]
            np.testing.assert_array_equal(walls, batch.get_state()["walls"])


# --- diagnosis --------------------------------------------------------------------------------------------------------


#: A network shape other than the zoo's: the diagnosis must read the trained shape from the folder.
OVERRIDES = {"policy_kwargs": {"features_extractor_class": "LightEncoder", "net_arch": [32]}}


def save_team(folder: Path, method: str, seed: int) -> None:
    config, at = RunConfig("small", OVERRIDES), Level.of(coordination=2, heterogeneity=3)
    of = Cell(method, "TeamSupport-v0", at, seed)
    settings = config.settings(of)
    model = settings.make_model(settings.make_env(seed), seed, device="cpu")
    cell = folder / "cells" / "TeamSupport-c2-h3" / method / f"seed-{seed}"
    cell.mkdir(parents=True)
    model.save(cell / "model.zip")
    write_run(cell, **config.describe(of), command="")


def test_it_looks_into_every_trained_team(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for method, seed in (("saf", 0), ("saf-paper-no-pool", 1), ("ippo", 0)):
        save_team(tmp_path, method, seed)
    results = Results(tmp_path)
    results.save_config(RunConfig("small", OVERRIDES))
    assert [str(cell) for cell in diagnosis.cells(results)] == [
        "ippo TeamSupport c=2, h=3 seed 0",
        "saf TeamSupport c=2, h=3 seed 0",
        "saf-paper-no-pool TeamSupport c=2, h=3 seed 1",
    ]
    assert not list(diagnosis.cells(results, "TeamTogether-*"))
    kept = tmp_path / "numbers.csv"
    monkeypatch.setattr(sys, "argv", ["diagnosis", str(tmp_path), "--episodes", "2", "--csv", str(kept)])
    diagnosis.main()
    teams = pd.read_csv(kept).set_index("method")
    ippo, saf = teams.loc["ippo"], teams.loc["saf"]
    assert saf["knowledge_source/read_entropy"] > 0.9  # untrained: attention is nearly uniform
    assert 0 <= saf["pool/zone_dependence"] < 0.1
    assert ippo.filter(regex="pool|message").isna().all()
    assert 0 <= ippo["greedy"] <= 25
    header, _, first, second, _ = capsys.readouterr().out.strip().splitlines()
    assert header.startswith("| task | level | method | critic/bias |")
    assert first.startswith("| TeamSupport | c2-h3 | ippo |")
    assert second.count("|") == header.count("|")
