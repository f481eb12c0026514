"""Benchmarks: scripted teams on levels with a known answer, the diagnosis of trained teams."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import diagnosis, scripted
from benchmarks.scripted_teams import TEAMS
from hecogrid_envs.batch import GameBatch
from hecogrid_envs.constants import Command, Direction
from hecogrid_envs.params import HECOGridParams
from sb3_saf.experiments.definitions import Cell, Level, RunConfig
from sb3_saf.experiments.results import Results
from sb3_saf.training.folders import write_run
from sb3_saf.training.settings import load_settings
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


# --- diagnosis --------------------------------------------------------------------------------------------------------


#: A network shape other than the zoo's: the diagnosis must read the trained shape from the folder.
OVERRIDES = {"policy_kwargs": {"features_extractor_class": "LightEncoder", "net_arch": [32]}}


def save_team(folder: Path, method: str, seed: int) -> None:
    level = {"coordination": 2, "heterogeneity": 3}
    settings = load_settings(method, "TeamSupport-v0", "small", overrides={**OVERRIDES, "env_kwargs": level})
    model = settings.make_model(settings.make_env(seed), seed, device="cpu")
    cell = folder / "cells" / "TeamSupport-c2-h3" / method / f"seed-{seed}"
    cell.mkdir(parents=True)
    model.save(cell / "model.zip")
    description = RunConfig("small", OVERRIDES).describe(Cell(method, "TeamSupport-v0", Level.of(**level), seed))
    write_run(cell, **description, command="")


def test_it_looks_into_every_trained_team(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for method, seed in (("saf", 0), ("saf", 1), ("ippo", 0)):
        save_team(tmp_path, method, seed)
    results = Results(tmp_path)
    results.save_config(RunConfig("small", OVERRIDES))
    assert [str(cell) for cell in diagnosis.cells(results)] == [
        "ippo TeamSupport c=2, h=3 seed 0",
        "saf TeamSupport c=2, h=3 seed 0",
        "saf TeamSupport c=2, h=3 seed 1",
    ]
    assert not list(diagnosis.cells(results, "TeamTogether-*"))
    kept = tmp_path / "numbers.json"
    monkeypatch.setattr(sys, "argv", ["diagnosis", str(tmp_path), "--episodes", "2", "--json", str(kept)])
    diagnosis.main()
    numbers = json.loads(kept.read_text())
    ippo, saf = numbers["TeamSupport c2-h3 ippo"], numbers["TeamSupport c2-h3 saf"]
    assert saf["knowledge_source/read_entropy"] > 0.9  # untrained: attention is nearly uniform
    assert 0 <= saf["pool/zone_dependence"] < 0.1
    assert not any(name.startswith(("pool", "message")) for name in ippo)
    assert 0 <= ippo["greedy"] <= 25
    for zone in range(3):  # untrained: three of seven commands do nothing
        assert 0.3 < ippo[f"useless/zone_{zone}"] < 0.55
    header, _, first, second = capsys.readouterr().out.strip().splitlines()
    assert header.startswith("| task | level | method | critic/bias |")
    assert first.startswith("| TeamSupport | c2-h3 | ippo |")
    assert second.count("|") == header.count("|")


def test_useless_commands_are_counted_by_zone() -> None:
    commands = np.array([Command.FORWARD, Command.TOGGLE, Command.DONE, Command.DROP, Command.PICKUP], dtype=np.uint8)
    zones = np.array([0, 0, 2, 2, 2])
    counted = diagnosis.useless_commands("TeamSupport", commands, zones)
    assert counted == {"useless/zone_0": 0.5, "useless/zone_2": pytest.approx(2 / 3)}
    with_keys = diagnosis.useless_commands("KeyForTreasure", commands, zones)
    assert with_keys == {"useless/zone_0": 0.5, "useless/zone_2": pytest.approx(1 / 3)}
