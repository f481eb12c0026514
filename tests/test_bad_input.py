"""Error messages of wrong calls, word for word: what was expected, what was given, how to fix it."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import hecogrid_envs
import sb3_saf
from hecogrid_envs import GameBatch, HECOGridEnv, HECOGridParams
from hecogrid_envs.params import MAX_AGENTS

SMALL: dict[str, Any] = {"n_agents": 2, "grid_size": 6, "n_treasures": 3, "clutter_density": 0.0}
PARAMETERS = (
    "n_agents, grid_size, coordination, heterogeneity, n_treasures, n_keys, clutter_density, view_size, "
    "view_tile_size, view_offset, support_radius, max_cycles, rules, agent_order, observation"
)
ENTRIES = "walls, treasures, keys, agent_pos, agent_dir, agent_has_key"


def exactly(message: str) -> str:
    return f"^{re.escape(message)}$"


WRONG_PARAMETERS: list[tuple[dict[str, Any], str]] = [
    ({"n_agent": 3}, f"unknown parameter 'n_agent' (did you mean 'n_agents'?); the parameters are {PARAMETERS}"),
    ({"wind": 1}, f"unknown parameter 'wind'; the parameters are {PARAMETERS}"),
    ({"n_agents": 0}, f"n_agents must be an integer from 1 to {MAX_AGENTS}, got 0"),
    ({"n_agents": True}, f"n_agents must be an integer from 1 to {MAX_AGENTS}, got True"),
    ({"n_agents": "ten"}, f"n_agents must be an integer from 1 to {MAX_AGENTS}, got 'ten'"),
    ({"grid_size": 2}, "grid_size must be an integer from 3 to 1000, got 2"),
    ({"grid_size": 10_000}, "grid_size must be an integer from 3 to 1000, got 10000"),
    ({"coordination": 0}, "coordination must be an integer from 1 to 10 (1 <= coordination <= n_agents), got 0"),
    (
        {"coordination": 4, "n_agents": 3},
        "coordination must be an integer from 1 to 3 (1 <= coordination <= n_agents), got 4",
    ),
    (
        {"heterogeneity": 29},
        "heterogeneity must be an integer from 1 to 28 (1 <= heterogeneity <= grid_size - 2), got 29",
    ),
    ({"n_treasures": -1}, "n_treasures must be an integer from 0 to 784, got -1"),
    ({"n_keys": -1}, "n_keys must be an integer from 0 to 1000000, got -1"),
    ({"view_size": 6}, "view_size must be odd, from 1 to 57, got 6"),
    ({"view_size": 59}, "view_size must be an integer from 1 to 57 and odd, got 59"),
    ({"view_tile_size": 0}, "view_tile_size must be an integer from 1 to 128, got 0"),
    ({"view_offset": 7}, "view_offset must be an integer from 0 to 6 (0 <= view_offset < view_size), got 7"),
    ({"support_radius": -1}, "support_radius must be an integer from 0 to 30, got -1"),
    ({"max_cycles": 0}, "max_cycles must be an integer from 1 to 2147483647, got 0"),
    ({"clutter_density": 1.0}, "clutter_density must be a number from 0 (included) to 1 (excluded), got 1.0"),
    (
        {"clutter_density": float("nan")},
        "clutter_density must be a number from 0 (included) to 1 (excluded), got nan",
    ),
    ({"rules": "papers"}, "rules must be 'paper' or 'released', got 'papers' (did you mean 'paper'?)"),
    ({"agent_order": 1}, "agent_order must be 'random' or 'index', got 1"),
    ({"observation": "rbg"}, "observation must be 'rgb' or 'tiles', got 'rbg' (did you mean 'rgb'?)"),
    (
        {"observation": "tiles", "view_tile_size": 11},
        "observation='tiles' needs a view_tile_size from 1 to 10, got 11: larger tiles have grid lines that turn with "
        "the viewer, so a code alone does not tell its pixels; use observation='rgb'",
    ),
    (
        {"grid_size": 12},
        "the map is too small: 100 treasures (n_treasures) + 10 walls (clutter_density=0.1) + 30 keys (n_keys) need "
        "140 cells, grid_size=12 has 100; lower them or raise grid_size",
    ),
    (
        {"grid_size": 5, "n_treasures": 0, "n_keys": 9, "clutter_density": 0.0},
        "no cell is left for agents to stand on: 0 walls (clutter_density=0.0) + 9 keys (n_keys) fill all 9 cells of "
        "grid_size=5; lower them or raise grid_size",
    ),
    ({"render_mode": "rgb"}, "render_mode must be one of ('rgb_array', 'human', 'ansi') or None, got 'rgb'"),
]


def small_env() -> HECOGridEnv:
    env = hecogrid_envs.parallel_env("TeamSupport", **SMALL)
    env.reset(seed=0)
    return env


def state_with(**changes: Any) -> dict[str, Any]:
    """Return a valid state of ``small_env`` with changes; None removes an entry."""
    walls = np.ones((6, 6), dtype=bool)
    walls[1:-1, 1:-1] = False
    state: dict[str, Any] = {
        "walls": walls,
        "treasures": np.zeros((6, 6), dtype=np.uint8),
        "keys": np.zeros((6, 6), dtype=bool),
        "agent_pos": np.array([[1, 1], [2, 3]]),
        "agent_dir": np.array([0, 3]),
        "agent_has_key": np.array([False, False]),
    }
    state.update(changes)
    return {name: value for name, value in state.items() if value is not None}


def plane(x: int, y: int, value: Any = True) -> np.ndarray[Any, Any]:
    board = np.zeros((6, 6), dtype=type(value))
    board[x, y] = value
    return board


WRONG_STATES: list[tuple[object, str]] = [
    (3, "a state must be a mapping of arrays, got int"),
    (state_with(keys=None), f"state lacks 'keys'; it needs {ENTRIES}"),
    (state_with(key=1), f"state has an unknown entry 'key'; it needs just {ENTRIES}"),
    (state_with(walls=np.ones((5, 6), dtype=bool)), "state entry 'walls' must have shape (6, 6), got (5, 6)"),
    (state_with(agent_pos=np.zeros((3, 2), dtype=int)), "state entry 'agent_pos' must have shape (2, 2), got (3, 2)"),
    (state_with(agent_dir=np.array([0.0, 1.0])), "state entry 'agent_dir' must be int64, got float64"),
    (
        state_with(agent_dir=np.array([0, 4])),
        "state entry 'agent_dir' must hold values from 0 to 3, got 4 at index (1,)",
    ),
    (
        state_with(agent_pos=np.array([[1, 1], [6, 1]])),
        "state entry 'agent_pos' must hold values from 0 to 5, got 6 at index (1, 0)",
    ),
    (
        state_with(treasures=plane(2, 2, 3)),
        "state entry 'treasures' must hold values from 0 to 2, got 3 at index (2, 2)",
    ),
    (
        state_with(walls=plane(0, 0)),
        "inconsistent state: the outer ring must be wall, but there is none at (x, y) = (0, 1)",
    ),
    (state_with(treasures=plane(0, 2, 1)), "inconsistent state: a treasure lies in a wall at (x, y) = (0, 2)"),
    (state_with(keys=plane(5, 5)), "inconsistent state: a key lies in a wall at (x, y) = (5, 5)"),
    (
        state_with(keys=plane(3, 3), treasures=plane(3, 3, 2)),
        "inconsistent state: a key and a treasure share a cell at (x, y) = (3, 3)",
    ),
    (
        state_with(agent_pos=np.array([[1, 1], [0, 3]])),
        "inconsistent state: agent 1 stands in a wall at (x, y) = (0, 3)",
    ),
    (state_with(keys=plane(2, 3)), "inconsistent state: agent 1 stands on a key at (x, y) = (2, 3)"),
]

BOTH = {"agent_0": 0, "agent_1": 0}
WRONG_ACTIONS: list[tuple[Any, str]] = [
    ([0, 0], "actions must be a dict from agent to action, got list"),
    ({"agent_0": 0}, "no action for 'agent_1'; every agent needs one: agent_0, agent_1"),
    ({**BOTH, "agent_2": 0}, "unknown agent 'agent_2'; the agents are agent_0, agent_1"),
    ({**BOTH, "agent_1": 7}, "action of 'agent_1' must be an integer from 0 to 6, got 7"),
    ({**BOTH, "agent_0": 1.0}, "action of 'agent_0' must be an integer from 0 to 6, got 1.0"),
    ({**BOTH, "agent_0": True}, "action of 'agent_0' must be an integer from 0 to 6, got True"),
]


def vec(**changes: Any) -> Any:
    return sb3_saf.make_vec_env("TeamSupport", **{"n_envs": 2, "seed": 0, **SMALL, **changes})


def started() -> Any:
    venv = vec()
    venv.reset()
    return venv


def stepped_without_reset() -> None:
    small = hecogrid_envs.parallel_env("TeamSupport", **SMALL)
    small.step(BOTH)


def stepped_after_the_end() -> None:
    env = hecogrid_envs.parallel_env("TeamSupport", **SMALL, max_cycles=1)
    env.reset()
    env.step(BOTH)
    env.step(BOTH)


WRONG_CALLS: list[tuple[Callable[[], Any], str]] = [
    (
        lambda: hecogrid_envs.parallel_env("TeamSuport"),
        "unknown task 'TeamSuport' (did you mean 'TeamSupport'?); "
        "the tasks are TeamTogether, TeamSupport, KeyForTreasure",
    ),
    (
        lambda: hecogrid_envs.parallel_env("Pong"),
        "unknown task 'Pong'; the tasks are TeamTogether, TeamSupport, KeyForTreasure",
    ),
    (lambda: small_env().reset(seed=-1), "seed must be an integer of at least 0, or None, got -1"),
    (lambda: small_env().reset(seed=1.5), "seed must be an integer of at least 0, or None, got 1.5"),  # type: ignore[arg-type]
    (lambda: small_env().render(), "no render_mode was given; create the environment with render_mode='rgb_array'"),
    (stepped_without_reset, "the episode has not begun or is over: call reset() before step()"),
    (stepped_after_the_end, "the episode has not begun or is over: call reset() before step()"),
    (lambda: GameBatch("TeamSupport", HECOGridParams(), 0), "n_games must be an integer of at least 1, got 0"),
    (lambda: GameBatch("TeamSupport", HECOGridParams(), 1, 0), "n_threads must be an integer of at least 1, got 0"),
    (lambda: vec(n_envs=0), "n_games must be an integer of at least 1, got 0"),
    (lambda: vec(backend="gpu"), "backend must be 'native' or 'supersuit', got 'gpu'"),
    (
        lambda: vec().set_options([{}]),
        "expected a dict for all games or a list of 4 dicts, one per row (2 games of 2 agents), got 1",
    ),
    (lambda: vec().env_method("state", indices=4), "there is no row 4: expected 0 to 3"),
    (lambda: vec().step(np.zeros(4, dtype=int)), "the games have not begun: call reset() before step()"),
    (
        lambda: started().step(np.zeros(3, dtype=int)),
        "actions must have shape (4,), one per agent of 2 games x 2 agents, got (3,)",
    ),
    (lambda: started().step(np.zeros(4)), "actions must be integers, got float64"),
    (lambda: started().step(np.array([0, 0, 9, 0])), "actions must be from 0 to 6, got 9 in row 2"),
    (
        lambda: started().env_method("step", BOTH, indices=0),
        "this game is one of a batch and steps with it: call step on the vector environment",
    ),
]


@pytest.mark.parametrize(("params", "message"), WRONG_PARAMETERS, ids=[str(params) for params, _ in WRONG_PARAMETERS])
def test_wrong_parameters(params: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=exactly(message)):
        hecogrid_envs.parallel_env("KeyForTreasure", **params)


@pytest.mark.parametrize(("state", "message"), WRONG_STATES, ids=[message[:40] for _, message in WRONG_STATES])
def test_wrong_states(state: object, message: str) -> None:
    env = small_env()
    before = env.get_state()
    with pytest.raises(ValueError, match=exactly(message)):
        env.reset(options={"state": state})
    np.testing.assert_equal(env.get_state(), before, "a refused state must leave the game as it was")


def test_the_unchanged_state_is_accepted() -> None:
    small_env().reset(options={"state": state_with()})


@pytest.mark.parametrize(("actions", "message"), WRONG_ACTIONS, ids=[message[:40] for _, message in WRONG_ACTIONS])
def test_wrong_actions(actions: Any, message: str) -> None:
    env = small_env()
    before = env.get_state()
    with pytest.raises(ValueError, match=exactly(message)):
        env.step(actions)
    np.testing.assert_equal(env.get_state(), before, "a refused action must leave the game as it was")
    env.step(BOTH)


@pytest.mark.parametrize(("call", "message"), WRONG_CALLS, ids=[message[:40] for _, message in WRONG_CALLS])
def test_wrong_calls(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=exactly(message)):
        call()
