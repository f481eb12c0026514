"""The tidy table: one row per cell and test level, made anew from the cells whenever it is needed."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from sb3_saf.experiments.cells import Cell, Grid, expand, merge
from sb3_saf.experiments.definitions import Experiment, Level
from sb3_saf.experiments.files import write_text
from sb3_saf.experiments.results import Results

#: Columns that differ between two runs of the same cells; all others are equal, bit for bit.
WALL_COLUMNS: Final = ("wall_seconds_training", "wall_seconds_test")


class Row(NamedTuple):
    """
    One cell, tested at one level.

    :param method: name of the algorithm, or ``"random"``
    :param task: the game
    :param train_coordination: c that it was trained at
    :param train_heterogeneity: h that it was trained at
    :param coordination: c that it was tested at
    :param heterogeneity: h that it was tested at
    :param seed: of the run
    :param n_agents: N
    :param n_treasures: the largest return there is
    :param game_steps: steps of the game that it was trained for; 0 for a random team
    :param episodes: team episodes of the test
    :param evaluation_seed: from which the games of the test got theirs
    :param return_mean: mean team return (treasures)
    :param return_low: lower end of its 95 % interval over episodes, Student's t
    :param return_high: upper end
    :param score: mean team return / treasures
    :param returns: team return of every episode, with spaces between
    :param wall_seconds_training: time that the training took
    :param wall_seconds_test: time that the test took
    :param cell: folder below ``cells``
    """

    method: str
    task: str
    train_coordination: int
    train_heterogeneity: int
    coordination: int
    heterogeneity: int
    seed: int
    n_agents: int
    n_treasures: int
    game_steps: int
    episodes: int
    evaluation_seed: int
    return_mean: float
    return_low: float
    return_high: float
    score: float
    returns: str
    wall_seconds_training: float
    wall_seconds_test: float
    cell: str

    @property
    def train_level(self) -> Level:
        """Where it was trained."""
        return Level(self.train_coordination, self.train_heterogeneity)

    @property
    def level(self) -> Level:
        """Where it was tested."""
        return Level(self.coordination, self.heterogeneity)


def requested(experiment: Experiment, results: Results) -> Grid:
    """
    All cells that were ever asked for in a folder, random teams last.

    :param results: a folder with a protocol
    """
    protocol = results.protocol()
    assert protocol is not None
    grids = [expand(experiment, choice, protocol) for choice in results.requests(experiment.name)]
    cells = merge(cell for grid in grids for cell in grid.cells)
    left_out = dict.fromkeys(left_out for grid in grids for left_out in grid.left_out)
    return Grid(sorted(cells, key=lambda cell: not cell.is_trained), list(left_out))


def rows(results: Results, cells: Iterable[Cell]) -> list[Row]:
    """
    What is finished of some cells.

    :return: in the cells' order, then their tests'
    """
    return [row for cell in cells for row in _rows_of(results, cell)]


def _rows_of(results: Results, cell: Cell) -> Iterator[Row]:
    tests = [test for level in cell.tests if (test := results.test(cell, level)) is not None]
    if not tests:
        return
    game_steps = int(results.config(cell).get("game_steps", 0))
    seconds = float(results.status(cell)["wall_seconds"])
    for test in tests:
        yield Row(
            cell.method,
            cell.task,
            *cell.level,
            test["coordination"],
            test["heterogeneity"],
            cell.seed,
            test["n_agents"],
            test["n_treasures"],
            game_steps,
            len(test["returns"]),
            test["evaluation_seed"],
            test["return_mean"],
            test["return_low"],
            test["return_high"],
            float(np.mean(test["returns"])) / test["n_treasures"],
            " ".join(f"{value:.12g}" for value in test["returns"]),
            seconds,
            test["wall_seconds"],
            cell.id,
        )


def to_csv(table: Sequence[Row]) -> str:
    """The table as text; floats in full, so that they come back as they were."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(Row._fields)
    writer.writerows(table)
    return buffer.getvalue()


def write_table(experiment: Experiment, results: Results) -> None:
    """Write ``table.csv`` from all that was ever asked for and is finished."""
    folder = results.folder / experiment.name
    write_text(folder / "table.csv", to_csv(rows(results, requested(experiment, results).cells)))
