"""
Figures of results, from tidy tables: learning curves, bars against a level, aggregates.

Every function returns a matplotlib ``Figure`` and reads no files. Intervals are 95 %, none for a single run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from textwrap import fill
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_saf.training.statistics import (
    CURVE_COLUMNS,
    FEWEST_SEEDS,
    Floats,
    interquartile_means,
    learning_curve,
    mean_over_seeds,
    performance_profiles,
    require_columns,
)

#: Letters in a line of a panel's title.
_TITLE_WIDTH: Final = 48
#: Colours distinguishable by colour-blind readers (Okabe and Ito, and darker ones).
_COLOURS: Final = {
    "saf": "#0072B2",
    "mappo": "#E69F00",
    "ippo": "#009E73",
    "saf-no-pool": "#CC79A7",
    "saf-no-ks": "#56B4E9",
    "qplex": "#D55E00",
    "qplex-pool": "#8B6F00",
    "qmix": "#882255",
    "vdn": "#332288",
    "pqn": "#661100",
    "random": "#666666",
}
#: Line, hatch and mark of variants of a method, which share its colour: with memory, with weights for each agent.
_VARIANTS: Final = {
    "-gru": ("--", "//", "^"),
    "-lstm": (":", "\\\\", "v"),
    "-separate": ("-.", "xx", "s"),
    "-paper": ("-.", "xx", "s"),
}
#: Horizontal lines, of references and of the largest possible score.
_REFERENCE: Final = "#222222"
_REFERENCE_LINES: Final = ("-.", ":", (0, (1, 3)), (0, (5, 5)))

_PANEL_WIDTH: Final = 4.6
_MOST_IN_A_ROW: Final = 4
_DPI: Final = 130
#: Legend sizes in inches: of a line, of a letter, and of the handle beside the text.
_LINE, _LETTER, _HANDLE = 0.24, 0.085, 0.65
TEAM_RETURN: Final = "team return (treasures)"


class Style(NamedTuple):
    """Style of a method, the same in every figure."""

    colour: str
    line: str = "-"
    hatch: str | None = None
    mark: str = "o"


def method_styles(methods: Sequence[str]) -> dict[str, Style]:
    """Return one style per method: fixed for known methods, the method's colour for variants."""
    known = {name: Style(colour, "--" if name == "random" else "-") for name, colour in _COLOURS.items()}
    for ending, variant in _VARIANTS.items():
        known |= {f"{name}{ending}": Style(colour, *variant) for name, colour in _COLOURS.items()}
    taken = {_COLOURS["random"], *(known[method].colour for method in methods if method in known)}
    free = [colour for colour in _COLOURS.values() if colour not in taken] or list(_COLOURS.values())
    others = [method for method in methods if method not in known]
    fresh = {method: Style(free[index % len(free)], ":", "..") for index, method in enumerate(others)}
    return {method: known.get(method) or fresh[method] for method in methods}


def _methods_of(table: pd.DataFrame) -> list[str]:
    """Return the methods of a table, known ones first, in the order of the colours."""
    known = list(_COLOURS)
    found = list(dict.fromkeys(table["method"]))
    return sorted(found, key=lambda method: known.index(method) if method in known else len(known))


def _panels(table: pd.DataFrame, panel: str | None) -> list[tuple[str, pd.DataFrame]]:
    if panel is None:
        return [("", table)]
    require_columns(table, (panel,))
    return [(str(name), rows) for name, rows in table.groupby(panel, sort=False)]


def _figure(n_panels: int, height: float = 3.6) -> tuple[Figure, list[Axes]]:
    columns = min(n_panels, _MOST_IN_A_ROW)
    rows = math.ceil(n_panels / columns)
    figure = Figure(figsize=(_PANEL_WIDTH * columns + 0.6, height * rows), dpi=_DPI, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for unused in axes[n_panels:]:
        unused.set_axis_off()
    return figure, list(axes[:n_panels])


def _finish(figure: Figure, axes: Sequence[Axes], title: str | None) -> Figure:
    """Add the title on top, and one legend for all panels below them."""
    entries: dict[str, Artist] = {}
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(axis="y", alpha=0.3)
        ax.set_axisbelow(True)
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    width, height = figure.get_size_inches()
    columns = max(1, min(len(entries), int(width / (_HANDLE + _LETTER * max(map(len, entries))))))
    figure.set_size_inches(width, height + _LINE * (math.ceil(len(entries) / columns) - 1))
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns, frameon=False)
    if title:
        figure.suptitle(title)
    return figure


def _start_at_zero(axes: Axes, values: Floats) -> None:
    """Start the axis at 0 if no score is negative, even if an interval is."""
    if len(values) and values.min() >= 0:
        axes.set_ylim(0, 1.05 * axes.get_ylim()[1])


def draw_curves(
    runs: pd.DataFrame,
    title: str | None = None,
    panel: str | None = None,
    y_label: str = TEAM_RETURN,
    names: Mapping[str, str] | None = None,
    references: Mapping[str, float | Mapping[str, float]] | None = None,
) -> Figure:
    """
    Draw learning curves: mean and, from three seeds on, 95 % interval (Student's t) over seeds.

    :param runs: columns ``method``, ``seed``, ``game_steps``, ``score``
    :param panel: column with one panel per value, for instance ``"task"``
    :param names: names of methods in words
    :param references: names and scores of horizontal lines, for instance of a random team, or their scores by panel
    """
    require_columns(runs, CURVE_COLUMNS)
    panels, methods = _panels(runs, panel), _methods_of(runs)
    styles, labels = method_styles(methods), {}
    for method in methods:
        counts = [rows[rows["method"] == method]["seed"].nunique() for _, rows in panels]
        fewest, most = min(n for n in counts if n), max(counts)
        seeds = f"{most} seed{'s' * (most > 1)}" if fewest == most else f"{fewest} to {most} seeds"
        labels[method] = f"{(names or {}).get(method, method)} ({seeds})"
    figure, all_axes = _figure(len(panels))
    for ax, (name, rows) in zip(all_axes, panels, strict=True):
        for method in [method for method in methods if (rows["method"] == method).any()]:
            of_method, style, label = rows[rows["method"] == method], styles[method], labels[method]
            curve = learning_curve(of_method)
            marker = "o" if len(curve) == 1 else None
            steps = curve["game_steps"]
            ax.plot(steps, curve["value"], color=style.colour, linestyle=style.line, label=label, marker=marker)
            if of_method["seed"].nunique() >= FEWEST_SEEDS:
                ax.fill_between(steps, curve["low"], curve["high"], color=style.colour, alpha=0.2, linewidth=0)
        for (label, scores), line in zip((references or {}).items(), cycle(_REFERENCE_LINES), strict=False):
            score = scores.get(name) if isinstance(scores, Mapping) else scores
            if score is not None:
                ax.axhline(score, color=_REFERENCE, linestyle=line, label=label)
        ax.set(xlabel="game steps", ylabel=y_label, title=fill(name, _TITLE_WIDTH))
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))
        _start_at_zero(ax, rows["score"].to_numpy())
    return _finish(figure, all_axes, title)


def draw_levels(
    results: pd.DataFrame,
    level: str,
    title: str | None = None,
    panel: str | None = None,
    y_label: str = TEAM_RETURN,
    names: Mapping[str, str] | None = None,
    maximum: float | None = None,
) -> Figure:
    """
    Draw bars of the return against a level: mean and, from three seeds on, 95 % interval (Student's t) over seeds.

    :param results: columns ``method``, ``seed``, ``score`` and the column named by ``level``; several rows of a run
        (episodes) are averaged
    :param level: for instance ``"coordination"``
    :param panel: column with one panel per value, for instance ``"task"``
    :param names: names of methods in words
    :param maximum: the largest possible score, drawn as a line
    """
    require_columns(results, ("method", "seed", level, "score"))
    panels = _panels(results, panel)
    styles = method_styles(_methods_of(results))
    figure, all_axes = _figure(len(panels))
    for ax, (name, rows) in zip(all_axes, panels, strict=True):
        # Side by side at each level, in the order of the methods.
        methods, levels = _methods_of(rows), list(dict.fromkeys(rows[level]))
        if not any(isinstance(value, str) for value in levels):
            levels.sort()
        width = min(0.3, 0.8 / len(methods))
        for index, method in enumerate(methods):
            of_method, style = rows[rows["method"] == method], styles[method]
            found = [value for value in levels if (of_method[level] == value).any()]
            means = [of_method[of_method[level] == value].groupby("seed")["score"].mean().to_numpy() for value in found]
            estimates = [mean_over_seeds(of_seeds).drawn(len(of_seeds)) for of_seeds in means]
            values = np.array([estimate.value for estimate in estimates])
            margins = np.array([[e.value - e.low, e.high - e.value] for e in estimates]).reshape(-1, 2).T
            places = [levels.index(value) + (index - (len(methods) - 1) / 2) * width for value in found]
            label = (names or {}).get(method, method)
            ax.bar(places, values, width * 0.92, color=style.colour, hatch=style.hatch, edgecolor="white", label=label)
            ax.errorbar(places, values, yerr=margins, fmt="none", ecolor="black", capsize=3, linewidth=1)
        ax.set_xticks(range(len(levels)), [str(value) for value in levels])
        ax.set_xlim(-0.6, len(levels) - 0.4)
        if maximum is not None:
            ax.axhline(maximum, color=_REFERENCE, linestyle=":", label="largest possible")
        ax.set(xlabel=level, ylabel=y_label, title=fill(name, _TITLE_WIDTH))
        _start_at_zero(ax, rows["score"].to_numpy())
    return _finish(figure, all_axes, title)


def draw_differences(
    compared: pd.DataFrame,
    title: str | None = None,
    panel: str | None = None,
    x_label: str = "difference",
    names: Mapping[str, str] | None = None,
    band: float | None = None,
    reference: str | None = None,
) -> Figure:
    """
    Draw paired differences with their intervals, one group of lines per level (a forest plot).

    :param compared: columns ``method``, ``level``, ``value``, ``low``, ``high`` (NaN for a single run), and optionally
        ``pooled``, whether a row is a mean over others, drawn as a diamond
    :param panel: column with one panel per value, for instance ``"task"``
    :param names: names of methods in words
    :param band: differences up to this size do not matter; drawn as a grey band
    :param reference: the method from which the others are subtracted, whose colour is not theirs
    """
    require_columns(compared, ("method", "level", "value", "low", "high"))
    panels = _panels(compared, panel)
    styles = method_styles([*([] if reference is None else [reference]), *_methods_of(compared)])
    figure, all_axes = _figure(len(panels), height=1.4 + 0.25 * max(len(rows) for _, rows in panels))
    for ax, (name, rows) in zip(all_axes, panels, strict=True):
        places = rows.assign(place=range(len(rows)))
        for method, here in places.groupby("method", sort=False):
            style, name_in_words = styles[str(method)], (names or {}).get(str(method), str(method))
            is_pooled = here["pooled"] if "pooled" in here else pd.Series(False, here.index)
            for rows_of_mark, mark, size in ((here[~is_pooled], style.mark, 5), (here[is_pooled], "D", 9)):
                if rows_of_mark.empty:
                    continue
                value, low, high, place = rows_of_mark[["value", "low", "high", "place"]].to_numpy(dtype=float).T
                ends, label = [value - low, high - value], name_in_words if mark == style.mark else None
                ax.errorbar(
                    value, place, xerr=ends, fmt=mark, color=style.colour, markersize=size, capsize=3, label=label
                )
        if band is not None:
            ax.axvspan(-band, band, color="#DDDDDD", zorder=0)
        middles = places.groupby("level", sort=False)["place"].mean()
        ax.set_yticks(middles.to_numpy(), middles.index)
        ax.axvline(0, color="black", linewidth=1)
        ax.invert_yaxis()
        ax.set(xlabel=x_label, title=fill(name, _TITLE_WIDTH))
    return _finish(figure, all_axes, title)


def draw_aggregates(
    scores: Mapping[str, Floats],
    title: str | None = None,
    x_label: str = "normalised score",
    names: Mapping[str, str] | None = None,
) -> Figure:
    """
    Draw interquartile means and performance profiles, both with stratified bootstrap intervals (rliable).

    :param scores: (S, K) scores of each method on S seeds and K tasks, normalised to 0 to 1
    """
    methods = _methods_of(pd.DataFrame({"method": list(scores)}))
    styles = method_styles(methods)
    ordered = {method: scores[method] for method in methods}
    figure, (left, right) = _figure(2, height=max(3.6, 1.4 + 0.3 * len(methods)))
    for row, (method, estimate) in enumerate(interquartile_means(ordered).items()):
        colour = styles[method].colour
        left.barh(row, estimate.high - estimate.low, left=estimate.low, height=0.6, color=colour, alpha=0.5)
        left.plot([estimate.value] * 2, [row - 0.3, row + 0.3], color="black", linewidth=1.5)
    words = [(names or {}).get(method, method) for method in methods]
    left.set_yticks(range(len(methods)), words)
    left.invert_yaxis()
    left.margins(x=0.1)
    left.use_sticky_edges = False  # bars end within the axes
    left.autoscale_view()
    left.set(xlabel=x_label, title="interquartile mean")
    top = max(float(runs.max()) for runs in scores.values())
    thresholds = np.linspace(0, top if top > 0 else 1, 101)
    for name, (method, profile) in zip(words, performance_profiles(ordered, thresholds).items(), strict=True):
        colour, line = styles[method].colour, styles[method].line
        right.plot(thresholds, profile.share, color=colour, linestyle=line, label=name)
        right.fill_between(thresholds, profile.low, profile.high, color=colour, alpha=0.2, linewidth=0)
    right.set(xlabel=f"{x_label}, threshold", ylabel="share of runs above it", title="performance profile")
    right.set_ylim(-0.02, 1.02)
    return _finish(figure, [left, right], title)
