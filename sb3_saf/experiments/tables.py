"""
Results as tidy pandas tables, for reports and custom figures.

Tables of tests have one row per cell and test level, and are always computed from the cells:

``method``, ``task``                 name of the method, or ``"random"``; the environment
``train_level``, ``level``           levels of training and test, such as ``"c2-h1"``
``train_...``, one column each       parameters of these levels, such as ``train_coordination``, ``coordination``
``seed``                             of the run
``n_agents``, ``max_return``         N; the largest possible team return, if known
``game_steps``, ``best_game_steps``  of the training, 0 for a random team; until the best policy of the evaluations
``episodes``, ``actions``            of the test, and whether they are drawn, as in training, or the most likely ones
``return_mean``, ``return_low``,     absolute metric: mean team return of the best policy, with its 95 % interval over
``return_high``, ``return_sd``       episodes (Student's t) and their standard deviation
``return_last``                      the same of the last policy
``return_most_likely``,              the same of best and last policy with the most likely actions
``return_last_most_likely``
``success_rate``, ``length``         fraction of episodes won; empty if the games do not report it; mean game steps
``score``                            fraction of the largest return; if that is unknown, of the range of all returns
                                     in the table on this task and level
``agent_returns``                    mean own return of every agent, separated by spaces
``processor_seconds``,               cost of training with its evaluations, and of the tests
``wall_seconds_training``, ``wall_seconds_test``
``commit``, ``processor``            version of this package, and kind of processor
``cell``                             folder below ``cells``
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from sb3_saf.experiments.definitions import MODULE, RANDOM, Experiment, Level, View
from sb3_saf.experiments.grid import Cell, Grid, expand, merge
from sb3_saf.experiments.results import BEST, EVALUATIONS, LAST, MOST_LIKELY, Results
from sb3_saf.teams.files import write_text
from sb3_saf.training.folders import python_command, read_curve
from sb3_saf.training.statistics import Estimate, mean_over_seeds

#: Minimum seeds for a comparison: two may agree by chance, and the interval then has no width.
FEWEST_SEEDS: Final = 3


class Frames(NamedTuple):
    """
    Results of an experiment.

    :param tests: see the module
    :param curves: one row for each point of a learning curve, columns ``method``, ``task``, ``level``, the level's
        parameters, ``seed``, ``game_steps``, ``processor_seconds`` and ``score``, mean training return
    """

    tests: pd.DataFrame
    curves: pd.DataFrame


def read_results(folder: str | Path, name: str) -> Frames:
    """
    Return the results of an experiment, complete or not.

    :param folder: folder of results, as in ``python -m sb3_saf.experiments run NAME -f FOLDER``
    :param name: name of the experiment
    :raises ValueError: for an unknown name, or if no cell is finished
    """
    results = Results(Path(folder))
    experiment = results.experiment(name)
    cells = [] if results.config() is None else requested(experiment, results).cells
    tests = frame_of_tests(results, cells)
    if tests.empty:
        raise ValueError(
            f"{folder} has no finished cell of {name!r}; run it first: {python_command(MODULE)} run {name} -f {folder}"
        )
    return Frames(tests.drop(columns=["cell"]), frame_of_curves(results, cells))


def requested(experiment: Experiment, results: Results) -> Grid:
    """Return all cells ever requested in a folder with settings, random teams last."""
    config = results.config()
    assert config is not None
    grids = [expand(experiment, selection, config) for selection in results.selections(experiment.name)]
    cells = merge(cell for grid in grids for cell in grid.cells)
    left_out = dict.fromkeys(left_out for grid in grids for left_out in grid.left_out)
    return Grid(sorted(cells, key=lambda cell: not cell.is_trained), list(left_out))


def frame_of_tests(results: Results, cells: Iterable[Cell]) -> pd.DataFrame:
    """Return the finished tests of some cells, in the order of cells, then of tests."""
    table = pd.DataFrame([row for cell in cells for row in _rows(results, cell)])
    if not table.empty:
        table["score"] = _scores(table)
    return table


def _rows(results: Results, cell: Cell) -> Iterator[dict[str, Any]]:
    run = results.run(cell)
    for level in cell.tests:
        test = results.test(cell, level)
        if run is None or test is None:
            continue
        evaluation, cost = test.evaluation, run.finished()
        low, high = evaluation.interval()
        means = {(play.policy, play.actions): play.evaluation.mean for play in test.plays}
        actions, versions = test.plays[0].actions, run.description["versions"]
        yield {
            **{"method": cell.method, "task": cell.task, "train_level": cell.level.slug, "level": level.slug},
            **{f"train_{name}": value for name, value in cell.level.parameters},
            **level.env_kwargs,
            "n_agents": test.n_agents,
            "max_return": test.max_return,
            "seed": cell.seed,
            "game_steps": int(run.description["settings"].get("game_steps", 0)),
            "best_game_steps": best_game_steps(run.folder) if cell.is_trained else 0,
            "episodes": len(evaluation.returns),
            "actions": actions,
            "return_mean": evaluation.mean,
            "return_low": low,
            "return_high": high,
            "return_sd": float(np.std(evaluation.returns, ddof=1)) if len(evaluation.returns) > 1 else math.nan,
            "return_last": means.get((LAST, actions), evaluation.mean),
            "return_most_likely": means.get((BEST, MOST_LIKELY), math.nan),
            "return_last_most_likely": means.get((LAST, MOST_LIKELY), math.nan),
            "success_rate": math.nan if evaluation.success_rate is None else evaluation.success_rate,
            "length": float(np.mean(evaluation.lengths)),
            "score": math.nan,
            "agent_returns": " ".join(f"{value:.12g}" for value in test.plays[0].agent_means),
            "processor_seconds": cost["processor_seconds"],
            "wall_seconds_training": cost["wall_seconds"],
            "wall_seconds_test": sum(play.wall_seconds for play in test.plays),
            "commit": versions["commit"],
            "processor": versions.get("processor", ""),
            "cell": cell.id,
        }


def best_game_steps(folder: Path) -> int:
    """Return the game steps of a run's best evaluation, the first of equal ones."""
    curve = pd.read_csv(folder / EVALUATIONS)
    return int(curve["game_steps"][curve["return_mean"].idxmax()])


def _scores(table: pd.DataFrame) -> pd.Series:
    """Return the fraction of the largest return, or of the range of returns on the same task and level."""
    here = table.groupby(["task", "level"])["return_mean"]
    low, high = here.transform("min"), here.transform("max")
    of_range = ((table["return_mean"] - low) / (high - low).where(high > low, 1.0)).astype(float)
    known = pd.to_numeric(table["max_return"])
    return (table["return_mean"] / known).where(known.notna(), of_range)


def write_table(experiment: Experiment, results: Results) -> None:
    """Write ``table.csv`` of all requested and finished cells; floats are stored exactly."""
    table = frame_of_tests(results, requested(experiment, results).cells)
    write_text(results.folder / experiment.name / "table.csv", table.to_csv(index=False, lineterminator="\n"))


def frame_of_curves(results: Results, cells: Iterable[Cell]) -> pd.DataFrame:
    """Return the learning curves of all trained cells in one table; empty if there are none."""
    curves = []
    for cell in cells:
        run = results.run(cell) if cell.is_trained else None
        if run is not None:
            names = {"method": cell.method, "task": cell.task, "level": cell.level.slug, **cell.level.env_kwargs}
            curve = read_curve(run.folder)[["game_steps", "processor_seconds", "score"]]
            curves.append(curve.assign(**names, seed=cell.seed))
    return pd.concat(curves, ignore_index=True) if curves else pd.DataFrame()


def of_view(table: pd.DataFrame, view: View) -> pd.DataFrame:
    """
    Return the rows of a view, with their position on the axis in a column with the axis's name.

    The random team belongs to every view, since it does not depend on training levels.

    :param table: table of tests
    """
    positions = {level.slug: view.position(level) for level in view.levels}
    trained_at = table["level"] if view.train is None else view.train.slug
    rows = table[table["level"].isin(positions) & ((table["method"] == RANDOM) | (table["train_level"] == trained_at))]
    return rows.assign(**{view.axis: rows["level"].map(positions)})


def strata(experiment: Experiment, table: pd.DataFrame) -> pd.DataFrame:
    """
    Return the rows of all views, each once, with a column ``stratum``, the task of aggregates.

    :param table: table of tests
    """
    parts = []
    for view in experiment.views:
        shown = of_view(table, view)
        parts.append(shown.assign(stratum=shown["task"] + " " + shown["level"] + view.suffix))
    return pd.concat(parts, ignore_index=True).drop_duplicates(["method", "seed", "stratum"])


def complete(rows: pd.DataFrame) -> pd.DataFrame:
    """
    Return the strata and seeds that every method has, so that aggregates are comparable.

    :param rows: columns ``method``, ``seed``, ``stratum``, one row for each
    :return: subset of the rows; empty if the methods have none in common
    """
    n_methods = rows["method"].nunique()
    rows = rows[rows.groupby("stratum")["method"].transform("nunique") == n_methods]
    n_strata = rows["stratum"].nunique()
    return rows[rows.groupby("seed")["stratum"].transform("size") == n_methods * n_strata]


class Comparison(NamedTuple):
    """
    Comparison of two methods on the same seeds and the same test games.

    :param seeds: common seeds
    :param first: mean return of the first, with its 95 % interval over these seeds
    :param second: the same for the second
    :param difference: mean of first - second, paired by seed
    """

    seeds: list[int]
    first: Estimate
    second: Estimate
    difference: Estimate

    @property
    def verdict(self) -> str:
        """Whether the first is higher or lower, or why there is no verdict."""
        if len(self.seeds) < FEWEST_SEEDS:
            return f"no winner: fewer than {FEWEST_SEEDS} seeds"
        if self.first.low > self.second.high and self.difference.low > 0:
            return "higher"
        if self.first.high < self.second.low and self.difference.high < 0:
            return "lower"
        return "no winner: intervals overlap"


class Compared(NamedTuple):
    """Comparison of a view's first method with another one, at a level of a task."""

    task: str
    level: Level
    ours: str
    other: str
    found: Comparison


def comparisons(table: pd.DataFrame, view: View) -> list[Compared]:
    """Compare SAF, or the first method if SAF is missing, with each other one, if they have common seeds."""
    rows, levels = of_view(table, view), {level.slug: level for level in view.levels}
    methods = list(dict.fromkeys(rows["method"]))
    ours = "saf" if "saf" in methods else next(iter(methods), RANDOM)
    return [
        Compared(str(task), levels[level], ours, other, found)
        for (task, level), here in rows.groupby(["task", "level"], sort=False)
        for other in methods
        if other != ours and (found := compare(*(here[here["method"] == one] for one in (ours, other)))) is not None
    ]


def compare(first: pd.DataFrame, second: pd.DataFrame) -> Comparison | None:
    """
    Compare two methods at one level of one task, naming a winner only where intervals do not overlap.

    :param first: columns ``seed`` and ``return_mean``
    :param second: the same
    :return: None if they have no seed in common
    """
    columns = ["seed", "return_mean"]
    pairs = first[columns].merge(second[columns], on="seed", suffixes=("_first", "_second")).sort_values("seed")
    if pairs.empty:
        return None
    ours, theirs = (pairs[f"return_mean_{side}"].to_numpy(dtype=np.float64) for side in ("first", "second"))
    return Comparison(
        pairs["seed"].tolist(), mean_over_seeds(ours), mean_over_seeds(theirs), mean_over_seeds(ours - theirs)
    )
