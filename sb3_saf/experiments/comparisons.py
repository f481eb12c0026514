"""Comparisons of two methods on the same seeds, which name a winner only where intervals do not overlap."""

from __future__ import annotations

from typing import Final, NamedTuple

import pandas as pd

from sb3_saf.training.statistics import Estimate, mean_over_seeds

#: Two seeds may agree by chance, and an interval then has no width.
FEWEST_SEEDS: Final = 3


class Comparison(NamedTuple):
    """
    Two methods on the same seeds and the same test games.

    :param seeds: that both have
    :param first: mean return of the first, with its 95 % interval over these seeds
    :param second: of the second
    :param difference: mean of first - second, seed by seed
    """

    seeds: list[int]
    first: Estimate
    second: Estimate
    difference: Estimate

    @property
    def sign(self) -> int:
        """1 if the first is higher, -1 if the second is, 0 if nothing can be said."""
        if len(self.seeds) < FEWEST_SEEDS:
            return 0
        if self.first.low > self.second.high and self.difference.low > 0:
            return 1
        if self.first.high < self.second.low and self.difference.high < 0:
            return -1
        return 0

    @property
    def verdict(self) -> str:
        """In words."""
        if len(self.seeds) < FEWEST_SEEDS:
            return f"no winner: fewer than {FEWEST_SEEDS} seeds"
        if self.sign == 0:
            return "no winner: intervals overlap"
        return "higher" if self.sign > 0 else "lower"


def compare(first: pd.DataFrame, second: pd.DataFrame) -> Comparison | None:
    """
    Compare two methods at one level of one task.

    :param first: columns ``seed`` and ``return_mean``
    :param second: the same
    :return: None if they have no seed in common
    """
    pairs = first.merge(second, on="seed", suffixes=("_first", "_second")).sort_values("seed")
    if pairs.empty:
        return None
    ours, theirs = pairs["return_mean_first"].to_numpy(), pairs["return_mean_second"].to_numpy()
    return Comparison(
        pairs["seed"].tolist(), mean_over_seeds(ours), mean_over_seeds(theirs), mean_over_seeds(ours - theirs)
    )
