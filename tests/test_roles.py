"""Agents with roles: all see the same and are rewarded for different actions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO

from sb3_saf import TeamRolloutBuffer, make_team_env

SEEN = np.ones(2, np.float32)


class Buttons(ParallelEnv[str, np.ndarray, int]):
    """Agent i is rewarded for pressing button i; all see the same."""

    metadata: dict[str, Any] = {"name": "buttons"}

    def __init__(self) -> None:
        self.possible_agents = ["a", "b", "c"]
        self.own, self.choices = spaces.Box(0.0, 1.0, (2,), np.float32), spaces.Discrete(3)

    def observation_space(self, agent: str) -> spaces.Box:
        return self.own

    def action_space(self, agent: str) -> spaces.Discrete:
        return self.choices

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.agents, self.steps = self.possible_agents[:], 0
        return dict.fromkeys(self.agents, SEEN), {name: {} for name in self.agents}

    def step(self, actions: dict[str, int]) -> Any:
        self.steps += 1
        names, over = self.agents, self.steps == 10
        rewards = {name: float(actions[name] == number) for number, name in enumerate(names)}
        self.agents = [] if over else names
        nobody, everybody = dict.fromkeys(names, False), dict.fromkeys(names, over)
        return dict.fromkeys(names, SEEN), rewards, nobody, everybody, {name: {} for name in names}


def test_roles_are_learned_by_actors_that_read_who_acts() -> None:
    model = PPO(
        "MAPPOPolicy",
        make_team_env(Buttons, n_envs=4, seed=0),
        n_steps=50,
        batch_size=150,
        n_epochs=8,
        learning_rate=3e-3,
        rollout_buffer_class=TeamRolloutBuffer,
        policy_kwargs={"actor_identity": True, "net_arch": [32]},
        seed=0,
        device="cpu",
    )
    model.learn(6_000)
    rows: dict[str, np.ndarray] = {"obs": np.tile(SEEN, (900, 1)), "agent": np.arange(900) % 3}
    actions, _ = model.predict(rows, deterministic=False)
    assert (actions == rows["agent"]).mean() > 0.9  # without actor_identity a third


def test_one_agent_alone_must_say_who_it_is() -> None:
    model = PPO(
        "MAPPOPolicy",
        make_team_env(Buttons, seed=0),
        policy_kwargs={"actor_identity": True, "net_arch": [8]},
        device="cpu",
    )
    with pytest.raises(
        ValueError, match=r"\{'obs': \.\.\., 'agent': its index\}, or the observations of all agents by"
    ):
        model.predict(SEEN)
    model.predict({"obs": SEEN, "agent": np.array(1)})
