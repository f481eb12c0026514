"""SAF's critic: an agent's value from its own state and what it reads from the knowledge source."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch as th
from torch import nn

from sb3_saf.networks.critic import Heads, JointValueHead, OwnValueHead, TeamCritic, TeamStates
from sb3_saf.networks.gather import gather
from sb3_saf.networks.knowledge_source import Exchanged, KnowledgeSource
from sb3_saf.networks.layers import mlp
from sb3_saf.policies.parts import CriticInput


class Communicated(NamedTuple):
    """
    What every agent knows itself, and what went through the knowledge source.

    :param states: (G, N, d), s of every agent
    :param exchanged: messages read, and the attention of writing and reading
    """

    states: th.Tensor
    exchanged: Exchanged


class SAFStates(TeamStates):
    """
    s_i^SAF of every agent (arXiv 2210.03022, section 5):

    m'_i = g_theta(z_i), s_i = g_omega(z_i), slots written from m', m_i read with s_i, s_i^SAF = g_phi([s_i, m_i]).

    :param features_dim: size of z
    :param n_agents: N
    :param activation_fn: activation of all MLPs
    :param n_slots: L
    :param latent_dim: d, size of messages, states and slots
    :param projection_hidden: sizes of the hidden layers of g_theta, g_omega and g_phi
    """

    def __init__(
        self,
        features_dim: int,
        n_agents: int,
        activation_fn: type[nn.Module],
        n_slots: int,
        latent_dim: int,
        projection_hidden: Sequence[int],
    ):
        super().__init__(latent_dim)
        self.message_net = mlp([features_dim, *projection_hidden, latent_dim], activation_fn)
        self.state_net = mlp([features_dim, *projection_hidden, latent_dim], activation_fn)
        self.knowledge_source = KnowledgeSource(n_agents, latent_dim, n_slots)
        self.combine_net = mlp([2 * latent_dim, *projection_hidden, latent_dim], activation_fn)

    def states(self, features: th.Tensor, teams: th.Tensor, active: th.Tensor | None = None) -> th.Tensor:
        """See :class:`TeamStates`."""
        communicated = self.communicate(features, teams, active)
        return self.combine(communicated.states, communicated.exchanged.read)

    def communicate(self, features: th.Tensor, teams: th.Tensor, active: th.Tensor | None = None) -> Communicated:
        """
        Send every agent's message through the knowledge source.

        :param features: (K, d) features of views
        :param teams: (G, N) int64, which view each agent of a team has
        :param active: (G, N) bool, agents that take part; all if None
        """
        # g_theta and g_omega depend on one view only: once per view, then gathered.
        messages, states = gather(self.message_net(features), teams), gather(self.state_net(features), teams)
        return Communicated(states, self.knowledge_source.exchange(messages, states, active))

    def combine(self, states: th.Tensor, read: th.Tensor) -> th.Tensor:
        """
        s^SAF = g_phi([s, m]).

        :param states: (G, N, d), s of every agent
        :param read: (G, N, d), m of every agent: what it read, or what is to be tried in its place
        :return: (G, N, d)
        """
        combined: th.Tensor = self.combine_net(th.cat([states, read], dim=2))
        return combined


class SAFCritic(SAFStates, TeamCritic):
    """
    V_i from s_i^SAF, or from those of the whole team.

    :param features_dim: size of z
    :param n_agents: N
    :param hidden: sizes of the hidden layers of the value head
    :param activation_fn: activation of all MLPs
    :param heads: one value head for all agents, or one for each
    :param critic_input: whether the value head reads the agent's ``"own"`` s^SAF or those of the whole ``"team"``
    :param agent_identity: whether a shared head on the whole team reads whose value is asked
    :param n_slots: L
    :param latent_dim: d, size of messages, states and slots
    :param projection_hidden: sizes of the hidden layers of g_theta, g_omega and g_phi
    """

    def __init__(
        self,
        features_dim: int,
        n_agents: int,
        hidden: Sequence[int],
        activation_fn: type[nn.Module],
        heads: Heads,
        critic_input: CriticInput,
        agent_identity: bool,
        n_slots: int,
        latent_dim: int,
        projection_hidden: Sequence[int],
    ):
        super().__init__(features_dim, n_agents, activation_fn, n_slots, latent_dim, projection_hidden)
        self.value_head: OwnValueHead | JointValueHead
        if critic_input == "own":
            self.value_head = OwnValueHead(latent_dim, n_agents, hidden, activation_fn, heads)
        else:
            self.value_head = JointValueHead(latent_dim, n_agents, hidden, activation_fn, heads, agent_identity)

    def forward(self, features: th.Tensor, teams: th.Tensor, active: th.Tensor | None = None) -> th.Tensor:
        """See :class:`TeamCritic`."""
        return self.judge(self.states(features, teams, active), active)

    def judge(self, states: th.Tensor, active: th.Tensor | None = None) -> th.Tensor:
        """
        V_i of every agent.

        :param states: (G, N, d), s^SAF of every agent
        :param active: (G, N) bool, agents that take part; all if None
        :return: (G, N)
        """
        if isinstance(self.value_head, OwnValueHead):
            return self.value_head.of_teams(states)
        if active is not None:
            states = states * active.unsqueeze(2)
        values: th.Tensor = self.value_head(states)
        return values
