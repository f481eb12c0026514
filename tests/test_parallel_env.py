"""One game as a PettingZoo environment: conformance, seeds, spaces, states."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import pettingzoo
import pytest
from pettingzoo.test import (
    api_test,
    max_cycles_test,
    parallel_api_test,
    parallel_seed_test,
    render_test,
    seed_test,
    state_test,
)

import hecogrid_envs
from hecogrid_envs import TASK_NAMES, TASKS, HECOGridEnv, HECOGridParams
from hecogrid_envs.tasks import register_with_pettingzoo

SMALL: dict[str, Any] = {"n_agents": 4, "grid_size": 9, "n_treasures": 12, "n_keys": 5, "max_cycles": 20}
VARIANTS = [
    pytest.param({**SMALL, "rules": rules, "observation": observation}, id=f"{rules}-{observation}")
    for rules in ("paper", "released")
    for observation in ("rgb", "tiles")
]

pytestmark = pytest.mark.parametrize("task", TASK_NAMES)


def random_actions(env: HECOGridEnv, rng: np.random.Generator) -> dict[str, int]:
    return {agent: int(rng.integers(7)) for agent in env.agents}


def test_pettingzoo_conformance(task: str) -> None:
    def make(**params: Any) -> HECOGridEnv:
        return hecogrid_envs.parallel_env(task, **SMALL, **params)

    parallel_api_test(make(), num_cycles=50)
    parallel_seed_test(make)
    api_test(hecogrid_envs.env(task, **SMALL), num_cycles=50)
    seed_test(lambda: hecogrid_envs.env(task, **SMALL), num_cycles=50)
    state_test(hecogrid_envs.env(task, **SMALL), make())


def test_max_cycles(task: str) -> None:
    max_cycles_test(importlib.import_module(TASKS[task].__module__))


def test_renders_in_every_mode(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    render_test(
        lambda render_mode: hecogrid_envs.env(task, render_mode=render_mode, **SMALL),
        custom_tests={"ansi": lambda text: isinstance(text, str) and "#" in text},
    )


def test_made_by_name(task: str) -> None:
    register_with_pettingzoo()  # a second time is silent
    env = pettingzoo.make("parallel", f"hecogrid/{task}-v0", n_agents=3)
    assert isinstance(env, TASKS[task])
    assert len(env.possible_agents) == 3
    aec = pettingzoo.make("aec", f"hecogrid/{task}-v0", n_agents=2, max_cycles=7)
    aec.reset(seed=0)
    assert aec.unwrapped.params == HECOGridParams(n_agents=2, max_cycles=7)


@pytest.mark.parametrize("params", VARIANTS)
def test_full_episodes_stay_in_their_spaces(task: str, params: dict[str, Any]) -> None:
    env = hecogrid_envs.parallel_env(task, **params)
    rng = np.random.default_rng(0)
    for episode in range(3):
        observations, infos = env.reset(seed=0 if episode == 0 else None)
        assert set(observations) == set(infos) == set(env.possible_agents)
        steps = 0
        while env.agents:
            result = env.step(random_actions(env, rng))
            steps += 1
            assert env.state_space.contains(env.state())
            for agent, observation in result.observations.items():
                assert env.observation_space(agent).contains(observation)
            assert len(set(result.rewards.values())) == 1
            assert not any(result.terminations.values())
            assert set(result.truncations.values()) == {steps == params["max_cycles"]}
        assert steps == params["max_cycles"]


def test_documentation_page(task: str) -> None:
    page = TASKS[task].__doc__
    assert page is not None
    for heading in ("Description", "Actions", "Observation", "State", "Reward and end", "Arguments", "Version history"):
        assert f"## {heading}" in page
    code = page.split("```python\n")[1].split("```")[0]
    scope: dict[str, Any] = {}
    exec(code, scope)  # the example on the page runs
    assert scope["observations"]["agent_0"].shape == (28, 28, 3)
