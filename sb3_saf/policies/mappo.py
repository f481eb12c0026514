"""
MAPPO: the actor of IPPO, and a critic that reads the observations of the whole team.

Shared heads are MAPPO of the SAF paper's text ("the actor and critic parameters are shared across all agents") and of
its final code, a head for each agent that of its parameter table.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

import torch as th
from stable_baselines3 import PPO

from sb3_saf.networks.critic import Heads, JointValueHead, OwnValueHead, StateCritic, TeamCritic
from sb3_saf.networks.layers import NetworkSpec, Rows, gather
from sb3_saf.policies.base import TeamActorCriticPolicy, TeamMaskablePolicy
from sb3_saf.policies.parts import (
    AlgorithmSpec,
    CriticInput,
    Declaration,
    PaperTable,
    TeamParts,
    memory_variants,
    team_policies,
)
from sb3_saf.teams.checks import check_choice


class JointCritic(TeamCritic):
    """V_i from the concatenated features of all agents, [z_1, ..., z_N]."""

    def __init__(self, spec: NetworkSpec, parts: MAPPOParts):
        super().__init__(spec, 1, spec.n_agents * spec.features_dim)
        self.value_head = JointValueHead(spec, self.head_dim, parts.value_heads, parts.agent_identity)

    def states(self, features: th.Tensor, teams: Rows, active: th.Tensor | None = None) -> th.Tensor:
        """See :class:`TeamCritic`; (G, 1, N d), features of inactive agents are read as zeros."""
        members = gather(features, teams)
        if active is not None:
            members = members * active.unsqueeze(2)
        return members.flatten(1).unsqueeze(1)


class MeanCritic(TeamCritic):
    """V_i from an agent's own features and their mean over the team, [z_i, 1/N sum_j z_j], for teams of any size."""

    def __init__(self, spec: NetworkSpec, heads: Heads):
        super().__init__(spec, spec.n_agents, 2 * spec.features_dim)
        self.value_head = OwnValueHead(spec, self.head_dim, heads)

    def states(self, features: th.Tensor, teams: Rows, active: th.Tensor | None = None) -> th.Tensor:
        """See :class:`TeamCritic`; (G, N, 2 d), the mean over active agents only."""
        members = gather(features, teams)
        weights = th.ones(members.shape[:2], device=members.device) if active is None else active.to(members.dtype)
        sums = (members * weights.unsqueeze(2)).sum(dim=1)
        means = sums / weights.sum(dim=1, keepdim=True).clamp(min=1)
        return th.cat([members, means.unsqueeze(1).expand_as(members)], dim=2)


@dataclass(frozen=True)
class MAPPOParts(TeamParts):
    """
    MAPPO's actor and critic; other fields are those of :class:`TeamParts`.

    :param agent_identity: whether a shared critic on joint features reads the agent's index as a one-hot vector;
        without it all agents of a team get the same value
    :param critic_input: whether the critic reads the observations of the whole ``"team"`` (None), the agent's own and
        their ``"mean"``, or the ``"state"`` of the game (``make_team_env(..., state=True)``)
    """

    agent_identity: bool = True
    critic_input: CriticInput | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("critic_input", self.value_input, self.value_inputs)

    @property
    def value_input(self) -> CriticInput:
        """Input of the critic."""
        return self.critic_input or self.value_inputs[0]

    @property
    def value_inputs(self) -> tuple[CriticInput, ...]:
        """Possible inputs of the critic, the default first."""
        return "team", "mean", "state"

    def critic(self, spec: NetworkSpec) -> OwnValueHead | TeamCritic | StateCritic:
        """Make the critic: V_i from [z_1, ..., z_N], from z_i and their mean, or from the state."""
        if self.value_input == "state":
            return StateCritic(spec, self.value_heads, self.agent_identity)
        return MeanCritic(spec, self.value_heads) if self.value_input == "mean" else JointCritic(spec, self)


class MAPPOPolicy(TeamActorCriticPolicy):
    """Policy of PPO with a central critic, ``PPO("MAPPOPolicy", env)``; takes the fields of :class:`MAPPOParts`."""

    parts_class: ClassVar[type[TeamParts]] = MAPPOParts


class MAPPOMaskablePolicy(TeamMaskablePolicy):
    """MAPPO's parts for MaskablePPO; takes the fields of :class:`MAPPOParts` by keyword."""

    parts_class: ClassVar[type[TeamParts]] = MAPPOParts


DECLARATION: Final = Declaration(
    "MAPPO",
    team_policies(MAPPOPolicy, MAPPOMaskablePolicy),
    {
        "mappo": AlgorithmSpec(PPO, "MAPPOPolicy", "mappo"),
        # An actor and a critic for each agent: MAPPO of the paper's parameter table.
        "mappo-separate": AlgorithmSpec(PPO, "MAPPOPolicy", "mappo", {"heads": "per_agent"}),
        **memory_variants(AlgorithmSpec(PPO, "MAPPOPolicy", "mappo"), "mappo"),
    },
    PaperTable({"heads": "per_agent"}, 2_477_296),
)
