"""Agents that are paid on different scales: advantages and values normalised for each agent."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CallbackList

from sb3_saf import TeamRolloutBuffer, make_team_env, ppo_settings
from sb3_saf.networks.critic import ValueNormalizer
from sb3_saf.policies.base import TeamActorCriticPolicy
from tests.probe_envs import Arms

SCALES: Final = (1.0, 30.0, 300.0, 1000.0)


def make(policy: str, scales: Sequence[float], normalize_values: bool = False, **kwargs: Any) -> PPO:
    env = make_team_env(partial(Arms, scales), 4, seed=0)
    settings: dict[str, Any] = {
        "n_steps": 32,
        "batch_size": 64 * len(scales),
        "learning_rate": 5e-3,
        "gamma": 0.5,
        "device": "cpu",
    }
    networks = {"net_arch": [32], "normalize_values": normalize_values}
    return PPO(policy, env, **ppo_settings(env, policy.lower(), policy_kwargs=networks, **settings | kwargs), seed=0)


def right_arms(model: PPO) -> np.ndarray[Any, Any]:
    """Return the probability of each agent's right arm, (N,)."""
    env: Any = model.get_env()
    assert isinstance(model.policy, TeamActorCriticPolicy)
    with th.no_grad():
        distribution: Any = model.policy.get_distribution(model.policy.obs_to_tensor(env.reset())[0])
    probabilities: np.ndarray[Any, Any] = distribution.distribution.probs.numpy()
    agents = np.arange(env.n_agents)
    return probabilities[agents, agents % Arms.n_actions]


@pytest.mark.parametrize("normalize_values", [False, True])
@pytest.mark.parametrize("policy", ["MAPPO", "IPPO"])
def test_all_agents_learn_whatever_they_are_paid(policy: str, normalize_values: bool) -> None:
    model = make(policy, SCALES, normalize_values).learn(12 * 32 * 4 * len(SCALES))
    assert right_arms(model).min() > 0.9


def test_without_it_the_small_ones_stay_at_chance() -> None:
    model = make("IPPO", (1.0, 1000.0), rollout_buffer_kwargs={}).learn(12 * 32 * 4 * 2)
    small, large = right_arms(model)
    assert small < 0.5 < 0.9 < large


@pytest.mark.parametrize("dying", [False, True])
def test_advantages_of_each_agent_have_mean_0_and_deviation_1(dying: bool) -> None:
    model = make("MAPPO", (1.0, 30.0, 0.5), n_epochs=1)
    model.learn(32 * 4 * 3)
    buffer: Any = model.rollout_buffer
    assert isinstance(buffer, TeamRolloutBuffer) and buffer.active is not None
    if dying:
        buffer.active[20:, :, 0] = 0
    playing = buffer.active.reshape(32, 12) != 0
    last = th.zeros(12)
    buffer.normalize_advantage = None
    buffer.compute_returns_and_advantage(last, np.zeros(12))
    given, returns = buffer.advantages.copy(), buffer.returns.copy()
    buffer.normalize_advantage = "agent"
    buffer.compute_returns_and_advantage(last, np.zeros(12))
    np.testing.assert_array_equal(buffer.returns, returns)
    for agent in range(3):
        rows = playing & (np.arange(12) % 3 == agent)
        own = given[rows].astype(float)
        np.testing.assert_allclose(buffer.advantages[rows], (own - own.mean()) / own.std(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("how", ["by the game", "by make_team_env"])
def test_shared_rewards_learn_as_before(how: str) -> None:
    def weights(**kwargs: Any) -> dict[str, th.Tensor]:
        shared = {"team_reward": "sum"} if how == "by make_team_env" else {"shared": True}
        env = make_team_env(Arms, 2, seed=0, **shared)
        settings = ppo_settings(env, n_steps=16, device="cpu", **kwargs)
        assert ("rollout_buffer_kwargs" in settings) == (how == "by the game" or bool(kwargs))
        return PPO("MAPPOPolicy", env, **settings, seed=0).learn(16 * 4 * 2).policy.state_dict()

    as_set, before = weights(), weights(rollout_buffer_kwargs={"ends": "own"})
    assert all(th.equal(as_set[name], before[name]) for name in before)


def test_statistics_of_each_agent() -> None:
    rng = np.random.default_rng(0)
    normalizer, alone = ValueNormalizer(2), [ValueNormalizer(), ValueNormalizer()]
    outputs, agents = th.randn(6), th.tensor([0, 1, 1, 0, 1, 0])
    for _ in range(3):
        of_agents = np.arange(60) % 2
        returns = rng.normal(np.where(of_agents, 1000.0, 2.0), np.where(of_agents, 300.0, 1.0))
        before = normalizer(outputs, agents=agents)
        scale, shift = normalizer.update(returns, of_agents)
        for agent, one in enumerate(alone):
            one.update(returns[of_agents == agent])
            rows = agents == agent
            assert th.equal(normalizer(outputs, agents=agents)[rows], one(outputs[rows]))
        after = normalizer(outputs, agents=agents)
        th.testing.assert_close(after, (before * scale[agents] + shift[agents]).float(), rtol=1e-4, atol=1e-3)


def test_the_critic_starts_from_the_old_values_after_an_update() -> None:
    """PPO's old values are converted with the statistics of their own agents."""
    model = make("MAPPO", (1.0, 1000.0), normalize_values=True, clip_range_vf=1e-6, n_epochs=1, batch_size=256)
    model.learn(32 * 4 * 2)
    policy: Any = model.policy
    policy.set_training_mode(True)
    callback = CallbackList([])
    callback.init_callback(model)
    assert model.env is not None
    model.collect_rollouts(model.env, callback, model.rollout_buffer, 32)
    policy.set_training_mode(True)
    (minibatch,) = model.rollout_buffer.get(None)
    values, _, _ = policy.evaluate_actions(minibatch.observations, minibatch.actions.long().flatten())
    th.testing.assert_close(minibatch.old_values, values.flatten(), rtol=1e-3, atol=1e-2)


def test_choices_are_named() -> None:
    with pytest.raises(ValueError, match="normalize_advantage must be"):
        make("MAPPO", (1.0, 2.0), rollout_buffer_kwargs={"normalize_advantage": "row"})
    with pytest.raises(ValueError, match="normalize_values must be"):
        make("MAPPO", (1.0, 2.0), normalize_values="row")  # type: ignore[arg-type]
