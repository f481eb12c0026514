"""
IPPO: independent agents with shared weights; actor and critic read the agent's own observation.

The SAF paper's IPPO has a head for each agent ("IPPO trains separate networks"): ``heads="per_agent"``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final

import torch as th
from stable_baselines3 import PPO

from sb3_saf.networks.critic import Heads, OwnValueHead, TeamCritic
from sb3_saf.networks.layers import NetworkSpec, Rows, gather
from sb3_saf.policies.base import TeamActorCriticPolicy, TeamMaskablePolicy
from sb3_saf.policies.parts import AlgorithmSpec, Declaration, PaperTable, TeamParts, memory_variants, team_policies


class OwnCritic(TeamCritic):
    """V_i from the memory of z_i, of all agents of a team at once; ``spec`` has a memory."""

    def __init__(self, spec: NetworkSpec, heads: Heads):
        super().__init__(spec, spec.n_agents, spec.features_dim)
        self.value_head = OwnValueHead(spec, self.head_dim, heads)

    def states(self, features: th.Tensor, teams: Rows, active: th.Tensor | None = None) -> th.Tensor:
        """See :class:`TeamCritic`; (G, N, d)."""
        return gather(features, teams)


def own_critic(spec: NetworkSpec, heads: Heads) -> OwnValueHead | TeamCritic:
    """Make the critic that reads z_i, or its memory."""
    return OwnValueHead(spec, spec.features_dim, heads) if spec.memory is None else OwnCritic(spec, heads)


@dataclass(frozen=True)
class IPPOParts(TeamParts):
    """IPPO's actor and critic, with the fields of :class:`TeamParts`."""

    def critic(self, spec: NetworkSpec) -> OwnValueHead | TeamCritic:
        """Make the critic: V_i from z_i."""
        return own_critic(spec, self.value_heads)


class IPPOPolicy(TeamActorCriticPolicy):
    """Policy of independent PPO, ``PPO("IPPOPolicy", env)``; takes the fields of :class:`IPPOParts` by keyword."""

    parts_class: ClassVar[type[TeamParts]] = IPPOParts


class IPPOMaskablePolicy(TeamMaskablePolicy):
    """IPPO's parts for MaskablePPO; takes the fields of :class:`IPPOParts` by keyword."""

    parts_class: ClassVar[type[TeamParts]] = IPPOParts


DECLARATION: Final = Declaration(
    "IPPO",
    team_policies(IPPOPolicy, IPPOMaskablePolicy),
    {
        "ippo": AlgorithmSpec(PPO, "IPPOPolicy", "ippo"),
        # The paper's IPPO: an actor and a critic for each agent.
        "ippo-separate": AlgorithmSpec(PPO, "IPPOPolicy", "ippo", {"heads": "per_agent"}),
        **memory_variants(AlgorithmSpec(PPO, "IPPOPolicy", "ippo"), "ippo"),
    },
    PaperTable({"heads": "per_agent"}, 1_740_016),
)
