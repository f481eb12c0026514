"""Agents with roles: all see the same and are rewarded for different actions."""

from __future__ import annotations

from functools import partial

import numpy as np
from stable_baselines3 import PPO

from sb3_saf import TeamRolloutBuffer, make_team_env
from tests.probe_envs import Buttons

BUTTONS = partial(Buttons, n_agents=3, length=10)
SEEN = np.ones(10, np.float32)


def test_roles_are_learned_by_actors_that_read_who_acts() -> None:
    model = PPO(
        "MAPPOPolicy",
        make_team_env(BUTTONS, n_envs=4, seed=0),
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
