"""MAPPO's critic: an agent's value from what the whole team sees."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from torch import nn

from sb3_saf.networks.critic import Heads, JointValueHead, StateCritic, TeamCritic
from sb3_saf.networks.gather import gather
from sb3_saf.policies.extractors import ObservationEncoder


class JointCritic(TeamCritic):
    """
    V_i from the features of all agents side by side, [z_1, ..., z_N].

    :param features_dim: d
    :param n_agents: N
    :param hidden: sizes of the hidden layers
    :param activation_fn: activation of the hidden layers
    :param heads: one head for all agents, or one for each
    :param agent_identity: whether a shared head reads whose value is asked
    """

    def __init__(
        self,
        features_dim: int,
        n_agents: int,
        hidden: Sequence[int],
        activation_fn: type[nn.Module],
        heads: Heads,
        agent_identity: bool,
    ):
        super().__init__()
        self.value_head = JointValueHead(features_dim, n_agents, hidden, activation_fn, heads, agent_identity)

    def forward(self, features: th.Tensor, teams: th.Tensor, active: th.Tensor | None = None) -> th.Tensor:
        """See :class:`TeamCritic`; features of agents that take no part are read as zeros."""
        members = gather(features, teams)
        if active is not None:
            members = members * active.unsqueeze(2)
        values: th.Tensor = self.value_head(members)
        return values


class JointStateCritic(StateCritic):
    """
    V_i from the encoded state of the game.

    :param state_space: space of the state
    :param features_dim: size of the encoded state
    :param n_agents: N
    :param hidden: sizes of the hidden layers
    :param activation_fn: activation of the hidden layers
    :param heads: one head for all agents, or one for each
    :param agent_identity: whether a shared head reads whose value is asked
    """

    def __init__(
        self,
        state_space: spaces.Space[Any],
        features_dim: int,
        n_agents: int,
        hidden: Sequence[int],
        activation_fn: type[nn.Module],
        heads: Heads,
        agent_identity: bool,
    ):
        super().__init__()
        self.encoder = ObservationEncoder(state_space, features_dim)
        self.value_head = JointValueHead(
            features_dim, n_agents, hidden, activation_fn, heads, agent_identity, joint_dim=features_dim
        )

    def forward(self, states: th.Tensor) -> th.Tensor:
        """See :class:`StateCritic`."""
        values: th.Tensor = self.value_head(self.encoder(states))
        return values
