"""The algorithms by the names of the command line, the log folders and the YAML files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_saf.qplex.qplex import QPLEX
from sb3_saf.training.names import unknown_name


@dataclass(frozen=True)
class AlgorithmSpec:
    """
    What a name stands for.

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


#: A further algorithm is one more line here and one more file in ``zoo_configs``.
ALGOS: Final[dict[str, AlgorithmSpec]] = {
    "saf": AlgorithmSpec(PPO, "SAFPolicy", "saf"),
    "mappo": AlgorithmSpec(PPO, "MAPPOPolicy", "mappo"),
    "ippo": AlgorithmSpec(PPO, "IPPOPolicy", "ippo"),
    # Ablations read SAF's file: they differ in one argument and in nothing else.
    "saf-no-pool": AlgorithmSpec(PPO, "SAFPolicy", "saf", {"n_policies": 1}),
    "saf-no-ks": AlgorithmSpec(PPO, "SAFPolicy", "saf", {"knowledge_source": False}),
    "saf-lstm": AlgorithmSpec(RecurrentPPO, "SAFLstmPolicy", "saf-lstm"),
    "mappo-lstm": AlgorithmSpec(RecurrentPPO, "MAPPOLstmPolicy", "mappo-lstm"),
    "ippo-lstm": AlgorithmSpec(RecurrentPPO, "IPPOLstmPolicy", "ippo-lstm"),
    "qplex": AlgorithmSpec(QPLEX, "QPLEXPolicy", "qplex", {"mixer": "qplex"}),
    "qplex-pool": AlgorithmSpec(QPLEX, "QPLEXPoolPolicy", "qplex", {"mixer": "qplex"}),
    "qmix": AlgorithmSpec(QPLEX, "QPLEXPolicy", "qplex", {"mixer": "qmix"}),
    "vdn": AlgorithmSpec(QPLEX, "QPLEXPolicy", "qplex", {"mixer": "vdn"}),
}


def find_algorithm(algo: str) -> AlgorithmSpec:
    """
    Look up an algorithm.

    :raises ValueError: for an unknown name, with the nearest one
    """
    if algo not in ALGOS:
        raise unknown_name("algorithm", algo, ALGOS)
    return ALGOS[algo]
