"""The tables of a report's page: means, losses, aggregates, comparisons."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import pandas as pd

from sb3_saf.experiments.comparisons import FEWEST_SEEDS, compare
from sb3_saf.experiments.definitions import RANDOM, Experiment, Level, View
from sb3_saf.experiments.selection import complete, of_view, strata, with_levels
from sb3_saf.training.statistics import Estimate, interquartile_means, mean_over_seeds, score_matrices

_NOTHING = "–"


def numbers(column: pd.Series) -> str:
    """The different numbers of a column, in order."""
    return ", ".join(str(value) for value in sorted(column.unique()))


def show(estimate: Estimate, digits: int = 2) -> str:
    """An estimate as text; the interval only if there is one."""
    value = f"{estimate.value:.{digits}f}"
    if math.isnan(estimate.low):
        return value
    return f"{value} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"


def markdown_table(head: Sequence[str], body: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a table."""
    return [_line(head), _line(["---"] * len(head)), *map(_line, body)]


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _trained(view: View) -> str:
    return "" if view.train is None else f", trained at {view.train}"


def means(table: pd.DataFrame, view: View) -> str:
    """
    Mean returns: a table for each task, a column for each level.

    :param table: columns of ``Row``
    """
    rows = with_levels(of_view(table, view))
    if rows.empty:
        return ""
    levels = [level for level in view.levels if level in set(rows["level"])]
    parts = [f"## Team return by {view.axis}{_trained(view)}", "", "Mean over seeds, 95 % interval (Student's t).", ""]
    for task, of_task in rows.groupby("task", sort=False):
        body = []
        for method, of_method in of_task.groupby("method", sort=False):
            by_level = [of_method.loc[of_method["level"] == level, "return_mean"] for level in levels]
            counts = sorted({len(values) for values in by_level if len(values)})
            body.append([str(method), *map(_mean, by_level), " or ".join(map(str, counts))])
        parts += [*markdown_table([f"{task}", *map(str, levels), "seeds"], body), ""]
    return "\n".join(parts).rstrip()


def _mean(values: pd.Series) -> str:
    return _NOTHING if values.empty else show(mean_over_seeds(values.to_numpy()))


def losses(table: pd.DataFrame, view: View) -> str:
    """
    What harder levels cost: the share of the first level's return that is lost, seed by seed.

    :param table: columns of ``Row``
    """
    rows = with_levels(of_view(table, view))
    first, *harder = view.levels
    harder = [level for level in harder if level in set(rows["level"])]
    if view.train is not None or not harder:
        return ""
    body = []
    for task, of_task in rows.groupby("task", sort=False):
        for method, of_method in of_task.groupby("method", sort=False):
            easy, *hard = (_by_seed(of_method, level) for level in (first, *harder))
            body.append([str(task), str(method), *(_loss(easy, each) for each in hard)])
    text = (
        f"Share of the return at {first} that is lost, in percent: mean over seeds of each seed's own loss, 95 % "
        f"interval (Student's t). {_NOTHING} where a seed has no return at {first} to lose."
    )
    title = f"## Loss by {view.axis}"
    return "\n".join([title, "", text, "", *markdown_table(["task", "", *map(str, harder)], body)])


def _by_seed(rows: pd.DataFrame, level: Level) -> pd.DataFrame:
    return rows.loc[rows["level"] == level, ["seed", "return_mean"]]


def _loss(easy: pd.DataFrame, hard: pd.DataFrame) -> str:
    pairs = easy.merge(hard, on="seed", suffixes=("_easy", "_hard"))
    if pairs.empty or not (pairs["return_mean_easy"] > 0).all():
        return _NOTHING
    share = pairs["return_mean_hard"] / pairs["return_mean_easy"]
    return show(mean_over_seeds((100 * (1 - share)).to_numpy()), digits=0)


def aggregates(experiment: Experiment, table: pd.DataFrame) -> str:
    """
    Interquartile means over the tasks, for each level and over everything.

    :param table: columns of ``Row``
    """
    common = complete(strata(experiment, table))
    if common.empty:
        return "## Aggregates\n\nNone yet: the methods have no seed in common on the same settings."
    text = (
        "Interquartile mean of the share of treasures collected, over tasks and the seeds "
        f"{numbers(common['seed'])}, which all methods have; 95 % stratified bootstrap intervals (rliable)."
    )
    parts = ["## Aggregates", "", text, ""]
    methods = list(dict.fromkeys(common["method"]))
    for view in experiment.views:
        columns = {str(level): found for level in view.levels if (found := _of_level(common, view, level))}
        if columns:
            head = [f"by {view.axis}{_trained(view)}", *columns]
            parts += [*_estimates(head, methods, columns.values()), ""]
    over_all = interquartile_means(score_matrices(common, "stratum"))
    return "\n".join([*parts, *_estimates(["over everything", "all"], methods, [over_all])])


def _of_level(common: pd.DataFrame, view: View, level: Level) -> dict[str, Estimate]:
    """Interquartile means at one level; empty if nothing is known of it."""
    train = view.train or level
    kept = [row.level == level and (row.method == RANDOM or row.trained_at == train) for row in common.itertuples()]
    rows = common[kept]
    return {} if rows.empty else interquartile_means(score_matrices(rows, "task"))


def _estimates(head: Sequence[str], methods: Iterable[str], columns: Iterable[dict[str, Estimate]]) -> list[str]:
    found = list(columns)
    return markdown_table(head, [[method, *(show(column[method], 3) for column in found)] for method in methods])


def comparisons(table: pd.DataFrame, view: View) -> str:
    """
    The first method against each other one, seed by seed.

    :param table: columns of ``Row``
    """
    rows = with_levels(of_view(table, view))
    methods = list(dict.fromkeys(rows["method"]))
    if len(methods) < 2:
        return ""
    ours = "saf" if "saf" in methods else methods[0]
    body = list(_compared(rows, ours, [method for method in methods if method != ours]))
    head = ["task", "level", f"{ours} against", "seeds", ours, "other", "difference", f"{ours} is"]
    text = (
        "Mean returns on the seeds that both have, with 95 % intervals over seeds; differences are taken seed by seed. "
        f"Where the intervals of the two overlap, that of the difference holds 0, or there are fewer than "
        f"{FEWEST_SEEDS} seeds, no winner is named. Every line is a test of its own; many lines name a winner "
        "by chance now and then."
    )
    title = f"## Paired comparisons by {view.axis}{_trained(view)}"
    return "\n".join([title, "", text, "", *markdown_table(head, body)])


def _compared(rows: pd.DataFrame, ours: str, others: Sequence[str]) -> Iterator[list[str]]:
    for (task, level), here in rows.groupby(["task", "level"], sort=False):
        for other in others:
            first, second = (here.loc[here["method"] == method, ["seed", "return_mean"]] for method in (ours, other))
            found = compare(first, second)
            if found is not None:
                numbers = [show(found.first), show(found.second), show(found.difference)]
                seeds = ", ".join(map(str, found.seeds))
                yield [str(task), str(level), other, seeds, *numbers, found.verdict]
