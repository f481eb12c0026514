"""MAPPO: the actor of IPPO, and a critic that reads what the whole team sees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from gymnasium import spaces

from sb3_saf.envs.teams import STATE_KEY
from sb3_saf.networks.critic import JointStates, OwnValueHead, StateCritic, TeamCritic, TeamStates
from sb3_saf.policies.base import TeamActorCriticPolicy
from sb3_saf.policies.mappo_critic import JointCritic, JointStateCritic
from sb3_saf.policies.parts import CriticInput, NetworkSpec, TeamParts, check_choice


@dataclass(frozen=True)
class MAPPOParts(TeamParts):
    """
    MAPPO's actor and critic.

    :param heads: ``"shared"`` for one actor and one critic that all agents use, ``"per_agent"`` for one each
    :param agent_identity: whether a shared critic on joint features reads, as a one-hot vector, whose value is asked;
        without it all agents of a team get the same value
    :param critic_input: whether the critic reads what the whole ``"team"`` sees, or the ``"state"`` of the game
        (``make_team_env(..., state=True)``)
    """

    agent_identity: bool = True
    critic_input: CriticInput = "team"

    #: What the critic may read.
    critic_inputs: ClassVar[tuple[CriticInput, ...]] = ("team", "state")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("critic_input", self.critic_input, self.critic_inputs)

    def critic(self, spec: NetworkSpec) -> OwnValueHead | TeamCritic | StateCritic:
        """V_i from [z_1, ..., z_N], or from the state."""
        if self.critic_input == "state":
            return JointStateCritic(
                _required(spec.state_space),
                spec.features_dim,
                spec.n_agents,
                spec.value_hidden,
                spec.activation_fn,
                self.heads,
                self.agent_identity,
            )
        return JointCritic(
            spec.features_dim, spec.n_agents, spec.value_hidden, spec.activation_fn, self.heads, self.agent_identity
        )

    def team_states(self, spec: NetworkSpec) -> TeamStates | None:
        """[z_1, ..., z_N], and whose value is asked where one head serves all agents."""
        if self.critic_input == "state":
            raise ValueError(
                "critic_input='state' has no critic with memory; pass enable_critic_lstm=False, or leave critic_input "
                "out"
            )
        return self._joint(spec.features_dim, spec.n_agents)

    def _joint(self, features_dim: int, n_agents: int, members: TeamStates | None = None) -> JointStates:
        return JointStates(features_dim, n_agents, self.agent_identity and self.heads == "shared", members)


def _required(state_space: spaces.Space[Any] | None) -> spaces.Space[Any]:
    if state_space is None:
        raise ValueError(
            f"critic_input='state' needs observations with {STATE_KEY!r}, and these have none; build the environment "
            "with sb3_saf.make_team_env(..., state=True), or leave critic_input out"
        )
    return state_space


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
