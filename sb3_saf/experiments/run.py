"""Run what is missing of an experiment, on an engine, and keep the table up to date."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from textwrap import shorten
from typing import NamedTuple

from tqdm import tqdm

from sb3_saf.experiments.cells import Cell, Choice, Grid, Protocol, Shard, expand
from sb3_saf.experiments.definitions import Experiment
from sb3_saf.experiments.engine import Ending, Engine, Job
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.table import write_table
from sb3_saf.experiments.work import Work, do


@dataclass(frozen=True)
class Machine:
    """
    How cells run, which changes nothing in their results but the last digits.

    :param device: as SB3 takes it
    :param threads: of torch in each worker
    :param retries: further attempts for a cell that failed or whose process died
    :param tensorboard: whether cells keep TensorBoard logs
    :param shared_disk: whether workers see the folder of results
    :param resume: whether cells that were killed go on from their last checkpoint, which takes a shared disk
    """

    device: str = "auto"
    threads: int = 1
    retries: int = 1
    tensorboard: bool = False
    shared_disk: bool = True
    resume: bool = True


class Summary(NamedTuple):
    """
    How a run ended.

    :param finished: cells that it finished
    :param failed: cells that failed for good
    """

    finished: int
    failed: list[Cell]


def run(
    experiment: Experiment,
    choice: Choice,
    protocol: Protocol,
    results: Results,
    engine: Engine,
    machine: Machine,
    shard: Shard,
) -> Summary:
    """
    Run the cells that are not finished.

    :raises ValueError: if something is wrong before the first cell starts
    """
    grid = expand(experiment, choice, protocol)
    results.agree(protocol)
    results.agree_on(grid.cells, protocol)
    with results.locked(shard):
        results.add_request(experiment.name, choice)
        cells = shard.of(grid.cells)
        todo = [cell for cell in cells if results.missing_tests(cell)]
        print(_opening(experiment, grid, cells, todo, shard, results))
        summary = _run_all(todo, protocol, results, engine, machine)
    write_table(experiment, results)
    return summary


def _opening(
    experiment: Experiment, grid: Grid, cells: Sequence[Cell], todo: Sequence[Cell], shard: Shard, results: Results
) -> str:
    lines = [str(left_out) for left_out in grid.left_out]
    part = "" if shard.count == 1 else f", {len(cells)} of them in part {shard}"
    lines.append(
        f"{experiment.name}: {len(grid.cells)} cells{part}; {len(cells) - len(todo)} finished, {len(todo)} to run in "
        f"{results.folder}"
    )
    return "\n".join(lines)


def _run_all(todo: Sequence[Cell], protocol: Protocol, results: Results, engine: Engine, machine: Machine) -> Summary:
    cells = {cell.id: cell for cell in todo}
    jobs = [Job(cell.id, partial(_work, cell, protocol, results, machine)) for cell in todo]
    finished, failed = 0, []
    endings = engine.run(do, jobs, machine.retries)
    # On a terminal a bar with the time that is left; in a log file a line per cell.
    with tqdm(total=len(jobs), unit="cell", disable=None, dynamic_ncols=True) as bar:
        try:
            for ended in endings:
                cell = cells[ended.job.name]
                if ended.result is not None:
                    results.add(cell, ended.result)
                    finished += 1
                elif ended.final:
                    results.add_failure(cell, protocol, ended.error or "")
                    failed.append(cell)
                bar.update(int(ended.final))
                bar.write(_line(cell, ended, results, f"{finished + len(failed)}/{len(jobs)}"), file=sys.stdout)
        finally:
            endings.close()  # type: ignore[attr-defined]
    return Summary(finished, failed)


def _work(cell: Cell, protocol: Protocol, results: Results, machine: Machine) -> Work:
    """What a worker is told when it takes a cell."""
    scratch = str(results.scratch) if machine.shared_disk else None
    return Work(
        cell,
        protocol,
        results.missing_tests(cell),
        results.model(cell),
        machine.device,
        machine.threads,
        machine.tensorboard,
        scratch,
        str(results.unfinished(cell)) if machine.shared_disk and machine.resume else None,
    )


def _line(cell: Cell, ended: Ending, results: Results, count: str) -> str:
    """One line about an ending."""
    if ended.error is None:
        tests = [(level, results.test(cell, level)) for level in cell.tests]
        returns = ", ".join(f"{test['return_mean']:.2f} ({level})" for level, test in tests if test is not None)
        return f"[{count}] {cell}: return {returns}"
    reason = shorten(ended.error.strip().splitlines()[-1], width=160, placeholder=" ...")
    if ended.final:
        return f"[{count}] {cell}: FAILED: {reason}; see {results.cell_folder(cell) / 'error.txt'}"
    return f"[{count}] {cell}: attempt {ended.attempt} failed, trying again: {reason}"
