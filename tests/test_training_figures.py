"""Statistics, figures and comparisons of tidy tables, compared with independently computed numbers."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from rliable import metrics
from scipy import stats

from benchmarks.paper import pooled, shares
from sb3_saf import confidence_interval
from sb3_saf.experiments.tables import compare, holm, mean_difference
from sb3_saf.training.figures import draw_curves, draw_differences, draw_levels, method_styles
from sb3_saf.training.settings import ALGOS
from sb3_saf.training.statistics import (
    Estimate,
    interquartile_means,
    learning_curve,
    mean_over_seeds,
    optimality_gaps,
    performance_profiles,
    probability_of_improvement,
    score_matrices,
)


def runs(**scores: list[list[float]]) -> pd.DataFrame:
    """Return one list per seed, measured after 100, 200, ... game steps."""
    rows = [
        {"method": method, "seed": seed, "game_steps": 100 * (step + 1), "score": score, "task": "t"}
        for method, seeds in scores.items()
        for seed, curve in enumerate(seeds)
        for step, score in enumerate(curve)
    ]
    return pd.DataFrame(rows)


def test_mean_and_interval_over_seeds() -> None:
    estimate = mean_over_seeds([1.0, 2.0, 6.0])
    assert estimate == (3.0, *confidence_interval([1, 2, 6])) == estimate.drawn(3)
    assert np.isnan(estimate.drawn(2)).tolist() == [False, True, True], "intervals of two seeds are not drawn"
    alone = mean_over_seeds([4.0])
    assert alone.value == 4.0
    assert np.isnan([alone.low, alone.high]).all()


def test_a_curve_ends_where_a_seed_ends_and_is_interpolated_between() -> None:
    table = pd.DataFrame(
        {"seed": [0, 0, 0, 1, 1], "game_steps": [0, 100, 200, 50, 150], "score": [0.0, 10.0, 20.0, 5.0, 25.0]}
    )
    curve = learning_curve(table)
    assert curve["game_steps"].tolist() == [50, 100, 150]
    assert curve["value"].tolist() == [5.0, 12.5, 20.0]


@pytest.mark.parametrize("reference", ["saf", "others"])
def test_a_method_has_one_colour_in_bars_and_differences(reference: str) -> None:
    table = runs(**{reference: [[1.0]], "mine": [[2.0]]}).assign(level=1)
    row = {"method": "mine", "level": "1", "value": 0.0, "low": -1.0, "high": 1.0}
    bars, differences = draw_levels(table, "level"), draw_differences(pd.DataFrame([row]), reference=reference)
    (line,) = (one for one in differences.axes[0].get_lines() if one.get_marker() == "o")
    assert to_hex(str(line.get_color())) == to_hex(bars.axes[0].patches[1].get_facecolor())


def test_curves_are_drawn_where_they_are() -> None:
    table = runs(saf=[[1, 2, 3], [3, 4, 8]], mappo=[[0, 0, 1]])
    figure = draw_curves(table, title="T", panel="task")
    (axes,) = figure.axes
    lines = {str(line.get_label()): line for line in axes.get_lines()}
    assert list(lines) == ["saf (2 seeds)", "mappo (1 seed)"]
    assert np.array_equal(lines["saf (2 seeds)"].get_xdata(), [100, 200, 300])
    assert np.array_equal(lines["saf (2 seeds)"].get_ydata(), [2, 3, 5.5])
    curve = learning_curve(table[table["method"] == "saf"])
    assert curve[["low", "high"]].iloc[2].tolist() == pytest.approx(list(confidence_interval([3, 8])))
    assert to_hex(str(lines["mappo (1 seed)"].get_color())) == method_styles(["mappo"])["mappo"].colour.lower()
    assert (axes.get_xlabel(), axes.get_title()) == ("game steps", "t")
    assert figure.get_suptitle() == "T"
    assert [len(draw_curves(runs(saf=[[1, 2, 3]] * n)).axes[0].collections) for n in (2, 3)] == [0, 1], "bands"
    tables = pd.concat([table, runs(saf=[[0, 0, 1]]).assign(task="u")])
    references: dict[str, float | dict[str, float]] = {"all": 7.0, "one": {"u": 9.0}}
    two = draw_curves(tables, panel="task", references=references)
    labels = ["saf (1 to 2 seeds)", "mappo (1 seed)", "all", "one"]
    assert [text.get_text() for text in two.legends[0].get_texts()] == labels
    heights = [[float(np.max(line.get_ydata())) for line in axes.get_lines()] for axes in two.axes]
    assert heights == [[5.5, 1.0, 7.0], [1.0, 7.0, 9.0]], "a reference of one panel stands in that panel"


def test_levels_are_numbers_in_order_or_words_as_they_come() -> None:
    for given, drawn in (([2, 1], ["1", "2"]), (["small", "large"], ["small", "large"]), (["a", 2], ["a", "2"])):
        table = pd.DataFrame({"method": "saf", "seed": 0, "size": given, "score": 1.0})
        assert [label.get_text() for label in draw_levels(table, "size").axes[0].get_xticklabels()] == drawn


def test_bars_are_means_of_seeds_not_of_episodes() -> None:
    table = pd.DataFrame(
        {
            "method": ["saf"] * 4 + ["ippo"],
            "seed": [0, 0, 0, 1, 0],
            "coordination": [1, 1, 1, 1, 2],
            "score": [1.0, 2.0, 3.0, 10.0, 4.0],
        }
    )
    (axes,) = draw_levels(table, "coordination").axes
    heights = sorted(patch.get_height() for patch in axes.patches)  # type: ignore[attr-defined]
    assert heights == [4.0, 6.0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["1", "2"]


def test_scores_become_matrices_of_seeds_and_tasks() -> None:
    rows = [("saf", seed, task, 10.0 * seed + index) for seed in (0, 1) for index, task in enumerate("ab")]
    table = pd.DataFrame([*rows, ("saf", 1, "b", 13.0)], columns=["method", "seed", "task", "score"])
    assert score_matrices(table)["saf"].tolist() == [[0, 1], [10, 12]]
    with pytest.raises(ValueError, match="saf has no seed 0 on b"):
        score_matrices(table.drop(index=1))
    other = pd.DataFrame([("ippo", 0, "a", 1.0)], columns=table.columns)
    with pytest.raises(ValueError, match="ippo has no seed 0 on b"):
        score_matrices(pd.concat([table, other]))
    elsewhere = pd.DataFrame([("ippo", seed, task, 1.0) for seed in (0, 1) for task in "cd"], columns=table.columns)
    with pytest.raises(ValueError, match="ippo has no seed 0 on a, b"):
        score_matrices(pd.concat([table, elsewhere]))


def test_interquartile_mean_and_its_interval() -> None:
    scores = np.arange(8.0).reshape(4, 2)
    estimate = interquartile_means({"saf": scores})["saf"]
    assert estimate.value == np.mean([2, 3, 4, 5])
    assert estimate.low < estimate.value < estimate.high
    # Resampling a task's seeds can at most give its extremes.
    assert estimate.low >= 0.5 and estimate.high <= 6.5
    alone = interquartile_means({"saf": scores[:1]})["saf"]
    assert np.isnan([alone.low, alone.high]).all()


@pytest.mark.parametrize("shape", [(1, 1), (3, 1), (2, 9), (5, 7)])
def test_the_interquartile_mean_is_rliables(shape: tuple[int, int]) -> None:
    scores = np.random.default_rng(0).normal(size=shape)
    assert interquartile_means({"saf": scores})["saf"].value == pytest.approx(metrics.aggregate_iqm(scores), rel=1e-12)
    assert interquartile_means({"saf": np.full((3, 2), 0.25)})["saf"] == (0.25, 0.25, 0.25)


def test_bootstraps_repeat_and_leave_the_global_generator_alone() -> None:
    scores = {"saf": np.random.default_rng(0).normal(size=(5, 3))}
    first = interquartile_means(scores)
    before = np.random.get_state()[1].copy()  # type: ignore[index]  # noqa: NPY002
    assert interquartile_means(scores) == first
    assert np.array_equal(np.random.get_state()[1], before)  # type: ignore[index]  # noqa: NPY002


def test_performance_profiles_are_shares_above_thresholds() -> None:
    thresholds = np.array([-1.0, 0.0, 0.5, 2.5, 3.0])
    profile = performance_profiles({"saf": np.array([[0.0, 1.0], [2.0, 3.0]])}, thresholds)["saf"]
    assert profile.share.tolist() == [1.0, 0.75, 0.75, 0.25, 0.0]
    assert (profile.low <= profile.share).all()
    assert (profile.share <= profile.high).all()


def test_methods_keep_their_styles_and_none_looks_like_another() -> None:
    assert method_styles(["ippo", "saf"])["saf"] == method_styles(["saf", "other"])["saf"]
    methods = [*ALGOS, "random", "saf gamma=0.9", "saf, variant 1"]
    assert len(set(method_styles(methods).values())) == len(methods)
    assert method_styles(methods)["saf-lstm"].colour == method_styles(methods)["saf"].colour


def test_tables_are_checked() -> None:
    with pytest.raises(ValueError, match="seed is missing"):
        draw_curves(pd.DataFrame({"method": ["saf"], "game_steps": [1], "score": [1.0]}))
    with pytest.raises(ValueError, match="at least one row"):
        draw_levels(pd.DataFrame(columns=["method", "seed", "coordination", "score"]), "coordination")


# --- comparisons ------------------------------------------------------------------------------------------------------


def seeds_of(values: list[float], **columns: object) -> pd.DataFrame:
    return pd.DataFrame({"seed": range(len(values)), "return_mean": values}).assign(**columns)


def test_paired_differences_are_tested_over_common_seeds() -> None:
    first, second = seeds_of([3.0, 3.5, 3.1, 9.0]), seeds_of([1.0, 1.1, 1.3])
    found = compare(first, second)
    assert found is not None
    assert (found.seeds, found.test.verdict) == ([0, 1, 2], "higher")
    assert found.test.p == pytest.approx(stats.ttest_rel([3.0, 3.5, 3.1], [1.0, 1.1, 1.3]).pvalue)
    low, high = stats.t.interval(0.95, 2, *(np.mean([2.0, 2.4, 1.8]), stats.sem([2.0, 2.4, 1.8])))
    assert found.test.estimate == pytest.approx((np.mean([2.0, 2.4, 1.8]), low, high))
    swapped, few = compare(second, first), compare(seeds_of([1.0, 1.0]), seeds_of([2.0, 2.0]))
    assert swapped is not None and swapped.test.verdict == "lower"
    assert few is not None and few.test.verdict == "fewer than 3 pairs" and few.first == Estimate(1.0, 1.0, 1.0)
    assert compare(seeds_of([1.0]), seeds_of([1.0]).assign(seed=5)) is None


def test_a_small_spread_by_chance_is_not_below_the_noise_of_the_tests() -> None:
    """Differences of 1 that agree to the last digit, from 16 episodes with a standard deviation of 8."""
    first, second = (seeds_of(values, return_sd=8.0, episodes=16) for values in ([3.0, 3.0, 3.0], [2.0, 2.0, 2.0]))
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
    assert [mean_difference([8.0] * 3, margin=margin).verdict for margin in (0.5, np.nan)] == ["higher", "higher"]


def test_pooled_differences_are_over_settings_or_over_seeds() -> None:
    """In percent of the largest return, which differs between settings."""

    def table(method: str, **returns: list[float]) -> pd.DataFrame:
        parts = [
            seeds_of(
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
