"""Plan of an experiment: its cells, and the remaining work."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import timedelta

from sb3_saf.experiments.definitions import Experiment
from sb3_saf.experiments.grid import Cell, RunConfig, Selection, expand
from sb3_saf.experiments.results import Results


def make_plan(experiment: Experiment, selection: Selection, config: RunConfig, results: Results) -> str:
    """Return the cells, the game steps and, if cells are finished, the remaining time, as text."""
    grid = expand(experiment, selection, config)
    results.agree(config, grid.cells)
    trained = [cell for cell in grid.cells if cell.is_trained]
    finished = [cell for cell in trained if results.is_finished(cell)]
    steps = {cell.id: config.settings(cell).game_steps for cell in trained}
    left = sum(steps.values()) - sum(steps[cell.id] for cell in finished)
    n_tests = sum(len(results.missing_tests(cell)) for cell in grid.cells)
    each = " or ".join(f"{count:,}" for count in sorted(set(steps.values())))
    lines = [
        f"{experiment.name}, size {config.size}: {experiment.question}",
        *_settings(trained),
        *(f"left out    {left_out}" for left_out in grid.left_out),
        f"cells       {len(trained)} to train ({_factors(trained)}), {len(finished)} of them finished",
        f"tests       {n_tests} to play, of {config.episodes} team episodes each, random teams included",
        f"game steps  {left:,} left of {sum(steps.values()):,} ({each} a cell)",
    ]
    seconds = sum(status["wall_seconds"] for cell in finished if (status := results.status(cell)) is not None)
    if seconds:
        rate = sum(steps[cell.id] for cell in finished) / seconds
        lines.append(f"rate        {rate:,.0f} game steps/s of one worker in the finished cells")
        lines.append(
            f"time        about {timedelta(seconds=round(left / rate))} (h:mm:ss) of one worker at this rate"
            if left
            else ""
        )
    return "\n".join(line for line in lines if line)


def _settings(cells: Sequence[Cell]) -> Iterator[str]:
    """Yield a line for each setting, with its methods and seeds."""
    for task, level, tests in dict.fromkeys((cell.task, cell.level, cell.tests) for cell in cells):
        here = [cell for cell in cells if (cell.task, cell.level) == (task, level)]
        methods = " ".join(dict.fromkeys(cell.method for cell in here))
        seeds = " ".join(str(seed) for seed in dict.fromkeys(cell.seed for cell in here))
        tested = "" if tests == (level,) else f", tested at {'; '.join(map(str, tests))}"
        yield f"            {task}, {level}{tested}: {methods}, seeds {seeds}"


def _factors(cells: Sequence[Cell]) -> str:
    """Return the factors of the number of cells as text."""
    counts: dict[str, set[object]] = {
        "methods": {cell.method for cell in cells},
        "settings": {(cell.task, cell.level) for cell in cells},
        "seeds": {cell.seed for cell in cells},
    }
    return " x ".join(f"{len(values)} {name}" for name, values in counts.items())
