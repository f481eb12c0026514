"""Steps per second: what the rows of a table have in common. Needs NumPy alone: other interpreters use it, too."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

#: Does some work and says how many agent-steps it was.
Work = Callable[[], int]

#: Does work for so many seconds and says how many agent-steps per second it did.
Rate = Callable[[float], float]


class Row(NamedTuple):
    """One line of the table: agent-steps per second of every round."""

    name: str
    rates: list[float]

    @property
    def median(self) -> float:
        """Median over rounds."""
        return float(np.median(self.rates))


def random_actions(shape: tuple[int, ...], n_actions: int = 7) -> Iterator[Any]:
    """
    Actions drawn beforehand, without end.

    :param shape: how many, then the shape of one
    :param n_actions: actions are below
    """
    table = np.random.default_rng(0).integers(0, n_actions, size=shape)

    def forever() -> Iterator[Any]:
        while True:
            yield from table

    return forever()


def rate(work: Work, seconds: float) -> float:
    """
    Work for a while.

    :param seconds: at least
    :return: agent-steps per second
    """
    start, done = time.perf_counter(), 0
    while time.perf_counter() - start < seconds:
        done += work()
    return done / (time.perf_counter() - start)


def take_turns(programs: dict[str, Rate], seconds: float, rounds: int) -> list[Row]:
    """
    Measure every program once per round, after a round that does not count.

    A program that fails is left out with a line that says so; the others go on.

    :param programs: by name
    :param seconds: per program and round
    """
    rates: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(rounds + 1):
        for name in list(rates):
            try:
                rates[name].append(programs[name](seconds))
            except Exception as error:  # of libraries that are not ours
                del rates[name]
                print(f"left out: {name} ({one_line(error)})", flush=True)
    return [Row(name, found[1:]) for name, found in rates.items()]


def one_line(error: Exception) -> str:
    """What went wrong, short enough for a list."""
    return f"{type(error).__name__}: {error}".replace("\n", " ")[:200]


def table(rows: list[Row], unit: str) -> str:
    """
    Markdown, every row also as a ratio.

    :param unit: the row that the others are divided by begins so
    """
    one = next((row.median for row in rows if row.name.startswith(unit)), float("nan"))
    lines = [f"| what | agent-steps/s | lowest - highest | ratio to the {unit} |", "| --- | --- | --- | --- |"]
    for row in rows:
        low, high = min(row.rates), max(row.rates)
        lines.append(f"| {row.name} | {row.median:,.0f} | {low:,.0f} - {high:,.0f} | {row.median / one:.3g} |")
    return "\n".join(lines)
