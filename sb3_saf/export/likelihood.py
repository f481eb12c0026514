"""Log-likelihood of actions under an exported actor. Letters as in ``sb3_saf.export.act``."""

from __future__ import annotations

from math import log, pi
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_saf.export.act import Outputs, factors

Array = npt.NDArray[Any]


def log_prob(action: dict[str, Any], outputs: Outputs, actions: Array) -> Array:
    """
    Log-likelihood of the mixture of all policies, exactly: log sum_u w_u pi_u(a).

    :param action: the action space, as in ``actor.json``
    :param outputs: of the network
    :param actions: (K, D)
    :return: (K,)
    """
    by_policy = _gaussian(outputs, actions) if action["kind"] == "box" else _chosen(action, outputs, actions)
    result: Array = np.logaddexp.reduce(outputs.log_weights + by_policy, axis=1)
    return result


def _gaussian(outputs: Outputs, actions: Array) -> Array:
    """(K, U) log-densities."""
    mean, log_std = np.split(outputs.parameters, 2, axis=2)
    distance = (actions[:, np.newaxis] - mean) / np.exp(log_std)
    result: Array = (-0.5 * distance**2 - log_std - 0.5 * log(2.0 * pi)).sum(axis=2)
    return result


def _chosen(action: dict[str, Any], outputs: Outputs, actions: Array) -> Array:
    """(K, U) log-probabilities."""
    result = np.zeros_like(outputs.log_weights)
    for dimension, factor in enumerate(factors(action, outputs.parameters)):
        index = actions[:, dimension].astype(np.int64)
        if ((index < 0) | (index >= factor.shape[2])).any():
            raise ValueError(f"expected actions in 0..{factor.shape[2] - 1}, got {actions.tolist()}")
        result += factor[np.arange(len(index)), :, index]
    return result
