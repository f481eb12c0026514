"""A word to those who train SB3's own policies on teams by habit."""

from __future__ import annotations

import warnings

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import CombinedExtractor

from sb3_saf.callbacks.wrapping import AlgorithmClass, do_before
from sb3_saf.envs.teams import TEAM_KEY, TEAM_KEYS
from sb3_saf.policies.rows import TeamRowsPolicy


def warn_of_stock_policies(algorithm_class: AlgorithmClass) -> AlgorithmClass:
    """
    Let an algorithm warn when it begins to learn with ``"MultiInputPolicy"`` on teams.

    That policy reads all entries of a row, the team's view included, so that no agent could act on its own. As the
    policy of one learner that sees all it is fine, hence it may go on. SB3 has no door for this: it asks nobody when it
    puts a policy and an environment together, so ``learn`` of the class is wrapped. Calling it again changes nothing.

    :param algorithm_class: for instance PPO; its base classes are left alone
    :return: the same class
    """
    return do_before(algorithm_class, "learn", _warn_of_stock_policy)


def _warn_of_stock_policy(model: BaseAlgorithm) -> None:
    if not _reads_whole_rows(model):
        return
    own = sorted(name for name, policy in model.policy_aliases.items() if issubclass(policy, TeamRowsPolicy))
    warnings.warn(
        f"{type(model.policy).__name__} reads whole rows of teams: its actor sees {TEAM_KEY!r}, what all agents see, "
        f"so that agents cannot act on their own observations. Use a policy whose critic alone reads the team: "
        f"{', '.join(own)}, as in {type(model).__name__}({own[-1]!r}, env)",
        UserWarning,
        stacklevel=3,
    )


def _reads_whole_rows(model: BaseAlgorithm) -> bool:
    parts = getattr(model.observation_space, "spaces", {})
    return set(TEAM_KEYS) <= set(parts) and isinstance(
        getattr(model.policy, "features_extractor", None), CombinedExtractor
    )
