"""Measure programs that take turns, so that changes of the machine's speed affect all of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping
from typing import TypeVar

#: Does some work and returns its size, such as a number of agent-steps.
Work = Callable[[], int]
Name = TypeVar("Name", bound=Hashable)


def rates(programs: Mapping[Name, Work], rounds: int, seconds: float = 0.0) -> dict[Name, list[float]]:
    """
    Return what each program does per second of processor time, in every round.

    :param rounds: that count, after one of warm-up
    :param seconds: for which a program works in a round, at least once
    """
    found: dict[Name, list[float]] = {name: [] for name in programs}
    for _ in range(rounds + 1):
        for name, work in programs.items():
            start, n_done = time.process_time(), 0
            while not n_done or time.process_time() - start < seconds:
                n_done += work()
            found[name].append(n_done / (time.process_time() - start))
    return {name: values[1:] for name, values in found.items()}
