"""
Properties that hold for any configuration and any actions.

Ten thousand examples: ``EXAMPLES=10000 python -m pytest tests/test_invariants.py --timeout 3600``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

import hecogrid_envs
from hecogrid_envs import TASK_NAMES, GameBatch, HECOGridEnv, HECOGridParams

#: Values of small games that need not be compatible, and sometimes one arbitrary value.
USUAL: dict[str, st.SearchStrategy[Any]] = {
    "n_agents": st.integers(1, 6),
    "grid_size": st.integers(3, 11),
    "coordination": st.integers(1, 4),
    "heterogeneity": st.integers(1, 8),
    "n_treasures": st.integers(0, 12),
    "n_keys": st.integers(0, 6),
    "clutter_density": st.floats(0, 0.6),
    "view_size": st.sampled_from((1, 3, 5, 7, 9)),
    "view_tile_size": st.integers(1, 5),
    "view_offset": st.integers(0, 3),
    "support_radius": st.integers(0, 4),
    "max_cycles": st.integers(1, 9),
    "rules": st.sampled_from(("paper", "released")),
    "agent_order": st.sampled_from(("random", "index")),
    "observation": st.sampled_from(("rgb", "tiles")),
    "agent_colours": st.sampled_from(("zone", "none", "action")),
}
ANYTHING = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**70), -1),
    st.integers(2**31, 2**70),
    st.floats(),
    st.text(max_size=9),
    st.lists(st.integers(), max_size=2),
    st.sampled_from((0, 4, 10**6, "Paper", b"rgb", np.float32(0.5), np.array(3), {}, object)),
)
#: Maximum number of steps played in a game; some games have a million.
LONGEST = 60
ODD_ACTIONS: tuple[Any, ...] = (-1, 7, 2**40, 1.5, "left", None, [0], np.nan)


@st.composite
def configurations(draw: st.DrawFn) -> dict[str, Any]:
    params = {name: draw(values) for name, values in USUAL.items() if draw(st.booleans())}
    # The default game is large, so only other parameters are left out.
    params |= {name: draw(USUAL[name]) for name in ("n_agents", "grid_size", "n_treasures") if name not in params}
    if draw(st.integers(0, 3)):
        limits = {"coordination": params["n_agents"], "heterogeneity": params["grid_size"] - 2, "view_offset": 0}
        limits["n_treasures"] = limits["n_keys"] = (params["grid_size"] - 2) ** 2 // 4
        params = {name: min(value, limits[name]) if name in limits else value for name, value in params.items()}
        params = {"coordination": 1, "heterogeneity": 1, "n_keys": 0, **params}
    if draw(st.integers(0, 3)) == 0:
        params[draw(st.sampled_from([*USUAL, "wind"]))] = draw(ANYTHING)
    return params


class Count(NamedTuple):
    """Numbers of things in a state that are constant."""

    walls: bytes
    treasures: int
    keys: int

    @classmethod
    def of(cls, state: Any) -> Count:
        return cls(
            state["walls"].tobytes(),
            int((state["treasures"] > 0).sum()),
            int(state["keys"].sum() + state["agent_has_key"].sum()),
        )


def check_places(state: Any) -> None:
    """No agent is in a wall, on a key or outside the map."""
    x, y = state["agent_pos"].T
    assert not (state["walls"] | state["keys"])[x, y].any()
    ring = np.ones_like(state["walls"])
    ring[1:-1, 1:-1] = False
    assert state["walls"][ring].all()


def check_views(env: HECOGridEnv, params: dict[str, Any], observations: dict[str, Any]) -> None:
    """
    Views equal those drawn from the state alone, which does not store the order of arrival in a cell; with the released
    rules, agents' colours are those of the previous step, and actions that are shown are not part of the state.
    """
    state = env.get_state()
    if params.get("rules") == "released" or params.get("agent_colours") == "action":
        return
    if len({tuple(place) for place in state["agent_pos"].tolist()}) < len(state["agent_pos"]):
        event("a shared cell: not compared")
        return
    again = GameBatch(env.task, HECOGridParams.from_kwargs(params))
    again.set_state(state)
    assert np.array_equal(np.stack(list(observations.values())), again.observe_game(0))


def check_odd_action(env: HECOGridEnv, action: Any) -> None:
    """The action is refused, and the game does not change."""
    before = env.get_state()
    actions = dict.fromkeys(env.agents, 0) | {env.agents[-1]: action}
    try:
        env.step(actions)
    except ValueError:
        after = env.get_state()
        assert all(np.array_equal(before[name], after[name]) for name in before)  # type: ignore[literal-required]
    else:
        raise AssertionError(f"the action {action!r} was taken")


def check_step(before: Any, env: HECOGridEnv, rewards: dict[str, float]) -> int:
    """Each treasure is rewarded once, for all agents equally: the number of collected treasures."""
    state = env.get_state()
    check_places(state)
    assert Count.of(state) == Count.of(before)
    was, now = before["treasures"], state["treasures"]
    assert (now[was == 2] == 2).all() and ((was == 0) == (now == 0)).all()
    collected = int((now == 2).sum() - (was == 2).sum())
    assert len(set(rewards.values())) == 1
    assert abs(sum(rewards.values()) - collected) < 1e-9
    return collected


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(st.sampled_from(TASK_NAMES), configurations(), st.integers(0, 2**40), st.sampled_from(ODD_ACTIONS))
def test_what_is_true_of_every_game(task: str, params: dict[str, Any], seed: int, odd_action: Any) -> None:
    try:
        env = hecogrid_envs.parallel_env(task, **params)
    except ValueError:
        event("refused at construction")
        return
    rng = np.random.default_rng(seed)
    observations, _ = env.reset(seed=seed)
    first, collected, paid = env.get_state(), 0, 0.0
    check_places(first)
    check_views(env, params, observations)
    check_odd_action(env, odd_action)
    steps = 0
    while env.agents and steps < LONGEST:
        before = env.get_state()
        # Forward changes most; in other zones it has another number.
        actions = rng.choice(7, size=len(env.agents), p=(0.1, 0.1, 0.4, 0.15, 0.15, 0.05, 0.05))
        observations, rewards, terminated, truncated, _ = env.step(dict(zip(env.agents, actions, strict=True)))
        steps += 1
        collected += check_step(before, env, rewards)
        paid += sum(rewards.values())
        check_views(env, params, observations)
        assert not any(terminated.values())
    max_cycles = params.get("max_cycles", HECOGridParams().max_cycles)
    assert steps == min(max_cycles, LONGEST)
    assert set(truncated.values()) == {steps == max_cycles}
    assert abs(paid - collected) < 1e-6
    assert Count.of(env.get_state()) == Count.of(first)
    event("treasures collected" if collected else "nothing collected")
