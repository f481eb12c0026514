"""Plan of an experiment, and the run of its missing cells on an engine."""

from __future__ import annotations

import shutil
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import timedelta
from textwrap import shorten
from typing import Any, NamedTuple

from filelock import BaseFileLock

from sb3_saf.experiments.cell import Job
from sb3_saf.experiments.definitions import Cell, Experiment, RunConfig, Selection, Shard, expand
from sb3_saf.experiments.engines import Engine
from sb3_saf.experiments.results import BEST_MODEL, MODEL, Results
from sb3_saf.experiments.tables import write_tables
from sb3_saf.teams.files import write_text
from sb3_saf.training.folders import Run


def make_plan(
    experiment: Experiment,
    selection: Selection,
    config: RunConfig,
    results: Results,
    shard: Shard = Shard(),  # noqa: B008 (immutable)
) -> str:
    """Return the cells, the game steps and, if cells are finished, the remaining time, as text."""
    everything = expand(experiment, selection, config)
    results.agree(config, everything)
    cells = shard.of(everything)
    trained = [cell for cell in cells if cell.is_trained]
    finished = [(cell, run) for cell in trained if (run := results.run(cell)) is not None]
    steps = {cell.id: config.settings(cell).game_steps for cell in trained}
    left = sum(steps.values()) - sum(steps[cell.id] for cell, _ in finished)
    n_tests = sum(len(results.missing_tests(cell)) for cell in cells)
    each = " or ".join(f"{count:,}" for count in sorted(set(steps.values())))
    settings = []
    for task, level, tests in dict.fromkeys((cell.task, cell.level, cell.tests) for cell in trained):
        here = [cell for cell in trained if (cell.task, cell.level) == (task, level)]
        methods = " ".join(dict.fromkeys(cell.method for cell in here))
        seeds = " ".join(str(seed) for seed in dict.fromkeys(cell.seed for cell in here))
        tested = "" if tests == (level,) else f", tested at {'; '.join(map(str, tests))}"
        settings.append(f"            {task}, {level}{tested}: {methods}, seeds {seeds}")
    factors: dict[str, set[Any]] = {
        "methods": {cell.method for cell in trained},
        "settings": {(cell.task, cell.level) for cell in trained},
        "seeds": {cell.seed for cell in trained},
    }
    product = " x ".join(f"{len(values)} {name}" for name, values in factors.items())
    lines = [
        f"{experiment.name}, size {config.size}: {experiment.question}",
        *settings,
        f"cells       {len(trained)} to train ({product}), {len(finished)} of them finished",
        f"tests       {n_tests} to play, of {config.episodes} team episodes each, random teams included",
        f"game steps  {left:,} left of {sum(steps.values()):,} ({each} a cell)",
    ]
    if seconds := sum(run.finished()["wall_seconds"] for _, run in finished):
        rate = sum(steps[cell.id] for cell, _ in finished) / seconds
        lines.append(f"rate        {rate:,.0f} game steps/s of one worker in the finished cells")
        lines.append(
            f"time        about {timedelta(seconds=round(left / rate))} (h:mm:ss) of one worker at this rate"
            if left
            else ""
        )
    return "\n".join(line for line in lines if line)


@dataclass(frozen=True)
class CellOptions:
    """
    Options for running cells, which affect only the last digits of results.

    :param retries: additional attempts for a failed or killed cell
    :param tensorboard: whether cells keep TensorBoard logs
    :param resume: whether killed cells continue from their last checkpoint
    """

    device: str = "auto"
    threads: int = 1
    retries: int = 1
    tensorboard: bool = False
    resume: bool = True


class Summary(NamedTuple):
    """Result of a run: finished cells, cells that failed finally, and cells of other runs."""

    finished: int
    failed: list[Cell]
    elsewhere: list[Cell]


class Attempt(NamedTuple):
    """A running cell, the attempt's number from 1, and the lock against other runs."""

    cell: Cell
    number: int
    lock: BaseFileLock


def run(
    experiment: Experiment,
    selection: Selection,
    config: RunConfig,
    results: Results,
    engine: Engine,
    options: CellOptions | None = None,
    shard: Shard = Shard(),  # noqa: B008 (immutable)
) -> Summary:
    """
    Run the unfinished cells. Several runs may share a folder: each cell is run by one of them.

    :param engine: closed at the end
    :raises ValueError: for invalid arguments, before the first cell starts
    """
    everything = expand(experiment, selection, config)
    results.check_experiment(experiment)
    before = [cell for one in results.selections(experiment.name) for cell in expand(experiment, one, config)]
    results.agree(config, [*everything, *before])  # the report has all of them
    cells = shard.of(everything)
    todo = [cell for cell in cells if results.missing_tests(cell)]
    progress = _Progress(todo, config, results, engine, options or CellOptions())
    results.save_config(config)  # of settings with which all cells can be made
    results.agree(config)  # another run may have begun meanwhile
    results.add_selection(experiment, selection)
    for error in results.damaged.values():
        print(f"damaged, what it belongs to is run again: {error}")
    part = "" if shard.parts == 1 else f", {len(cells)} of them in part {shard}"
    print(
        f"{experiment.name}: {len(everything)} cells{part}; {len(cells) - len(todo)} finished, {len(todo)} to run in "
        f"{results.folder}"
    )
    progress.work()
    summary = Summary(progress.n_finished, progress.failed, progress.elsewhere)
    if summary.elsewhere:
        print(f"{len(summary.elsewhere)} cells were left to another run in {results.folder}")
    write_tables(experiment, results)
    return summary


class _Progress:
    """Cells of one run: waiting, running, ended."""

    def __init__(
        self, todo: Sequence[Cell], config: RunConfig, results: Results, engine: Engine, options: CellOptions
    ) -> None:
        self._config, self._results, self._engine, self._options = config, results, engine, options
        self._waiting = deque((cell, 1) for cell in todo)
        self._at_work: dict[Future[None], Attempt] = {}
        self.n_finished = 0
        self.failed: list[Cell] = []
        self.elsewhere: list[Cell] = []
        self._n_cells, self._clock = len(todo), time.monotonic()
        #: Game steps of the cells that have not ended, and of those that are finished.
        self._left = {cell.id: config.settings(cell).game_steps if cell.is_trained else 0 for cell in todo}
        self._played = 0

    @property
    def _count(self) -> str:
        """How many cells have ended, of how many."""
        return f"[{self._n_cells - len(self._left)}/{self._n_cells}]"

    def work(self) -> None:
        """Run all cells, close the engine, and release the locks of cells that are still at work after an error."""
        try:
            with self._engine:
                self._start_some()
                while self._at_work:
                    done, _ = wait(self._at_work, return_when=FIRST_COMPLETED)
                    for future in done:
                        attempt = self._at_work[future]
                        print(self._end(attempt, future.exception()), flush=True)
                        del self._at_work[future]
                        attempt.lock.release()
                    self._start_some()
        finally:
            for attempt in self._at_work.values():
                attempt.lock.release()

    def _start_some(self) -> None:
        while self._waiting and len(self._at_work) < self._engine.slots:
            cell, number = self._waiting.popleft()
            lock = self._results.lock(cell)
            tests = () if lock is None else self._results.missing_tests(cell)
            if lock is None or not tests:  # another run has locked or finished it
                self.elsewhere.append(cell)
                del self._left[cell.id]
                if lock is not None:
                    lock.release()
                continue
            self._at_work[self._start(replace(cell, tests=tests))] = Attempt(cell, number, lock)

    def _start(self, cell: Cell) -> Future[None]:
        """Write the worker's input to the cell's folder, and submit it."""
        results, options, folder = self._results, self._options, self._results.unfinished(cell)
        trained, begun = results.run(cell), False
        with suppress(ValueError):
            description, begun_with = self._config.describe(cell), Run(folder / "result").description
            begun = {name: begun_with[name] for name in description} == description
        if not (options.resume and begun) or trained is not None:
            shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        for name in ("error.txt", MODEL, BEST_MODEL):
            (folder / name).unlink(missing_ok=True)
        if cell.is_trained and trained is not None:
            for name in (BEST_MODEL, MODEL):
                shutil.copy(trained.folder / name, folder)
        Job(cell, self._config, options.device, options.threads, options.tensorboard).write(folder)
        return self._engine.submit(folder)

    def _end(self, attempt: Attempt, error: BaseException | None) -> str:
        """Store the result or the error of an attempt; return a line about it."""
        cell = attempt.cell
        folder = self._results.unfinished(cell)
        asked = [folder / "result" / "tests" / f"{level.slug}.json" for level in Job.read(folder).cell.tests]
        if error is None and not all(path.exists() for path in asked):
            error = RuntimeError("the worker ended without results; does the game end its process?")
        if error is None:
            self._results.publish(cell)
            self.n_finished += 1
            self._played += self._left.pop(cell.id)
            found = [(level, self._results.test(cell, level)) for level in cell.tests]
            returns = ", ".join(f"{test.evaluation.mean:.2f} ({level})" for level, test in found if test is not None)
            # The rate of this run, and the remaining time at that rate.
            speed = ""
            if self._played and (left := sum(self._left.values())):
                rate = self._played / (time.monotonic() - self._clock)
                speed = f"; {rate:,.0f} game steps/s, about {timedelta(seconds=round(left / rate))} (h:mm:ss) left"
            return f"{self._count} {cell}: return {returns}{speed}"
        reason = shorten(str(error).strip().splitlines()[-1], width=160, placeholder=" ...")
        if attempt.number <= self._options.retries:
            self._waiting.append((cell, attempt.number + 1))
            return f"{self._count} {cell}: attempt {attempt.number} failed, trying again: {reason}"
        self.failed.append(cell)
        del self._left[cell.id]
        path = folder / "error.txt"
        write_text(path, str(error))
        return f"{self._count} {cell}: FAILED: {reason}; see {path}"
