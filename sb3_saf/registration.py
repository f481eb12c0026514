"""Makes the policies known to algorithms by name, as SB3 knows "MlpPolicy"."""

from __future__ import annotations

import warnings
from typing import Final

from sb3_contrib import TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_saf.callbacks.game_steps import log_game_steps
from sb3_saf.policies.ippo import IPPOPolicy
from sb3_saf.policies.mappo import MAPPOPolicy
from sb3_saf.policies.maskable import IPPOMaskablePolicy, MAPPOMaskablePolicy, SAFMaskablePolicy
from sb3_saf.policies.recurrent import IPPOLstmPolicy, MAPPOLstmPolicy, SAFLstmPolicy
from sb3_saf.policies.saf import SAFPolicy
from sb3_saf.policies.stock_policies import warn_of_stock_policies
from sb3_saf.qplex.policies import QPLEXLstmPolicy, QPLEXPolicy, QPLEXPoolPolicy
from sb3_saf.qplex.qplex import QPLEX

#: Which names each algorithm learns. SB3 keeps one dict per algorithm.
POLICIES: Final[dict[type[BaseAlgorithm], dict[str, type[BasePolicy]]]] = {
    algorithm: {policy.__name__: policy for policy in policies}
    for algorithm, policies in (
        (PPO, (IPPOPolicy, MAPPOPolicy, SAFPolicy)),
        (A2C, (IPPOPolicy, MAPPOPolicy, SAFPolicy)),
        (TRPO, (IPPOPolicy, MAPPOPolicy, SAFPolicy)),
        (RecurrentPPO, (IPPOLstmPolicy, MAPPOLstmPolicy, SAFLstmPolicy)),
        (QPLEX, (QPLEXLstmPolicy, QPLEXPolicy, QPLEXPoolPolicy)),
        (MaskablePPO, (IPPOMaskablePolicy, MAPPOMaskablePolicy, SAFMaskablePolicy)),
    )
}


def register(algorithm: type[BaseAlgorithm], name: str, policy: type[BasePolicy]) -> None:
    """
    Let an algorithm know a policy by name. A name that belongs to another policy stays with it, with a warning.

    :param algorithm: class with ``policy_aliases``
    :param name: what users type
    :param policy: the policy class
    """
    known = algorithm.policy_aliases.setdefault(name, policy)
    if (known.__module__, known.__qualname__) == (policy.__module__, policy.__qualname__):
        algorithm.policy_aliases[name] = policy  # also after a reload of the module
        return
    warnings.warn(
        f"{algorithm.__name__} already knows another policy by the name {name!r}, "
        f"{known.__module__}.{known.__qualname__}; pass the class {policy.__module__}.{policy.__qualname__} instead "
        "of its name",
        stacklevel=2,
    )


def register_all() -> None:
    """
    Register every policy, log game steps beside SB3's rows, and warn of SB3's own policies on teams; done when
    ``sb3_saf`` is imported.
    """
    for algorithm, policies in POLICIES.items():
        log_game_steps(algorithm)
        warn_of_stock_policies(algorithm)
        for name, policy in policies.items():
            register(algorithm, name, policy)
