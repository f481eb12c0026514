"""
Knowledge source: slots that all agents write to and read from (arXiv 2210.03022, section 5), and its attention.

The core of the attention is compiled on the CPU: for many groups of few queries and few sources, PyTorch's batched
products and softmax take ten times as long.

Letters: G groups or teams, N agents, L slots, Q queries, S sources, d features. Attention weights are (G, query,
source).
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from torch import nn
from torch.autograd.function import once_differentiable

from hecogrid_envs.core.jit import cached
from sb3_saf.networks.layers import Linear, mlp

Floats = npt.NDArray[np.float32]
#: Allows reordering of sums; the order is fixed at compile time.
_FAST: Final = {"contract", "reassoc", "nsz"}


class Attention(nn.Module):
    """
    One head of scaled dot-product attention: softmax(Q K^T / sqrt(d)) V, then a linear output layer.

    Queries, keys and values have no bias (spec: SAF's parameter table). The projections are therefore merged to W_q^T
    W_k, applied to queries, and W_o W_v, applied to the weighted sums: sources are not projected.
    """

    def __init__(self, features_dim: int):
        super().__init__()
        self.query = Linear(features_dim, features_dim, gain=1.0, bias=False)
        self.key = Linear(features_dim, features_dim, gain=1.0, bias=False)
        self.value = Linear(features_dim, features_dim, gain=1.0, bias=False)
        self.out = Linear(features_dim, features_dim, gain=1.0)
        self.scale = features_dim**-0.5

    def forward(
        self, queries: th.Tensor, sources: th.Tensor, active: th.Tensor | None = None
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Attend to the sources.

        :param queries: (G, Q, d), or (Q, d) that are the same for all G
        :param sources: (G, S, d)
        :param active: (G, S) bool, sources to attend to; all if None. Without any active source the values are zero
        :return: values (G, Q, d), with the output layer applied, and weights (G, Q, S), which sum to 1 over sources
        """
        queries = queries @ ((self.query.weight.t() * self.scale) @ self.key.weight)
        on_cpu = sources.device.type == "cpu" and sources.dtype == th.float32 and not th.compiler.is_compiling()
        taken, weights = _Taken.apply(queries, sources, active) if on_cpu else _taken(queries, sources, active)
        return nn.functional.linear(taken, self.out.weight @ self.value.weight, self.out.bias), weights


def _taken(queries: th.Tensor, sources: th.Tensor, active: th.Tensor | None) -> tuple[th.Tensor, th.Tensor]:
    """Return weighted sums of sources (G, Q, d) and the weights softmax(queries sources^T), (G, Q, S)."""
    scores = queries @ sources.transpose(1, 2)
    if active is None:
        weights = scores.softmax(dim=2)
    else:
        # The lowest finite number instead of -inf: a row without sources gives zeros instead of NaN.
        shown = active.unsqueeze(1)
        weights = scores.masked_fill(~shown, th.finfo(scores.dtype).min).softmax(dim=2) * shown
    return weights @ sources, weights


class _Taken(th.autograd.Function):
    """Compute :func:`_taken` compiled."""

    @staticmethod
    def forward(
        ctx: Any, queries: th.Tensor, sources: th.Tensor, active: th.Tensor | None
    ) -> tuple[th.Tensor, th.Tensor]:
        n_groups, n_sources, n_features = sources.shape
        queries, sources = queries.contiguous(), sources.contiguous()
        taken = sources.new_empty(n_groups, queries.shape[-2], n_features)
        weights = sources.new_empty(n_groups, queries.shape[-2], n_sources)
        shown = np.ones((1, n_sources), np.bool_) if active is None else active.numpy()
        _take(_by_group(queries), sources.numpy(), shown, taken.numpy(), weights.numpy())
        ctx.save_for_backward(queries, sources, weights)
        return taken, weights

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[Any, ...]:
        queries, sources, weights = ctx.saved_tensors
        of_taken, of_weights = (gradient.contiguous().numpy() for gradient in gradients)
        of_queries, of_sources = th.zeros_like(queries), th.zeros_like(sources)
        saved = (_by_group(queries), sources.numpy(), weights.numpy())
        _give_back(of_taken, of_weights, *saved, _by_group(of_queries), of_sources.numpy())
        return of_queries, of_sources, None


def _by_group(queries: th.Tensor) -> Floats:
    """Return queries with a group axis, (G or 1, Q, d)."""
    array: Floats = queries.detach().numpy()
    return array if array.ndim == 3 else array[np.newaxis]


# --- kernels: queries and shown have one entry for all groups, or one for each ----------------------------------------


@cached(error_model="numpy", fastmath=_FAST)
def _take(queries: Floats, sources: Floats, shown: npt.NDArray[np.bool_], taken: Floats, weights: Floats) -> None:
    n_groups, n_sources, n_features = sources.shape
    zero = np.float32(0)
    for g in range(n_groups):
        of, look = g if len(queries) > 1 else 0, g if len(shown) > 1 else 0
        for q in range(taken.shape[1]):
            highest = np.float32(-np.inf)
            for s in range(n_sources):
                score = zero
                for i in range(n_features):
                    score += queries[of, q, i] * sources[g, s, i]
                weights[g, q, s] = score
                if shown[look, s]:
                    highest = max(highest, score)
            total = zero
            for s in range(n_sources):
                weight = np.float32(math.exp(weights[g, q, s] - highest)) if shown[look, s] else zero
                weights[g, q, s] = weight
                total += weight
            for i in range(n_features):
                taken[g, q, i] = zero
            for s in range(n_sources):
                if shown[look, s]:
                    weight = weights[g, q, s] / total
                    weights[g, q, s] = weight
                    for i in range(n_features):
                        taken[g, q, i] += weight * sources[g, s, i]


@cached(error_model="numpy", fastmath=_FAST)
def _give_back(
    of_taken: Floats,
    of_weights: Floats,
    queries: Floats,
    sources: Floats,
    weights: Floats,
    of_queries: Floats,
    of_sources: Floats,
) -> None:
    """Add the gradients of queries and sources to ``of_queries`` and ``of_sources``."""
    n_groups, n_sources, n_features = sources.shape
    of_weight = np.empty(n_sources, np.float32)
    for g in range(n_groups):
        of = g if len(queries) > 1 else 0
        for q in range(of_taken.shape[1]):
            mean = np.float32(0)
            for s in range(n_sources):
                gradient = of_weights[g, q, s]
                for i in range(n_features):
                    gradient += of_taken[g, q, i] * sources[g, s, i]
                of_weight[s] = gradient
                mean += gradient * weights[g, q, s]
            for s in range(n_sources):
                weight = weights[g, q, s]
                of_score = weight * (of_weight[s] - mean)
                for i in range(n_features):
                    of_sources[g, s, i] += weight * of_taken[g, q, i] + of_score * queries[of, q, i]
                    of_queries[of, q, i] += of_score * sources[g, s, i]


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

    def forward(self, slots: th.Tensor, messages: th.Tensor, active: th.Tensor | None) -> tuple[th.Tensor, th.Tensor]:
        """
        Update the slots.

        :param slots: (L, d), the same for all teams, or (G, L, d)
        :param messages: (G, N, d)
        :param active: (G, N) bool or None
        :return: slots (G, L, d) and attention (G, L, N)
        """
        values, weights = self.attention(self.query_norm(slots), self.source_norm(messages), active)
        slots = slots + values
        return slots + self.mlp(self.mlp_norm(slots)), weights


class SelfAttentionBlock(nn.Module):
    """Slots attend to each other: x + attend(norm(x)), then x + mlp(norm(x))."""

    def __init__(self, features_dim: int):
        super().__init__()
        self.norm = nn.LayerNorm(features_dim)
        self.attention = Attention(features_dim)
        self.mlp_norm = nn.LayerNorm(features_dim)
        self.mlp = mlp([features_dim] * 3, nn.GELU)

    def forward(self, slots: th.Tensor) -> th.Tensor:
        """Update the slots (G, L, d)."""
        normed = self.norm(slots)
        slots = slots + self.attention(normed, normed)[0]
        return slots + self.mlp(self.mlp_norm(slots))


class KnowledgeSource(nn.Module):
    """
    Slots that attend to the agents' messages (write) and that agents attend to (read).

    Writing costs L x N and reading N x L: linear in the number of agents. A learned embedding marks the sender of a
    message; apart from that, the order of agents does not matter. After writing, slots attend to each other twice.

    :param features_dim: d of messages, states and slots
    :param n_slots: L
    """

    def __init__(self, n_agents: int, features_dim: int = 64, n_slots: int = 4):
        super().__init__()
        self.agent_embeddings = nn.Parameter(th.randn(n_agents, features_dim) * features_dim**-0.5)
        # Orthogonal, and as large as the normed values that writing adds: smaller slots would all become the mean of
        # the messages, which makes reading from them indistinguishable.
        self.slots = nn.Parameter(nn.init.orthogonal_(th.empty(n_slots, features_dim), gain=features_dim**0.5))
        self.write_block = CrossAttentionBlock(features_dim)
        self.slot_blocks = nn.ModuleList(SelfAttentionBlock(features_dim) for _ in range(2))
        self.read_query_norm = nn.LayerNorm(features_dim)
        self.read_source_norm = nn.LayerNorm(features_dim)
        self.read_attention = Attention(features_dim)

    def write(self, messages: th.Tensor, active: th.Tensor | None = None) -> tuple[th.Tensor, th.Tensor]:
        """
        Fill the slots.

        :param messages: (G, N, d), m' of every agent
        :param active: (G, N) bool, agents whose messages are written; all if None
        :return: slots (G, L, d) and write attention (G, L, N)
        """
        slots, attention = self.write_block(self.slots, messages + self.agent_embeddings, active)
        for block in self.slot_blocks:
            slots = block(slots)
        return slots, attention

    def forward(self, messages: th.Tensor, states: th.Tensor, active: th.Tensor | None = None) -> Exchanged:
        """
        Write as in :meth:`write`, then read from the slots with the agents' states as queries.

        :param states: (G, N, d), s of every agent
        """
        slots, written = self.write(messages, active)
        read, looked = self.read_attention(self.read_query_norm(states), self.read_source_norm(slots))
        return Exchanged(read, written, looked)
