"""
Critics: value estimates for training; and their normalisation, by which critics learn returns of mean 0 and variance 1
while values outside the critic are on the raw scale.

How normalisation works with SB3's unmodified PPO:

1. The policy passes every output of its critic through its :class:`ValueNormalizer`, so *all* values outside the policy
   are on the raw scale: in the buffer, in the advantages, in the bootstrap of a time limit.
2. SB3 trains with its squared error on the raw scale. The gradient of a value is rescaled in the backward pass to the
   gradient of the squared error of normalised values (:meth:`ValueNormalizer.forward`).
3. The statistics need the returns, which the rollout buffer computes. The minibatches of ``TeamRolloutBuffer`` contain
   them (``sb3_saf.buffers.rollout``); the policy updates the statistics at the first minibatch of a rollout, before the
   gradient step. Training on minibatches of other buffers raises a ValueError.

Letters: B rows, K unique own observations, G unique teams, N agents, d features. Own observations and teams are
separate arguments (``features`` and ``teams``), so that functions of one observation are computed once each.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Final, Literal, cast

import numpy as np
import numpy.typing as npt
import torch as th
from torch import nn

from sb3_saf.networks.encoders import ObservationEncoder
from sb3_saf.networks.layers import AgentHeads, NetworkSpec, Rows, mlp, side_by_side
from sb3_saf.networks.memory import Memory

#: One head for all agents, or one for each.
Heads = Literal["shared", "per_agent"]


class TeamCritic(nn.Module, ABC):
    """
    Base of critics that read the observations of the whole team: states of the agents, or one of the team, then values.

    If the policy's critic has a memory, it is between the two: values depend on what it returns for the states of
    successive steps. Subclasses make ``value_head``, with ``head_dim`` inputs.

    :param n_states: U, states of a team: N, or 1
    :param state_dim: S, size of a state
    """

    value_head: OwnValueHead | JointValueHead

    def __init__(self, spec: NetworkSpec, n_states: int, state_dim: int):
        super().__init__()
        self.n_states = n_states
        self.memory = None if spec.memory is None else Memory(spec.memory, state_dim, spec.memory_size)
        #: Size of a state, or of the memory's output.
        self.head_dim = state_dim if self.memory is None else spec.memory_size

    @abstractmethod
    def states(self, features: th.Tensor, teams: Rows, active: th.Tensor | None = None) -> th.Tensor:
        """
        Return the states of every team.

        :param features: (K, d) features of own observations
        :param teams: (G, N), index into ``features`` of each agent of a team
        :param active: (G, N) bool, agents that take part; all if None
        :return: (G, U, S)
        """

    def values(self, states: th.Tensor) -> th.Tensor:
        """Return the values (G, N) of all agents from states (G, U, S), or from those of their memory (G, U, H)."""
        return self.value_head.of_teams(states)


class OwnValueHead(nn.Module):
    """Value of an agent from its own features."""

    def __init__(self, spec: NetworkSpec, features_dim: int, heads: Heads):
        super().__init__()
        self.reads_agent = heads == "per_agent"

        def make_head() -> nn.Sequential:
            return mlp([features_dim, *spec.value_hidden, 1], spec.activation_fn)

        self.head: nn.Module = AgentHeads(make_head, spec.n_agents) if self.reads_agent else make_head()

    def forward(self, features: th.Tensor, agent: th.Tensor | None = None) -> th.Tensor:
        """Return values (K,) of single agents from features (K, d), and where ``reads_agent`` their indices (K,)."""
        values: th.Tensor = self.head(features, agent) if self.reads_agent else self.head(features)
        return values.squeeze(1)

    def of_teams(self, features: th.Tensor) -> th.Tensor:
        """Return values (G, N) of whole teams from features (G, N, d)."""
        n_teams, n_agents, _ = features.shape
        agent = th.arange(n_agents, device=features.device).repeat(n_teams) if self.reads_agent else None
        values: th.Tensor = self(features.flatten(0, 1), agent)
        return values.view(n_teams, n_agents)


class JointValueHead(nn.Module):
    """
    Value of an agent from the features of its whole team.

    A head shared by all agents reads the agent's one-hot index; without it, all agents of a team get the same value.
    With one head per agent the index selects the head.

    :param joint_dim: size of the joint features
    :param agent_identity: whether a shared head reads the agent's index
    """

    def __init__(self, spec: NetworkSpec, joint_dim: int, heads: Heads, agent_identity: bool):
        super().__init__()
        self.n_agents = spec.n_agents
        self.agent_identity = agent_identity and heads == "shared"
        n_inputs = joint_dim + (spec.n_agents if self.agent_identity else 0)
        n_heads = 1 if heads == "shared" else spec.n_agents
        self.heads = nn.ModuleList(mlp([n_inputs, *spec.value_hidden, 1], spec.activation_fn) for _ in range(n_heads))

    def of_teams(self, features: th.Tensor) -> th.Tensor:
        """Return values (G, N) of whole teams from features (G, N, d), or joint ones of any other form (G, ...)."""
        joint = features.flatten(1)
        if self.agent_identity:  # the joint part of the first layer is computed once per team
            first, *rest = cast(nn.Sequential, self.heads[0])
            assert isinstance(first, nn.Linear)
            weight_joint, weight_agent = first.weight.split([joint.shape[1], self.n_agents], dim=1)
            x = nn.functional.linear(joint, weight_joint, first.bias).unsqueeze(1) + weight_agent.t()
            for layer in rest:
                x = layer(x)
            return x.squeeze(2)
        if len(self.heads) == 1:
            of_team: th.Tensor = self.heads[0](joint)
            return of_team.expand(-1, self.n_agents)
        (values,) = side_by_side([cast(list[nn.Sequential], list(self.heads))], joint)
        return values.squeeze(2).t()


class StateCritic(nn.Module):
    """
    V_i from the encoded state of the game.

    :param spec: spec of the policy; an encoded state is as large as an encoded observation
    :param agent_identity: whether a shared head reads the agent's index
    :raises ValueError: if rows have no state, or the critic is to have a memory
    """

    def __init__(self, spec: NetworkSpec, heads: Heads, agent_identity: bool):
        super().__init__()
        if spec.memory is not None:
            raise ValueError(
                "critic_input='state' has no critic with memory; pass critic_memory=False, or leave critic_input out"
            )
        if spec.state_space is None:
            raise ValueError(
                "critic_input='state' needs observations with 'state', and these have none; build the environment "
                "with sb3_saf.make_team_env(..., state=True), or leave critic_input out"
            )
        self.encoder = ObservationEncoder(spec.state_space, spec.features_dim)
        self.value_head = JointValueHead(spec, spec.features_dim, heads, agent_identity)

    def forward(self, states: th.Tensor) -> th.Tensor:
        """Return the values (G, N) of all agents from states (G, *state), as SB3 preprocesses observations."""
        return self.value_head.of_teams(self.encoder(states))


#: Lower limit of the standard deviation: nearly constant returns are not scaled to variance 1.
MIN_STD: Final = 1e-2


class ValueNormalizer(nn.Module):
    """
    Running mean and variance of all returns with equal weights, and the conversion of the critic's outputs to values.

    Before the first update the mean is 0 and the variance 1: values are the critic's outputs, bit for bit.

    :param n_agents: N for statistics of each agent's own returns; None for one of all
    """

    mean: th.Tensor
    var: th.Tensor
    count: th.Tensor

    def __init__(self, n_agents: int | None = None) -> None:
        super().__init__()
        shape = () if n_agents is None else (n_agents,)
        self.register_buffer("mean", th.zeros(shape))
        self.register_buffer("var", th.ones(shape))
        self.register_buffer("count", th.zeros(shape, dtype=th.int64))

    @property
    def std(self) -> th.Tensor:
        """() or (N,) standard deviation by which values are scaled."""
        return self.var.sqrt().clamp_min(MIN_STD)

    def forward(
        self, outputs: th.Tensor, active: th.Tensor | None = None, agents: th.Tensor | None = None
    ) -> th.Tensor:
        """
        De-normalise: ``v = mean + std * n`` for the critic's outputs n.

        The incoming gradient at v is divided by std². With returns R, SB3's loss sends back
        ``d/dv (R - v)² = -2 (R - v)``, and the chain rule through ``v = mean + std * n`` makes ``-2 std (R - v)`` of it
        at n. The loss of normalised values is ``((R - mean) / std - n)²`` with the gradient
        ``-2 ((R - mean) / std - n) = -2 (R - v) / std`` at n: the same, divided by std². So SB3's ``vf_coef`` weighs
        the normalised loss, while the ``train/value_loss`` that it logs and ``clip_range_vf`` stay on the raw scale.

        :param outputs: (B, ...) outputs of the critic
        :param active: (B, ...) bool, rows that take part; the values of others are exactly zero. All if None
        :param agents: (B, ...) agents of the rows, for statistics of each agent
        :return: (B, ...) values on the scale of returns
        """
        mean, std = (value[agents] if value.ndim else value for value in (self.mean, self.std))
        values = mean + std * outputs
        if values.requires_grad:
            factor = std**-2
            values.register_hook(lambda gradient: gradient * factor)
        return values if active is None else values * active

    def update(
        self, returns: npt.NDArray[np.floating], agents: npt.NDArray[np.integer] | None = None
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Update the statistics with more returns.

        :param returns: returns of any shape, on the raw scale
        :param agents: their agents, in the same shape, for statistics of each agent
        :return: conversion of values under the old statistics, ``scale * value + shift``: new standard deviation / old,
            and a shift in the units of returns, () or (N,) each
        :raises ValueError: for NaN or infinity
        """
        returns = np.asarray(returns, dtype=np.float64)
        if not np.isfinite(returns).all():
            raise ValueError("returns must be finite, got NaN or infinity; check the environment's rewards")
        old_mean, old_std = self.mean.double(), self.std.double()
        for index in range(self.mean.numel()):
            own = returns if self.mean.ndim == 0 else returns[agents == index]
            if not own.size:
                continue
            # Mean and variance of the two sets together.
            means, variances, counts = (values.view(-1) for values in (self.mean, self.var, self.count))
            n_old, mean_before, var_before = int(counts[index]), float(means[index]), float(variances[index])
            mean, share = float(own.mean()), own.size / (n_old + own.size)
            between = share * (1.0 - share) * (mean - mean_before) ** 2 if n_old else 0.0
            means[index] = mean_before + share * (mean - mean_before)
            variances[index] = math.fsum([(1.0 - share) * var_before, share * float(own.var()), between])
            counts[index] = n_old + own.size
        scale = self.std.double() / old_std
        return scale, self.mean.double() - scale * old_mean
