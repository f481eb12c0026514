"""SAF: a critic that reads from a knowledge source, and an actor that is a pool of policies (arXiv 2210.03022)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final, get_args

import torch as th
from stable_baselines3 import PPO
from torch import nn

from sb3_saf.networks.actor import ActorNetwork, PolicyPool, Selection
from sb3_saf.networks.critic import JointValueHead, OwnValueHead, StateCritic, TeamCritic
from sb3_saf.networks.knowledge_source import Exchanged, KnowledgeSource
from sb3_saf.networks.layers import NetworkSpec, Rows, gather, mlp, side_by_side
from sb3_saf.policies.base import TeamActorCriticPolicy, TeamMaskablePolicy
from sb3_saf.policies.ippo import own_critic
from sb3_saf.policies.mappo import MAPPOParts
from sb3_saf.policies.parts import (
    AlgorithmSpec,
    CriticInput,
    Declaration,
    PaperTable,
    TeamParts,
    memory_variants,
    team_policies,
)
from sb3_saf.teams.checks import check_choice, check_count


class SAFCritic(TeamCritic):
    """
    V_i from s_i^SAF (arXiv 2210.03022, section 5), or from those of the whole team.

    m'_i = g_theta(z_i), s_i = g_omega(z_i), slots written from m', m_i read with s_i, s_i^SAF = g_phi([s_i, m_i]).

    :param parts: ``critic_input``, ``heads``, ``agent_identity`` and sizes
    """

    def __init__(self, spec: NetworkSpec, parts: SAFParts):
        n_states = spec.n_agents if parts.value_input == "own" else 1
        state_dim = parts.latent_dim * spec.n_agents // n_states
        super().__init__(spec, n_states, state_dim)

        def projection(n_inputs: int) -> nn.Sequential:
            return mlp([n_inputs, *parts.projection_arch, parts.latent_dim], spec.activation_fn)

        self.message_net = projection(spec.features_dim)  # g_theta
        self.state_net = projection(spec.features_dim)  # g_omega
        self.knowledge_source = KnowledgeSource(spec.n_agents, parts.latent_dim, parts.n_slots)
        self.combine_net = projection(2 * parts.latent_dim)  # g_phi
        if parts.value_input == "own":
            self.value_head = OwnValueHead(spec, self.head_dim, parts.value_heads)
        else:
            self.value_head = JointValueHead(spec, self.head_dim, parts.value_heads, parts.agent_identity)

    def states(self, features: th.Tensor, teams: Rows, active: th.Tensor | None = None) -> th.Tensor:
        """See :class:`TeamCritic`; (G, N, d), or (G, 1, N d) with those of inactive agents read as zeros."""
        states, exchanged = self.communicate(features, teams, active)
        states = self.combine_net(th.cat([states, exchanged.read], dim=2))
        if isinstance(self.value_head, OwnValueHead):
            return states
        if active is not None:
            states = states * active.unsqueeze(2)
        return states.flatten(1).unsqueeze(1)

    def communicate(
        self, features: th.Tensor, teams: Rows, active: th.Tensor | None = None
    ) -> tuple[th.Tensor, Exchanged]:
        """
        Exchange the agents' messages through the knowledge source.

        :param features: (K, d) features of own observations
        :param teams: (G, N), index into ``features`` of each agent of a team
        :param active: (G, N) bool, agents that take part; all if None
        :return: s of every agent (G, N, d); messages read, and the attention of writing and reading
        """
        # g_theta and g_omega depend on one observation only: computed once per unique observation, then gathered.
        ((own_messages, own_states),) = side_by_side([[self.message_net, self.state_net]], features)
        messages, states = gather(own_messages, teams), gather(own_states, teams)
        return states, self.knowledge_source(messages, states, active)


@dataclass(frozen=True)
class SAFParts(MAPPOParts):
    """
    SAF's actor and critic, without pool and knowledge source MAPPO's; other fields are those of :class:`MAPPOParts`.

    :param heads: ``"shared"`` for one critic that all agents use, ``"per_agent"`` for one each. The pool is always
        shared; without pool there is one actor, or one for each agent
    :param actor_identity: whether pool and selection, or a shared actor, read the agent's index as a one-hot vector
    :param n_policies: U, size of the pool; 1 is the ablation without pool
    :param selection: ``"mixture"`` (exact likelihood) or ``"gumbel"`` (one policy, drawn at every evaluation)
    :param knowledge_source: False is the ablation without knowledge source: MAPPO's critic
    :param critic_input: whether the critic reads the agent's ``"own"`` s^SAF (None) or those of the whole ``"team"``.
        Without knowledge source it reads observations: the ``"team"``'s (None), the agent's own and their ``"mean"``,
        as MAPPO's, or its ``"own"``, as IPPO's. SAF's critic does not support the ``"state"`` of the game: all its
        information comes through the knowledge source
    :param n_slots: L, slots of the knowledge source
    :param latent_dim: d, size of messages, states, slots, queries and signature keys
    :param projection_arch: hidden sizes of g_theta, g_omega, g_phi and g_psel
    """

    n_policies: int = 4
    selection: Selection = "mixture"
    knowledge_source: bool = True
    n_slots: int = 4
    latent_dim: int = 64
    projection_arch: tuple[int, ...] = (128, 128)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("selection", self.selection, get_args(Selection))
        for name in ("n_policies", "n_slots", "latent_dim"):
            check_count(name, getattr(self, name))
        # Saved models may have a list.
        object.__setattr__(self, "projection_arch", tuple(self.projection_arch))

    @property
    def value_inputs(self) -> tuple[CriticInput, ...]:
        """See :class:`MAPPOParts`."""
        return ("own", "team") if self.knowledge_source else ("team", "mean", "own")

    def actor(self, spec: NetworkSpec) -> ActorNetwork:
        """Make the policy pool, or MAPPO's actor for a single policy."""
        if self.n_policies == 1:
            return super().actor(spec)
        arguments = (self.n_policies, self.selection, self.latent_dim, self.projection_arch)
        return PolicyPool(spec, *arguments, identity=self.actor_identity)

    def critic(self, spec: NetworkSpec) -> OwnValueHead | TeamCritic | StateCritic:
        """Make the critic: V_i from s_i^SAF, or without knowledge source MAPPO's or IPPO's."""
        if self.knowledge_source:
            return SAFCritic(spec, self)
        return own_critic(spec, self.value_heads) if self.value_input == "own" else super().critic(spec)


class SAFPolicy(TeamActorCriticPolicy):
    """Policy of SAF, ``PPO("SAFPolicy", env)``; takes the fields of :class:`SAFParts` by keyword."""

    parts_class: ClassVar[type[TeamParts]] = SAFParts


class SAFMaskablePolicy(TeamMaskablePolicy):
    """SAF's parts for MaskablePPO; takes the fields of :class:`SAFParts` by keyword."""

    parts_class: ClassVar[type[TeamParts]] = SAFParts


DECLARATION: Final = Declaration(
    "SAF",
    team_policies(SAFPolicy, SAFMaskablePolicy),
    {
        "saf": AlgorithmSpec(PPO, "SAFPolicy", "saf"),
        # Ablations use SAF's settings and differ in these arguments only.
        "saf-no-pool": AlgorithmSpec(PPO, "SAFPolicy", "saf", {"n_policies": 1}),
        # The paper's ablation: an actor for each agent, so that sharing is compared with not sharing.
        "saf-no-pool-separate": AlgorithmSpec(PPO, "SAFPolicy", "saf", {"n_policies": 1, "heads": "per_agent"}),
        "saf-no-ks": AlgorithmSpec(PPO, "SAFPolicy", "saf", {"knowledge_source": False}),
        **memory_variants(AlgorithmSpec(PPO, "SAFPolicy", "saf"), "saf"),
    },
    PaperTable({"heads": "per_agent", "critic_input": "team"}, 2_698_342),
)
