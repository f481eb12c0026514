"""
Compare two threads with two independent processes that play half of the games each.
``python -m benchmarks.two_threads``

On virtual machines the second core may add much less than the first, and this changes within seconds, because other
guests use the same cores. So there are many short rounds, and ratios are computed within a round.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from types import TracebackType

import numpy as np

from benchmarks.batches import N_GAMES, batch_work
from benchmarks.rates import Rate, Row, Work, rate, take_turns

SECONDS = 0.1
ROUNDS = 41


class TwoProcesses:
    """
    Two processes that are measured at the same time.

    :param make: creates the work that each process repeats; must be picklable
    """

    def __init__(self, make: Callable[[], Work]):
        context = multiprocessing.get_context("spawn")
        self._ends: list[Connection] = []
        self._processes = []
        for _ in range(2):
            ours, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, make), daemon=True)
            process.start()
            self._ends.append(ours)
            self._processes.append(process)
        for end in self._ends:
            end.recv()

    def rate(self, seconds: float) -> float:
        """
        Work at the same time.

        :param seconds: minimum
        :return: agent-steps per second of both together
        """
        for end in self._ends:
            end.send(seconds)
        return float(sum(end.recv() for end in self._ends))

    def __enter__(self) -> TwoProcesses:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for end in self._ends:
            end.send(None)
        for process in self._processes:
            process.join()


def _serve(end: Connection, make: Callable[[], Work]) -> None:
    work = make()
    rate(work, SECONDS)
    end.send(True)
    while (seconds := end.recv()) is not None:
        end.send(rate(work, seconds))


def threads_table(seconds: float = SECONDS, rounds: int = ROUNDS) -> str:
    """
    Measure two threads and two processes.

    :param seconds: per program and round
    :return: Markdown
    """
    lines = [
        "| views | two threads, times one | two processes, times one | threads, times processes |",
        "| --- " * 4 + "|",
    ]
    for observation in ("tiles", "rgb"):
        make = partial(batch_work, "TeamSupport", observation)
        with TwoProcesses(partial(make, n_games=N_GAMES // 2)) as processes:
            programs: dict[str, Rate] = {
                "one": partial(rate, make(n_games=N_GAMES)),
                "threads": partial(rate, make(n_games=N_GAMES, n_threads=2)),
                "processes": processes.rate,
            }
            one, threads, both = take_turns(programs, seconds, rounds)
        ratios = (times(threads, one), times(both, one), times(threads, both))
        lines.append(f"| {observation} | {' | '.join(ratios)} |")
    return "\n".join(lines)


def times(row: Row, other: Row) -> str:
    """
    Compute the speed ratio of two programs, round by round.

    :return: median, and quartiles
    """
    low, median, high = np.quantile(np.array(row.rates) / np.array(other.rates), [0.25, 0.5, 0.75])
    return f"{median:.2f} ({low:.2f} - {high:.2f})"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="per program and round")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    options = parser.parse_args()
    print(threads_table(options.seconds, options.rounds))


if __name__ == "__main__":
    main()
