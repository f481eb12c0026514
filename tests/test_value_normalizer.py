"""Normalisation of values and advantages in SB3's PPO and A2C, for all agents and for each."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import pytest
import torch as th
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.buffers import DictRolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback

from sb3_saf import TeamRolloutBuffer, make_team_env, ppo_settings
from sb3_saf.envs.joint_observation import TimeLimit
from sb3_saf.networks.critic import MIN_STD, ValueNormalizer
from sb3_saf.policies.base import TeamActorCriticPolicy
from tests.probe_envs import Arms, DelayedReward
from tests.test_policies import NAMES, POLICIES, equal_weights, make_policy
from tests.toy_teams import VECTOR, ToyTeams, team_rows

Returns = npt.NDArray[np.float64]


def some_returns(mean: float = 40.0, std: float = 7.0, shape: tuple[int, ...] = (50, 12), seed: int = 0) -> Returns:
    return np.random.default_rng(seed).normal(mean, std, shape)


def make_model(policy: str = "SAFPolicy", normalize: bool = True, algorithm: Any = PPO, **kwargs: Any) -> Any:
    sizes: dict[str, Any] = {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 12}}
    kwargs = {"policy_kwargs": sizes | {"normalize_values": normalize}, "env": ToyTeams(), "n_steps": 10} | kwargs
    if algorithm is PPO:
        kwargs = {"batch_size": 120, "n_epochs": 2} | kwargs
    kwargs = {"rollout_buffer_class": TeamRolloutBuffer} | kwargs
    return algorithm(policy, seed=0, device="cpu", **kwargs)


def normalizer_of(policy: Any) -> ValueNormalizer:
    assert isinstance(policy.value_normalizer, ValueNormalizer)
    return policy.value_normalizer


class Returned(BaseCallback):
    """Records the returns of all rollouts."""

    def __init__(self) -> None:
        super().__init__()
        self.returns: list[Returns] = []

    def _on_rollout_end(self) -> None:
        self.returns.append(self.model.rollout_buffer.returns.copy())  # type: ignore[attr-defined]

    def _on_step(self) -> bool:
        return True


# --- statistics -------------------------------------------------------------------------------------------------------


def test_statistics_are_numpys_over_all_returns() -> None:
    normalizer = ValueNormalizer()
    sets = [some_returns(1000.0, 2.0, (3,), 0), some_returns(-5.0, 30.0, (200, 7), 1), some_returns(8.0, 0.1, (1,), 2)]
    for returns in sets:
        normalizer.update(returns)
    everything = np.concatenate([returns.ravel() for returns in sets])
    assert int(normalizer.count) == everything.size == 1404
    assert float(normalizer.mean) == pytest.approx(everything.mean(), rel=1e-6)
    assert float(normalizer.var) == pytest.approx(everything.var(), rel=1e-6)
    assert float(normalizer.std) == pytest.approx(everything.std(), rel=1e-6)


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_every_rollout_counts_once(algorithm: Any) -> None:
    model, callback = make_model(algorithm=algorithm), Returned()
    model.learn(5 * 120, callback=callback)
    assert len(callback.returns) == 5
    everything = np.array(callback.returns, dtype=np.float64)
    normalizer = normalizer_of(model.policy)
    assert int(normalizer.count) == everything.size == 600
    assert float(normalizer.mean) == pytest.approx(everything.mean(), abs=1e-6)
    assert float(normalizer.var) == pytest.approx(everything.var(), rel=1e-5)


def test_returns_that_hardly_vary_are_not_blown_up() -> None:
    normalizer = ValueNormalizer()
    normalizer.update(np.full(1000, 3.0))
    assert float(normalizer.mean) == 3.0 and float(normalizer.var) == 0.0
    assert normalizer(th.ones(1)).item() == pytest.approx(3.0 + MIN_STD)
    assert [float(value) for value in normalizer.update(np.zeros(0))] == [1.0, 0.0]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_returns_must_be_finite(bad: float) -> None:
    normalizer = ValueNormalizer()
    with pytest.raises(ValueError, match=r"returns must be finite, got NaN or infinity; check the environment's"):
        normalizer.update(np.array([1.0, bad]))
    assert int(normalizer.count) == 0


# --- the gradient is that of the normalised loss ----------------------------------------------------------------------


def gradients_of(policy: TeamActorCriticPolicy, loss: th.Tensor) -> dict[str, th.Tensor]:
    policy.zero_grad()
    loss.backward()
    return {name: p.grad.clone() for name, p in policy.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("policy_class", POLICIES)
@pytest.mark.parametrize("method", ["evaluate_actions", "predict_values"])
def test_sb3s_loss_has_the_gradient_of_the_normalised_loss(policy_class: Any, method: str) -> None:
    policy, obs = make_policy(policy_class, normalize_values=True), team_rows(VECTOR)
    policy.set_training_mode(False)  # training mode accepts only minibatches with returns
    plain = make_policy(policy_class)
    plain.load_state_dict(policy.state_dict(), strict=False)
    normalizer_of(policy).update(some_returns())
    mean, std = some_returns().mean(), some_returns().std()
    returns = th.as_tensor(some_returns(shape=(12,), seed=1), dtype=th.float32)

    def values_of(which: TeamActorCriticPolicy) -> th.Tensor:
        if method == "predict_values":
            return which.predict_values(obs).flatten()
        return which.evaluate_actions(obs, th.zeros(12).long())[0].flatten()

    values, outputs = values_of(policy), values_of(plain)
    th.testing.assert_close(values, mean + std * outputs, rtol=1e-6, atol=1e-5)
    found = gradients_of(policy, th.nn.functional.mse_loss(returns, values))
    expected = gradients_of(plain, th.nn.functional.mse_loss((returns - mean) / std, outputs))
    assert found.keys() == expected.keys() and len(found) > 4
    for name, gradient in found.items():
        scale = expected[name].abs().max().clamp_min(1.0)
        assert (gradient - expected[name]).abs().max() <= 1e-6 * scale, name


# --- advantages -------------------------------------------------------------------------------------------------------

GAMMA, LAMBDA, LENGTH, STEPS, GAMES, OUTPUT = 0.9, 0.8, 4, 11, 3, 0.5


def rollout_of_a_constant_critic(time_limit: TimeLimit, normalize: bool) -> Any:
    """One rollout of 11 steps with episodes of 4, so two whole ones and a part. The critic always outputs 0.5."""
    env = make_team_env(DelayedReward, n_envs=GAMES, seed=1, time_limit=time_limit, length=LENGTH)
    model = make_model(
        "MAPPOPolicy", normalize, env=env, n_steps=STEPS, batch_size=66, gamma=GAMMA, gae_lambda=LAMBDA, n_epochs=1,
        learning_rate=0.0, vf_coef=0.0,
    )  # fmt: skip
    with th.no_grad():
        for name, parameter in model.policy.value_net.named_parameters():
            parameter.fill_(OUTPUT if parameter.shape == (1,) else 0.0)
            assert "value_head" in name
    if normalize:
        normalizer_of(model.policy).update(some_returns(6.0, 3.0))
    return model.learn(STEPS * GAMES * 2)


def advantages_by_a_loop(own: npt.NDArray[Any], value: float, time_limit: TimeLimit) -> npt.NDArray[np.float64]:
    """Compute (T, B) advantages for a critic with constant ``value``: discounted sums of TD errors."""
    advantages = np.zeros(own.shape[:2])
    for step in range(STEPS):
        for row in range(own.shape[1]):
            weight = 1.0
            for later in range(step, STEPS):
                ends = later % LENGTH == LENGTH - 1
                reward = float(own[later, row, 0]) if ends else 0.0
                follows = 0.0 if ends and time_limit == "terminal" else value
                advantages[step, row] += weight * (reward + GAMMA * follows - value)
                if ends:
                    break
                weight *= GAMMA * LAMBDA
    return advantages


@pytest.mark.parametrize("time_limit", ["terminal", "bootstrap"])
@pytest.mark.parametrize("normalize", [False, True])
def test_advantages_of_a_constant_critic(time_limit: TimeLimit, normalize: bool) -> None:
    buffer = rollout_of_a_constant_critic(time_limit, normalize).rollout_buffer
    before = some_returns(6.0, 3.0)
    value = before.mean() + before.std() * OUTPUT if normalize else OUTPUT
    own = buffer.observations["obs"].reshape(STEPS, 2 * GAMES, -1)
    assert {-1.0, 1.0} == set(own[:, :, 0].ravel())
    expected = advantages_by_a_loop(own, value, time_limit)
    np.testing.assert_allclose(buffer.values, value, rtol=1e-6)
    np.testing.assert_allclose(buffer.advantages, expected, rtol=0, atol=1e-5)
    np.testing.assert_allclose(buffer.returns, expected + value, rtol=0, atol=1e-5)


# --- training ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_old_values_are_what_the_unchanged_critic_says(name: str) -> None:
    """Otherwise ``clip_range_vf`` would start from a difference caused by the new statistics."""
    model = make_model(name, learning_rate=0.0, n_epochs=1)
    normalizer_of(model.policy).update(some_returns(shape=(40,)))
    model.learn(120)
    model.policy.set_training_mode(False)
    for samples in model.rollout_buffer.get(30):
        values = model.policy.predict_values(samples.observations).flatten()
        th.testing.assert_close(samples.old_values, values, rtol=0, atol=1e-4)
    # Error of the stored values, far above the tolerance: the statistics changed from those of arbitrary returns to the
    # rollout's.
    assert abs(model.rollout_buffer.values.mean() - values.detach().mean().item()) > 100 * 1e-4


def test_a_buffer_that_never_updates_the_statistics_fails() -> None:
    model = make_model(rollout_buffer_class=DictRolloutBuffer)
    with pytest.raises(ValueError, match=r"rollout_buffer_class=sb3_saf\.TeamRolloutBuffer"):
        model.learn(120)


def test_statistics_are_saved_and_loaded(tmp_path: Path) -> None:
    model = make_model().learn(240)
    model.save(tmp_path / "model")
    loaded = PPO.load(tmp_path / "model", env=ToyTeams(), device="cpu")
    assert equal_weights(model.policy, loaded.policy)
    one, other = normalizer_of(model.policy), normalizer_of(loaded.policy)
    assert (one.mean, one.var, one.count) == (other.mean, other.var, other.count) and int(one.count) == 240
    obs = team_rows(VECTOR)
    assert th.equal(loaded.policy.predict_values(obs), model.policy.predict_values(obs))
    loaded.learn(120, reset_num_timesteps=False)
    assert int(other.count) == 360
    model.policy.save(str(tmp_path / "policy"))
    alone = type(model.policy).load(str(tmp_path / "policy"), device="cpu")
    assert th.equal(alone.predict_values(obs), model.policy.predict_values(obs))


# --- agents that are paid on different scales -------------------------------------------------------------------------


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


@pytest.mark.parametrize(("policy", "normalize_values"), [("MAPPO", False), ("IPPO", True)])
def test_all_agents_learn_whatever_they_are_paid(policy: str, normalize_values: bool) -> None:
    model = make(policy, SCALES, normalize_values).learn(12 * 32 * 4 * len(SCALES))
    assert right_arms(model).min() > 0.9


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

    env = make_team_env(Arms, 2, seed=0)
    assert "rollout_buffer_kwargs" not in ppo_settings(env, normalize_advantage=False)
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


def test_choices_are_named() -> None:
    with pytest.raises(ValueError, match="normalize_advantage must be"):
        make("MAPPO", (1.0, 2.0), rollout_buffer_kwargs={"normalize_advantage": "row"})
    with pytest.raises(ValueError, match="normalize_values must be"):
        make("MAPPO", (1.0, 2.0), normalize_values="row")  # type: ignore[arg-type]
