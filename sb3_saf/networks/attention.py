"""
One head of scaled dot-product attention. Its core is compiled on the CPU: for many groups of few queries and few
sources, PyTorch's batched products and softmax take ten times as long.

Letters: G groups, Q queries, S sources, d features.
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
from sb3_saf.networks.layers import Linear

Floats = npt.NDArray[np.float32]
#: Allows reordering of sums; the order is fixed at compile time.
_FAST: Final = {"contract", "reassoc", "nsz"}


class Attended(NamedTuple):
    """
    Output of an attention layer.

    :param values: (G, Q, d)
    :param weights: (G, Q, S), weight of each source for each query; sums to 1 over sources
    """

    values: th.Tensor
    weights: th.Tensor


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

    def forward(self, queries: th.Tensor, sources: th.Tensor, active: th.Tensor | None = None) -> Attended:
        """
        Attend to the sources.

        :param queries: (G, Q, d), or (Q, d) that are the same for all G
        :param sources: (G, S, d)
        :param active: (G, S) bool, sources to attend to; all if None. Without any active source the values are zero
        :return: values (G, Q, d), with the output layer applied, and weights (G, Q, S)
        """
        queries = queries @ ((self.query.weight.t() * self.scale) @ self.key.weight)
        on_cpu = sources.device.type == "cpu" and sources.dtype == th.float32 and not th.compiler.is_compiling()
        taken, weights = _Taken.apply(queries, sources, active) if on_cpu else _taken(queries, sources, active)
        return Attended(nn.functional.linear(taken, self.out.weight @ self.value.weight, self.out.bias), weights)


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
