"""IPPO: independent agents that share weights; actor and critic read the agent's own observation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from sb3_saf.networks.critic import OwnValueHead
from sb3_saf.policies.base import TeamActorCriticPolicy
from sb3_saf.policies.ippo_critic import OwnCritic
from sb3_saf.policies.parts import NetworkSpec, TeamParts


@dataclass(frozen=True)
class IPPOParts(TeamParts):
    """
    IPPO's actor and critic.

    :param heads: ``"shared"`` for one actor and one critic that all agents use, ``"per_agent"`` for one each
    """

    def critic(self, spec: NetworkSpec) -> OwnValueHead:
        """V_i from z_i."""
        return OwnCritic(spec.features_dim, spec.n_agents, spec.value_hidden, spec.activation_fn, self.heads)


class IPPOPolicy(TeamActorCriticPolicy):
    """
    Policy of independent PPO for teams: ``PPO("IPPOPolicy", env)``.

    It takes the arguments of :class:`TeamActorCriticPolicy` and, by keyword, those of :class:`IPPOParts`.
    """

    parts_class: ClassVar[type[TeamParts]] = IPPOParts

    @classmethod
    def paper_table_kwargs(cls) -> dict[str, Any]:
        """Arguments with which the parameter count is the paper's: one head per agent."""
        return {"heads": "per_agent"}
