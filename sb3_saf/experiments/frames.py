"""Results as pandas tables, for reports and for figures of one's own."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from sb3_saf.experiments.cells import Cell
from sb3_saf.experiments.definitions import find_experiment
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.table import Row, requested, rows


class Frames(NamedTuple):
    """
    What is there of an experiment, in tidy tables.

    :param tests: one row for each cell and level that it was tested at, columns of
        :class:`~sb3_saf.experiments.table.Row`; ``return_mean`` is a mean over episodes, ``seed`` the training run
    :param curves: one row for each point of a learning curve, columns ``method``, ``task``, ``coordination``,
        ``heterogeneity``, ``level`` (both in one word), ``seed``, ``game_steps`` and ``score``, the mean team return of
        training episodes
    """

    tests: pd.DataFrame
    curves: pd.DataFrame


def read_results(folder: str | Path, name: str) -> Frames:
    """
    Read the results of an experiment, complete or not.

    :param folder: of the results, as given to ``python -m sb3_saf.experiments run NAME -f FOLDER``
    :param name: of the experiment
    :raises ValueError: for an unknown name, or if nothing of it is finished
    """
    experiment, results = find_experiment(name), Results(Path(folder))
    cells = [] if results.protocol() is None else requested(experiment, results).cells
    tests = frame_of_tests(rows(results, cells))
    if tests.empty:
        raise ValueError(
            f"{folder} has no finished cell of {name!r}; run it first: "
            f"python -m sb3_saf.experiments run {name} -f {folder}"
        )
    return Frames(tests, frame_of_curves(results, cells))


def frame_of_tests(finished: Iterable[Row]) -> pd.DataFrame:
    """
    The table of tests, without what only files need.

    :param finished: its rows
    """
    return pd.DataFrame(finished, columns=Row._fields).drop(columns=["returns", "cell"])


def frame_of_curves(results: Results, cells: Iterable[Cell]) -> pd.DataFrame:
    """
    Learning curves of all trained cells, in one table; empty if there are none.

    :param results: where cells are
    :param cells: which ones
    """
    found = []
    for cell in cells:
        path = results.cell_folder(cell) / "curve.csv"
        if results.is_finished(cell) and path.exists():
            level = {**cell.level._asdict(), "level": cell.level.slug}
            names = {"method": cell.method, "task": cell.task, **level, "seed": cell.seed}
            found.append(pd.read_csv(path).rename(columns={"mean_return": "score"}).assign(**names))
    return pd.concat(found, ignore_index=True) if found else pd.DataFrame()
