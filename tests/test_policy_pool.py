"""The knowledge source and the policy pool, compared with independent accounts, enumeration and counting."""

from __future__ import annotations

from itertools import product
from math import exp, log, pi
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.spaces import Discrete
from stable_baselines3.common.distributions import make_proba_distribution
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

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
from sb3_saf.networks.knowledge_source import Attention, KnowledgeSource
from sb3_saf.networks.layers import NetworkSpec
from sb3_saf.policies.parts import CriticInput
from sb3_saf.policies.saf import SAFCritic, SAFParts

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
    log_weights, actions = pool.evaluate(features)
    query = pool.query_net(features)
    logits = th.stack([(query * key).sum(dim=1) / 5**0.5 for key in pool.signature_keys], dim=1)
    th.testing.assert_close(log_weights, logits.log_softmax(dim=1))
    for number, policy in enumerate(pool.policies):
        th.testing.assert_close(actions[:, number], policy(features))


@pytest.mark.parametrize("space", SPACES)
def test_gumbel_is_one_policy_at_a_time_and_its_mode_the_favourites(space: spaces.Space[Any]) -> None:
    pool, features = make_pool(space, "gumbel"), th.randn(N_ROWS, 6)
    (log_weights, actions), parameters = pool.evaluate(features), pool(features)
    policies = [distribution_of(space, actions[:, number]) for number in range(4)]
    favourite = log_weights.argmax(dim=1)
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


# --- the knowledge source ---------------------------------------------------------------------------------------------


Array = npt.NDArray[np.float64]
N_TEAMS, N_AGENTS, SIZE = 3, 5, 8


@pytest.fixture
def source() -> KnowledgeSource:
    return KnowledgeSource(N_AGENTS, features_dim=SIZE, n_slots=4)


def random_team(n_agents: int = N_AGENTS) -> th.Tensor:
    return th.randn(N_TEAMS, n_agents, SIZE)


# --- an independent implementation in NumPy, for one team -------------------------------------------------------------


def normed(x: Array, norm: nn.LayerNorm) -> Array:
    mean, variance = x.mean(axis=-1, keepdims=True), x.var(axis=-1, keepdims=True)
    weight, bias = norm.weight.detach().numpy(), norm.bias.detach().numpy()
    return (x - mean) / np.sqrt(variance + norm.eps) * weight + bias


def linear(x: Array, layer: nn.Module) -> Array:
    assert isinstance(layer, nn.Linear)
    result = x @ layer.weight.detach().numpy().T
    return result if layer.bias is None else result + layer.bias.detach().numpy()


def perceptron(x: Array, net: nn.Sequential) -> Array:
    hidden = th.tensor(linear(x, net[0]))
    return linear(nn.functional.gelu(hidden).numpy(), net[2])


def attended(queries: Array, sources: Array, attention: Attention) -> tuple[Array, Array]:
    answers, weights = [], []
    keys, values = linear(sources, attention.key), linear(sources, attention.value)
    for query in linear(queries, attention.query):
        scores = np.array([query @ key / np.sqrt(len(query)) for key in keys])
        shares = np.exp(scores) / np.exp(scores).sum()
        answers.append(sum(share * value for share, value in zip(shares, values, strict=True)))
        weights.append(shares)
    return linear(np.array(answers), attention.out), np.array(weights)


def reference(source: KnowledgeSource, messages: Array, states: Array) -> tuple[Array, Array, Array]:
    """Compute slots (L, d), write attention (L, N) and what agents read (N, d)."""
    slots = source.slots.detach().numpy()
    marked = messages + source.agent_embeddings.detach().numpy()
    write = source.write_block
    update, attention = attended(normed(slots, write.query_norm), normed(marked, write.source_norm), write.attention)
    slots = slots + update
    slots = slots + perceptron(normed(slots, write.mlp_norm), write.mlp)
    for block in source.slot_blocks:
        seen = normed(slots, block.norm)  # type: ignore[arg-type]
        slots = slots + attended(seen, seen, block.attention)[0]  # type: ignore[arg-type]
        slots = slots + perceptron(normed(slots, block.mlp_norm), block.mlp)  # type: ignore[arg-type]
    queries, sources = normed(states, source.read_query_norm), normed(slots, source.read_source_norm)
    return slots, attention, attended(queries, sources, source.read_attention)[0]


def test_agrees_with_an_independent_account(source: KnowledgeSource) -> None:
    for parameter in source.parameters():  # so that norms and biases matter too
        nn.init.normal_(parameter, std=0.5)
    source = source.double()
    messages, states = random_team().double(), random_team().double()
    (written, weights), read = source.write(messages), source(messages, states).read
    for team in range(N_TEAMS):
        slots, attention, answers = reference(source, messages[team].numpy(), states[team].numpy())
        np.testing.assert_allclose(written[team].detach().numpy(), slots, rtol=1e-9)
        np.testing.assert_allclose(weights[team].detach().numpy(), attention, rtol=1e-9)
        np.testing.assert_allclose(read[team].detach().numpy(), answers, rtol=1e-9)


# --- properties -------------------------------------------------------------------------------------------------------


def test_inactive_agents_are_not_heard(source: KnowledgeSource) -> None:
    messages, active = random_team(), th.ones(N_TEAMS, N_AGENTS, dtype=th.bool)
    active[0, 2] = active[1, :4] = False
    written, weights = source.write(messages, active)
    assert (weights.transpose(1, 2)[~active] == 0).all()
    th.testing.assert_close(weights.sum(dim=2), th.ones(N_TEAMS, 4))
    changed = messages.clone()
    changed[~active] = 1e3
    assert th.equal(source.write(changed, active)[0], written)
    # A team of only the active agents writes the same.
    alone = KnowledgeSource(4, SIZE)
    alone.load_state_dict(source.state_dict() | {"agent_embeddings": source.agent_embeddings[[0, 1, 3, 4]]})
    th.testing.assert_close(alone.write(messages[:1, [0, 1, 3, 4]])[0], written[:1], rtol=0, atol=1e-6)


def test_a_team_without_active_agents_gives_numbers(source: KnowledgeSource) -> None:
    active = th.zeros(N_TEAMS, N_AGENTS, dtype=th.bool)
    messages = random_team().requires_grad_()
    read = source(messages, random_team(), active).read
    read.sum().backward()
    assert read.isfinite().all()
    assert messages.grad is not None and (messages.grad == 0).all()


def test_cost_is_linear_in_the_number_of_agents() -> None:
    """Multiply-adds, exactly."""

    def cost(n_agents: int) -> int:
        module = KnowledgeSource(n_agents, SIZE)
        with FlopCounterMode(display=False) as counter:
            module(random_team(n_agents), random_team(n_agents)).read.sum().backward()
        return int(counter.get_total_flops())

    fixed, per_agent = 2 * cost(5) - cost(10), (cost(10) - cost(5)) // 5
    for n_agents in (1, 20, 320):
        assert cost(n_agents) == fixed + per_agent * n_agents


# --- the critic around it ---------------------------------------------------------------------------------------------


def make_critic(critic_input: CriticInput, heads: str = "shared") -> SAFCritic:
    spec = NetworkSpec(SIZE, N_AGENTS, Discrete(2), [16], [16], nn.Tanh, 0.0)
    parts = SAFParts(heads=heads, critic_input=critic_input, latent_dim=6, projection_arch=(12,))  # type: ignore[arg-type]
    return SAFCritic(spec, parts)


def test_critic_is_the_papers_chain() -> None:
    critic = make_critic("own")
    views, teams = th.randn(4, SIZE), th.tensor([[0, 1, 2, 3, 0], [2, 2, 2, 1, 3]])
    z = views[teams]
    s = critic.state_net(z)
    m = critic.knowledge_source(critic.message_net(z), s).read
    s_saf = critic.combine_net(th.cat([s, m], dim=2))
    assert isinstance(critic.value_head, nn.Module)
    expected = critic.value_head(s_saf.flatten(0, 1)).view(2, N_AGENTS)
    th.testing.assert_close(critic.values(critic.states(views, teams)), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("heads", ["shared", "per_agent"])
def test_critic_on_the_team_reads_everyones_state(heads: str) -> None:
    critic = make_critic("team", heads)
    teams = th.arange(N_TEAMS * N_AGENTS).view(N_TEAMS, N_AGENTS)
    states = critic.states(th.randn(N_TEAMS * N_AGENTS, SIZE), teams).detach().requires_grad_()
    for agent in range(N_AGENTS):
        gradient = th.autograd.grad(critic.values(states)[:, agent].sum(), states)[0]
        assert (gradient.abs().sum(dim=2) > 0).all()
