"""
Critics: value estimates for training.

Letters: K unique own observations, G unique teams, N agents, d features. Own observations and teams are separate
arguments (``features`` and ``teams``), so that functions of one observation are computed once each.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Literal, cast

import torch as th
from torch import nn

from sb3_saf.networks.layers import AgentHeads, NetworkSpec, Rows, gather, mlp, side_by_side

#: One head for all agents, or one for each.
Heads = Literal["shared", "per_agent"]


class TeamCritic(nn.Module, ABC):
    """Base of critics that read the observations of the whole team."""

    @abstractmethod
    def forward(self, features: th.Tensor, teams: Rows, active: th.Tensor | None = None) -> th.Tensor:
        """
        Return the value of every agent of every team.

        :param features: (K, d) features of own observations
        :param teams: (G, N), index into ``features`` of each agent of a team
        :param active: (G, N) bool, agents that take part; all if None
        :return: (G, N)
        """


class TeamStates(nn.Module, ABC):
    """
    Base of modules that compute a critic's state of each agent: the input of its value head, or of its LSTM.

    :param states_dim: S, size of a state
    """

    def __init__(self, states_dim: int):
        super().__init__()
        self.states_dim = states_dim

    @abstractmethod
    def states(self, features: th.Tensor, teams: Rows, active: th.Tensor | None = None) -> th.Tensor:
        """
        Return the state of every agent of every team.

        :param features: (K, d) features of own observations
        :param teams: (G, N), index into ``features`` of each agent of a team
        :param active: (G, N) bool, agents that take part; all if None
        :return: (G, N, S)
        """


class JointStates(TeamStates):
    """
    An agent's state is the concatenation of its team's states and its one-hot index.

    :param features_dim: d
    :param n_agents: N
    :param agent_identity: False omits the one-hot index: all agents of a team then have the same state
    :param members: computes each agent's own state, of size d; None for the features of its own observation
    """

    def __init__(self, features_dim: int, n_agents: int, agent_identity: bool, members: TeamStates | None = None):
        super().__init__(features_dim * n_agents + (n_agents if agent_identity else 0))
        self.agent_identity = agent_identity
        self.members = members

    def states(self, features: th.Tensor, teams: Rows, active: th.Tensor | None = None) -> th.Tensor:
        """See :class:`TeamStates`; inactive agents are read as zeros."""
        members = gather(features, teams) if self.members is None else self.members.states(features, teams, active)
        if active is not None:
            members = members * active.unsqueeze(2)
        n_teams, n_agents, _ = members.shape
        joint = members.flatten(1).unsqueeze(1).expand(-1, n_agents, -1)
        if not self.agent_identity:
            return joint
        return th.cat([joint, th.eye(n_agents, device=joint.device).expand(n_teams, -1, -1)], dim=2)


class StateCritic(nn.Module, ABC):
    """Base of critics that read only the state of the game."""

    @abstractmethod
    def forward(self, states: th.Tensor) -> th.Tensor:
        """
        Return the value of every agent of every game.

        :param states: (G, *state) states, as SB3 preprocesses observations
        :return: (G, N)
        """


class OwnValueHead(nn.Module):
    """
    Value of an agent from its own features.

    :param spec: spec of the policy
    :param features_dim: d
    :param heads: one head for all agents, or one for each
    """

    def __init__(self, spec: NetworkSpec, features_dim: int, heads: Heads):
        super().__init__()
        self.reads_agent = heads == "per_agent"

        def make_head() -> nn.Sequential:
            return mlp([features_dim, *spec.value_hidden, 1], spec.activation_fn)

        self.head: nn.Module = AgentHeads(make_head, spec.n_agents) if self.reads_agent else make_head()

    def forward(self, features: th.Tensor, agent: th.Tensor | None = None) -> th.Tensor:
        """
        Return values of single agents.

        :param features: (K, d)
        :param agent: (K,) int64 index of the agent, where ``reads_agent``
        :return: (K,)
        """
        values: th.Tensor = self.head(features, agent) if self.reads_agent else self.head(features)
        return values.squeeze(1)

    def of_teams(self, features: th.Tensor) -> th.Tensor:
        """
        Return values of whole teams.

        :param features: (G, N, d)
        :return: (G, N)
        """
        n_teams, n_agents, _ = features.shape
        agent = th.arange(n_agents, device=features.device).repeat(n_teams) if self.reads_agent else None
        values: th.Tensor = self(features.flatten(0, 1), agent)
        return values.view(n_teams, n_agents)


class JointValueHead(nn.Module):
    """
    Value of an agent from the features of its whole team.

    A head shared by all agents reads the agent's one-hot index; without it, all agents of a team get the same value.
    With one head per agent the index selects the head.

    :param spec: spec of the policy
    :param joint_dim: size of the joint features
    :param heads: one head for all agents, or one for each
    :param agent_identity: whether a shared head reads the agent's index
    """

    def __init__(self, spec: NetworkSpec, joint_dim: int, heads: Heads, agent_identity: bool):
        super().__init__()
        self.n_agents = spec.n_agents
        self.agent_identity = agent_identity and heads == "shared"
        n_inputs = joint_dim + (spec.n_agents if self.agent_identity else 0)
        n_heads = 1 if heads == "shared" else spec.n_agents
        self.heads = nn.ModuleList(mlp([n_inputs, *spec.value_hidden, 1], spec.activation_fn) for _ in range(n_heads))

    def forward(self, features: th.Tensor) -> th.Tensor:
        """
        Return values of whole teams.

        :param features: (G, N, d), or joint features of any other form (G, ...)
        :return: (G, N)
        """
        joint = features.flatten(1)
        if self.agent_identity:
            return self._with_identity(joint)
        if len(self.heads) == 1:
            of_team: th.Tensor = self.heads[0](joint)
            return of_team.expand(-1, self.n_agents)
        (values,) = side_by_side([cast(list[nn.Sequential], list(self.heads))], joint)
        return values.squeeze(2).t()

    def _with_identity(self, joint: th.Tensor) -> th.Tensor:
        """Return values (G, N) of [joint features, one-hot agent]; the joint part is computed once per team."""
        first, *rest = cast(nn.Sequential, self.heads[0])
        assert isinstance(first, nn.Linear)
        weight_joint, weight_agent = first.weight.split([joint.shape[1], self.n_agents], dim=1)
        x = nn.functional.linear(joint, weight_joint, first.bias).unsqueeze(1) + weight_agent.t()
        for layer in rest:
            x = layer(x)
        return x.squeeze(2)
