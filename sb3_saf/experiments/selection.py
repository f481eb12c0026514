"""Which rows of an experiment's table belong together."""

from __future__ import annotations

import pandas as pd

from sb3_saf.experiments.definitions import HETEROGENEITY, RANDOM, Experiment, Level, View


def of_view(table: pd.DataFrame, view: View) -> pd.DataFrame:
    """
    The rows that a view shows, with the level in a column named as its axis.

    The random team belongs to every view: it is the same whatever others were trained at.

    :param table: columns of ``Row``
    """
    shown = [
        row.level in view.levels and (row.method == RANDOM or view.shows(row.trained_at, row.level))
        for row in with_levels(table).itertuples()
    ]
    rows = table[shown]
    return rows.assign(**{view.axis: rows[HETEROGENEITY if view.axis == HETEROGENEITY else "coordination"]})


def with_levels(table: pd.DataFrame) -> pd.DataFrame:
    """The table with columns ``level`` and ``trained_at``."""
    tested = zip(table["coordination"], table["heterogeneity"], strict=True)
    trained = zip(table["train_coordination"], table["train_heterogeneity"], strict=True)
    return table.assign(level=[Level(*pair) for pair in tested], trained_at=[Level(*pair) for pair in trained])


def strata(experiment: Experiment, table: pd.DataFrame) -> pd.DataFrame:
    """
    The rows of all views, each once, with a column ``stratum``: what aggregates count as one task.

    :param table: columns of ``Row``
    """
    parts = []
    for view in experiment.views:
        shown = with_levels(of_view(table, view))
        trained = "" if view.train is None else f", trained at {view.train}"
        names = [f"{row.task} {row.level}{trained}" for row in shown.itertuples()]
        parts.append(shown.assign(stratum=names))
    return pd.concat(parts, ignore_index=True).drop_duplicates(["method", "seed", "stratum"])


def complete(rows: pd.DataFrame) -> pd.DataFrame:
    """
    The strata and seeds that every method has, so that aggregates compare like with like.

    :param rows: columns ``method``, ``seed``, ``stratum``, one row for each
    :return: some of the rows; none if the methods have nothing in common
    """
    n_methods = rows["method"].nunique()
    rows = rows[rows.groupby("stratum")["method"].transform("nunique") == n_methods]
    n_strata = rows["stratum"].nunique()
    return rows[rows.groupby("seed")["stratum"].transform("size") == n_methods * n_strata]
