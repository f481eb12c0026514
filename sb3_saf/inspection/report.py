"""
From played episodes to numbers with names: the scalars of the TensorBoard page.

Tags are ``group/name``; a group is one box of the page. What a policy or an environment lacks is left out.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_saf.evaluation import confidence_interval
from sb3_saf.inspection.calibration import calibrate, lambda_returns, rmse
from sb3_saf.inspection.doors import ReturnScale
from sb3_saf.inspection.episodes import Played
from sb3_saf.inspection.insides import Replacement
from sb3_saf.inspection.knowledge import Attention, attention_of
from sb3_saf.inspection.pool import chosen_by, differences, mean_difference, selection_entropy, zone_dependence

Scalars = dict[str, float]

_TAG_WITHOUT: Final[dict[Replacement, str]] = {
    "zero": "message/value_error_zeroed",
    "shuffled": "message/value_error_shuffled",
}


def counted_agents(played: Played) -> npt.NDArray[np.int64]:
    """(n,) the agent of each row that counts."""
    n_steps, n_rows = played.counted.shape
    agents = np.tile(np.arange(played.n_agents), n_rows // played.n_agents)
    return np.broadcast_to(agents, (n_steps, n_rows))[played.counted]


def counted_games(played: Played) -> npt.NDArray[np.bool_]:
    """(T, E) whether a game was in an episode of the set."""
    return np.any(played.counted.reshape(len(played.counted), -1, played.n_agents), axis=2)


def team_scalars(played: Played, scale: ReturnScale) -> Scalars:
    """Team returns, with their 95 % interval."""
    returns = np.array(played.returns)
    scalars = {"team/return": float(returns.mean()), "team/episode_length": float(np.mean(played.lengths))}
    if len(returns) > 1:
        scalars["team/return_low"], scalars["team/return_high"] = confidence_interval(returns)
    if scale.best:
        scalars[f"team/share_of_{scale.unit or 'best_return'}"] = float(returns.mean()) / scale.best
    return scalars


def pool_scalars(played: Played, action_space: spaces.Space[object]) -> Scalars:
    """How often each policy is chosen, how decidedly, and how much policies differ."""
    if played.weights is None or played.actions is None:
        return {}
    weights = played.weights[played.counted]
    chosen = weights.mean(axis=0, dtype=np.float64)
    spread = selection_entropy(weights)
    scalars = {f"pool/chosen/policy_{policy}": float(share) for policy, share in enumerate(chosen)}
    scalars["pool/entropy"], scalars["pool/entropy_of_mean"] = spread.each, spread.mean
    scalars["pool/difference"] = mean_difference(differences(action_space, played.actions[played.counted]))
    return scalars | _zone_scalars(played, weights)


def _zone_scalars(played: Played, weights: npt.NDArray[np.float32]) -> Scalars:
    if played.zones is None:
        return {}
    zones = played.zones[played.counted]
    scalars = {
        f"pool_by_zone/zone_{zone}/policy_{policy}": float(share)
        for zone, shares in enumerate(chosen_by(weights, zones, int(zones.max(initial=-1)) + 1))
        for policy, share in enumerate(shares)
        if np.isfinite(share)
    }
    dependence = zone_dependence(weights, zones)
    return scalars if dependence is None else scalars | {"pool/zone_dependence": dependence}


def write_attention(played: Played) -> Attention | None:
    """Attention of slots over agents; None without a knowledge source."""
    return None if played.write is None else attention_of(played.write[counted_games(played)])


def read_attention(played: Played) -> Attention | None:
    """Attention of agents over slots; None without a knowledge source."""
    if played.read is None:
        return None
    # Readers that take no part are left out as queries without sources are.
    takes_part = played.counted.reshape(*played.read.shape[:3], 1)
    return attention_of((played.read * takes_part)[counted_games(played)])


def knowledge_scalars(played: Played) -> Scalars:
    """How concentrated writing and reading are, and how much each slot is read."""
    scalars: Scalars = {}
    read = read_attention(played)
    for name, attention in (("write", write_attention(played)), ("read", read)):
        if attention is not None and attention.entropy is not None and attention.entropy_of_mean is not None:
            scalars[f"knowledge_source/{name}_entropy"] = attention.entropy
            scalars[f"knowledge_source/{name}_entropy_of_mean"] = attention.entropy_of_mean
    if read is not None:
        for slot, share in enumerate(np.nanmean(read.mean, axis=0)):
            scalars[f"knowledge_source/read/slot_{slot}"] = float(share)
    return scalars


def critic_scalars(played: Played, gamma: float, gae_lambda: float) -> Scalars:
    """Values against discounted returns, and against the targets of training."""
    values, counted = played.values[played.counted], played.counted
    returns = lambda_returns(played, gamma)[counted]
    found = calibrate(values, returns)
    scalars: dict[str, float | None] = {
        "critic/mean_value": float(values.mean()),
        "critic/mean_return": float(returns.mean()),
        "critic/bias": found.bias,
        "critic/error": found.rmse,
        "critic/slope": found.slope,
        "critic/explained_variance": found.explained_variance,
        "critic/td_error": rmse(values, lambda_returns(played, gamma, 0.0)[counted]),
    }
    if gae_lambda != 1:
        target = lambda_returns(played, gamma, gae_lambda)[counted]
        scalars["critic/explained_variance_of_target"] = calibrate(values, target).explained_variance
    return {tag: value for tag, value in scalars.items() if value is not None}


def message_scalars(played: Played, gamma: float) -> Scalars:
    """The critic's error with the message that it read, and with others in its place."""
    if not played.values_without:
        return {}
    counted, returns = played.counted, lambda_returns(played, gamma)[played.counted]
    scalars = {"message/value_error": rmse(played.values[counted], returns)}
    for name, values in played.values_without.items():
        scalars[_TAG_WITHOUT[name]] = rmse(values[counted], returns)
    return scalars
