"""
Scalars of the TensorBoard page, from a recording.

Tags are ``group/name``; a group is one box of the page. Scalars that a policy or an environment lacks are omitted.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_saf.evaluation import confidence_interval
from sb3_saf.inspection.calibration import calibrate, lambda_returns, rmse
from sb3_saf.inspection.games import ReturnScale
from sb3_saf.inspection.pool import (
    chosen_by,
    differences,
    entropy,
    mean_difference,
    selection_entropy,
    zone_dependence,
)
from sb3_saf.inspection.reading import Replacement
from sb3_saf.inspection.recording import EpisodeRecording

Scalars = dict[str, float]

_TAG_WITHOUT: Final[dict[Replacement, str]] = {
    "zero": "message/value_error_zeroed",
    "shuffled": "message/value_error_shuffled",
}


class Attention(NamedTuple):
    """
    Attention of queries over sources, over many teams.

    :param mean: (Q, S) mean weights; rows sum to 1
    :param entropy: mean entropy of one query's weights, divided by log S: 0 if one source has all weight, 1 for uniform
        weights; None if there is only one source
    :param entropy_of_mean: entropy of a query's mean weights, divided by log S, mean over queries; None for a single
        source. Higher than ``entropy`` if the attended source changes
    """

    mean: npt.NDArray[np.float64]
    entropy: float | None
    entropy_of_mean: float | None


def attention_of(weights: npt.NDArray[np.floating[Any]]) -> Attention:
    """Summarise attention (n, Q, S); queries without any source (zeros) are excluded."""
    shown = weights.sum(axis=2) > 0
    n_sources = weights.shape[2]
    with np.errstate(invalid="ignore"):
        mean = weights.sum(axis=0, dtype=np.float64) / shown.sum(axis=0)[:, np.newaxis]
    if n_sources == 1 or not shown.any():
        return Attention(mean, None, None)
    scale = math.log(n_sources)
    seen = shown.any(axis=0)
    return Attention(mean, float(entropy(weights)[shown].mean()) / scale, float(entropy(mean[seen]).mean()) / scale)


def counted_agents(recording: EpisodeRecording) -> npt.NDArray[np.int64]:
    """Return the agent of each counted row, (n,)."""
    n_steps, n_rows = recording.counted.shape
    agents = np.tile(np.arange(recording.n_agents), n_rows // recording.n_agents)
    return np.broadcast_to(agents, (n_steps, n_rows))[recording.counted]


def counted_games(recording: EpisodeRecording) -> npt.NDArray[np.bool_]:
    """Return whether a game was in a recorded episode, (T, E)."""
    return np.any(recording.counted.reshape(len(recording.counted), -1, recording.n_agents), axis=2)


def team_scalars(recording: EpisodeRecording, scale: ReturnScale) -> Scalars:
    """Compute the mean team return with its 95 % interval."""
    returns = np.array(recording.episode_returns)
    scalars = {"team/return": float(returns.mean()), "team/episode_length": float(np.mean(recording.episode_lengths))}
    if len(returns) > 1:
        scalars["team/return_low"], scalars["team/return_high"] = confidence_interval(returns)
    if scale.best:
        scalars[f"team/share_of_{scale.unit or 'best_return'}"] = float(returns.mean()) / scale.best
    return scalars


def pool_scalars(recording: EpisodeRecording, action_space: spaces.Space[object]) -> Scalars:
    """Compute how often each policy is selected, the entropy of selection, and the differences between policies."""
    if recording.pool_weights is None or recording.pool_actions is None:
        return {}
    weights = recording.pool_weights[recording.counted]
    chosen = weights.mean(axis=0, dtype=np.float64)
    spread = selection_entropy(weights)
    scalars = {f"pool/chosen/policy_{policy}": float(share) for policy, share in enumerate(chosen)}
    scalars["pool/entropy"], scalars["pool/entropy_of_mean"] = spread.each, spread.mean
    scalars["pool/difference"] = mean_difference(differences(action_space, recording.pool_actions[recording.counted]))
    return scalars | _zone_scalars(recording, weights)


def _zone_scalars(recording: EpisodeRecording, weights: npt.NDArray[np.float32]) -> Scalars:
    if recording.zones is None:
        return {}
    zones = recording.zones[recording.counted]
    scalars = {
        f"pool_by_zone/zone_{zone}/policy_{policy}": float(share)
        for zone, shares in enumerate(chosen_by(weights, zones, int(zones.max(initial=-1)) + 1))
        for policy, share in enumerate(shares)
        if np.isfinite(share)
    }
    dependence = zone_dependence(weights, zones)
    return scalars if dependence is None else scalars | {"pool/zone_dependence": dependence}


def write_attention(recording: EpisodeRecording) -> Attention | None:
    """Summarise the attention of slots over agents; None without a knowledge source."""
    if recording.write_attention is None:
        return None
    return attention_of(recording.write_attention[counted_games(recording)])


def read_attention(recording: EpisodeRecording) -> Attention | None:
    """Summarise the attention of agents over slots; None without a knowledge source."""
    if recording.read_attention is None:
        return None
    # Inactive readers are excluded, like queries without sources.
    takes_part = recording.counted.reshape(*recording.read_attention.shape[:3], 1)
    return attention_of((recording.read_attention * takes_part)[counted_games(recording)])


def knowledge_scalars(recording: EpisodeRecording) -> Scalars:
    """Compute the concentration of writing and reading, and the attention to each slot."""
    scalars: Scalars = {}
    read = read_attention(recording)
    for name, attention in (("write", write_attention(recording)), ("read", read)):
        if attention is not None and attention.entropy is not None and attention.entropy_of_mean is not None:
            scalars[f"knowledge_source/{name}_entropy"] = attention.entropy
            scalars[f"knowledge_source/{name}_entropy_of_mean"] = attention.entropy_of_mean
    if read is not None:
        for slot, share in enumerate(np.nanmean(read.mean, axis=0)):
            scalars[f"knowledge_source/read/slot_{slot}"] = float(share)
    return scalars


def critic_scalars(recording: EpisodeRecording, gae_lambda: float) -> Scalars:
    """Compare values with discounted returns, and with the targets of training."""
    counted = recording.counted
    values, returns = recording.values[counted], recording.returns[counted]
    found = calibrate(values, returns)
    scalars: dict[str, float | None] = {
        "critic/mean_value": float(values.mean()),
        "critic/mean_return": float(returns.mean()),
        "critic/bias": found.bias,
        "critic/error": found.rmse,
        "critic/slope": found.slope,
        "critic/explained_variance": found.explained_variance,
        "critic/td_error": rmse(values, targets(recording, 0.0)[counted]),
    }
    if gae_lambda != 1:
        target = targets(recording, gae_lambda)[counted]
        scalars["critic/explained_variance_of_target"] = calibrate(values, target).explained_variance
    return {tag: value for tag, value in scalars.items() if value is not None}


def targets(recording: EpisodeRecording, lam: float) -> npt.NDArray[np.float64]:
    """Compute TD(lambda) targets (T, B) of a recording."""
    r = recording
    return lambda_returns(r.rewards, r.ends, r.last_values, r.values, r.gamma, lam)


def message_scalars(recording: EpisodeRecording) -> Scalars:
    """Compute the critic's error with the message read, and with replaced ones."""
    if recording.message_strengths is None:
        return {}
    counted, returns = recording.counted, recording.returns[recording.counted]
    scalars = {
        "message/value_error": rmse(recording.values[counted], returns),
        "message/strength": float(recording.message_strengths[counted].mean()),
    }
    for name, values in recording.values_without.items():
        scalars[_TAG_WITHOUT[name]] = rmse(values[counted], returns)
    return scalars
