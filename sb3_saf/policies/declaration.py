"""
What the file of an algorithm declares. Registration, command lines, the paper's table and the tests that sweep over all
algorithms read it, so that a further algorithm is one more file here (and its YAML in ``zoo_configs``, and its page).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from sb3_contrib import TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_saf.policies.base import TeamActorCriticPolicy
from sb3_saf.policies.maskable import TeamMaskablePolicy
from sb3_saf.policies.recurrent import TeamRecurrentPolicy

Policies = Mapping[type[BaseAlgorithm], tuple[type[BasePolicy], ...]]


@dataclass(frozen=True)
class AlgorithmSpec:
    """
    What a name of the command lines stands for.

    :param algorithm: the algorithm's class
    :param policy: name of its policy
    :param config: name of the YAML file in ``zoo_configs``, without ``.yml``
    :param policy_kwargs: what makes the policy this one; nothing overrides it
    """

    algorithm: type[BaseAlgorithm]
    policy: str
    config: str
    policy_kwargs: Mapping[str, Any] = field(default_factory=dict)

    @property
    def draws_actions(self) -> bool:
        """Whether drawn actions are the policy's own; those of off-policy algorithms are exploration."""
        return not issubclass(self.algorithm, OffPolicyAlgorithm)

    @property
    def policy_class(self) -> type[BasePolicy]:
        """The policy's class."""
        return self.algorithm.policy_aliases[self.policy]


class PaperTable(NamedTuple):
    """
    The algorithm's line in the paper's table of parameters.

    :param policy_kwargs: arguments with which a policy has as many parameters
    :param n_parameters: the paper's figure
    """

    policy_kwargs: Mapping[str, Any]
    n_parameters: int


@dataclass(frozen=True)
class Declaration:
    """
    An algorithm.

    :param name: what it is called, such as ``"SAF"``
    :param policies: its policy classes, by the algorithms of SB3 and sb3-contrib that train them; the first of each is
        also known as ``f"{name}Policy"`` and as ``name``
    :param commands: its names on command lines, in log folders and results
    :param paper_table: None for an algorithm that is not in it
    """

    name: str
    policies: Policies
    commands: Mapping[str, AlgorithmSpec]
    paper_table: PaperTable | None = None


def team_policies(
    policy: type[TeamActorCriticPolicy], recurrent: type[TeamRecurrentPolicy], maskable: type[TeamMaskablePolicy]
) -> Policies:
    """Return which algorithms train the policies that are made of one set of parts."""
    return {
        PPO: (policy,),
        A2C: (policy,),
        TRPO: (policy,),
        RecurrentPPO: (recurrent,),
        MaskablePPO: (maskable,),
    }
