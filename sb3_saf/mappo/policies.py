"""MAPPO: the actor of IPPO, and a critic that reads what the whole team sees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from sb3_saf.common.critic import JointStates, OwnValueHead, TeamCritic, TeamStates
from sb3_saf.common.parts import NetworkSpec, TeamParts
from sb3_saf.common.policies import TeamActorCriticPolicy
from sb3_saf.mappo.critic import JointCritic


@dataclass(frozen=True)
class MAPPOParts(TeamParts):
    """
    MAPPO's actor and critic.

    :param heads: ``"shared"`` for one actor and one critic that all agents use, ``"per_agent"`` for one each
    :param agent_identity: whether a shared critic on joint features reads, as a one-hot vector, whose value is asked;
        without it all agents of a team get the same value
    """

    agent_identity: bool = True

    def critic(self, spec: NetworkSpec) -> OwnValueHead | TeamCritic:
        """V_i from [z_1, ..., z_N]."""
        return JointCritic(
            spec.features_dim, spec.n_agents, spec.value_hidden, spec.activation_fn, self.heads, self.agent_identity
        )

    def team_states(self, spec: NetworkSpec) -> TeamStates | None:
        """[z_1, ..., z_N], and whose value is asked where one head serves all agents."""
        return self._joint(spec.features_dim, spec.n_agents)

    def _joint(self, features_dim: int, n_agents: int, members: TeamStates | None = None) -> JointStates:
        return JointStates(features_dim, n_agents, self.agent_identity and self.heads == "shared", members)


class MAPPOPolicy(TeamActorCriticPolicy):
    """
    Policy of multi-agent PPO with a central critic: ``PPO("MAPPOPolicy", env)``.

    It takes the arguments of :class:`TeamActorCriticPolicy` and, by keyword, those of :class:`MAPPOParts`.
    """

    parts_class: ClassVar[type[TeamParts]] = MAPPOParts

    @classmethod
    def paper_table_kwargs(cls) -> dict[str, Any]:
        """Arguments with which the parameter count is the paper's: one head per agent."""
        return {"heads": "per_agent"}
