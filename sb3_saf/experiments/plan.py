"""What a run would cost, before it runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from sb3_saf.experiments.cells import Cell, Choice, Protocol, expand
from sb3_saf.experiments.definitions import Experiment
from sb3_saf.experiments.measure import Measurement, measure
from sb3_saf.experiments.results import Results

_UNITS: Final = (("d", 86_400), ("h", 3_600), ("min", 60), ("s", 1))


def make_plan(
    experiment: Experiment,
    choice: Choice,
    protocol: Protocol,
    results: Results,
    *,
    workers: int,
    threads: int,
    device: str,
    rate: float | None,
) -> str:
    """
    The number of cells, game steps, time and memory, as text.

    :param workers: cells at the same time
    :param threads: of each worker
    :param device: as SB3 takes it
    :param rate: game steps per second of one worker; None to measure
    """
    grid = expand(experiment, choice, protocol)
    results.agree_on(grid.cells, protocol)
    trained = [cell for cell in grid.cells if cell.is_trained]
    todo = [cell for cell in trained if not results.is_finished(cell)]
    n_tests = sum(len(results.missing_tests(cell)) for cell in grid.cells)
    lines = [
        f"{experiment.name}, size {protocol.size}: {experiment.question}",
        f"cells       {len(trained)} to train ({_factors(trained)}); {len(trained) - len(todo)} of them are finished",
        f"tests       {n_tests} to play, of {protocol.episodes} team episodes each, random teams included",
        *(f"left out    {left_out}" for left_out in grid.left_out),
    ]
    game_steps = {cell.id: protocol.settings(cell).game_steps for cell in todo}
    if not todo:
        return "\n".join([*lines, "time        nothing is left to train"])
    lines.append(f"game steps  {sum(game_steps.values()):,} ({' or '.join(_counts(game_steps))} a cell)")
    if rate is not None:
        lines.append(f"rate        {rate:,.0f} game steps/s for each worker, as given")
        rates = dict.fromkeys((cell.method for cell in todo), rate)
        return "\n".join([*lines, _time(todo, game_steps, rates, workers)])
    measured = _measured(todo, protocol, threads, device)
    lines += [f"measured    {measurement}" for measurement in measured]
    rates = {measurement.method: measurement.rate for measurement in measured}
    return "\n".join([*lines, _time(todo, game_steps, rates, workers), _memory(measured, len(todo), workers)])


def _factors(cells: Sequence[Cell]) -> str:
    """What a number of cells is made of."""
    counts: dict[str, set[object]] = {
        "methods": {cell.method for cell in cells},
        "settings": {(cell.task, cell.level) for cell in cells},
        "seeds": {cell.seed for cell in cells},
    }
    return " x ".join(f"{len(values)} {name}" for name, values in counts.items())


def _counts(game_steps: Mapping[str, int]) -> list[str]:
    return [f"{count:,}" for count in sorted(set(game_steps.values()))]


def _measured(todo: Sequence[Cell], protocol: Protocol, threads: int, device: str) -> list[Measurement]:
    """One measurement for each method, at its first setting: the levels cost the same."""
    first = {cell.method: cell for cell in reversed(todo)}
    return [measure(cell, protocol, threads, device) for cell in reversed(first.values())]


def _time(todo: Sequence[Cell], game_steps: Mapping[str, int], rates: Mapping[str, float], workers: int) -> str:
    """
    The time of all trainings, divided among workers.

    Tests are left out: at the paper's size they are some thousandths of it.
    """
    seconds = [game_steps[cell.id] / rates[cell.method] for cell in todo]
    together = max(sum(seconds) / workers, *seconds)
    each = " to ".join(dict.fromkeys((_duration(min(seconds)), _duration(max(seconds)))))
    return (
        f"time        about {_duration(together)} with {workers} worker{'s' * (workers > 1)} of this speed, each with "
        f"cores of its own ({each} a cell, {_duration(sum(seconds))} in all)"
    )


def _memory(measured: Sequence[Measurement], n_cells: int, workers: int) -> str:
    largest = max(measurement.megabytes for measurement in measured)
    at_once = min(workers, n_cells)
    return (
        f"memory      about {at_once * largest / 1000:.1f} GB, {largest / 1000:.1f} GB for each of {at_once} workers "
        "(measured, extrapolated to all games; without a GPU's own)"
    )


def _duration(seconds: float) -> str:
    """Two units at most: 2 d 3 h."""
    left = max(1, round(seconds))
    parts = []
    for unit, size in _UNITS:
        if left >= size:
            parts.append(f"{left // size} {unit}")
            left %= size
        elif parts:
            break
    return " ".join(parts[:2])
