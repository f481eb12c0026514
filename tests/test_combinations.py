"""Agents that die or join, action masks, memory, masks from two sources and value normalisation, combined."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3 import PPO

from sb3_saf import SAFMaskablePolicy, TeamRolloutBuffer, evaluate_team, make_team_env
from sb3_saf.envs.joint_observation import CentralizedValueWrapper
from sb3_saf.networks.critic import ValueNormalizer
from tests.toy_envs import TellingEnv

N_AGENTS, N_ACTIONS = 3, 4
#: Agent 0 is active for steps 1 to 3, agent 1 from the observation after step 2; agent i may take every second action.
LIVES: dict[str, Any] = {"n_agents": N_AGENTS, "max_cycles": 5, "deaths": {0: 3}, "joins": {1: 2}}


class TwiceMaskedEnv(TellingEnv):
    """Observations have masks that allow every second action; a method returns masks that forbid the lower of those."""

    def action_masks(self) -> dict[str, Any]:
        return {agent: np.arange(N_ACTIONS) >= 2 for agent in self.agents}


class ShownMasksEnv(TellingEnv):
    """Masks in observations or infos, without a method that returns them."""

    @property
    def action_masks(self) -> Any:
        raise AttributeError("this game has no action_masks()")


def lively_env(env: Any = TellingEnv, **kwargs: Any) -> CentralizedValueWrapper:
    return make_team_env(env, 2, seed=0, **{**LIVES, **kwargs})


def make_model(algorithm: Any, policy: str, env: Any, **policy_kwargs: Any) -> Any:
    """Create a small model; rollouts have 10 steps of 6 rows."""
    networks = {"net_arch": [8], "features_extractor_kwargs": {"features_dim": 8}, **policy_kwargs}
    settings: dict[str, Any] = {"n_steps": 10, "batch_size": 30, "n_epochs": 1, "seed": 0, "device": "cpu"}
    if algorithm is PPO:
        settings["rollout_buffer_class"] = TeamRolloutBuffer
    return algorithm(policy, env, policy_kwargs=networks, **settings)


def active_rows(obs: Any) -> Any:
    return obs["active"][np.arange(len(obs["agent"])), obs["agent"]] == 1


def test_an_action_must_be_allowed_by_both_masks() -> None:
    env = lively_env(TwiceMaskedEnv, masks="observation", deaths={}, joins={})
    model = make_model(MaskablePPO, "SAFMaskablePolicy", env).learn(60)
    buffer = model.rollout_buffer
    taken = buffer.actions.reshape(-1).astype(int)
    assert (taken >= 2).all(), "the environment's action_masks() forbid 0 and 1"
    shown = buffer.observations["action_mask"].reshape(-1, N_ACTIONS)
    assert shown[np.arange(len(taken)), taken].all()
    assert len(np.unique(taken)) == 2

    policy = model.policy
    assert isinstance(policy, SAFMaskablePolicy)
    rows, _ = policy.obs_to_tensor(env.reset())
    assert isinstance(rows, dict)
    asked = th.tensor([[False, False, True, True]]).expand(6, -1)
    distribution = policy.get_distribution(rows, asked)
    likelihoods = th.stack([distribution.log_prob(th.full((6,), a)).exp() for a in range(N_ACTIONS)], dim=1)
    both = asked & (rows["action_mask"] != 0)
    assert both.sum(dim=1).eq(1).all()
    th.testing.assert_close(likelihoods, both.float())


def test_values_are_normalised_by_the_returns_of_those_who_take_part() -> None:
    """The mean would differ if idle rows, whose returns are 0, were counted."""
    model = make_model(PPO, "MAPPOPolicy", lively_env(), normalize_values=True).learn(60)
    buffer: Any = model.rollout_buffer
    is_active = buffer.active.reshape(10, 6) == 1
    returns = buffer.returns[is_active].astype(np.float64)
    normalizer = model.policy.value_normalizer
    assert isinstance(normalizer, ValueNormalizer)
    assert int(normalizer.count) == is_active.sum() == 2 * 2 * (3 + 3 + 5)
    assert float(normalizer.mean) == pytest.approx(returns.mean(), rel=1e-5)
    assert float(normalizer.var) == pytest.approx(returns.var(), rel=1e-4)
    assert abs(buffer.returns.mean() - returns.mean()) > 1.0
    obs: Any = lively_env().reset()
    values = model.policy.predict_values(model.policy.obs_to_tensor(obs)[0]).detach().flatten()
    assert (values[~active_rows(obs)] == 0).all(), "zero on the raw scale, not the mean of returns"


@pytest.mark.parametrize(
    "policy_kwargs", [{"critic_input": "state"}, {"heads": "per_agent"}, {"agent_identity": False}]
)
def test_normalised_values_with_every_critic_and_agents_that_die(policy_kwargs: dict[str, Any]) -> None:
    env = lively_env(state=True, time_limit="bootstrap")
    model = make_model(PPO, "MAPPOPolicy", env, normalize_values=True, **policy_kwargs).learn(120)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
    assert isinstance(model.action_space, spaces.Discrete)


@pytest.mark.parametrize("masks", ["observation", "info"])
def test_maskable_ppo_finds_the_masks_that_observations_show(masks: str) -> None:
    """The game has no method action_masks(), and fails the test at the first illegal action."""
    env = lively_env(ShownMasksEnv, masks=masks, deaths={}, joins={})
    assert is_masking_supported(env)
    obs: Any = env.reset()
    np.testing.assert_array_equal(get_action_masks(env), obs["action_mask"] == 1)
    model = make_model(MaskablePPO, "MAPPOMaskablePolicy", env).learn(60)
    assert evaluate_team(model, lively_env(ShownMasksEnv, masks=masks, deaths={}, joins={}), 2).lengths == [5, 5]
    assert not is_masking_supported(lively_env(ShownMasksEnv, masks=None))
