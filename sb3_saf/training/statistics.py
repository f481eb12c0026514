"""
Statistics for the figures: means with intervals over seeds, interquartile means and performance profiles by rliable.

Tables are tidy: one row per observation, the column ``method`` names the algorithm, ``seed`` the run. Letters: S seeds,
K tasks, X thresholds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch as th

from sb3_saf.evaluation import confidence_interval
from sb3_saf.teams.randomness import own_randomness

Floats = npt.NDArray[np.float64]

#: Bootstrap samples, and the seed that makes intervals reproducible.
N_RESAMPLES: Final = 2_000
BOOTSTRAP_SEED: Final = 0

#: Intervals and comparisons need as many seeds: with two, Student's t interval is 18 times the standard deviation wide.
FEWEST_SEEDS: Final = 3

CURVE_COLUMNS: Final = ("method", "seed", "game_steps", "score")


class Estimate(NamedTuple):
    """A value with its 95 % interval, NaN for a single run."""

    value: float
    low: float
    high: float

    def drawn(self, n_seeds: int) -> Estimate:
        """Return what figures show of it: no interval of fewer than three seeds, which would hide all others."""
        return self if n_seeds >= FEWEST_SEEDS else Estimate(self.value, np.nan, np.nan)


class Profile(NamedTuple):
    """Fraction of runs with a score above each threshold, with its 95 % interval; (X,) each."""

    share: Floats
    low: Floats
    high: Floats


def mean_over_seeds(values: Sequence[float] | Floats) -> Estimate:
    """Return mean and Student's t interval of one value per seed, (S,)."""
    sample = np.asarray(values, dtype=np.float64)
    low, high = confidence_interval(sample) if len(sample) > 1 else (np.nan, np.nan)
    return Estimate(float(sample.mean()), low, high)


def require_columns(table: pd.DataFrame, columns: Sequence[str]) -> None:
    """Check that a table has columns and rows; otherwise raise ValueError with the missing columns."""
    missing = [column for column in columns if column not in table.columns]
    if missing:
        raise ValueError(f"expected a table with the columns {', '.join(columns)}; {', '.join(missing)} is missing")
    if table.empty:
        raise ValueError("expected at least one row of results, got none")


def learning_curve(runs: pd.DataFrame) -> pd.DataFrame:
    """
    Return mean and interval over the seeds of one method at each point of training.

    Seeds measured at different points are interpolated within their common range: with fewer seeds a curve would jump.

    :param runs: columns ``seed``, ``game_steps``, ``score``
    :return: columns ``game_steps``, ``value``, ``low``, ``high``
    """
    curves = [
        (by_step.index.to_numpy(dtype=np.float64), by_step.to_numpy(dtype=np.float64))
        for by_step in (run.groupby("game_steps")["score"].mean() for _, run in runs.groupby("seed"))
    ]
    first, last = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    steps = np.unique(np.concatenate([steps for steps, _ in curves]))
    steps = steps[(steps >= first) & (steps <= last)]
    scores = np.stack([np.interp(steps, *curve) for curve in curves])
    estimates = [mean_over_seeds(column) for column in scores.T]
    return pd.DataFrame(estimates, columns=["value", "low", "high"], dtype=np.float64).assign(game_steps=steps)


def score_matrices(results: pd.DataFrame, task: str = "task") -> dict[str, Floats]:
    """
    Return scores by method, (S, K) each, for rliable.

    :param results: columns ``method``, ``seed``, the column named by ``task``, ``score``; several rows of a run
        (episodes) are averaged
    :raises ValueError: if a method lacks a task, or a seed of one
    """
    require_columns(results, ("method", "seed", task, "score"))
    table = results.groupby(["method", "seed", task], observed=True)["score"].mean().unstack(task)
    for (method, seed), is_missing in table.isna().T.items():
        if is_missing.any():
            raise ValueError(
                f"aggregates need every seed of a method on every task: {method} has no seed {seed} on "
                f"{', '.join(map(str, table.columns[is_missing]))}; run it, or leave that method, seed or task out"
            )
    return {str(method): table.loc[method].to_numpy(dtype=np.float64) for method in results["method"].unique()}


def interquartile_means(scores: Mapping[str, Floats]) -> dict[str, Estimate]:
    """Return the interquartile mean of each method's (S, K) scores with a stratified bootstrap interval over seeds."""

    def mean(runs: Floats) -> float:  # rliable's aggregate_iqm without scipy's checks, which take most of its time
        ordered = np.sort(runs, axis=None)
        cut = len(ordered) // 4
        return float(ordered[cut : len(ordered) - cut].mean())

    return _estimates(scores, mean)


def optimality_gaps(scores: Mapping[str, Floats]) -> dict[str, Estimate]:
    """Return the mean missing part of a score of 1 for each method's (S, K) scores, as :func:`interquartile_means`."""
    return _estimates(scores, lambda runs: float(1 - np.minimum(runs, 1).mean()))


def _estimates(scores: Mapping[str, Any], statistic: Callable[..., float]) -> dict[str, Estimate]:
    profiles = _bootstrap(scores, lambda *runs: np.array([statistic(*runs)]))
    return {method: Estimate(*(float(part[0]) for part in parts)) for method, parts in profiles.items()}


def probability_of_improvement(first: Floats, second: Floats) -> Estimate:
    """
    Return the probability that a run of one method is better than one of another, with a stratified bootstrap interval.

    It is rliable's: the mean over tasks of P(X > Y) + P(X = Y) / 2, without the checks that take most of its time.

    :param first: (S, K) scores
    :param second: (S', K) scores
    """

    def probability(x: Floats, y: Floats) -> float:
        pairs = x[:, np.newaxis], y[np.newaxis]
        return float(np.mean(pairs[0] > pairs[1]) + 0.5 * np.mean(pairs[0] == pairs[1]))

    return _estimates({"": [first, second]}, probability)[""]


def performance_profiles(scores: Mapping[str, Floats], thresholds: Floats) -> dict[str, Profile]:
    """Return the fraction of each method's (S, K) scores above thresholds (X,), with stratified bootstrap intervals."""
    return _bootstrap(scores, lambda runs: (runs[..., None] > thresholds).mean(axis=(0, 1)))


def _bootstrap(scores: Mapping[str, Any], statistic: Callable[..., Floats]) -> dict[str, Profile]:
    """Return rliable's point estimates and 95 % intervals; the intervals are NaN for a single seed."""
    from rliable.library import get_interval_estimates

    # rliable uses NumPy's global generator even if ``random_state`` is given.
    with own_randomness(BOOTSTRAP_SEED, th.device("cpu")):
        values, intervals = get_interval_estimates(dict(scores), statistic, reps=N_RESAMPLES)
    for method, runs in scores.items():
        if min(map(len, runs if isinstance(runs, list) else [runs])) < 2:
            intervals[method] = np.full_like(intervals[method], np.nan)
    return {method: Profile(values[method], *intervals[method]) for method in scores}
