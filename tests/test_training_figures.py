"""Statistics and figures of tidy tables, compared with independently computed numbers."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex

pytest.importorskip("rliable")

from rliable import metrics

from sb3_saf import confidence_interval
from sb3_saf.training.figures import draw_curves, draw_levels, method_styles
from sb3_saf.training.settings import ALGOS
from sb3_saf.training.statistics import (
    interquartile_means,
    learning_curve,
    mean_over_seeds,
    performance_profiles,
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
    assert mean_over_seeds([1.0, 2.0, 6.0]) == (3.0, *confidence_interval([1, 2, 6]))
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
    two = draw_curves(pd.concat([table, runs(saf=[[0, 0, 1]]).assign(task="u")]), panel="task")
    assert [text.get_text() for text in two.legends[0].get_texts()] == ["saf (1 to 2 seeds)", "mappo (1 seed)"]


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
    with pytest.raises(ValueError, match="on the same tasks: ippo has no result on b"):
        score_matrices(pd.concat([table, other]))
    elsewhere = pd.DataFrame([("ippo", seed, task, 1.0) for seed in (0, 1) for task in "cd"], columns=table.columns)
    with pytest.raises(ValueError, match="on the same tasks: saf has no result on c, d"):
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
