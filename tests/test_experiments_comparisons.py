"""Comparisons: paired differences against the noise of tests, equivalence, corrections, aggregates."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from rliable import metrics
from scipy import stats

from sb3_saf.experiments.tables import compare, holm, mean_difference, pooled, shares
from sb3_saf.training.statistics import Estimate, mean_over_seeds, optimality_gaps, probability_of_improvement


def runs(values: list[float], **columns: object) -> pd.DataFrame:
    return pd.DataFrame({"seed": range(len(values)), "return_mean": values}).assign(**columns)


def test_intervals_are_students_for_any_number_of_runs() -> None:
    """Five runs of 1 to 5: 3 +- 1.963 (marl-eval assumes ten runs and the normal distribution: 0.877)."""
    assert mean_over_seeds([1.0, 2.0, 3.0, 4.0, 5.0]) == pytest.approx((3, 3 - 1.963, 3 + 1.963), abs=5e-4)


def test_paired_differences_are_tested_over_common_seeds() -> None:
    first, second = runs([3.0, 3.5, 3.1, 9.0]), runs([1.0, 1.1, 1.3])
    found = compare(first, second)
    assert found is not None
    assert (found.seeds, found.test.verdict) == ([0, 1, 2], "higher")
    assert found.test.p == pytest.approx(stats.ttest_rel([3.0, 3.5, 3.1], [1.0, 1.1, 1.3]).pvalue)
    low, high = stats.t.interval(0.95, 2, *(np.mean([2.0, 2.4, 1.8]), stats.sem([2.0, 2.4, 1.8])))
    assert found.test.estimate == pytest.approx((np.mean([2.0, 2.4, 1.8]), low, high))
    swapped, few = compare(second, first), compare(runs([1.0, 1.0]), runs([2.0, 2.0]))
    assert swapped is not None and swapped.test.verdict == "lower"
    assert few is not None and few.test.verdict == "fewer than 3 pairs" and few.first == Estimate(1.0, 1.0, 1.0)
    assert compare(runs([1.0]), runs([1.0]).assign(seed=5)) is None


def test_a_small_spread_by_chance_is_not_below_the_noise_of_the_tests() -> None:
    """Differences of 1 that agree to the last digit, from 16 episodes with a standard deviation of 8."""
    first, second = (runs(values, return_sd=8.0, episodes=16) for values in ([3.0, 3.0, 3.0], [2.0, 2.0, 2.0]))
    found = compare(first, second)
    assert found is not None and found.test.verdict == "open"
    half = stats.t.ppf(0.975, 2) * np.sqrt(2 * 8**2 / 16) / np.sqrt(3)
    assert found.test.estimate == pytest.approx((1, 1 - half, 1 + half))


@pytest.mark.parametrize(
    ("differences", "verdict"),
    [([0.1, -0.1, 0.0, 0.05], "equivalent"), ([0.4, -0.6, 0.5, 0.1], "open"), ([1.9, 2.0, 2.1, 2.0], "higher")],
)
def test_equivalence_needs_both_bounds_to_be_excluded(differences: list[float], verdict: str) -> None:
    """Within 0.5: two one-sided t tests."""
    found = mean_difference(differences, margin=0.5)
    assert found.verdict == verdict
    one_sided = [
        stats.ttest_1samp(differences, -0.5, alternative="greater").pvalue,
        stats.ttest_1samp(differences, 0.5, alternative="less").pvalue,
    ]
    assert found.p_equivalent == pytest.approx(max(one_sided))
    assert mean_difference([0.0, 0.0, 0.0], margin=0.5).verdict == "equivalent"


def test_pooled_differences_are_over_settings_or_over_seeds() -> None:
    """In percent of the largest return, which differs between settings."""

    def table(method: str, **returns: list[float]) -> pd.DataFrame:
        parts = [
            runs(
                values, method=method, task="T", train_level=level, level=level, max_return=50.0 if level == "a" else 25
            )
            for level, values in returns.items()
        ]
        return pd.concat(parts)

    first, second = table("x", a=[10.0, 12.0], b=[5.0, 6.0], c=[1.0]), table("y", a=[9.0, 11.0], b=[5.0, 5.0], c=[2.0])
    pairs = shares(pd.concat([first, second]), "x", "y")
    assert pairs["difference"].tolist() == pytest.approx([2, 2, 0, 4, -4])
    over_settings = pooled(pairs)
    assert over_settings is not None
    assert over_settings.estimate == pytest.approx(mean_over_seeds([2.0, 2.0, -4.0]))
    over_seeds = pooled(pairs[pairs["setting"] != "T c c"])
    assert over_seeds is not None and over_seeds.estimate == pytest.approx(mean_over_seeds([1.0, 3.0]))
    assert pooled(pairs[:0]) is None


def test_holm() -> None:
    multitest = pytest.importorskip("statsmodels.stats.multitest")
    values = [0.04, 0.001, 0.03, 0.5, 0.012]
    assert holm(values) == pytest.approx(multitest.multipletests(values, method="holm")[1])
    assert holm([]) == []


def test_improvement_and_gap_are_rliables() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 4, (5, 3)) / 3, rng.integers(0, 4, (4, 3)) / 3
    found = probability_of_improvement(first, second)
    assert found.value == pytest.approx(metrics.probability_of_improvement(first, second))
    assert 0 <= found.low <= found.value <= found.high <= 1
    gap = optimality_gaps({"x": first * 2})["x"]
    assert gap.value == pytest.approx(metrics.aggregate_optimality_gap(first * 2)) and gap.low <= gap.value <= gap.high
    assert np.isnan(probability_of_improvement(first[:1], second[:1]).low)
