"""PPO on the real tasks: the same seed gives the same weights with any backend, and teams learn."""

from __future__ import annotations

from typing import Any

import pytest
import torch as th
from stable_baselines3 import PPO

import sb3_saf

SMALL: dict[str, Any] = {"n_agents": 3, "grid_size": 9, "n_treasures": 12, "n_keys": 5}
LIGHT: dict[str, Any] = {"features_extractor_class": sb3_saf.LightEncoder}


def train_as_typed(backend: Any = None) -> PPO:
    """Train as in the README, with fewer epochs and steps, the paper's CNN, and SB3's buffer and batch size."""
    env = sb3_saf.make_team_env("TeamTogether", n_envs=4, seed=0, backend=backend)
    with pytest.warns(UserWarning, match="You have specified a mini-batch size of 64"):
        model = PPO("SAFPolicy", env, n_steps=10, seed=0, n_epochs=1)
    return model.learn(800)


def weights(model: Any) -> th.Tensor:
    return th.nn.utils.parameters_to_vector(model.policy.parameters()).detach()


def test_runs_of_one_seed_end_with_equal_weights_on_both_backends() -> None:
    first, supersuit = train_as_typed(), train_as_typed("supersuit")
    assert th.equal(weights(first), weights(supersuit))
    with pytest.warns(UserWarning, match="You have specified a mini-batch size of 64"):
        untrained = PPO("SAFPolicy", sb3_saf.make_team_env("TeamTogether", n_envs=4), n_steps=10, seed=0)
    assert not th.equal(weights(first), weights(untrained))


def test_it_learns() -> None:
    """After 6,400 game steps three agents collect more than 10 of 12 treasures; a random team collects 4."""
    level = {**SMALL, "grid_size": 8, "clutter_density": 0.0}
    env = sb3_saf.make_team_env("TeamSupport", n_envs=16, seed=0, **level)
    model = PPO(
        "SAFPolicy",
        env,
        n_steps=50,
        batch_size=600,
        n_epochs=4,
        learning_rate=7e-4,
        ent_coef=0.01,
        rollout_buffer_class=sb3_saf.TeamRolloutBuffer,
        policy_kwargs=LIGHT,
        seed=0,
    ).learn(6_400 * env.n_agents)
    games = sb3_saf.make_team_env("TeamSupport", n_envs=32, seed=1, **level)
    trained = sb3_saf.evaluate_team(model, games, 32, deterministic=False)
    random = sb3_saf.evaluate_team(sb3_saf.RandomPolicy(env.action_space, seed=0), games, 32)
    assert trained.interval().low > random.interval().high
    assert trained.mean > 2 * random.mean, (trained, random)
