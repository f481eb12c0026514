"""
Knowledge source: slots that all agents write to and read from (arXiv 2210.03022, section 5).

Letters: G teams, N agents, L slots, d features. Attention weights are (G, query, source).
"""

from __future__ import annotations

from typing import NamedTuple

import torch as th
from torch import nn

from sb3_saf.networks.attention import Attended, Attention
from sb3_saf.networks.layers import mlp


class Exchanged(NamedTuple):
    """
    Result of writing and reading.

    :param read: (G, N, d), m of every agent
    :param write_attention: (G, L, N), attention of each slot to each agent; sums to 1 over agents
    :param read_attention: (G, N, L), attention of each agent to each slot; sums to 1 over slots
    """

    read: th.Tensor
    write_attention: th.Tensor
    read_attention: th.Tensor


class CrossAttentionBlock(nn.Module):
    """Slots attend to the agents' messages: x + attend(norm(x), norm(messages)), then x + mlp(norm(x))."""

    def __init__(self, features_dim: int):
        super().__init__()
        self.query_norm = nn.LayerNorm(features_dim)
        self.source_norm = nn.LayerNorm(features_dim)
        self.attention = Attention(features_dim)
        self.mlp_norm = nn.LayerNorm(features_dim)
        self.mlp = mlp([features_dim] * 3, nn.GELU)

    def forward(self, slots: th.Tensor, messages: th.Tensor, active: th.Tensor | None) -> Attended:
        """
        Update the slots.

        :param slots: (L, d), the same for all teams, or (G, L, d)
        :param messages: (G, N, d)
        :param active: (G, N) bool or None
        :return: slots (G, L, d) and attention (G, L, N)
        """
        attended = self.attention(self.query_norm(slots), self.source_norm(messages), active)
        slots = slots + attended.values
        return Attended(slots + self.mlp(self.mlp_norm(slots)), attended.weights)


class SelfAttentionBlock(nn.Module):
    """Slots attend to each other: x + attend(norm(x)), then x + mlp(norm(x))."""

    def __init__(self, features_dim: int):
        super().__init__()
        self.norm = nn.LayerNorm(features_dim)
        self.attention = Attention(features_dim)
        self.mlp_norm = nn.LayerNorm(features_dim)
        self.mlp = mlp([features_dim] * 3, nn.GELU)

    def forward(self, slots: th.Tensor) -> th.Tensor:
        """
        Update the slots.

        :param slots: (G, L, d)
        :return: (G, L, d)
        """
        normed = self.norm(slots)
        slots = slots + self.attention(normed, normed).values
        return slots + self.mlp(self.mlp_norm(slots))


class KnowledgeSource(nn.Module):
    """
    Slots that attend to the agents' messages (write) and that agents attend to (read).

    Writing costs L x N and reading N x L: linear in the number of agents. A learned embedding marks the sender of a
    message; apart from that, the order of agents does not matter.

    :param features_dim: d of messages, states and slots
    :param n_slots: L
    :param n_self_attention: number of self-attention blocks after writing
    """

    def __init__(self, n_agents: int, features_dim: int = 64, n_slots: int = 4, n_self_attention: int = 2):
        super().__init__()
        self.agent_embeddings = nn.Parameter(th.randn(n_agents, features_dim) * features_dim**-0.5)
        # Orthogonal, and as large as the normed values that writing adds: smaller slots would all become the mean of
        # the messages, which makes reading from them indistinguishable.
        self.slots = nn.Parameter(nn.init.orthogonal_(th.empty(n_slots, features_dim), gain=features_dim**0.5))
        self.write_block = CrossAttentionBlock(features_dim)
        self.slot_blocks = nn.ModuleList(SelfAttentionBlock(features_dim) for _ in range(n_self_attention))
        self.read_query_norm = nn.LayerNorm(features_dim)
        self.read_source_norm = nn.LayerNorm(features_dim)
        self.read_attention = Attention(features_dim)

    def write(self, messages: th.Tensor, active: th.Tensor | None = None) -> Attended:
        """
        Fill the slots.

        :param messages: (G, N, d), m' of every agent
        :param active: (G, N) bool, agents whose messages are written; all if None
        :return: slots (G, L, d) and write attention (G, L, N)
        """
        slots, attention = self.write_block(self.slots, messages + self.agent_embeddings, active)
        for block in self.slot_blocks:
            slots = block(slots)
        return Attended(slots, attention)

    def forward(self, messages: th.Tensor, states: th.Tensor, active: th.Tensor | None = None) -> Exchanged:
        """
        Write, then read from the slots with the agents' states as queries.

        :param messages: (G, N, d), m' of every agent
        :param states: (G, N, d), s of every agent
        :param active: (G, N) bool, agents whose messages are written; all if None
        """
        slots, written = self.write(messages, active)
        read = self.read_attention(self.read_query_norm(states), self.read_source_norm(slots))
        return Exchanged(read.values, written, read.weights)
