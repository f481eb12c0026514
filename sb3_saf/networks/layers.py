"""
Building blocks that actors and critics are made of.

Letters: B, G, K rows of any kind, N agents, S sources, d features.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import torch as th
from torch import nn

if TYPE_CHECKING:
    from gymnasium import spaces

HIDDEN_GAIN: Final = math.sqrt(2)


class NetworkSpec(NamedTuple):
    """
    What a policy tells the networks that it is built from.

    :param features_dim: size of an encoded observation
    :param n_agents: N
    :param action_space: one agent's action space
    :param actor_hidden: sizes of the hidden layers of each action head
    :param value_hidden: sizes of the hidden layers of each value head
    :param activation_fn: activation of hidden layers
    :param log_std_init: first log standard deviation, Box actions only
    :param state_space: space of the game's state where rows have it
    """

    features_dim: int
    n_agents: int
    action_space: spaces.Space[Any]
    actor_hidden: list[int]
    value_hidden: list[int]
    activation_fn: type[nn.Module]
    log_std_init: float
    state_space: spaces.Space[Any] | None = None


def gather(x: th.Tensor, rows: th.Tensor) -> th.Tensor:
    """
    Return ``x[rows]``, with a gradient that is the same every time.

    On the CPU, PyTorch adds up the gradient of ``x[rows]`` in parallel, in an order that changes from run to run; that
    of ``index_select`` is added in order, and in a third of the time.

    :param x: (K, *shape)
    :param rows: int64 of any shape, each in 0..K-1
    :return: (*rows.shape, *shape)
    """
    return x.index_select(0, rows.flatten()).view(*rows.shape, *x.shape[1:])


def gather_agents(x: th.Tensor, teams: th.Tensor, agent: th.Tensor) -> th.Tensor:
    """
    Return ``x[teams, agent]``, see :func:`gather`.

    :param x: (G, N, *shape)
    :param teams: (B,) int64
    :param agent: (B,) int64
    :return: (B, *shape)
    """
    return gather(x.flatten(0, 1), teams * x.shape[1] + agent)


class Linear(nn.Linear):
    """
    A linear layer that knows the gain of its orthogonal initialisation (see :func:`orthogonal_init`).

    :param in_features: inputs
    :param out_features: outputs
    :param gain: scale of the orthogonal weight matrix
    :param bias: whether to add a learned constant
    """

    def __init__(self, in_features: int, out_features: int, gain: float, bias: bool = True):
        super().__init__(in_features, out_features, bias=bias)
        self.gain = gain


class Tanh(nn.Tanh):
    """
    ``nn.Tanh``, on the CPU as 2 sigmoid(2 x) - 1: PyTorch's sigmoid takes a sixth of the time of its tanh, which would
    be a fifth of SAF's forward pass. The two differ by 2e-7 at most.
    """

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Of any shape."""
        if x.device.type != "cpu" or th.compiler.is_compiling():
            return super().forward(x)
        result: th.Tensor = _TanhBySigmoid.apply(x)
        return result


class _TanhBySigmoid(th.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: th.Tensor) -> th.Tensor:
        y = (x * 2).sigmoid_().mul_(2).sub_(1)
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: th.Tensor) -> th.Tensor:
        # Autograd's own formula, which can be differentiated again, as TRPO does.
        gradient: th.Tensor = th.ops.aten.tanh_backward(gradients[0], *ctx.saved_tensors)
        return gradient


def mlp(sizes: Sequence[int], activation_fn: type[nn.Module], output_gain: float = 1.0) -> nn.Sequential:
    """
    Multi-layer perceptron with a linear output.

    :param sizes: inputs, hidden layers, outputs
    :param activation_fn: activation after every layer but the last; ``nn.Tanh`` becomes :class:`Tanh`
    :param output_gain: orthogonal gain of the last layer
    """
    activation = Tanh if activation_fn is nn.Tanh else activation_fn
    layers: list[nn.Module] = []
    for n_in, n_out in pairwise(sizes[:-1]):
        layers += [Linear(n_in, n_out, gain=HIDDEN_GAIN), activation()]
    return nn.Sequential(*layers, Linear(sizes[-2], sizes[-1], gain=output_gain))


def orthogonal_init(module: nn.Module) -> None:
    """
    Initialise every linear and convolutional layer: orthogonal weights, zero bias.

    :param module: layers of type :class:`Linear` use their own gain, others that of hidden layers
    """
    for layer in module.modules():
        if isinstance(layer, (nn.Linear, nn.Conv2d)):
            nn.init.orthogonal_(layer.weight, gain=layer.gain if isinstance(layer, Linear) else HIDDEN_GAIN)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


class AgentHeads(nn.Module):
    """
    One head per agent, all of one shape.

    :param make_head: makes a head that maps (K, d) to (K, P)
    :param n_agents: N
    """

    def __init__(self, make_head: Callable[[], nn.Module], n_agents: int):
        super().__init__()
        self.heads = nn.ModuleList(make_head() for _ in range(n_agents))

    def forward(self, x: th.Tensor, agent: th.Tensor) -> th.Tensor:
        """
        Send each row through the head of its agent.

        :param x: (K, d)
        :param agent: (K,) int64 in 0..N-1
        :return: (K, P)
        """
        if th.compiler.is_compiling():  # a graph has no parts whose sizes depend on numbers
            every = th.stack([head(x) for head in self.heads], dim=1)
            return every.gather(1, agent.reshape(-1, 1, 1).expand(-1, 1, every.shape[2])).squeeze(1)
        order = agent.argsort(stable=True)
        counts = th.bincount(agent, minlength=len(self.heads)).tolist()
        parts = th.split(gather(x, order), counts)
        by_agent = th.cat([head(part) for head, part in zip(self.heads, parts, strict=True)])
        position = th.empty_like(order)
        position[order] = th.arange(len(order), device=order.device)
        return gather(by_agent, position)


class Attended(NamedTuple):
    """
    What an attention layer gives.

    :param values: (G, Q, d)
    :param weights: (G, Q, S), the share of each source in each query's answer; sums to 1 over sources
    """

    values: th.Tensor
    weights: th.Tensor


class Attention(nn.Module):
    """
    One head of scaled dot-product attention: softmax(Q K^T / sqrt(d)) V, then a linear output layer.

    Queries, keys and values have no bias (spec: SAF's parameter table).

    :param features_dim: d
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
        Let each query look at the sources.

        :param queries: (G, Q, d)
        :param sources: (G, S, d)
        :param active: (G, S) bool, sources to look at; all if None. Without any active source the values are zero
        :return: values (G, Q, d), with the output layer applied, and weights (G, Q, S)
        """
        scores = self.query(queries) @ self.key(sources).transpose(1, 2) * self.scale
        if active is None:
            weights = scores.softmax(dim=2)
        else:
            # The lowest finite number instead of -inf: a row without sources gives zeros, not NaN.
            shown = active.unsqueeze(1)
            weights = scores.masked_fill(~shown, th.finfo(scores.dtype).min).softmax(dim=2) * shown
        return Attended(self.out(weights @ self.value(sources)), weights)
