"""An experiment's report: what is there, what is missing, the paper's figures, and a page of tables."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pandas as pd
from matplotlib.figure import Figure

from sb3_saf.experiments.cells import Cell, Choice
from sb3_saf.experiments.definitions import RANDOM, Experiment, Level
from sb3_saf.experiments.frames import frame_of_curves, frame_of_tests
from sb3_saf.experiments.page import Content, write_page
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.selection import complete, of_view, strata
from sb3_saf.experiments.table import requested, rows, write_table
from sb3_saf.training.figures import draw_aggregates, draw_curves, draw_levels
from sb3_saf.training.statistics import score_matrices


class Report(NamedTuple):
    """
    What was written.

    :param page: the Markdown page
    :param figures: the pictures
    :param missing: cells that are not finished
    :param n_cells: all that were asked for
    """

    page: Path
    figures: list[Path]
    missing: list[Cell]
    n_cells: int


def write_report(experiment: Experiment, results: Results, wanted: Choice) -> Report:
    """
    Draw and write what is there of an experiment, complete or not.

    :param wanted: the seeds, methods, tasks and levels to show; empty ones for all that were run
    :raises ValueError: if nothing is finished
    """
    protocol = results.protocol()
    assert protocol is not None
    asked, shown = requested(experiment, results), experiment.at(wanted.levels)
    cells = [cell for cell in asked.cells if _is_wanted(cell, wanted, shown)]
    finished = rows(results, cells)
    if not finished:
        raise ValueError(f"{results.folder} has no finished cell of {experiment.name!r} among those to be shown")
    folder = results.folder / experiment.name
    write_table(experiment, results)
    table = frame_of_tests(finished)
    curves = frame_of_curves(results, cells)
    figures = [
        *_draw_views(shown, table, folder),
        *_draw_aggregates(shown, table, folder),
        *_draw_curves(shown, curves, table, folder),
    ]
    missing = [cell for cell in cells if results.missing_tests(cell)]
    content = Content(shown, protocol, results, cells, missing, asked.left_out, table, figures)
    return Report(write_page(content, folder / "report.md"), figures, missing, len(cells))


def _is_wanted(cell: Cell, wanted: Choice, shown: Experiment) -> bool:
    """Whether a cell is to be shown; the random team always is, on what is."""
    levels = {level for train, tests in shown.settings for level in ((train,) if cell.is_trained else tests)}
    return (
        (not wanted.seeds or cell.seed in wanted.seeds)
        and (not wanted.tasks or cell.task in wanted.tasks)
        and (not wanted.methods or cell.method in wanted.methods or not cell.is_trained)
        and cell.level in levels
    )


def _save(figure: Figure, path: Path) -> Path:
    figure.savefig(path)
    return path


def _draw_views(experiment: Experiment, table: pd.DataFrame, folder: Path) -> list[Path]:
    """One bar chart for each dial."""
    paths = []
    for view in experiment.views:
        shown = of_view(table, view)
        if shown.empty:
            continue
        trained = "" if view.train is None else f", trained at {view.train}"
        drawn = shown.assign(score=shown["return_mean"])
        figure = draw_levels(drawn, view.axis, title=f"{experiment.name}{trained}", panel="task")
        paths.append(_save(figure, folder / f"levels-{view.axis.replace(' = ', '-')}.png"))
    return paths


def _draw_aggregates(experiment: Experiment, table: pd.DataFrame, folder: Path) -> list[Path]:
    """Interquartile means and performance profiles over everything that all methods have."""
    common = complete(strata(experiment, table))
    if common.empty:
        return []
    seeds = ", ".join(map(str, sorted(common["seed"].unique())))
    title = f"{experiment.name}: {common['stratum'].nunique()} settings, seeds {seeds}"
    figure = draw_aggregates(score_matrices(common, "stratum"), title=title, x_label="treasures collected (share)")
    return [_save(figure, folder / "aggregates.png")]


def _draw_curves(experiment: Experiment, curves: pd.DataFrame, table: pd.DataFrame, folder: Path) -> list[Path]:
    """One figure for each setting that was trained at, with the random team as a line."""
    paths: list[Path] = []
    if curves.empty:
        return paths
    for (task, *dials), runs in curves.groupby(["task", *Level._fields], sort=False):
        level = Level(*dials)
        at_level = (table["coordination"] == level.coordination) & (table["heterogeneity"] == level.heterogeneity)
        random = table[(table["method"] == RANDOM) & (table["task"] == task) & at_level]
        steps = pd.DataFrame({"game_steps": [runs["game_steps"].min(), runs["game_steps"].max()]})
        line = random[["method", "seed", "return_mean"]].rename(columns={"return_mean": "score"})
        together = pd.concat([runs, line.merge(steps, how="cross")], ignore_index=True)
        figure = draw_curves(together, title=f"{experiment.name}: {task}, {level}")
        paths.append(_save(figure, folder / f"curve-{task}-{level.slug}.png"))
    return paths
