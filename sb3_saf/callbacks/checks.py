"""Check how an algorithm, a policy, a buffer and an environment of teams were put together."""

from __future__ import annotations

import warnings

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import CombinedExtractor

from sb3_saf.buffers.rollout import TeamRolloutBuffer
from sb3_saf.envs.teams import TEAM_KEY, TEAM_KEYS
from sb3_saf.policies.rows import TeamRowsPolicy


def check_training(model: BaseAlgorithm) -> None:
    """
    Check a model before it learns; the callbacks of this package call it.

    SB3's own ``"MultiInputPolicy"`` reads all entries of a row, what the whole team sees included, so that no agent
    could act on its own observation: a warning says so. It may go on, as the policy of one learner that sees all.

    :param model: any algorithm on any environment
    :raises ValueError: if minibatches cannot hold whole teams, with batch sizes that can
    """
    buffer, batch_size = getattr(model, "rollout_buffer", None), getattr(model, "batch_size", None)
    if isinstance(buffer, TeamRolloutBuffer) and batch_size is not None:
        buffer.check_batch_size(batch_size)
    entries = getattr(model.observation_space, "spaces", {})
    extractor = getattr(model.policy, "features_extractor", None)
    if set(TEAM_KEYS) <= set(entries) and isinstance(extractor, CombinedExtractor):
        own = sorted(
            name
            for name, policy in model.policy_aliases.items()
            if issubclass(policy, TeamRowsPolicy) and name == policy.__name__
        )
        warnings.warn(
            f"{type(model.policy).__name__} reads whole rows of teams: its actor sees {TEAM_KEY!r}, what all agents "
            "see, so that agents cannot act on their own observations. Use a policy whose critic alone reads the team: "
            f"{', '.join(own)}, as in {type(model).__name__}({own[-1]!r}, env)",
            UserWarning,
            stacklevel=3,
        )
