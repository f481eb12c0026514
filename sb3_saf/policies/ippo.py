"""
IPPO: independent agents with shared weights; actor and critic read the agent's own observation.

The SAF paper's IPPO has a head for each agent ("IPPO trains separate networks"): ``heads="per_agent"``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO

from sb3_saf.networks.critic import OwnValueHead
from sb3_saf.networks.layers import NetworkSpec
from sb3_saf.policies.base import TeamActorCriticPolicy, TeamMaskablePolicy
from sb3_saf.policies.parts import AlgorithmSpec, Declaration, PaperTable, TeamParts, team_policies
from sb3_saf.policies.recurrent import TeamRecurrentPolicy


@dataclass(frozen=True)
class IPPOParts(TeamParts):
    """
    IPPO's actor and critic.

    :param heads: ``"shared"`` for one actor and one critic that all agents use, ``"per_agent"`` for one each
    :param actor_identity: whether a shared actor reads the agent's index as a one-hot vector
    """

    def critic(self, spec: NetworkSpec) -> OwnValueHead:
        """Make the critic: V_i from z_i."""
        return OwnValueHead(spec, spec.features_dim, self.heads)


class IPPOPolicy(TeamActorCriticPolicy):
    """Policy of independent PPO, ``PPO("IPPOPolicy", env)``; takes the fields of :class:`IPPOParts` by keyword."""

    parts_class: ClassVar[type[TeamParts]] = IPPOParts


class IPPOLstmPolicy(TeamRecurrentPolicy):
    """IPPO's parts for RecurrentPPO; takes the fields of :class:`IPPOParts` by keyword."""

    parts_class: ClassVar[type[TeamParts]] = IPPOParts


class IPPOMaskablePolicy(TeamMaskablePolicy):
    """IPPO's parts for MaskablePPO; takes the fields of :class:`IPPOParts` by keyword."""

    parts_class: ClassVar[type[TeamParts]] = IPPOParts


DECLARATION: Final = Declaration(
    "IPPO",
    team_policies(IPPOPolicy, IPPOLstmPolicy, IPPOMaskablePolicy),
    {
        "ippo": AlgorithmSpec(PPO, "IPPOPolicy", "ippo"),
        # The paper's IPPO: an actor and a critic for each agent.
        "ippo-separate": AlgorithmSpec(PPO, "IPPOPolicy", "ippo", {"heads": "per_agent"}),
        "ippo-lstm": AlgorithmSpec(RecurrentPPO, "IPPOLstmPolicy", "ippo-lstm"),
    },
    PaperTable({"heads": "per_agent"}, 1_740_016),
)
