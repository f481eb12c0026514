"""
Base classes for algorithm files: the parts (actor and critic), and a declaration (policies and names).

Policy classes implement SB3's interfaces (PPO's, maskable ...); parts implement the algorithm. A policy
class names its parts and takes their fields as constructor arguments, so that each default is written once.

Registration, command lines, the paper's table and the tests of all algorithms read the declaration: a new algorithm is
one more file in this folder (with a YAML in ``zoo_configs``, and a page).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, NamedTuple, get_args

from sb3_contrib import TRPO, MaskablePPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_saf.networks.actor import ActorNetwork, SinglePolicy
from sb3_saf.networks.critic import Heads, OwnValueHead, StateCritic, TeamCritic
from sb3_saf.networks.layers import NetworkSpec
from sb3_saf.networks.memory import MEMORY_NAMES
from sb3_saf.teams.checks import check_choice, check_flag

#: Input of a critic: the agent's own features, the whole team's, its own and their mean, or the state of the game.
CriticInput = Literal["own", "team", "mean", "state"]

#: Policy classes by the algorithms that train them.
Policies = Mapping[type[BaseAlgorithm], tuple[type[BasePolicy], ...]]


@dataclass(frozen=True)
class TeamParts(ABC):
    """
    Base of all parts: the actor that MAPPO and IPPO share.

    :param heads: ``"shared"`` for one actor and one critic that all agents use, ``"per_agent"`` for one each
    :param critic_heads: the same for the critic alone; None for ``heads``
    :param actor_identity: whether a shared actor reads the agent's index as a one-hot vector: for teams with roles that
        observations do not show. Off by default, because such a model needs the agent's index to act, and was not
        reliably better if observations distinguish agents (measured in docs/reference/own_environment.md)
    """

    heads: Heads = "shared"
    critic_heads: Heads | None = None
    actor_identity: bool = False

    def __post_init__(self) -> None:
        check_choice("heads", self.heads, get_args(Heads))
        check_choice("critic_heads", self.critic_heads, (*get_args(Heads), None))
        for flag in [one.name for one in fields(self) if isinstance(one.default, bool)]:
            check_flag(flag, getattr(self, flag))

    @property
    def value_heads(self) -> Heads:
        """Heads of the critic."""
        return self.critic_heads or self.heads

    def actor(self, spec: NetworkSpec) -> ActorNetwork:
        """Make the actor; separate actors do not need the agent's index."""
        return SinglePolicy(spec, self.heads == "per_agent", self.actor_identity)

    @abstractmethod
    def critic(self, spec: NetworkSpec) -> OwnValueHead | TeamCritic | StateCritic:
        """Make the critic."""


@dataclass(frozen=True)
class AlgorithmSpec:
    """
    Algorithm behind a name of the command lines.

    :param algorithm: the algorithm's class
    :param policy: name of its policy
    :param config: name of the YAML file in ``zoo_configs``, without ``.yml``
    :param policy_kwargs: fixed policy arguments, which cannot be overridden
    """

    algorithm: type[BaseAlgorithm]
    policy: str
    config: str
    policy_kwargs: Mapping[str, Any] = field(default_factory=dict)

    @property
    def draws_actions(self) -> bool:
        """Whether sampled actions come from the policy; those of off-policy algorithms are exploration."""
        return not issubclass(self.algorithm, OffPolicyAlgorithm)

    @property
    def policy_class(self) -> type[BasePolicy]:
        """The policy's class."""
        return self.algorithm.policy_aliases[self.policy]


class PaperTable(NamedTuple):
    """
    The algorithm's line in the paper's table of parameters.

    :param policy_kwargs: arguments with which a policy has as many parameters
    :param n_parameters: number of parameters in the paper
    """

    policy_kwargs: Mapping[str, Any]
    n_parameters: int


@dataclass(frozen=True)
class Declaration:
    """
    Declaration of an algorithm.

    :param name: its name, such as ``"SAF"``
    :param policies: its policy classes, by the algorithms of SB3 and sb3-contrib that train them; the first of each is
        also registered as ``f"{name}Policy"``, ``name`` and ``name`` in lower case
    :param commands: its names on command lines, in log folders and results
    :param paper_table: None for an algorithm that is not in it
    """

    name: str
    policies: Policies
    commands: Mapping[str, AlgorithmSpec]
    paper_table: PaperTable | None = None


def team_policies(policy: type[BasePolicy], maskable: type[BasePolicy]) -> Policies:
    """Return the policies of one set of parts by the algorithms that train them."""
    return {PPO: (policy,), A2C: (policy,), TRPO: (policy,), MaskablePPO: (maskable,)}


def memory_variants(spec: AlgorithmSpec, name: str) -> dict[str, AlgorithmSpec]:
    """Return the variants with memory, ``"name-gru"`` and ``"name-lstm"``."""
    kwargs = {kind: {**spec.policy_kwargs, "memory": kind} for kind in MEMORY_NAMES}
    return {f"{name}-{kind}": replace(spec, policy_kwargs=kwargs[kind]) for kind in MEMORY_NAMES}
