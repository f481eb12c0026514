"""What engines have in common: jobs go in, endings come out as they happen."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, Protocol

#: A function of one picklable argument, importable by worker processes.
JobFunction = Callable[[Any], bytes]


class Job(NamedTuple):
    """
    One call.

    :param name: unique
    :param payload: makes the argument when the job starts, so that a long queue costs no memory
    """

    name: str
    payload: Callable[[], Any]


class Ending(NamedTuple):
    """
    How one attempt ended.

    :param job: the job
    :param attempt: from 1
    :param result: what the function returned; None if it did not
    :param error: its traceback, or how its process died; None if all went well
    :param final: whether there will be no further attempt
    """

    job: Job
    attempt: int
    result: bytes | None
    error: str | None
    final: bool


class Engine(Protocol):
    """Runs jobs in other processes."""

    def run(self, function: JobFunction, jobs: Sequence[Job], retries: int) -> Iterator[Ending]:
        """
        Run all jobs; closing the iterator ends what is running.

        :param function: called with each job's payload
        :param jobs: in the order in which they start
        :param retries: further attempts for a job that failed or whose process died
        :return: one ending for each attempt, as it happens
        """
        ...


def guarded(function: JobFunction, payload: Any) -> tuple[bytes | None, str | None]:
    """
    Call, and catch what goes wrong.

    :return: the result and None, or None and the traceback
    """
    try:
        return function(payload), None
    except Exception:
        return None, traceback.format_exc()


def ending(job: Job, attempt: int, retries: int, result: bytes | None, error: str | None) -> Ending:
    """An attempt's ending: final if it went well or was the last."""
    return Ending(job, attempt, result, error, error is None or attempt > retries)
