"""
Building blocks of actors and critics.

Letters: B, G, K rows of any kind, N agents, S sources, d features.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias, cast

import torch as th
from torch import nn

from sb3_saf.networks.memory import Memory, MemoryName
from sb3_saf.networks.tanh import Tanh

if TYPE_CHECKING:
    from gymnasium import spaces

HIDDEN_GAIN: Final = math.sqrt(2)
#: Layers with at most this many outputs are stored column by column.
_FEW_OUTPUTS: Final = 16


class NetworkSpec(NamedTuple):
    """
    Properties of a policy from which its networks are built.

    :param features_dim: size of an encoded observation
    :param action_space: one agent's action space
    :param actor_hidden: sizes of the hidden layers of each action head
    :param value_hidden: sizes of the hidden layers of each value head
    :param activation_fn: activation of hidden layers
    :param log_std_init: first log standard deviation, Box actions only
    :param state_space: space of the game's state if rows have it
    :param memory: kind of the critic's memory; None for none
    :param memory_size: size of the critic's memory
    """

    features_dim: int
    n_agents: int
    action_space: spaces.Space[Any]
    actor_hidden: list[int]
    value_hidden: list[int]
    activation_fn: type[nn.Module]
    log_std_init: float = 0.0
    state_space: spaces.Space[Any] | None = None
    memory: MemoryName | None = None
    memory_size: int = 0


class InOrder(NamedTuple):
    """Indices 0, 1, 2 ... in a shape, which need neither memory nor a copy of the selected rows."""

    shape: tuple[int, ...]


#: Row indices: int64 of any shape, or all in order.
Rows: TypeAlias = th.Tensor | InOrder


def gather(x: th.Tensor, rows: Rows) -> th.Tensor:
    """
    Return ``x[rows]`` with a reproducible gradient.

    On the CPU, PyTorch sums the gradient of ``x[rows]`` in parallel, in an order that varies between runs; that of
    ``index_select`` is summed in order, in a third of the time.

    :param x: (K, *shape)
    :param rows: int64 of any shape, each in 0..K-1, or all K in order
    :return: (*rows.shape, *shape)
    """
    if isinstance(rows, InOrder):
        return x if len(rows.shape) == 1 else x.reshape(*rows.shape, *x.shape[1:])
    return x.index_select(0, rows.flatten()).view(*rows.shape, *x.shape[1:])


class Linear(nn.Linear):
    """
    Linear layer with the gain of its orthogonal initialisation (see :func:`orthogonal_init`).

    :param gain: scale of the orthogonal weight matrix
    :param bias: whether to add a learned constant
    """

    def __init__(self, in_features: int, out_features: int, gain: float, bias: bool = True):
        super().__init__(in_features, out_features, bias=bias)
        self.gain = gain


class NormalizedReLU(nn.Module):
    """ReLU after layer normalisation without weights: inputs (K, d) with mean 0 and variance 1 in each row."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Return (K, d)."""
        return nn.functional.relu(nn.functional.layer_norm(x, x.shape[-1:]))


def mlp(sizes: Sequence[int], activation_fn: type[nn.Module], output_gain: float = 1.0) -> nn.Sequential:
    """
    Make a multi-layer perceptron with a linear output.

    :param sizes: inputs, hidden layers, outputs
    :param activation_fn: activation after every layer but the last; ``nn.Tanh`` becomes :class:`Tanh`
    :param output_gain: orthogonal gain of the last layer
    """
    activation = Tanh if activation_fn is nn.Tanh else activation_fn
    layers: list[nn.Module] = []
    for n_in, n_out in pairwise(sizes[:-1]):
        layers += [Linear(n_in, n_out, gain=HIDDEN_GAIN), activation()]
    return nn.Sequential(*layers, Linear(sizes[-2], sizes[-1], gain=output_gain))


#: Activations that are the same function of every number, which nets may share.
_ELEMENTWISE: Final = (Tanh, nn.ReLU, nn.ELU, nn.GELU, nn.SiLU, nn.LeakyReLU, nn.Sigmoid, nn.Softplus, nn.Mish)


def side_by_side(groups: Sequence[Sequence[nn.Sequential]], x: th.Tensor) -> list[th.Tensor]:
    """
    Evaluate several MLPs on the same inputs in few large operations: the first layers of all in one product, every
    further layer of a group in one batch. Equal to separate calls, up to the order of summation.

    :param groups: MLPs of :func:`mlp` with one activation; those of a group have one shape
    :param x: (K, d)
    :return: for each group of U MLPs, (U, K, P); few outputs are stored as (U, P, K), which is faster for what follows
    """
    if any(type(layer) not in _ELEMENTWISE for group in groups for layer in [*group[0]][1::2]):
        return [th.stack([net(x) for net in group]) for group in groups]
    firsts = [cast(nn.Linear, net[0]) for group in groups for net in group]
    wide = nn.functional.linear(x, th.cat([one.weight for one in firsts]), th.cat([one.bias for one in firsts]))
    have_hidden = [len(group[0]) > 1 for group in groups]
    if all(have_hidden):
        wide = groups[0][0][1](wide)
    parts = list(th.split(wide, [len(group) * cast(nn.Linear, group[0][0]).out_features for group in groups], dim=1))
    for number, group in enumerate(groups):
        if have_hidden[number] and not all(have_hidden):
            parts[number] = group[0][1](parts[number])
    return [_deeper(group, part) for group, part in zip(groups, parts, strict=True)]


def _deeper(group: Sequence[nn.Sequential], hidden: th.Tensor) -> th.Tensor:
    """Return outputs (U, K, P) of a group from those of its first layers, (K, U * h)."""
    x = hidden.unflatten(1, (len(group), -1)).transpose(0, 1)
    for number in range(2, len(group[0]), 2):
        layers = [cast(nn.Linear, net[number]) for net in group]
        weight, bias = th.stack([one.weight for one in layers]), th.stack([one.bias for one in layers])
        if number == len(group[0]) - 1 and weight.shape[1] <= _FEW_OUTPUTS:
            return th.baddbmm(bias.unsqueeze(2), weight, x.transpose(1, 2)).transpose(1, 2)
        x = th.baddbmm(bias.unsqueeze(1), x, weight.transpose(1, 2))
        if number < len(group[0]) - 1:
            x = group[0][number + 1](x)
    return x


def orthogonal_init(module: nn.Module) -> None:
    """
    Initialise every linear and convolutional layer, and every memory: orthogonal weights, zero bias.

    :param module: layers of type :class:`Linear` use their own gain, others that of hidden layers
    """
    for layer in module.modules():
        if isinstance(layer, (nn.Linear, nn.Conv2d)):
            nn.init.orthogonal_(layer.weight, gain=layer.gain if isinstance(layer, Linear) else HIDDEN_GAIN)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
        elif isinstance(layer, Memory):
            layer.orthogonal_init()


class AgentHeads(nn.Module):
    """
    One head per agent, all of one shape.

    :param make_head: makes a head that maps (K, d) to (K, P)
    """

    def __init__(self, make_head: Callable[[], nn.Module], n_agents: int):
        super().__init__()
        self.heads = nn.ModuleList(make_head() for _ in range(n_agents))

    def forward(self, x: th.Tensor, agent: th.Tensor) -> th.Tensor:
        """Apply the head of its agent (K,), int64 in 0..N-1, to each row of (K, d); (K, P)."""
        if th.compiler.is_compiling():  # graphs have no data-dependent sizes
            every = th.stack([head(x) for head in self.heads], dim=1)
            return every.gather(1, agent.reshape(-1, 1, 1).expand(-1, 1, every.shape[2])).squeeze(1)
        order = agent.argsort(stable=True)
        counts = th.bincount(agent, minlength=len(self.heads)).tolist()
        parts = th.split(gather(x, order), counts)
        by_agent = th.cat([head(part) for head, part in zip(self.heads, parts, strict=True)])
        position = th.empty_like(order)
        position[order] = th.arange(len(order), device=order.device)
        return gather(by_agent, position)
