"""Wrong calls raise ValueErrors that name the argument, and leave games as they were."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hecogrid_envs
import sb3_saf
from hecogrid_envs import TASK_NAMES, GameBatch, HECOGridEnv, HECOGridParams
from hecogrid_envs.params import MAX_AGENTS
from tests.levels import level

SMALL: dict[str, Any] = {"n_agents": 2, "grid_size": 6, "n_treasures": 3, "clutter_density": 0.0}

#: Parameters, and what the message names beside the first of them.
WRONG_PARAMETERS: list[tuple[dict[str, Any], str]] = [
    ({"n_agent": 3}, "did you mean 'n_agents'"),
    ({"n_agents": 0}, f"1 to {MAX_AGENTS}, got 0"),
    ({"n_agents": True}, "got True"),
    ({"grid_size": 2}, "got 2"),
    ({"coordination": 0}, "got 0"),
    ({"coordination": 4, "n_agents": 3}, "1 to 3"),
    ({"heterogeneity": 29}, "grid_size - 2"),
    ({"view_size": 6}, "odd"),
    ({"view_size": 59}, "1 to 57"),
    ({"view_offset": 7}, "0 to 6"),
    ({"max_cycles": 0}, "got 0"),
    ({"clutter_density": 1.0}, "got 1.0"),
    ({"clutter_density": float("nan")}, "got nan"),
    ({"rules": "papers"}, "did you mean 'paper'"),
    ({"agent_order": 1}, "got 1"),
    ({"observation": "rbg"}, "did you mean 'rgb'"),
    ({"agent_colours": "zones"}, "did you mean 'zone'"),
    ({"observation": "tiles", "view_tile_size": 11}, "view_tile_size from 1 to 10, got 11"),
    ({"grid_size": 12}, "140 cells, grid_size=12 has 100"),
    ({"grid_size": 5, "n_treasures": 0, "n_keys": 9, "clutter_density": 0.0}, "no cell|9 keys"),
    ({"render_mode": "rgb"}, "got 'rgb'"),
]


def small_env() -> HECOGridEnv:
    env = hecogrid_envs.parallel_env("TeamSupport", **SMALL)
    env.reset(seed=0)
    return env


def state_with(**changes: Any) -> dict[str, Any]:
    """Return a valid state of ``small_env`` with changes; None removes an entry."""
    state = level("######\n#>...#\n#....#\n#.^..#\n#....#\n######") | changes
    return {name: value for name, value in state.items() if value is not None}


def plane(x: int, y: int, value: Any = True) -> np.ndarray[Any, Any]:
    board = np.zeros((6, 6), dtype=type(value))
    board[x, y] = value
    return board


#: States, and the entry and place that the message names.
WRONG_STATES: list[tuple[object, str]] = [
    (3, "mapping of arrays, got int"),
    (state_with(keys=None), "'keys'"),
    (state_with(walls=np.ones((5, 6), dtype=bool)), r"'walls' .*\(6, 6\), got \(5, 6\)"),
    (state_with(agent_pos=np.zeros((3, 2), dtype=int)), r"'agent_pos' .*\(2, 2\), got \(3, 2\)"),
    (state_with(agent_dir=np.array([0.0, 1.0])), "'agent_dir' .*int64, got float64"),
    (state_with(agent_dir=np.array([0, 4])), r"'agent_dir' .*got 4 at index \(1,\)"),
    (state_with(walls=plane(0, 0)), r"outer ring .*\(0, 1\)"),
    (state_with(treasures=plane(0, 2, 1)), r"treasure .*wall .*\(0, 2\)"),
    (state_with(keys=plane(5, 5)), r"key .*wall .*\(5, 5\)"),
    (state_with(keys=plane(3, 3), treasures=plane(3, 3, 2)), r"key .*treasure .*\(3, 3\)"),
    (state_with(agent_pos=np.array([[1, 1], [0, 3]])), r"agent 1 .*wall .*\(0, 3\)"),
    (state_with(keys=plane(2, 3)), r"agent 1 .*key .*\(2, 3\)"),
]

ODD_ACTIONS: tuple[Any, ...] = (-1, 7, 2**40, 1.5, np.nan, True, None, "left", {})
BOTH = {"agent_0": 0, "agent_1": 0}
WRONG_ACTIONS: list[tuple[Any, str]] = [
    ([0, 0], "dict from agent to action, got list"),
    ({"agent_0": 0}, "'agent_1'"),
    ({**BOTH, "agent_2": 0}, "'agent_2'"),
    *(
        ({**BOTH, "agent_1": action}, f"'agent_1' must be an integer from 0 to 6, got {action!r}")
        for action in ODD_ACTIONS
    ),
]


def vec(**changes: Any) -> Any:
    return sb3_saf.make_vec_env("TeamSupport", **{"n_envs": 2, "seed": 0, **SMALL, **changes})


def started() -> Any:
    venv = vec()
    venv.reset()
    return venv


def stepped_without_reset() -> None:
    hecogrid_envs.parallel_env("TeamSupport", **SMALL).step(BOTH)


def stepped_after_the_end() -> None:
    env = hecogrid_envs.parallel_env("TeamSupport", **SMALL, max_cycles=1)
    env.reset()
    env.step(BOTH)
    env.step(BOTH)


WRONG_CALLS: list[tuple[Callable[[], Any], str]] = [
    (lambda: hecogrid_envs.parallel_env("TeamSuport"), r"'TeamSuport' \(did you mean 'TeamSupport'"),
    (lambda: hecogrid_envs.parallel_env("Pong"), "'Pong'; the tasks are TeamTogether, TeamSupport, KeyForTreasure"),
    (lambda: small_env().reset(seed=-1), "seed .*got -1"),
    (lambda: small_env().render(), "render_mode"),
    (stepped_without_reset, r"call reset\(\)"),
    (stepped_after_the_end, r"call reset\(\)"),
    (lambda: GameBatch("TeamSupport", HECOGridParams(), 0), "n_games .*got 0"),
    (lambda: vec().set_options([{}]), "4 dicts, .*got 1"),
    (lambda: vec().env_method("state", indices=4), "row 4"),
    (lambda: vec().step(np.zeros(4, dtype=int)), r"call reset\(\)"),
    (lambda: started().step(np.zeros(3, dtype=int)), r"shape \(4,\), got .*\(3,\)"),
    (lambda: started().step(np.zeros(4)), "Discrete.*got float64"),
    (lambda: started().step(np.array([0, 0, 9, 0])), r"got 9 in row 2 \(game 1, agent_0\)"),
    (lambda: started().env_method("step", BOTH, indices=0), "step on the vector environment"),
]


@pytest.mark.parametrize(("params", "named"), WRONG_PARAMETERS, ids=[str(params) for params, _ in WRONG_PARAMETERS])
def test_wrong_parameters(params: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named) as error:
        hecogrid_envs.parallel_env("KeyForTreasure", **params)
    assert next(iter(params)) in str(error.value)


#: Values of all kinds.
ANYTHING = st.one_of(
    *(st.none(), st.booleans(), st.floats(), st.text(max_size=9), st.lists(st.integers(), max_size=2)),
    *(st.integers(-(2**70), -1), st.integers(2**31, 2**70)),
    st.sampled_from((0, 4, 10**6, "Paper", b"rgb", np.float32(0.5), np.array(3), {}, object)),
)
PARAMETERS = [*(field.name for field in fields(HECOGridParams)), "render_mode", "wind"]


@given(st.sampled_from(TASK_NAMES), st.dictionaries(st.sampled_from(PARAMETERS), ANYTHING, max_size=2))
def test_any_value_works_or_raises_a_value_error_that_names_the_parameter(task: str, params: dict[str, Any]) -> None:
    named = True
    try:
        hecogrid_envs.parallel_env(task, **{**SMALL, "n_keys": 1, **params}).reset(seed=0)
    except ValueError as error:
        named = any(name in str(error) for name in params)
    assert named


@pytest.mark.parametrize(("state", "named"), WRONG_STATES, ids=[named for _, named in WRONG_STATES])
def test_wrong_states(state: object, named: str) -> None:
    env = small_env()
    before = env.get_state()
    with pytest.raises(ValueError, match=named):
        env.reset(options={"state": state})
    np.testing.assert_equal(env.get_state(), before, "a refused state must leave the game as it was")


def test_the_unchanged_state_is_accepted() -> None:
    small_env().reset(options={"state": state_with()})


@pytest.mark.parametrize(("actions", "named"), WRONG_ACTIONS, ids=[named for _, named in WRONG_ACTIONS])
def test_wrong_actions(actions: Any, named: str) -> None:
    env = small_env()
    before = env.get_state()
    with pytest.raises(ValueError, match=named):
        env.step(actions)
    np.testing.assert_equal(env.get_state(), before, "a refused action must leave the game as it was")
    env.step(BOTH)


@pytest.mark.parametrize(("call", "named"), WRONG_CALLS, ids=[named for _, named in WRONG_CALLS])
def test_wrong_calls(call: Callable[[], Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        call()
