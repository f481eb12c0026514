"""Steps per second: measuring and tables. Needs only NumPy, because the separate environments use it too."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

#: Does some work and returns the number of agent-steps.
Work = Callable[[], int]

#: Works for a number of seconds and returns agent-steps per second.
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
    Yield actions drawn beforehand, endlessly.

    :param shape: number of actions, then the shape of one
    :param n_actions: exclusive upper bound of the actions
    """
    table = np.random.default_rng(0).integers(0, n_actions, size=shape)

    def forever() -> Iterator[Any]:
        while True:
            yield from table

    return forever()


def rate(work: Work, seconds: float) -> float:
    """
    Work for a while.

    :param seconds: minimum
    :return: agent-steps per second
    """
    start, done = time.perf_counter(), 0
    while time.perf_counter() - start < seconds:
        done += work()
    return done / (time.perf_counter() - start)


def take_turns(programs: dict[str, Rate], seconds: float, rounds: int) -> list[Row]:
    """
    Measure every program once per round, after a warm-up round.

    A program that fails is left out, with a message; the others continue.

    :param programs: by name
    :param seconds: per program and round
    """
    rates: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(rounds + 1):
        for name in list(rates):
            try:
                rates[name].append(programs[name](seconds))
            except Exception as error:  # raised by third-party libraries
                del rates[name]
                print(f"left out: {name} ({one_line(error)})", flush=True)
    return [Row(name, found[1:]) for name, found in rates.items()]


def one_line(error: Exception) -> str:
    """Describe an error in one short line."""
    return f"{type(error).__name__}: {error}".replace("\n", " ")[:200]


def table(rows: list[Row], unit: str) -> str:
    """
    Format rows as Markdown, with ratios.

    :param unit: start of the title of the row that the others are divided by
    """
    one = next((row.median for row in rows if row.name.startswith(unit)), float("nan"))
    lines = [f"| what | agent-steps/s | lowest - highest | ratio to the {unit} |", "| --- | --- | --- | --- |"]
    for row in rows:
        low, high = min(row.rates), max(row.rates)
        lines.append(f"| {row.name} | {row.median:,.0f} | {low:,.0f} - {high:,.0f} | {row.median / one:.3g} |")
    return "\n".join(lines)
