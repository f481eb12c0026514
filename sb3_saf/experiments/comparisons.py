"""
Comparisons of methods on the same seeds and test games.

The spread of paired differences over seeds is not taken to be below the noise of the tests: with few seeds it may be
small by chance. A difference is *equivalent* to none if a test with both bounds (TOST, 5 %) excludes 2 % of the largest
return. Other differences are *higher* or *lower* if the 95 % interval excludes 0, *open* if it does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from sb3_saf.experiments.definitions import RANDOM, Level, View
from sb3_saf.experiments.tables import of_view
from sb3_saf.training.statistics import Estimate, Floats, mean_over_seeds

#: Minimum seeds for a verdict.
FEWEST_SEEDS: Final = 3
#: Differences below this share of the largest return do not matter.
MARGIN: Final = 0.02
_LEVEL: Final = 0.05
_ON: Final = ["task", "level", "seed"]


class Difference(NamedTuple):
    """
    Mean of differences of independent pairs.

    :param estimate: mean with its 95 % interval (Student's t), NaN for a single pair
    :param p: of the two-sided test of no difference
    :param p_equivalent: of the test that the difference is at least the margin; NaN without margin
    """

    estimate: Estimate
    p: float
    p_equivalent: float
    n: int

    @property
    def verdict(self) -> str:
        """``"higher"``, ``"lower"``, ``"equivalent"`` or ``"open"``; or that there are too few pairs."""
        if self.n < FEWEST_SEEDS:
            return f"fewer than {FEWEST_SEEDS} pairs"
        if self.p_equivalent < _LEVEL:
            return "equivalent"
        return "open" if self.p >= _LEVEL else "higher" if self.estimate.value > 0 else "lower"


def mean_difference(differences: Sequence[float] | Floats, noise: float = 0.0, margin: float = np.nan) -> Difference:
    """
    Test the mean of paired differences.

    :param differences: (n,) one for each pair
    :param noise: standard deviation that the tests alone give a difference: the floor of their spread
    :param margin: smallest difference that matters
    """
    sample = np.asarray(differences, dtype=np.float64)
    n, mean = len(sample), float(sample.mean())
    if n < 2:
        return Difference(Estimate(mean, np.nan, np.nan), np.nan, np.nan, n)
    error = max(float(sample.std(ddof=1)), noise) / np.sqrt(n)
    if error == 0:
        return Difference(Estimate(mean, mean, mean), float(mean == 0), float(abs(mean) >= margin), n)
    half = float(stats.t.ppf(0.975, n - 1)) * error
    p = 2 * float(stats.t.sf(abs(mean) / error, n - 1))
    p_equivalent = float(stats.t.sf((margin - abs(mean)) / error, n - 1))
    return Difference(Estimate(mean, mean - half, mean + half), p, p_equivalent, n)


class Comparison(NamedTuple):
    """
    Comparison of two methods on the same seeds and the same test games.

    :param first: mean return of the first, with its 95 % interval over these seeds
    :param test: mean of first - second, paired by seed
    """

    seeds: list[int]
    first: Estimate
    second: Estimate
    test: Difference


class Compared(NamedTuple):
    """Comparison of a view's first method with another one, at a level of a task."""

    task: str
    level: Level
    ours: str
    other: str
    found: Comparison


def compare(first: pd.DataFrame, second: pd.DataFrame) -> Comparison | None:
    """
    Compare two methods at one level of one task.

    :param first: columns ``seed`` and ``return_mean``; with ``return_sd`` and ``episodes`` the noise of tests is known,
        with ``max_return`` the margin of equivalence
    :return: None if they have no seed in common
    """
    pairs = first.merge(second, on="seed", suffixes=("", "_second")).sort_values("seed")
    if pairs.empty:
        return None
    ours, theirs = (pairs[name].to_numpy(dtype=np.float64) for name in ("return_mean", "return_mean_second"))
    known = pairs["max_return"].iloc[0] if "max_return" in pairs else np.nan
    margin = MARGIN * float(known) if pd.notna(known) else np.nan
    test = mean_difference(ours - theirs, float(np.sqrt(_variance(pairs).mean())), margin)
    return Comparison(pairs["seed"].tolist(), mean_over_seeds(ours), mean_over_seeds(theirs), test)


def _variance(pairs: pd.DataFrame) -> Floats:
    """Return the variance of each pair's difference from the tests' episodes; 0 where it is not known."""
    if "return_sd" not in pairs:
        return np.zeros(len(pairs))
    parts = [pairs[f"return_sd{end}"] ** 2 / pairs[f"episodes{end}"] for end in ("", "_second")]
    return (parts[0] + parts[1]).fillna(0).to_numpy(dtype=np.float64)


def comparisons(table: pd.DataFrame, view: View) -> list[Compared]:
    """Compare SAF, or the first method if SAF is missing, with each other one, if they have common seeds."""
    rows = of_view(table, view)
    methods = list(dict.fromkeys(rows["method"]))
    ours = "saf" if "saf" in methods else next(iter(methods), RANDOM)
    found = []
    for task in dict.fromkeys(rows["task"]):
        for level in view.levels:
            here = rows[(rows["task"] == task) & (rows["level"] == level.slug)]
            for other in [method for method in methods if method != ours]:
                comparison = compare(*(here[here["method"] == one] for one in (ours, other)))
                if comparison is not None:
                    found.append(Compared(str(task), level, ours, other, comparison))
    return found


def shares(table: pd.DataFrame, first: str, second: str) -> pd.DataFrame:
    """
    Return the paired differences of two methods in percent of the largest return.

    :param table: table of tests
    :return: columns ``setting``, ``seed``, ``difference`` and ``variance`` (of the tests), one row per pair
    """
    ours, theirs = (table[table["method"] == method] for method in (first, second))
    pairs = ours.merge(theirs, on=["train_level", *_ON], suffixes=("", "_second"))
    scale = 100 / pd.to_numeric(pairs["max_return"]).to_numpy(dtype=np.float64)
    difference = (pairs["return_mean"] - pairs["return_mean_second"]).to_numpy(dtype=np.float64)
    setting = pairs["task"] + " " + pairs["train_level"] + " " + pairs["level"]
    variance = _variance(pairs) * scale**2
    return pd.DataFrame(
        {"setting": setting, "seed": pairs["seed"], "difference": difference * scale, "variance": variance}
    )


def pooled(pairs: pd.DataFrame) -> Difference | None:
    """
    Test the mean difference over settings: over those of their means if there are three or more, else over seeds.

    :param pairs: from :func:`shares`
    :return: in percent of the largest return; None without pairs
    """
    if pairs.empty:
        return None
    by = "setting" if pairs["setting"].nunique() >= FEWEST_SEEDS else "seed"
    groups = pairs.groupby(by)
    noise = float(np.sqrt((groups["variance"].mean() / groups.size()).mean()))
    return mean_difference(groups["difference"].mean().to_numpy(), noise, 100 * MARGIN)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p values corrected for the number of declared tests (Holm)."""
    p, order = np.asarray(p_values, dtype=np.float64), np.argsort(p_values)
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(1, np.maximum.accumulate((len(p) - np.arange(len(p))) * p[order]))
    return [float(value) for value in corrected]
