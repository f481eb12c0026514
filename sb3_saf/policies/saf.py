"""SAF: a critic that reads from a knowledge source, and an actor that is a pool of policies (arXiv 2210.03022)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, get_args

from sb3_saf.networks.actor import ActorNetwork
from sb3_saf.networks.critic import OwnValueHead, StateCritic, TeamCritic, TeamStates
from sb3_saf.networks.policy_pool import PolicyPool, Selection
from sb3_saf.policies.base import TeamActorCriticPolicy
from sb3_saf.policies.mappo import MAPPOParts
from sb3_saf.policies.parts import CriticInput, NetworkSpec, TeamParts, check_at_least_one, check_choice
from sb3_saf.policies.saf_critic import SAFCritic, SAFStates


@dataclass(frozen=True)
class SAFParts(MAPPOParts):
    """
    SAF's actor and critic. Without pool and without knowledge source they are MAPPO's.

    :param heads: ``"shared"`` for one critic that all agents use, ``"per_agent"`` for one each. The pool is always
        shared; without pool there is one actor, or one for each agent
    :param agent_identity: whether a shared critic on joint features reads, as a one-hot vector, whose value is asked
    :param n_policies: U, size of the pool; 1 is the ablation without pool
    :param selection: ``"mixture"`` (exact likelihood) or ``"gumbel"`` (one policy, drawn at every evaluation)
    :param knowledge_source: False is the ablation without knowledge source: MAPPO's critic
    :param critic_input: whether the critic reads the agent's ``"own"`` s^SAF or those of the whole ``"team"``; without
        knowledge source it is MAPPO's, on the team. SAF's critic does not read the ``"state"`` of the game: what it
        knows of the game comes through the knowledge source
    :param n_slots: L, slots of the knowledge source
    :param latent_dim: d, size of messages, states, slots, queries and signature keys
    :param projection_arch: hidden sizes of g_theta, g_omega, g_phi and g_psel
    """

    n_policies: int = 4
    selection: Selection = "mixture"
    knowledge_source: bool = True
    critic_input: CriticInput = "own"
    n_slots: int = 4
    latent_dim: int = 64
    projection_arch: tuple[int, ...] = (128, 128)

    critic_inputs: ClassVar[tuple[CriticInput, ...]] = ("own", "team")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("selection", self.selection, get_args(Selection))
        for name in ("n_policies", "n_slots", "latent_dim"):
            check_at_least_one(name, getattr(self, name))
        # Saved models may bring a list.
        object.__setattr__(self, "projection_arch", tuple(self.projection_arch))

    def actor(self, spec: NetworkSpec) -> ActorNetwork:
        """The policy pool; with a single policy there is nothing to select, and the actor is MAPPO's."""
        if self.n_policies == 1:
            return super().actor(spec)
        return PolicyPool(
            spec.features_dim,
            spec.action_space,
            spec.actor_hidden,
            spec.activation_fn,
            n_policies=self.n_policies,
            selection=self.selection,
            latent_dim=self.latent_dim,
            projection_hidden=self.projection_arch,
            log_std_init=spec.log_std_init,
        )

    def critic(self, spec: NetworkSpec) -> OwnValueHead | TeamCritic | StateCritic:
        """V_i from s_i^SAF."""
        if not self.knowledge_source:
            return super().critic(spec)
        return SAFCritic(
            spec.features_dim,
            spec.n_agents,
            spec.value_hidden,
            spec.activation_fn,
            heads=self.heads,
            critic_input=self.critic_input,
            agent_identity=self.agent_identity,
            n_slots=self.n_slots,
            latent_dim=self.latent_dim,
            projection_hidden=self.projection_arch,
        )

    def team_states(self, spec: NetworkSpec) -> TeamStates | None:
        """s_i^SAF, or those of all agents."""
        if not self.knowledge_source:
            return super().team_states(spec)
        states = SAFStates(
            spec.features_dim,
            spec.n_agents,
            spec.activation_fn,
            n_slots=self.n_slots,
            latent_dim=self.latent_dim,
            projection_hidden=self.projection_arch,
        )
        return states if self.critic_input == "own" else self._joint(self.latent_dim, spec.n_agents, states)


class SAFPolicy(TeamActorCriticPolicy):
    """
    Policy of SAF: ``PPO("SAFPolicy", env)``.

    It takes the arguments of :class:`TeamActorCriticPolicy` and, by keyword, those of :class:`SAFParts`.
    """

    parts_class: ClassVar[type[TeamParts]] = SAFParts

    @classmethod
    def paper_table_kwargs(cls) -> dict[str, Any]:
        """Arguments with which the parameter count is the paper's: one critic per agent, on all agents' s^SAF."""
        return {"heads": "per_agent", "critic_input": "team"}
