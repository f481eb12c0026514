"""The knowledge source: its computation, its size, and that the order of agents does not matter."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import torch as th
from gymnasium.spaces import Discrete
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from sb3_saf.networks.knowledge_source import Attention, KnowledgeSource
from sb3_saf.networks.layers import NetworkSpec
from sb3_saf.policies.parts import CriticInput
from sb3_saf.policies.saf import SAFCritic, SAFParts

Array = npt.NDArray[np.float64]
N_TEAMS, N_AGENTS, SIZE = 3, 5, 8


@pytest.fixture
def source() -> KnowledgeSource:
    return KnowledgeSource(N_AGENTS, features_dim=SIZE, n_slots=4)


def random_team(n_agents: int = N_AGENTS) -> th.Tensor:
    return th.randn(N_TEAMS, n_agents, SIZE)


def n_weights(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_sizes_of_the_paper() -> None:
    source = KnowledgeSource(n_agents=10)
    read = n_weights(source.read_query_norm) + n_weights(source.read_source_norm) + n_weights(source.read_attention)
    assert read == 16_704
    assert n_weights(source) - read == 76_096


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
    written, read = source.write(messages), source(messages, states).read
    for team in range(N_TEAMS):
        slots, attention, answers = reference(source, messages[team].numpy(), states[team].numpy())
        np.testing.assert_allclose(written.values[team].detach().numpy(), slots, rtol=1e-9)
        np.testing.assert_allclose(written.weights[team].detach().numpy(), attention, rtol=1e-9)
        np.testing.assert_allclose(read[team].detach().numpy(), answers, rtol=1e-9)


# --- properties -------------------------------------------------------------------------------------------------------


def test_agents_permuted_with_their_embeddings_write_the_same(source: KnowledgeSource) -> None:
    messages, states, order = random_team(), random_team(), th.randperm(N_AGENTS)
    before, read = source.write(messages), source(messages, states).read
    with th.no_grad():
        source.agent_embeddings.copy_(source.agent_embeddings[order])
    after = source.write(messages[:, order])
    th.testing.assert_close(after.values, before.values, rtol=0, atol=1e-6)
    th.testing.assert_close(after.weights, before.weights[:, :, order], rtol=0, atol=1e-6)
    th.testing.assert_close(source(messages[:, order], states[:, order]).read, read[:, order], rtol=0, atol=1e-6)


def test_inactive_agents_are_not_heard(source: KnowledgeSource) -> None:
    messages, active = random_team(), th.ones(N_TEAMS, N_AGENTS, dtype=th.bool)
    active[0, 2] = active[1, :4] = False
    written = source.write(messages, active)
    assert (written.weights.transpose(1, 2)[~active] == 0).all()
    th.testing.assert_close(written.weights.sum(dim=2), th.ones(N_TEAMS, 4))
    changed = messages.clone()
    changed[~active] = 1e3
    assert th.equal(source.write(changed, active).values, written.values)
    # A team of only the active agents writes the same.
    alone = KnowledgeSource(4, SIZE)
    alone.load_state_dict(source.state_dict() | {"agent_embeddings": source.agent_embeddings[[0, 1, 3, 4]]})
    th.testing.assert_close(alone.write(messages[:1, [0, 1, 3, 4]]).values, written.values[:1], rtol=0, atol=1e-6)


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
    th.testing.assert_close(critic(views, teams), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("heads", ["shared", "per_agent"])
def test_critic_on_the_team_reads_everyones_state(heads: str) -> None:
    critic = make_critic("team", heads)
    teams = th.arange(N_TEAMS * N_AGENTS).view(N_TEAMS, N_AGENTS)
    states = critic.states(th.randn(N_TEAMS * N_AGENTS, SIZE), teams).detach().requires_grad_()
    for agent in range(N_AGENTS):
        gradient = th.autograd.grad(critic.values(states)[:, agent].sum(), states)[0]
        assert (gradient.abs().sum(dim=2) > 0).all()


@pytest.mark.parametrize("critic_input", ["own", "team"])
def test_values_of_active_agents_do_not_depend_on_inactive_ones(critic_input: CriticInput) -> None:
    critic, views = make_critic(critic_input), th.randn(N_AGENTS, SIZE)
    teams = th.arange(N_AGENTS).view(1, N_AGENTS)
    active = th.tensor([[True, True, False, True, True]])
    before = critic(views, teams, active)
    views[2] += 10.0
    assert th.equal(critic(views, teams, active)[active], before[active])
    assert not th.equal(critic(views, teams)[active], before[active])
