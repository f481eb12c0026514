"""
Figures of results, from tidy tables: learning curves, bars against a level, aggregates.

Every function returns a matplotlib ``Figure`` and reads no files. Intervals are 95 % everywhere; where a single run
says nothing about its spread, none is drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_saf.zoo.statistics import (
    CURVE_COLUMNS,
    Floats,
    interquartile_means,
    learning_curve,
    mean_over_seeds,
    performance_profiles,
    require_columns,
)

#: Colours that colour-blind readers can tell apart (Okabe and Ito), one per method in the order of METHOD_ORDER.
_COLOURS: Final = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#000000", "#8B6F00")
#: The same method has the same colour in every figure.
METHOD_ORDER: Final = ("saf", "mappo", "ippo", "saf-no-pool", "saf-no-ks", "qplex", "qplex-pool", "random")

_PANEL_WIDTH: Final = 4.6
_DPI: Final = 130
TEAM_RETURN: Final = "team return (treasures)"


def method_colours(methods: Sequence[str]) -> dict[str, str]:
    """
    One colour per method; known methods always get theirs.

    :param methods: names, in any order
    """
    colours = {method: _COLOURS[METHOD_ORDER.index(method)] for method in methods if method in METHOD_ORDER}
    free = [colour for colour in _COLOURS if colour not in colours.values()] or list(_COLOURS)
    others = [method for method in methods if method not in METHOD_ORDER]
    return colours | {method: free[index % len(free)] for index, method in enumerate(others)}


def _methods_of(table: pd.DataFrame) -> list[str]:
    found = list(dict.fromkeys(table["method"]))
    return sorted(found, key=lambda method: METHOD_ORDER.index(method) if method in METHOD_ORDER else len(METHOD_ORDER))


def _panels(table: pd.DataFrame, panel: str | None) -> list[tuple[str, pd.DataFrame]]:
    if panel is None:
        return [("", table)]
    require_columns(table, (panel,))
    return [(str(name), rows) for name, rows in table.groupby(panel, sort=False)]


def _figure(n_panels: int, height: float = 3.6) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(_PANEL_WIDTH * n_panels + 0.6, height), dpi=_DPI, layout="constrained")
    return figure, list(figure.subplots(1, n_panels, squeeze=False)[0])


def _finish(figure: Figure, axes: Sequence[Axes], title: str | None, n_entries: int) -> Figure:
    """Title on top, one legend for all panels below, so that it covers no data."""
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(axis="y", alpha=0.3)
        ax.set_axisbelow(True)
    handles, labels = axes[0].get_legend_handles_labels()
    for ax in axes[1:]:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            if label not in labels:
                handles, labels = [*handles, handle], [*labels, label]
    figure.legend(
        handles, labels, loc="outside lower center", ncols=max(1, min(n_entries, 2 * len(axes), 5)), frameon=False
    )
    if title:
        figure.suptitle(title)
    return figure


def draw_curves(
    runs: pd.DataFrame, title: str | None = None, panel: str | None = None, y_label: str = TEAM_RETURN
) -> Figure:
    """
    Learning curves: mean and 95 % interval (Student's t) over seeds.

    :param runs: columns ``method``, ``seed``, ``game_steps``, ``score``
    :param title: of the figure
    :param panel: column whose values get a panel each, for instance ``"task"``
    :param y_label: what a score is
    """
    require_columns(runs, CURVE_COLUMNS)
    panels, methods = _panels(runs, panel), _methods_of(runs)
    colours = method_colours(methods)
    figure, all_axes = _figure(len(panels))
    for ax, (name, rows) in zip(all_axes, panels, strict=True):
        for method in [method for method in methods if (rows["method"] == method).any()]:
            of_method = rows[rows["method"] == method]
            curve, n_seeds = learning_curve(of_method), of_method["seed"].nunique()
            marker = "o" if len(curve) == 1 else None
            label = f"{method} ({n_seeds} seed{'s' * (n_seeds > 1)})"
            ax.plot(curve["game_steps"], curve["value"], color=colours[method], label=label, marker=marker)
            ax.fill_between(
                curve["game_steps"], curve["low"], curve["high"], color=colours[method], alpha=0.2, linewidth=0
            )
        ax.set(xlabel="game steps", ylabel=y_label, title=name)
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))
    return _finish(figure, all_axes, title, len(methods))


def draw_levels(
    results: pd.DataFrame,
    level: str,
    title: str | None = None,
    panel: str | None = None,
    y_label: str = TEAM_RETURN,
) -> Figure:
    """
    Bars of the return against a level: mean and 95 % interval (Student's t) over seeds.

    :param results: columns ``method``, ``seed``, ``score`` and the column named by ``level``; several rows of a run
        (episodes) are averaged
    :param level: for instance ``"coordination"``
    :param title: of the figure
    :param panel: column whose values get a panel each, for instance ``"task"``
    :param y_label: what a score is
    """
    require_columns(results, ("method", "seed", level, "score"))
    panels, methods = _panels(results, panel), _methods_of(results)
    colours, width = method_colours(methods), 0.8 / len(methods)
    levels = sorted(results[level].unique())
    figure, all_axes = _figure(len(panels))
    for ax, (name, rows) in zip(all_axes, panels, strict=True):
        for index, method in enumerate(methods):
            of_method = rows[rows["method"] == method]
            found = [value for value in levels if (of_method[level] == value).any()]
            estimates = [
                mean_over_seeds(of_method[of_method[level] == value].groupby("seed")["score"].mean().to_numpy())
                for value in found
            ]
            values = np.array([estimate.value for estimate in estimates])
            margins = np.array([[e.value - e.low, e.high - e.value] for e in estimates]).reshape(-1, 2).T
            places = [levels.index(value) + (index - (len(methods) - 1) / 2) * width for value in found]
            ax.bar(places, values, width * 0.92, color=colours[method], label=method)
            ax.errorbar(places, values, yerr=margins, fmt="none", ecolor="black", capsize=3, linewidth=1)
        ax.set_xticks(range(len(levels)), [str(value) for value in levels])
        ax.set(xlabel=level, ylabel=y_label, title=name)
    return _finish(figure, all_axes, title, len(methods))


def draw_aggregates(
    scores: Mapping[str, Floats], title: str | None = None, x_label: str = "normalised score"
) -> Figure:
    """
    Interquartile means and performance profiles, both with stratified bootstrap intervals (rliable).

    :param scores: (S, K) scores of each method on S seeds and K tasks, normalised, 0 to 1
    :param title: of the figure
    :param x_label: what a score is, with its unit
    """
    methods = _methods_of(pd.DataFrame({"method": list(scores)}))
    colours = method_colours(methods)
    figure, (left, right) = _figure(2)
    for row, (method, estimate) in enumerate(interquartile_means({m: scores[m] for m in methods}).items()):
        left.barh(row, estimate.high - estimate.low, left=estimate.low, height=0.6, color=colours[method], alpha=0.5)
        left.plot([estimate.value] * 2, [row - 0.3, row + 0.3], color="black", linewidth=1.5)
    left.set_yticks(range(len(methods)), methods)
    left.invert_yaxis()
    left.margins(x=0.1)
    left.use_sticky_edges = False  # bars end inside the axes
    left.autoscale_view()
    left.set(xlabel=x_label, title="interquartile mean")
    top = max(float(runs.max()) for runs in scores.values())
    thresholds = np.linspace(0, top if top > 0 else 1, 101)
    for method, profile in performance_profiles({m: scores[m] for m in methods}, thresholds).items():
        right.plot(thresholds, profile.share, color=colours[method], label=method)
        right.fill_between(thresholds, profile.low, profile.high, color=colours[method], alpha=0.2, linewidth=0)
    right.set(xlabel=f"{x_label} (threshold)", ylabel="share of runs above it", title="performance profile")
    right.set_ylim(-0.02, 1.02)
    return _finish(figure, [left, right], title, len(methods))
