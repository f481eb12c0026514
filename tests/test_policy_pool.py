"""The policy pool's likelihood, entropy and choices, compared with enumeration and counting."""

from __future__ import annotations

from itertools import product
from math import exp, log, pi
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import make_proba_distribution
from torch import nn

from sb3_saf.networks import distributions as mixtures
from sb3_saf.networks.actor import ActionHead, ActorNetwork, PolicyPool, Selection, SinglePolicy
from sb3_saf.networks.distributions import (
    PoolDistribution,
    SelectedDistribution,
    distribution_of,
    draw_policy,
    mixture_of,
    n_action_parameters,
)
from sb3_saf.networks.layers import NetworkSpec

N_ROWS, N_POLICIES = 4, 3
DISCRETE = spaces.Discrete(5)
MULTI_DISCRETE = spaces.MultiDiscrete([2, 3, 2])
MULTI_BINARY = spaces.MultiBinary(3)
BOX = spaces.Box(-1.0, 1.0, (2,), np.float32)
LARGE = spaces.MultiDiscrete([20, 20, 20])
SPACES = [DISCRETE, MULTI_DISCRETE, MULTI_BINARY, BOX, LARGE]
ENUMERABLE = [DISCRETE, MULTI_DISCRETE, MULTI_BINARY]


def random_mixture(space: spaces.Space[Any]) -> tuple[th.Tensor, th.Tensor]:
    """Return log weights (B, U) and parameters (B, U, P), far from uniform."""
    log_weights = (2.0 * th.randn(N_ROWS, N_POLICIES)).log_softmax(dim=1)
    return log_weights, 2.0 * th.randn(N_ROWS, N_POLICIES, n_action_parameters(space))


def joint_actions(space: spaces.Space[Any]) -> list[tuple[int, ...]]:
    sizes = {"Discrete": [5], "MultiDiscrete": [2, 3, 2], "MultiBinary": [2, 2, 2]}[type(space).__name__]
    return list(product(*map(range, sizes)))


def probability(space: spaces.Space[Any], parameters: list[float], action: tuple[float, ...]) -> float:
    """Compute one policy's probability (or density) of one action by its definition."""
    if isinstance(space, spaces.Box):
        means, log_stds = parameters[:2], parameters[2:]
        densities = [
            exp(-(((a - m) / exp(s)) ** 2) / 2) / (exp(s) * (2 * pi) ** 0.5)
            for a, m, s in zip(action, means, log_stds, strict=True)
        ]
        return densities[0] * densities[1]
    if isinstance(space, spaces.MultiBinary):
        ones = [1 / (1 + exp(-x)) for x in parameters]
        return float(np.prod([one if a else 1 - one for one, a in zip(ones, action, strict=True)]))
    sizes = [5] if isinstance(space, spaces.Discrete) else [2, 3, 2]
    result, start = 1.0, 0
    for size, chosen in zip(sizes, action, strict=True):
        scores = [exp(x) for x in parameters[start : start + size]]
        result *= scores[int(chosen)] / sum(scores)
        start += size
    return result


def mixture_probability(
    space: spaces.Space[Any], log_weights: th.Tensor, parameters: th.Tensor, row: int, action: tuple[float, ...]
) -> float:
    return sum(
        exp(log_weights[row, policy]) * probability(space, parameters[row, policy].tolist(), action)
        for policy in range(N_POLICIES)
    )


def as_actions(space: spaces.Space[Any], action: tuple[float, ...]) -> th.Tensor:
    """Return the same action in every row, as SB3 passes actions."""
    if isinstance(space, spaces.Discrete):
        return th.full((N_ROWS,), int(action[0]))
    dtype = th.int64 if isinstance(space, spaces.MultiDiscrete) else th.float32
    return th.tensor([action] * N_ROWS, dtype=dtype)


# --- the exact mixture ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("space", ENUMERABLE)
def test_mixture_agrees_with_enumeration(space: spaces.Space[Any]) -> None:
    log_weights, parameters = random_mixture(space)
    mixture = mixture_of(space, log_weights, parameters)
    actions = joint_actions(space)
    expected = np.array(
        [[mixture_probability(space, log_weights, parameters, row, a) for a in actions] for row in range(N_ROWS)]
    )
    np.testing.assert_allclose(expected.sum(axis=1), 1.0, rtol=1e-6)
    found = np.stack([mixture.log_prob(as_actions(space, a)).numpy() for a in actions], axis=1)
    np.testing.assert_allclose(found, np.log(expected), rtol=1e-4, atol=1e-5)
    entropy = mixture.entropy()
    assert entropy is not None
    np.testing.assert_allclose(entropy.numpy(), -(expected * np.log(expected)).sum(axis=1), rtol=1e-5)
    best = np.array(actions)[expected.argmax(axis=1)]
    np.testing.assert_array_equal(mixture.mode().numpy().reshape(N_ROWS, -1), best)


def test_mixture_of_gaussians_agrees_with_schoolbook_densities() -> None:
    log_weights, parameters = random_mixture(BOX)
    mixture = mixture_of(BOX, log_weights, parameters)
    for action in ((0.3, -0.8), (2.0, 1.0), (0.0, 0.0)):
        expected = [log(mixture_probability(BOX, log_weights, parameters, row, action)) for row in range(N_ROWS)]
        np.testing.assert_allclose(mixture.log_prob(as_actions(BOX, action)).numpy(), expected, rtol=1e-4)
    assert mixture.entropy() is None
    likeliest = log_weights.argmax(dim=1)
    assert th.equal(mixture.mode(), parameters[th.arange(N_ROWS), likeliest, :2])


def test_the_mixtures_mode_need_not_be_any_policys_favourite() -> None:
    # Two policies that prefer actions 0 and 1, and both have action 2 as second choice.
    logits = th.tensor([[[0.5, 0.1, 0.4], [0.1, 0.5, 0.4]]]).log()
    log_weights = th.tensor([[0.5, 0.5]]).log()
    assert mixture_of(spaces.Discrete(3), log_weights, logits).mode().tolist() == [2]
    assert mixture_of(spaces.MultiDiscrete([3]), log_weights, logits).mode().tolist() == [[2]]


def test_many_joint_actions_are_not_enumerated() -> None:
    log_weights, parameters = random_mixture(LARGE)
    mixture = mixture_of(LARGE, log_weights, parameters)
    assert mixture.entropy() is None
    likeliest = parameters[th.arange(N_ROWS), log_weights.argmax(dim=1)]
    assert th.equal(mixture.mode(), distribution_of(LARGE, likeliest).mode())


def test_enumeration_in_parts_gives_the_same_numbers_and_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    log_weights, parameters = (part.requires_grad_() for part in random_mixture(MULTI_DISCRETE))
    mixture = PoolDistribution(MULTI_DISCRETE).proba_distribution(log_weights, parameters)

    def entropy_gradients_and_mode() -> list[th.Tensor]:
        entropy = mixture.entropy()
        assert entropy is not None
        return [entropy, *th.autograd.grad(entropy.sum(), (log_weights, parameters)), mixture.mode()]

    at_once = entropy_gradients_and_mode()
    monkeypatch.setattr(mixtures, "_ENUMERATED_AT_ONCE", 2 * N_POLICIES * 12)
    for found, expected in zip(entropy_gradients_and_mode(), at_once, strict=True):
        th.testing.assert_close(found, expected)


@pytest.mark.parametrize("space", SPACES)
def test_samples_follow_the_mixture(space: spaces.Space[Any]) -> None:
    log_weights, parameters = random_mixture(space)
    count = 20_000
    mixture = mixture_of(space, log_weights[:1].expand(count, -1), parameters[:1].expand(count, -1, -1))
    sampled = mixture.sample().reshape(count, -1).double()
    if isinstance(space, spaces.Box):
        weights = log_weights[0].exp().double()
        means, stds = parameters[0, :, :2].double(), parameters[0, :, 2:].double().exp()
        mean = (weights[:, None] * means).sum(dim=0)
        variance = (weights[:, None] * (stds**2 + means**2)).sum(dim=0) - mean**2
        assert ((sampled.mean(dim=0) - mean).abs() < 5 * (variance / count).sqrt()).all()
        return
    drawn, counts = sampled.long().unique(dim=0, return_counts=True)
    for action, number in zip(drawn.tolist(), counts.tolist(), strict=True):
        if space is not LARGE:
            expected = mixture_probability(space, log_weights, parameters, 0, tuple(action))
            assert abs(number / count - expected) < 5 * (expected * (1 - expected) / count) ** 0.5 + 1e-3
    assert space.contains(np.asarray(sampled[0].numpy().reshape(space.shape), dtype=space.dtype))


def test_parameters_as_sb3_calls_them() -> None:
    log_weights, parameters = random_mixture(MULTI_DISCRETE)
    mixture = PoolDistribution(MULTI_DISCRETE)
    assert th.equal(mixture.actions_from_params(log_weights, parameters, deterministic=True), mixture.mode())
    actions, log_prob = mixture.log_prob_from_params(log_weights, parameters)
    assert th.equal(log_prob, mixture.log_prob(actions))
    with pytest.raises(NotImplementedError, match="PolicyPool"):
        mixture.proba_distribution_net()


def test_unknown_action_spaces_are_refused() -> None:
    with pytest.raises(ValueError, match=r"expected a Discrete, MultiDiscrete .* or Box space, got"):
        n_action_parameters(spaces.Text(3))
    with pytest.raises(ValueError, match="of one axis"):
        n_action_parameters(spaces.MultiDiscrete(np.full((2, 2), 2)))


# --- drawing one policy -----------------------------------------------------------------------------------------------


def test_drawn_policies_follow_their_weights() -> None:
    # If the noise is added to probabilities instead of logits, the most likely policy is drawn less than half of the
    # time.
    weights, count = th.tensor([0.8, 0.15, 0.05]), 50_000
    actions = th.eye(3).expand(count, -1, -1)
    shares = draw_policy(weights.log().expand(count, -1), actions).mean(dim=0)
    assert ((shares - weights).abs() < 5 * (weights * (1 - weights) / count).sqrt()).all()


def test_gradients_pass_straight_through_the_choice() -> None:
    log_weights, parameters = random_mixture(DISCRETE)
    log_weights, parameters = log_weights.requires_grad_(), parameters.requires_grad_()
    generator_state = th.get_rng_state()
    drawn = draw_policy(log_weights, parameters)
    to_weights, to_parameters = th.autograd.grad(drawn[:, 2].sum(), (log_weights, parameters))

    th.set_rng_state(generator_state)
    noise = -(-th.rand(N_ROWS, N_POLICIES).log()).log()
    soft = (log_weights + noise).softmax(dim=1)
    chosen = soft.argmax(dim=1)
    expected = th.autograd.grad((soft * parameters.detach()[:, :, 2]).sum(), log_weights)[0]
    th.testing.assert_close(to_weights, expected)
    only_chosen = th.zeros_like(to_parameters)
    only_chosen[th.arange(N_ROWS), chosen, 2] = 1.0
    assert th.equal(to_parameters, only_chosen)


def spec_of(space: spaces.Space[Any], log_std_init: float = 0.0) -> NetworkSpec:
    return NetworkSpec(6, 3, space, [8], [], nn.Tanh, log_std_init)


def make_pool(space: spaces.Space[Any], selection: Selection) -> PolicyPool:
    pool = PolicyPool(spec_of(space), n_policies=4, selection=selection, latent_dim=5, projection_hidden=[7])
    with th.no_grad():
        for parameter in pool.parameters():
            nn.init.normal_(parameter)
    return pool


def test_selection_by_signature_keys() -> None:
    pool, features = make_pool(DISCRETE, "mixture"), th.randn(N_ROWS, 6)
    output = pool.evaluate(features)
    query = pool.query_net(features)
    logits = th.stack([(query * key).sum(dim=1) / 5**0.5 for key in pool.signature_keys], dim=1)
    th.testing.assert_close(output.log_weights, logits.log_softmax(dim=1))
    for number, policy in enumerate(pool.policies):
        th.testing.assert_close(output.actions[:, number], policy(features))


@pytest.mark.parametrize("space", SPACES)
def test_pool_of_mixture_is_the_mixture_of_what_it_evaluates(space: spaces.Space[Any]) -> None:
    pool, features = make_pool(space, "mixture"), th.randn(N_ROWS, 6)
    found, expected = pool.distribution(pool(features)), mixture_of(space, *pool.evaluate(features))
    actions = expected.sample()
    th.testing.assert_close(found.log_prob(actions), expected.log_prob(actions))
    assert th.equal(found.mode(), expected.mode())


@pytest.mark.parametrize("space", SPACES)
def test_gumbel_is_one_policy_at_a_time_and_its_mode_the_favourites(space: spaces.Space[Any]) -> None:
    pool, features = make_pool(space, "gumbel"), th.randn(N_ROWS, 6)
    output, parameters = pool.evaluate(features), pool(features)
    policies = [distribution_of(space, output.actions[:, number]) for number in range(4)]
    favourite = output.log_weights.argmax(dim=1)
    modes = th.stack([policy.mode() for policy in policies])[favourite, th.arange(N_ROWS)]
    action, seen = policies[0].sample(), set()
    by_policy = th.stack([policy.log_prob(action) for policy in policies], dim=1)
    for _ in range(30):
        distribution = pool.distribution(parameters)
        assert isinstance(distribution, SelectedDistribution)
        assert th.equal(distribution.mode(), modes)
        matches = (distribution.log_prob(action).unsqueeze(1) - by_policy).abs() < 1e-6
        assert matches.any(dim=1).all()
        seen.add(tuple(matches.int().argmax(dim=1).tolist()))
        th.testing.assert_close(distribution.entropy(), distribution.drawn.entropy())
        assert distribution.sample().shape == action.shape
    assert len(seen) > 1


@pytest.mark.parametrize("space", SPACES)
def test_one_policy_is_sb3s_own_distribution(space: spaces.Space[Any]) -> None:
    actor, features = SinglePolicy(spec_of(space, -0.5)), th.randn(N_ROWS, 6)
    with th.no_grad():
        for parameter in actor.parameters():
            nn.init.normal_(parameter)
    found, plain = actor.distribution(actor(features)), make_proba_distribution(space)
    assert isinstance(found, type(plain))
    assert isinstance(actor.head, ActionHead)
    outputs = actor.head.net(features)
    arguments = [outputs, actor.head.log_std] if isinstance(space, spaces.Box) else [outputs]
    plain.proba_distribution(*arguments)
    actions = plain.sample()
    th.testing.assert_close(found.log_prob(actions), plain.log_prob(actions))
    th.testing.assert_close(found.entropy(), plain.entropy())
    assert th.equal(found.mode(), plain.mode())


# --- choice of the policy ---------------------------------------------------------------------------------------------


def identified(kind: str, action_space: spaces.Space[Any]) -> ActorNetwork:
    if kind == "single":
        return SinglePolicy(spec_of(action_space), identity=True)
    return PolicyPool(spec_of(action_space), 4, "mixture", 8, [8], identity=True)


@pytest.mark.parametrize("kind", ["single", "pool"])
def test_the_agents_identity_stands_beside_the_features(kind: str) -> None:
    th.manual_seed(0)
    actor = identified(kind, spaces.Discrete(5))
    wide = identified(kind, spaces.Discrete(5))
    wide.load_state_dict(actor.state_dict())
    wide.n_identities = 0
    features, agent = th.randn(4, 6), th.tensor([0, 2, 2, 1])
    assert actor.reads_agent
    assert th.equal(actor(features, agent), wide(th.cat([features, th.eye(3)[agent]], dim=1)))
    assert not th.allclose(actor(features, agent), actor(features, 2 - agent))
    with pytest.raises(ValueError, match="reads who acts"):
        actor(features)
