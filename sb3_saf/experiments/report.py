"""Report of an experiment: finished and missing cells, the paper's figures, and a page of tables."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Final, NamedTuple

import pandas as pd
from matplotlib.figure import Figure

from sb3_saf.experiments.definitions import RANDOM, Experiment
from sb3_saf.experiments.grid import Cell, RunConfig, Selection
from sb3_saf.experiments.page import Content, page
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.tables import (
    comparisons,
    complete,
    frame_of_curves,
    frame_of_tests,
    of_view,
    requested,
    strata,
    write_table,
)
from sb3_saf.training.figures import TEAM_RETURN, draw_aggregates, draw_curves, draw_differences, draw_levels
from sb3_saf.training.statistics import require_columns, score_matrices

#: Columns of a file of reference teams; all others are parameters of the environment.
_SCALE_COLUMNS: Final = ("task", "name", "mean", "low", "high")
_AGAINST_STEPS: Final = "against game steps"
_AGAINST_TIME: Final = "against processor time"


class Report(NamedTuple):
    """Paths of the Markdown page and its figures, and the requested cells with the unfinished ones."""

    page: Path
    figures: list[Path]
    missing: list[Cell]
    n_cells: int


def write_report(
    experiment: Experiment, results: Results, wanted: Selection, scale: pd.DataFrame | None = None
) -> Report:
    """
    Write the report of an experiment, complete or not. The old report is replaced when the new one is complete.

    :param wanted: the seeds, methods, environments and levels to show; empty for all that were run
    :param scale: returns of reference teams, from :func:`read_scale`
    :raises ValueError: if nothing is finished
    """
    config = results.config()
    assert config is not None
    asked, shown = requested(experiment, results), experiment.at(wanted.levels)
    cells = [cell for cell in asked.cells if wanted.has(cell, experiment)]
    table, curves = frame_of_tests(results, cells), frame_of_curves(results, cells)
    if table.empty:
        raise ValueError(f"{results.folder} has no finished cell of {experiment.name!r} among those to be shown")
    drawer = _Drawer(shown, table, curves, _references(scale, cells, config))
    figures = {**drawer.views(), **drawer.aggregates(), **drawer.curves()}
    missing = [cell for cell in cells if results.missing_tests(cell)]
    content = Content(shown, config, results, cells, missing, asked.left_out, table, curves, list(figures))
    folder = results.folder / experiment.name
    with tempfile.TemporaryDirectory(dir=folder, prefix=".report-") as name:
        fresh = Path(name)
        for file, figure in figures.items():
            figure.savefig(fresh / file)
        (fresh / "report.md").write_text(page(content), encoding="utf-8")
        for file in (*figures, "report.md"):
            os.replace(fresh / file, folder / file)
    write_table(experiment, results)
    return Report(folder / "report.md", [folder / file for file in figures], missing, len(cells))


def read_scale(path: Path) -> pd.DataFrame:
    """Read reference teams: columns ``task``, ``name``, ``mean`` and parameters; ValueError for missing columns."""
    try:
        scale = pd.read_csv(path)
        require_columns(scale, ("task", "name", "mean"))
        return scale.astype({"task": str, "name": str, "mean": float})
    except ValueError as error:
        raise ValueError(f"{path} is no file of reference teams: {error}") from None


def _references(scale: pd.DataFrame | None, cells: Iterable[Cell], config: RunConfig) -> pd.DataFrame:
    """Return the reference teams of the levels of some cells: columns ``task``, ``level``, ``name``, ``score``."""
    found = []
    if scale is not None:
        parameters = [name for name in scale.columns if name not in _SCALE_COLUMNS]
        for env, level in dict.fromkeys((cell.env, level) for cell in cells for level in cell.tests):
            cell = Cell(RANDOM, env, level, 0)
            here = config.settings(cell).env_kwargs
            rows = scale[scale["task"] == cell.task]
            for name in parameters:
                rows = rows[rows[name] == here.get(name)]
            found += [(cell.task, level.slug, row["name"], row["mean"]) for _, row in rows.iterrows()]
    return pd.DataFrame(found, columns=["task", "level", "name", "score"])


class _Drawer:
    """Drawer of an experiment's figures, by file name."""

    def __init__(self, experiment: Experiment, table: pd.DataFrame, curves: pd.DataFrame, scale: pd.DataFrame) -> None:
        self._experiment, self._table, self._curves = experiment, table, curves
        others = scale[~scale["name"].isin(set(table["method"]))]
        self._scale = others.assign(name="reference: " + others["name"].astype(str))
        self._is_hecogrid = bool(table["max_return"].notna().all())
        self._y_label = TEAM_RETURN if self._is_hecogrid else "team return"

    def views(self) -> dict[str, Figure]:
        """Return, for each axis of levels, a bar chart with reference teams as lines, and the paired differences."""
        figures = {}
        for view in self._experiment.views:
            shown = of_view(self._table, view)
            if shown.empty:
                continue
            name, positions = view.axis.replace(" = ", "-"), {level.slug: view.position(level) for level in view.levels}
            here = self._scale[self._scale["level"].isin(positions)]
            figures[f"levels-{name}.png"] = draw_levels(
                shown.assign(score=shown["return_mean"]),
                view.axis,
                title=f"{self._experiment.name}{view.suffix}",
                panel="task",
                y_label=self._y_label,
                references=here.assign(**{view.axis: here["level"].map(positions)}),
            )
            compared = [one for one in comparisons(self._table, view) if one.other != RANDOM]
            if compared:
                rows = [(one.task, one.other, str(one.level), *one.found.difference) for one in compared]
                figures[f"differences-{name}.png"] = draw_differences(
                    pd.DataFrame(rows, columns=["task", "method", "level", "value", "low", "high"]),
                    title=f"{compared[0].ours} minus others, seed by seed{view.suffix}",
                    panel="task",
                    x_label="difference of team returns, 95 % interval",
                )
        return figures

    def aggregates(self) -> dict[str, Figure]:
        """Return interquartile means and performance profiles over the results that all methods have."""
        common = complete(strata(self._experiment, self._table))
        if common.empty:
            return {}
        seeds = ", ".join(map(str, sorted(common["seed"].unique())))
        title = f"{self._experiment.name}: {common['stratum'].nunique()} settings, seeds {seeds}"
        label = "treasures collected (share)" if self._is_hecogrid else "normalised return"
        return {"aggregates.png": draw_aggregates(score_matrices(common, "stratum"), title=title, x_label=label)}

    def curves(self) -> dict[str, Figure]:
        """Return the learning curves of each training setting, against game steps and processor time."""
        figures: dict[str, Figure] = {}
        if self._curves.empty:
            return figures
        names = {level.slug: str(level) for level in self._experiment.tests()}
        for (task, level), runs in self._curves.groupby(["task", "level"], sort=False):
            here = (self._table["task"] == task) & (self._table["level"] == level)
            random = self._table[here & (self._table["method"] == RANDOM)]
            random = random[["method", "seed", "return_mean"]].rename(columns={"return_mean": "score"})
            panels = []
            for name, x in ((_AGAINST_STEPS, "game_steps"), (_AGAINST_TIME, "processor_seconds")):
                of_methods = runs[["method", "seed", "score"]].assign(game_steps=runs[x])
                ends = pd.DataFrame({"game_steps": [runs[x].min(), runs[x].max()]})
                panels.append(_together(of_methods, random.merge(ends, how="cross")).assign(panel=name))
            scale = self._scale[(self._scale["task"] == task) & (self._scale["level"] == level)]
            figure = draw_curves(
                pd.concat(panels, ignore_index=True),
                title=f"{self._experiment.name}: {task}, {names[level]}",
                panel="panel",
                y_label=self._y_label,
                references=dict(zip(scale["name"], scale["score"], strict=True)),
            )
            figure.axes[1].set_xlabel("processor time of the training (s)")
            slug = str(task).replace(":", "-")
            figures[f"curve-{slug}-{level}.png"] = figure
        return figures


def _together(*tables: pd.DataFrame) -> pd.DataFrame:
    """Concatenate non-empty tables; pandas warns about empty ones."""
    return pd.concat([table for table in tables if not table.empty], ignore_index=True)
