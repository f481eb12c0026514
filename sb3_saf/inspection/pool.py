"""
Statistics of a pool of policies: its selection, and the differences between its policies.

Letters: n rows, U policies, P parameters of an action distribution, K groups (zones or agents).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

Floats = npt.NDArray[np.floating[Any]]


class SelectionEntropy(NamedTuple):
    """
    Entropies of the selection, from 0 to 1 (divided by log U).

    Both low: the pool has collapsed to one policy. ``each`` low and ``mean`` high: confident selection that depends on
    the observation. Both high: all policies are blended.

    :param each: mean entropy of the weights of one observation
    :param mean: entropy of the mean weights
    """

    each: float
    mean: float


def selection_entropy(weights: Floats) -> SelectionEntropy:
    """Compute entropies of the selection from weights (n, U)."""
    scale = math.log(weights.shape[1])
    return SelectionEntropy(
        float(entropy(weights).mean()) / scale, float(entropy(weights.mean(axis=0, dtype=np.float64))) / scale
    )


def entropy(probabilities: Floats) -> npt.NDArray[np.float64]:
    """Compute (...) entropies in nats of probabilities (..., U)."""
    p = np.asarray(probabilities, dtype=np.float64)
    return -(p * np.log(np.where(p > 0, p, 1.0))).sum(axis=-1)


def chosen_by(weights: Floats, groups: npt.NDArray[np.integer[Any]], n_groups: int) -> npt.NDArray[np.float64]:
    """
    Return how often each policy is selected in each group.

    :param weights: (n, U)
    :param groups: (n,) from 0; -1 for rows without a group
    :param n_groups: K
    :return: (K, U), rows sum to 1; NaN for groups without rows
    """
    inside = groups >= 0
    counts = np.bincount(groups[inside], minlength=n_groups).astype(np.float64)
    sums = [np.bincount(groups[inside], column[inside], n_groups) for column in weights.T.astype(np.float64)]
    with np.errstate(invalid="ignore"):
        return np.stack(sums, axis=1) / counts[:, np.newaxis]


def zone_dependence(weights: Floats, zones: npt.NDArray[np.integer[Any]]) -> float | None:
    """
    Return the mutual information of zone and selected policy, divided by the smaller of log U and log K.

    :param weights: (n, U)
    :param zones: (n,) from 0, -1 for none
    :return: from 0 (selection independent of the zone) to 1 (one policy per zone); None for fewer than two zones
    """
    inside = zones >= 0
    counts = np.bincount(zones[inside])
    present = np.flatnonzero(counts)
    if len(present) < 2:
        return None
    table = chosen_by(weights, zones, len(counts))[present]
    shares = counts[present] / counts.sum()
    information = float(entropy(shares @ table) - shares @ entropy(table))
    return max(0.0, information / math.log(min(len(present), weights.shape[1])))


def differences(action_space: spaces.Space[Any], actions: Floats) -> npt.NDArray[np.float64]:
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


def mean_difference(table: npt.NDArray[np.float64]) -> float:
    """Return the mean of :func:`differences`, (U, U), over pairs of different policies."""
    return float(table[np.triu_indices(len(table), k=1)].mean())


def _overlap(action_space: spaces.Space[Any], p: Floats, q: Floats) -> npt.NDArray[np.float64]:
    """Return Bhattacharyya coefficients (n,), a product over action dimensions."""
    if isinstance(action_space, spaces.Box):
        return _overlap_of_gaussians(p, q)
    if isinstance(action_space, spaces.MultiBinary):
        on_p, on_q = 1 / (1 + np.exp(-p)), 1 / (1 + np.exp(-q))
        return (np.sqrt(on_p * on_q) + np.sqrt((1 - on_p) * (1 - on_q))).prod(axis=1)
    nvec = action_space.nvec.reshape(-1) if isinstance(action_space, spaces.MultiDiscrete) else [p.shape[1]]
    edges = np.cumsum(nvec)[:-1]
    pairs = zip(np.split(p, edges, axis=1), np.split(q, edges, axis=1), strict=True)
    return np.prod([np.sqrt(_softmax(one) * _softmax(other)).sum(axis=1) for one, other in pairs], axis=0)


def _overlap_of_gaussians(p: Floats, q: Floats) -> npt.NDArray[np.float64]:
    (mean_p, log_p), (mean_q, log_q) = np.split(p, 2, axis=1), np.split(q, 2, axis=1)
    var_p, var_q = np.exp(2 * log_p), np.exp(2 * log_q)
    total = var_p + var_q
    scale = np.sqrt(2 * np.exp(log_p + log_q) / total)
    return (scale * np.exp(-((mean_p - mean_q) ** 2) / (4 * total))).prod(axis=1)


def _softmax(logits: Floats) -> npt.NDArray[np.float64]:
    powers = np.exp(logits - logits.max(axis=1, keepdims=True))
    return np.asarray(powers / powers.sum(axis=1, keepdims=True))
