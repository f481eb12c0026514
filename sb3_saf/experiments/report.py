"""Report of an experiment: finished and missing cells, the paper's figures, a page of tables, and marl-eval's JSON."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from matplotlib.figure import Figure

from sb3_saf.experiments.comparisons import MARGIN, comparisons
from sb3_saf.experiments.definitions import METHODS, RANDOM, Experiment
from sb3_saf.experiments.grid import Cell, Selection
from sb3_saf.experiments.page import Content, page
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.tables import Frames, beside, complete, marl_eval, of_view, requested, strata, write_tables
from sb3_saf.suites.registry import find_environment
from sb3_saf.training.figures import TEAM_RETURN, draw_aggregates, draw_curves, draw_differences, draw_levels
from sb3_saf.training.statistics import score_matrices

#: Names of methods in words.
WORDS = {name: method.words for name, method in METHODS.items()}


class Report(NamedTuple):
    """Paths of the Markdown page and its figures, and the requested cells with the unfinished ones."""

    page: Path
    figures: list[Path]
    missing: list[Cell]
    n_cells: int


def write_report(
    experiment: Experiment, results: Results, wanted: Selection, published: Sequence[Frames] = ()
) -> Report:
    """
    Write the report of an experiment, complete or not. The old report is replaced when the new one is complete.

    :param wanted: the seeds, methods, environments and levels to show; empty for all that were run
    :param published: results to draw beside these, on the same games
    :raises ValueError: if nothing is finished
    """
    config = results.config()
    assert config is not None
    asked, shown = requested(experiment, results), experiment.at(wanted.levels)
    cells = [cell for cell in asked.cells if wanted.has(cell, experiment)]
    frames = _of_cells(write_tables(experiment, results), cells)
    if frames.tests.empty:
        raise ValueError(f"{results.folder} has no finished cell of {experiment.name!r} among those to be shown")
    for others in published:
        frames = beside(frames, others)
    figures = {**_views(shown, frames), **_aggregates(shown, frames), **_curves(shown, frames)}
    missing = [cell for cell in cells if results.missing_tests(cell)]
    content = Content(shown, config, results, cells, missing, asked.left_out, frames, list(figures))
    suite = find_environment(experiment.envs[0]).suite
    environment = "games" if suite is None else suite.name
    folder = results.folder / experiment.name
    with tempfile.TemporaryDirectory(dir=folder, prefix=".report-") as name:
        fresh = Path(name)
        for file, figure in figures.items():
            figure.savefig(fresh / file)
        (fresh / "report.md").write_text(page(content), encoding="utf-8")
        (fresh / "marl_eval.json").write_text(json.dumps(marl_eval(frames, environment), indent=1), encoding="utf-8")
        for file in (*figures, "marl_eval.json", "report.md"):
            os.replace(fresh / file, folder / file)
    return Report(folder / "report.md", [folder / file for file in figures], missing, len(cells))


def _of_cells(frames: Frames, cells: Sequence[Cell]) -> Frames:
    """Return the part of some tables that belongs to some cells and their tests."""
    tests = {(cell.id, level.slug) for cell in cells for level in cell.tests}
    runs = {(cell.method, cell.task, cell.level.slug, cell.seed) for cell in cells}
    is_test = [row in tests for row in frames.tests[["cell", "level"]].itertuples(index=False, name=None)]
    if frames.curves.empty:
        return Frames(frames.tests[is_test], frames.curves)
    names = frames.curves[["method", "task", "level", "seed"]].itertuples(index=False, name=None)
    return Frames(frames.tests[is_test], frames.curves[[row in runs for row in names]])


def _maximum(tests: pd.DataFrame) -> float | None:
    """Return the largest possible return if it is known and the same everywhere."""
    values = tests["max_return"].unique()
    return float(values[0]) if len(values) == 1 and pd.notna(values[0]) else None


def _y_label(tests: pd.DataFrame) -> str:
    return TEAM_RETURN if tests["max_return"].notna().all() else "team return"


def _views(experiment: Experiment, frames: Frames) -> dict[str, Figure]:
    """Return, for each axis of levels, a bar chart of the returns, and the paired differences."""
    figures = {}
    for view in experiment.views:
        rows = of_view(frames.tests, view)
        if rows.empty:
            continue
        name = view.axis.replace(" = ", "-")
        figures[f"levels-{name}.png"] = draw_levels(
            rows.assign(score=rows["return_mean"]),
            view.axis,
            title=f"{experiment.name}{view.suffix}",
            panel="task",
            y_label=_y_label(rows),
            names=WORDS,
            maximum=_maximum(rows),
        )
        compared = [one for one in comparisons(frames.tests, view) if one.other != RANDOM]
        if compared:
            lines = [(one.task, one.other, str(one.level), *one.found.test.estimate) for one in compared]
            maximum, ours = _maximum(rows), compared[0].ours
            figures[f"differences-{name}.png"] = draw_differences(
                pd.DataFrame(lines, columns=["task", "method", "level", "value", "low", "high"]),
                title=f"{WORDS.get(ours, ours)} minus others, seed by seed{view.suffix}",
                panel="task",
                x_label="difference of team returns, 95 % interval",
                names=WORDS,
                band=None if maximum is None else MARGIN * maximum,
            )
    return figures


def _aggregates(experiment: Experiment, frames: Frames) -> dict[str, Figure]:
    """Return interquartile means and performance profiles over the results that all methods have."""
    common = complete(strata(experiment, frames.tests))
    if common.empty:
        return {}
    seeds = ", ".join(map(str, sorted(common["seed"].unique())))
    title = f"{experiment.name}: {common['stratum'].nunique()} settings, seeds {seeds}"
    label = "treasures collected (share)" if common["max_return"].notna().all() else "normalised return"
    figure = draw_aggregates(score_matrices(common, "stratum"), title=title, x_label=label, names=WORDS)
    return {"aggregates.png": figure}


def _curves(experiment: Experiment, frames: Frames) -> dict[str, Figure]:
    """Return the learning curves of each training setting, against game steps and processor time."""
    figures: dict[str, Figure] = {}
    if frames.curves.empty:
        return figures
    titles = {level.slug: str(level) for level in experiment.tests()}
    tests = frames.tests[frames.tests["method"] == RANDOM]
    for (task, level), runs in frames.curves.groupby(["task", "level"], sort=False):
        random = tests[(tests["task"] == task) & (tests["level"] == level)]
        random = random[["method", "seed", "return_mean"]].rename(columns={"return_mean": "score"})
        panels = []
        for name, x in (("against game steps", "game_steps"), ("against processor time", "processor_seconds")):
            ends = pd.DataFrame({"game_steps": [runs[x].min(), runs[x].max()]})
            parts = [runs[["method", "seed", "score"]].assign(game_steps=runs[x]), random.merge(ends, how="cross")]
            panels.append(pd.concat([part for part in parts if len(part)]).assign(panel=name))
        figure = draw_curves(
            pd.concat(panels, ignore_index=True),
            title=f"{experiment.name}: {task}, {titles[level]}",
            panel="panel",
            y_label=_y_label(frames.tests),
            names=WORDS,
        )
        figure.axes[1].set_xlabel("processor time of the training (s)")
        slug = str(task).replace(":", "-")
        figures[f"curve-{slug}-{level}.png"] = figure
    return figures
