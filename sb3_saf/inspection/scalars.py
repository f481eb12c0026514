"""
Scalars of a recording: team return, pool of policies, knowledge source, critic and its messages.

Tags are ``group/name``; a group is one box of TensorBoard's page. Scalars that a policy or an environment lacks are
omitted. Letters: n rows, T game steps, B rows of all games, U policies, P parameters of an action distribution, K
groups (zones or agents), Q queries, S sources, L slots, N agents.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_saf.evaluation import confidence_interval
from sb3_saf.inspection.recording import EpisodeRecording, Replacement, ReturnScale

Scalars = dict[str, float]
Floats = npt.NDArray[np.floating[Any]]
Doubles = npt.NDArray[np.float64]
Integers = npt.NDArray[np.integer[Any]]

#: Spread below which values or returns count as constant.
_CONSTANT: Final = 1e-9
_TAG_WITHOUT: Final[dict[Replacement, str]] = {
    "zero": "message/value_error_zeroed",
    "shuffled": "message/value_error_shuffled",
}


def team_scalars(recording: EpisodeRecording, scale: ReturnScale) -> Scalars:
    """Compute the mean team return with its 95 % interval."""
    returns = np.array(recording.episode_returns)
    scalars = {"team/return": float(returns.mean()), "team/episode_length": float(np.mean(recording.episode_lengths))}
    if len(returns) > 1:
        scalars["team/return_low"], scalars["team/return_high"] = confidence_interval(returns)
    if scale.best:
        scalars[f"team/share_of_{scale.unit or 'best_return'}"] = float(returns.mean()) / scale.best
    return scalars


# --- the pool of policies ---------------------------------------------------------------------------------------------


def pool_scalars(recording: EpisodeRecording, action_space: spaces.Space[Any]) -> Scalars:
    """
    Compute how often each policy is selected, the entropy of selection, and the differences between policies.

    Entropies are divided by log U, from 0 to 1. ``entropy`` is the mean entropy of one observation's weights,
    ``entropy_of_mean`` the entropy of the mean weights. Both low: the pool has collapsed to one policy. The first low,
    the second high: confident selection that depends on the observation. Both high: all policies are blended.
    """
    if recording.pool_weights is None or recording.pool_actions is None:
        return {}
    weights = recording.pool_weights[recording.counted]
    shares = weights.mean(axis=0, dtype=np.float64)
    distances = policy_distances(action_space, recording.pool_actions[recording.counted])
    scalars = {
        **{f"pool/chosen/policy_{policy}": float(share) for policy, share in enumerate(shares)},
        "pool/entropy": float(entropy(weights).mean()) / math.log(weights.shape[1]),
        "pool/entropy_of_mean": float(entropy(shares)) / math.log(weights.shape[1]),
        "pool/difference": float(distances[np.triu_indices(len(distances), k=1)].mean()),
    }
    if recording.zones is None:
        return scalars
    zones = recording.zones[recording.counted]
    for zone, of_zone in enumerate(selection_by_group(weights, zones, int(zones.max(initial=-1)) + 1)):
        for policy, share in enumerate(of_zone):
            if np.isfinite(share):
                scalars[f"pool_by_zone/zone_{zone}/policy_{policy}"] = float(share)
    if (dependence := zone_dependence(weights, zones)) is not None:
        scalars["pool/zone_dependence"] = dependence
    return scalars


def entropy(probabilities: Floats) -> Doubles:
    """Compute (...) entropies in nats of probabilities (..., U)."""
    p = np.asarray(probabilities, dtype=np.float64)
    return -(p * np.log(np.where(p > 0, p, 1.0))).sum(axis=-1)


def selection_by_group(weights: Floats, groups: Integers, n_groups: int) -> Doubles:
    """
    Return how often each policy is selected in each group.

    :param weights: (n, U)
    :param groups: (n,) from 0; -1 for rows without a group
    :return: (K, U), rows sum to 1; NaN for groups without rows
    """
    inside = groups >= 0
    counts = np.bincount(groups[inside], minlength=n_groups).astype(np.float64)
    sums = [np.bincount(groups[inside], column[inside], n_groups) for column in weights.T.astype(np.float64)]
    with np.errstate(invalid="ignore"):
        return np.stack(sums, axis=1) / counts[:, np.newaxis]


def zone_dependence(weights: Floats, zones: Integers) -> float | None:
    """
    Return the mutual information of zone and selected policy, divided by the smaller of log U and log K.

    :param weights: (n, U)
    :param zones: (n,) from 0, -1 for none
    :return: from 0 (selection independent of the zone) to 1 (one policy per zone); None for fewer than two zones
    """
    counts = np.bincount(zones[zones >= 0])
    present = np.flatnonzero(counts)
    if len(present) < 2:
        return None
    table = selection_by_group(weights, zones, len(counts))[present]
    shares = counts[present] / counts.sum()
    information = float(entropy(shares @ table) - shares @ entropy(table))
    return max(0.0, information / math.log(min(len(present), weights.shape[1])))


def policy_distances(action_space: spaces.Space[Any], actions: Floats) -> Doubles:
    """
    Return the Hellinger distances between the action distributions of a pool's policies, mean over observations.

    sqrt(1 - sum_a sqrt(p(a) q(a))): 0 for equal distributions, 1 for disjoint ones. It is exact for every kind of
    action space, including joint actions of several dimensions.

    :param action_space: Discrete, MultiDiscrete, MultiBinary or Box
    :param actions: (n, U, P) parameters of each policy's distribution
    :return: (U, U), symmetric
    """
    n_policies = actions.shape[1]
    parameters = np.asarray(actions, dtype=np.float64)
    table = np.zeros((n_policies, n_policies))
    for i in range(n_policies):
        for j in range(i):
            overlap = _overlap(action_space, parameters[:, i], parameters[:, j])
            table[i, j] = table[j, i] = np.sqrt(np.clip(1.0 - overlap, 0.0, 1.0)).mean()
    return table


def _overlap(action_space: spaces.Space[Any], p: Floats, q: Floats) -> Doubles:
    """Return Bhattacharyya coefficients (n,), a product over action dimensions."""
    from scipy.special import expit, softmax  # imported here, since it takes a tenth of a second

    if isinstance(action_space, spaces.Box):
        (mean_p, log_p), (mean_q, log_q) = np.split(p, 2, axis=1), np.split(q, 2, axis=1)
        total = np.exp(2 * log_p) + np.exp(2 * log_q)
        scale = np.sqrt(2 * np.exp(log_p + log_q) / total)
        return (scale * np.exp(-((mean_p - mean_q) ** 2) / (4 * total))).prod(axis=1)
    if isinstance(action_space, spaces.MultiBinary):
        on_p, on_q = expit(p), expit(q)
        return (np.sqrt(on_p * on_q) + np.sqrt((1 - on_p) * (1 - on_q))).prod(axis=1)
    nvec = action_space.nvec.reshape(-1) if isinstance(action_space, spaces.MultiDiscrete) else [p.shape[1]]
    edges = np.cumsum(nvec)[:-1]
    pairs = zip(np.split(p, edges, axis=1), np.split(q, edges, axis=1), strict=True)
    return np.prod([np.sqrt(softmax(one, axis=1) * softmax(other, axis=1)).sum(axis=1) for one, other in pairs], axis=0)


# --- the knowledge source ---------------------------------------------------------------------------------------------


class Attention(NamedTuple):
    """
    Attention of queries over sources, over many teams.

    :param mean: (Q, S) mean weights; rows sum to 1
    :param entropy: mean entropy of one query's weights, divided by the log of its number of sources (agents that are
        out are none): 0 if one source has all weight, 1 for uniform weights; None if there is only one source
    :param entropy_of_mean: entropy of a query's mean weights, divided by log S, mean over queries; None for a single
        source. Higher than ``entropy`` if the attended source changes
    """

    mean: Doubles
    entropy: float | None
    entropy_of_mean: float | None


def attention_of(weights: Floats) -> Attention:
    """Summarise attention (n, Q, S); queries without any source (zeros) are excluded."""
    has_source = weights.sum(axis=2) > 0
    n_sources = weights.shape[2]
    with np.errstate(invalid="ignore"):
        mean = weights.sum(axis=0, dtype=np.float64) / has_source.sum(axis=0)[:, np.newaxis]
    if n_sources == 1 or not has_source.any():
        return Attention(mean, None, None)
    of_mean = float(entropy(mean[has_source.any(axis=0)]).mean()) / math.log(n_sources)
    n_own = np.maximum(2, (weights > 0).sum(axis=2))  # fewer where agents are out
    return Attention(mean, float((entropy(weights) / np.log(n_own))[has_source].mean()), of_mean)


def attentions(recording: EpisodeRecording) -> dict[str, Attention]:
    """Summarise ``write``, slots over agents, and ``read``, agents over slots; none without a knowledge source."""
    write, read, played = recording.write_attention, recording.read_attention, recording.counted_games
    if write is None or read is None:
        return {}
    # Inactive readers are excluded, like queries without sources.
    takes_part = recording.counted.reshape(*read.shape[:3], 1)
    return {"write": attention_of(write[played]), "read": attention_of((read * takes_part)[played])}


def knowledge_scalars(recording: EpisodeRecording) -> Scalars:
    """Compute the concentration of writing and reading, and the attention to each slot."""
    scalars: Scalars = {}
    found = attentions(recording)
    for name, attention in found.items():
        if attention.entropy is not None and attention.entropy_of_mean is not None:
            scalars[f"knowledge_source/{name}_entropy"] = attention.entropy
            scalars[f"knowledge_source/{name}_entropy_of_mean"] = attention.entropy_of_mean
    if found:
        for slot, share in enumerate(np.nanmean(found["read"].mean, axis=0)):
            scalars[f"knowledge_source/read/slot_{slot}"] = float(share)
    return scalars


# --- the critic -------------------------------------------------------------------------------------------------------


class Calibration(NamedTuple):
    """
    Agreement of values V with returns G.

    :param explained_variance: 1 - Var(G - V) / Var(G): 1 for a perfect critic, 0 for a constant one; None for equal
        returns
    :param slope: slope of the regression line of G on V: 1 for a calibrated critic, below 1 if values vary too much;
        None if all values are equal
    :param bias: mean of V - G: positive if values are too high
    :param rmse: root mean square of V - G
    """

    explained_variance: float | None
    slope: float | None
    bias: float
    rmse: float


def calibrate(values: Floats, returns: Floats) -> Calibration:
    """Compare values (n,) with returns (n,)."""
    v, g = np.asarray(values, dtype=np.float64), np.asarray(returns, dtype=np.float64)
    error = v - g
    var_v, var_g = v.var(), g.var()
    return Calibration(
        explained_variance=None if var_g < _CONSTANT**2 else float(1 - error.var() / var_g),
        slope=None if var_v < _CONSTANT**2 else float(((v - v.mean()) * (g - g.mean())).mean() / var_v),
        bias=float(error.mean()),
        rmse=float(np.sqrt((error**2).mean())),
    )


def critic_scalars(recording: EpisodeRecording, gae_lambda: float) -> Scalars:
    """Compare values with discounted returns, and with the targets of training."""
    counted = recording.counted
    values, returns = recording.values[counted], recording.returns[counted]
    calibration = calibrate(values, returns)
    scalars: dict[str, float | None] = {
        "critic/mean_value": float(values.mean()),
        "critic/mean_return": float(returns.mean()),
        "critic/bias": calibration.bias,
        "critic/error": calibration.rmse,
        "critic/slope": calibration.slope,
        "critic/explained_variance": calibration.explained_variance,
        "critic/td_error": calibrate(values, recording.targets(0.0)[counted]).rmse,
    }
    if gae_lambda != 1:
        target = recording.targets(gae_lambda)[counted]
        scalars["critic/explained_variance_of_target"] = calibrate(values, target).explained_variance
    return {tag: value for tag, value in scalars.items() if value is not None}


def message_scalars(recording: EpisodeRecording) -> Scalars:
    """Compute the critic's error with the message read, and with replaced ones."""
    if recording.message_strengths is None:
        return {}
    counted, returns = recording.counted, recording.returns[recording.counted]
    return {
        "message/value_error": calibrate(recording.values[counted], returns).rmse,
        "message/strength": float(recording.message_strengths[counted].mean()),
        **{
            _TAG_WITHOUT[name]: calibrate(values[counted], returns).rmse
            for name, values in recording.values_without.items()
        },
    }
