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

from sb3_saf.networks.critic import JointValueHead, OwnValueHead, StateCritic, TeamCritic
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
    """
    V_i from the concatenated features of all agents, [z_1, ..., z_N].

    :param spec: of the policy
    :param parts: ``heads`` and ``agent_identity``
    """

    def __init__(self, spec: NetworkSpec, parts: MAPPOParts):
        super().__init__(spec, 1, spec.n_agents * spec.features_dim)
        self.value_head = JointValueHead(spec, self.head_dim, parts.heads, parts.agent_identity)

    def states(self, features: th.Tensor, teams: Rows, active: th.Tensor | None = None) -> th.Tensor:
        """See :class:`TeamCritic`; (G, 1, N d), features of inactive agents are read as zeros."""
        members = gather(features, teams)
        if active is not None:
            members = members * active.unsqueeze(2)
        return members.flatten(1).unsqueeze(1)


@dataclass(frozen=True)
class MAPPOParts(TeamParts):
    """
    MAPPO's actor and critic.

    :param heads: ``"shared"`` for one actor and one critic that all agents use, ``"per_agent"`` for one each
    :param actor_identity: whether a shared actor reads the agent's index as a one-hot vector
    :param agent_identity: whether a shared critic on joint features reads the agent's index as a one-hot vector;
        without it all agents of a team get the same value
    :param critic_input: whether the critic reads the observations of the whole ``"team"``, or the ``"state"`` of the
        game (``make_team_env(..., state=True)``)
    """

    agent_identity: bool = True
    critic_input: CriticInput = "team"

    #: Possible inputs of the critic.
    critic_inputs: ClassVar[tuple[CriticInput, ...]] = ("team", "state")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("critic_input", self.critic_input, self.critic_inputs)

    def critic(self, spec: NetworkSpec) -> OwnValueHead | TeamCritic | StateCritic:
        """Make the critic: V_i from [z_1, ..., z_N], or from the state."""
        if self.critic_input == "state":
            return StateCritic(spec, self.heads, self.agent_identity)
        return JointCritic(spec, self)


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
