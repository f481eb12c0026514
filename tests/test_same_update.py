"""A real PPO update is the same with both buffers, and with or without encoding equal views once."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import DictRolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_saf import IPPOPolicy, MAPPOPolicy, SAFPolicy, TeamRolloutBuffer
from sb3_saf.policies.base import TeamActorCriticPolicy
from tests.test_policies import ACTIONS
from tests.toy_teams import VECTOR, CodeSpace, ToyTeams

#: SB3's buffer (the default) and ours, each also with every row encoded.
WAYS: list[tuple[type[DictRolloutBuffer] | None, bool]] = [
    (None, True),
    (TeamRolloutBuffer, True),
    (None, False),
    (TeamRolloutBuffer, False),
]


def updated(
    policy_class: type[TeamActorCriticPolicy],
    kwargs: dict[str, Any],
    own: spaces.Space[Any],
    action_space: spaces.Space[Any],
    buffer_class: type[DictRolloutBuffer] | None,
    encode_once: bool,
) -> PPO:
    """Create a model with one rollout of 120 rows and one gradient step on all of it."""
    sizes: dict[str, Any] = {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 12}, "chunk_size": 7}
    if not encode_once:
        sizes |= {"encode_once": False, "chunk_size": None}
    model = PPO(
        policy_class,
        ToyTeams(own, action_space),
        n_steps=10,
        batch_size=120,
        n_epochs=1,
        ent_coef=0.01,
        clip_range_vf=0.2,
        max_grad_norm=1e6,  # no clipping
        rollout_buffer_class=buffer_class,
        policy_kwargs=sizes | kwargs,
        seed=0,
        device="cpu",
    )
    return model.learn(120, log_interval=None)  # type: ignore[arg-type]  # None keeps what was logged


def gradients(model: PPO) -> dict[str, th.Tensor]:
    return {name: p.grad for name, p in model.policy.named_parameters() if p.grad is not None}


# test_policies compares both encodings for all options of a policy.
@pytest.mark.parametrize(
    ("policy_class", "kwargs", "own", "action_space"),
    [
        (IPPOPolicy, {"actor_identity": True}, VECTOR, ACTIONS["discrete"]),
        (MAPPOPolicy, {}, CodeSpace(), ACTIONS["box"]),
        (SAFPolicy, {}, VECTOR, ACTIONS["discrete"]),
        (SAFPolicy, {"critic_input": "team", "heads": "per_agent"}, CodeSpace(), ACTIONS["box"]),
    ],
)
def test_buffers_and_encodings_give_the_same_loss_and_gradients(
    policy_class: type[TeamActorCriticPolicy],
    kwargs: dict[str, Any],
    own: spaces.Space[Any],
    action_space: spaces.Space[Any],
) -> None:
    reference, *others = (updated(policy_class, kwargs, own, action_space, *way) for way in WAYS)
    assert type(reference.rollout_buffer) is DictRolloutBuffer
    assert isinstance(reference.policy, ActorCriticPolicy)
    expected = gradients(reference)
    assert expected.keys() == dict(reference.policy.named_parameters()).keys()
    for model in others:
        # The same rollout: rewards depend on views and actions. (SB3's buffer reorders the other arrays.)
        rewards, same = model.rollout_buffer.rewards, reference.rollout_buffer.rewards
        np.testing.assert_allclose(rewards, same, rtol=1e-5, atol=5e-6)  # bootstrapped values in float32
        for tag in ("train/loss", "train/value_loss", "train/policy_gradient_loss", "train/entropy_loss"):
            logged, right = (m.logger.name_to_value[tag] for m in (model, reference))
            assert logged == pytest.approx(right, rel=1e-5, abs=1e-6), tag
        for name, gradient in gradients(model).items():
            scale = expected[name].abs().max().clamp_min(1.0)
            assert (gradient - expected[name]).abs().max() <= 1e-5 * scale, name
