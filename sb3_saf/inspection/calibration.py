"""
Calibration of a critic: its values compared with the discounted returns.

Letters: T game steps, B rows, n values.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.floating[Any]]
Doubles = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

#: Spread below which values or returns count as constant.
_CONSTANT = 1e-9


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


class Bin(NamedTuple):
    """Bin of similar values: their mean, and mean and standard deviation of their returns."""

    value: float
    mean: float
    std: float


def lambda_returns(
    rewards: Floats, ends: Bools, last_values: Floats, values: Floats, gamma: float, lam: float = 1.0
) -> Doubles:
    """
    Compute TD(lambda) targets, the training targets of the critic; with ``lam=1`` they are the discounted returns.

    ::

        R_t = r_t + gamma last_t                                          if the episode ends with step t
        R_t = r_t + gamma ((1 - lam) V_{t+1} + lam R_{t+1})               otherwise

    ``last`` is the value of the last observation if the time limit is no true end (``time_limit="bootstrap"``), else 0.
    These are SB3's advantages by GAE plus values. Rows of unfinished episodes must be excluded.

    :param rewards: (T, B)
    :param ends: (T, B)
    :param last_values: (T, B)
    :param values: (T, B)
    :param gamma: discount factor
    :param lam: lambda
    :return: (T, B)
    """
    targets: Doubles = np.zeros(rewards.shape)
    values = np.asarray(values, dtype=np.float64)
    ahead = next_value = np.zeros_like(values[0])
    for t in reversed(range(len(targets))):
        going_on = (1 - lam) * next_value + lam * ahead
        targets[t] = rewards[t] + gamma * np.where(ends[t], last_values[t], going_on)
        ahead, next_value = targets[t], values[t]
    return targets


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


def reliability(values: Floats, returns: Floats, n_bins: int = 10) -> list[Bin]:
    """Compute mean returns of values and returns (n,) in at most ``n_bins`` bins of equal counts by value."""
    order = np.argsort(values, kind="stable")
    parts = np.array_split(order, min(n_bins, len(order)))
    return [Bin(float(values[part].mean()), float(returns[part].mean()), float(returns[part].std())) for part in parts]


def rmse(values: Floats, returns: Floats) -> float:
    """Compute the root mean square error of values (n,) against returns (n,)."""
    return float(np.sqrt(((np.asarray(values, dtype=np.float64) - returns) ** 2).mean()))
