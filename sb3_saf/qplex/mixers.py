"""
Mixers: functions from the agents' action values to the value of the joint action.

Each depends on the state of the game and satisfies the individual-global-max (IGM) consistency: in the joint action
with the highest Q_tot every agent takes its own best action. Mixers are used in training only.

Letters: G team steps, N agents, A actions, S size of the state, K attention kernels.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import pairwise
from typing import Final, Literal, NamedTuple, get_args

import torch as th
from torch import nn

from sb3_saf.networks.layers import mlp

MixerName = Literal["vdn", "qmix", "qplex"]
MIXER_NAMES: Final[tuple[MixerName, ...]] = get_args(MixerName)

#: Added to non-negative values that must be positive.
_EPSILON: Final = 1e-10


class JointChoice(NamedTuple):
    """
    Joint actions of teams at G steps, and the agents' own values.

    :param chosen: (G, N) Q_i of the agents' actions
    :param best: (G, N) V_i = max of Q_i over legal actions
    :param actions: (G, N) int64
    :param active: (G, N) bool, agents that take part; None if all do
    """

    chosen: th.Tensor
    best: th.Tensor
    actions: th.Tensor
    active: th.Tensor | None = None

    def only_active(self, values: th.Tensor) -> th.Tensor:
        """Return values (G, N), exactly zero for inactive agents."""
        return values if self.active is None else values.masked_fill(~self.active, 0.0)


class Mixed(NamedTuple):
    """
    Value of joint actions.

    :param q_tot: (G,)
    :param weights: (G, N) lambda_i, the weight of each agent's advantage; None for mixers without weights
    """

    q_tot: th.Tensor
    weights: th.Tensor | None = None


class Mixer(nn.Module, ABC):
    """Base of all mixers. Sums exclude inactive agents."""

    @abstractmethod
    def forward(self, state: th.Tensor, choice: JointChoice) -> Mixed:
        """Compute the value of joint actions in states (G, S)."""


class VDNMixer(Mixer):
    """VDN: Q_tot = sum_i Q_i, without state and parameters."""

    def forward(self, state: th.Tensor, choice: JointChoice) -> Mixed:
        """See :class:`Mixer`; the state is not read."""
        return Mixed(choice.only_active(choice.chosen).sum(dim=1))


class QMIXMixer(Mixer):
    """
    QMIX: Q_tot is a network of the Q_i with non-negative weights computed from the state.

    h = ELU(sum_i |W1_i(s)| Q_i + b1(s)), Q_tot = |w2(s)| . h + b2(s). Q_tot is thus monotonic in every Q_i.

    :param hidden: size of the hidden layer of b2's network
    :param embedding_dim: size of h
    """

    def __init__(self, state_dim: int, n_agents: int, hidden: int = 64, embedding_dim: int = 32):
        super().__init__()
        self.first_weights = nn.Linear(state_dim, n_agents * embedding_dim)
        self.first_bias = nn.Linear(state_dim, embedding_dim)
        self.last_weights = nn.Linear(state_dim, embedding_dim)
        self.last_bias = mlp([state_dim, hidden, 1], nn.ReLU)

    def forward(self, state: th.Tensor, choice: JointChoice) -> Mixed:
        """See :class:`Mixer`."""
        values = choice.only_active(choice.chosen)
        weights = self.first_weights(state).abs().view(*values.shape, -1)
        mixed = (values.unsqueeze(1) @ weights).squeeze(1) + self.first_bias(state)
        hidden = nn.functional.elu(mixed)
        q_tot: th.Tensor = (hidden * self.last_weights(state).abs()).sum(dim=1) + self.last_bias(state).squeeze(1)
        return Mixed(q_tot)


class ParallelMLPs(nn.Module):
    """
    K networks of one shape, computed in parallel.

    :param count: K
    :param sizes: inputs, hidden layers, outputs of each; ReLU in between
    """

    def __init__(self, count: int, sizes: Sequence[int]):
        super().__init__()
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for n_in, n_out in pairwise(sizes):
            bound = n_in**-0.5  # torch's initialisation of linear layers
            self.weights.append(nn.Parameter(th.empty(count, n_in, n_out).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(th.empty(count, 1, n_out).uniform_(-bound, bound)))

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Apply the networks: (G, inputs) to (K, G, outputs)."""
        x = x.expand(len(self.weights[0]), *x.shape)
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = th.baddbmm(bias, nn.functional.relu(x) if i else x, weight)
        return x


def _he_uniform(weight: th.Tensor, n_inputs: int) -> None:
    bound = math.sqrt(6 / n_inputs)
    weight.uniform_(-bound, bound)


class AttentionKernels(nn.Module):
    """
    lambda_i(s, a) = sum over K kernels of |key_k(s)| sigmoid(agents_ki(s)) sigmoid(action_ki(s, a)).

    :param hidden: sizes of the hidden layers of the networks of each kernel
    """

    def __init__(self, state_dim: int, n_agents: int, n_actions: int, n_kernels: int, hidden: tuple[int, ...]):
        super().__init__()
        self.key = ParallelMLPs(n_kernels, [state_dim, *hidden, 1])
        self.agents = ParallelMLPs(n_kernels, [state_dim, *hidden, n_agents])
        self.action = ParallelMLPs(n_kernels, [state_dim + n_agents * n_actions, *hidden, n_agents])
        # The networks that read the joint action have He initialisation. One-hot actions count as N inputs, the number
        # of non-zero ones. Together with a wide state they would hardly affect the hidden layers, and the initial
        # lambda would be nearly additive over agents. Where an advantage is close to zero, lambda gets no gradient, so
        # it would keep the value extrapolated from that sum (docs/qplex.md).
        first, *others = self.action.weights
        with th.no_grad():
            _he_uniform(first[:, -n_agents * n_actions :], n_agents)
            for weight in others:
                _he_uniform(weight, weight.shape[1])

    def forward(self, state: th.Tensor, state_and_actions: th.Tensor) -> th.Tensor:
        """Compute lambda (G, N) from states (G, S) and states with joint actions (G, S + N A)."""
        key = self.key(state).abs() + _EPSILON
        weights: th.Tensor = key * self.agents(state).sigmoid() * self.action(state_and_actions).sigmoid()
        return weights.sum(dim=0)


class QPLEXMixer(Mixer):
    """
    QPLEX: a duplex dueling mixer, which can represent every function with IGM consistency.

    With w_i(s) > 0, Q'_i = w_i Q_i + b_i, V'_i = w_i V_i + b_i and A'_i = Q'_i - V'_i (never above zero)::

        Q_tot = sum_i V'_i + sum_i lambda_i(s, a) A'_i,   lambda_i > 0

    computed as published: Q_tot = sum_i Q'_i + sum_i stopgrad(A'_i) (lambda_i - 1). The value is the same; advantages
    train the weights lambda only, not the agents.

    :param hidden: size of the hidden layer of the networks of w and b
    :param n_kernels: K, attention kernels that are summed to lambda
    :param kernel_hidden: sizes of the hidden layers of each kernel's networks
    """

    def __init__(
        self,
        state_dim: int,
        n_agents: int,
        n_actions: int,
        hidden: int = 64,
        n_kernels: int = 4,
        kernel_hidden: tuple[int, ...] = (64,),
    ):
        super().__init__()
        self.n_actions = n_actions
        self.scale = mlp([state_dim, hidden, n_agents], nn.ReLU)
        self.shift = mlp([state_dim, hidden, n_agents], nn.ReLU)
        self.kernels = AttentionKernels(state_dim, n_agents, n_actions, n_kernels, kernel_hidden)

    def forward(self, state: th.Tensor, choice: JointChoice) -> Mixed:
        """See :class:`Mixer`."""
        scale, shift = self.scale(state).abs() + _EPSILON, self.shift(state)
        chosen = choice.only_active(scale * choice.chosen + shift)
        best = choice.only_active(scale * choice.best + shift)
        advantages = (chosen - best).detach()
        weights = self.advantage_weights(state, choice)
        return Mixed((chosen + advantages * (weights - 1.0)).sum(dim=1), weights)

    def advantage_weights(self, state: th.Tensor, choice: JointChoice) -> th.Tensor:
        """Compute lambda (G, N) at states (G, S); reads ``actions`` and ``active`` of ``choice``."""
        actions = nn.functional.one_hot(choice.actions, self.n_actions).to(state.dtype)
        if choice.active is not None:
            actions = actions * choice.active.unsqueeze(2)
        return self.kernels(state, th.cat([state, actions.flatten(1)], dim=1))
