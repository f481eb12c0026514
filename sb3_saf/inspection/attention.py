"""
Who writes to which slot of the knowledge source, and who reads which.

Letters: n teams (games at steps), N agents, L slots.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sb3_saf.inspection.pool import entropy

Floats = npt.NDArray[np.floating[Any]]


class Attention(NamedTuple):
    """
    Attention of queries over sources, over many teams.

    :param mean: (Q, S) mean weights; rows sum to 1
    :param entropy: mean entropy of one query's weights, divided by log S: 0 for a single source, 1 for all alike; None
        for a single source
    :param entropy_of_mean: entropy of a query's mean weights, divided by log S, mean over queries; None for a single
        source. Higher than ``entropy`` where the source that is attended to changes
    """

    mean: npt.NDArray[np.float64]
    entropy: float | None
    entropy_of_mean: float | None


def attention_of(weights: Floats) -> Attention:
    """
    Sum up attention.

    :param weights: (n, Q, S); queries without any source (zeros) are left out
    """
    shown = weights.sum(axis=2) > 0
    n_sources = weights.shape[2]
    with np.errstate(invalid="ignore"):
        mean = weights.sum(axis=0, dtype=np.float64) / shown.sum(axis=0)[:, np.newaxis]
    if n_sources == 1 or not shown.any():
        return Attention(mean, None, None)
    scale = math.log(n_sources)
    seen = shown.any(axis=0)
    return Attention(mean, float(entropy(weights)[shown].mean()) / scale, float(entropy(mean[seen]).mean()) / scale)
