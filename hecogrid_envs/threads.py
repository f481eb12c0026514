"""The compiled loops over a batch's games, shared between threads."""

from __future__ import annotations

import os
import threading
import time
import weakref
from functools import partial
from itertools import pairwise
from typing import Any, Final

import numpy as np

from hecogrid_envs.arrays import aligned
from hecogrid_envs.core.jit import entry_point
from hecogrid_envs.core.sharing import (
    DESK_PART,
    END,
    FINISHED,
    FIRST,
    NEXT,
    PIECES,
    Workspace,
    is_asleep,
    lead,
    play_share,
    post,
    post_leave,
    serve,
)
from hecogrid_envs.core.types import I64, U8, Games, RuleBook
from hecogrid_envs.core.view import draw_pictures

#: Looks at the desk before a helper goes to sleep, about half a millisecond: tight loops find it awake, and while a
#: network computes it does not take its processor for long.
_POLLS_OF_HELPERS: Final = 1_000_000
#: Looks at the desk before the calling thread offers its processor to others.
_POLLS_OF_CALLER: Final = 10_000

#: In place of arrays that a task does not have.
NOTHING: Final[U8] = np.zeros(0, dtype=np.uint8)


class Helpers:
    """
    Threads that help with every task that is posted.

    Awake, they begin without a lock or a call into Python. A pool of Python threads made two threads slower than one:
    a step is over in some tens of microseconds (``python -m benchmarks.environments`` measures one and two).

    :param arguments: games, book and workspace of a batch
    :param shares: the first game and one beyond the last that each helper begins with; the last is the calling thread's
    """

    def __init__(self, arguments: tuple[Games, RuleBook, Workspace], shares: list[tuple[int, int]]):
        #: Threads do not survive a fork.
        self.process = os.getpid()
        self._desk = aligned(DESK_PART * (1 + len(shares)), np.int64)
        for part, (first, end) in zip(self._desk.reshape(-1, DESK_PART)[1:], shares, strict=True):
            part[FIRST], part[END], part[NEXT] = first, end, PIECES
        # As after a task: an interrupt may come before the first is posted.
        self._desk[FINISHED] = shares[-1][1]
        self._bells = [threading.Semaphore(0) for _ in shares[1:]]
        #: Arrays of the task on the desk, which stay where they are until it is done.
        self._posted: tuple[U8, U8] | None = None
        self._post = entry_point(post, self._desk, 0, NOTHING, NOTHING)
        lead_on = entry_point(lead, *arguments, self._desk, 0)
        self._lead = partial(lead_on, *arguments, self._desk, _POLLS_OF_CALLER)
        self._asleep = entry_point(is_asleep, self._desk, 0)
        compiled = entry_point(serve, *arguments, self._desk, 0, 0)
        self.threads = [
            threading.Thread(
                target=_serve,
                args=(compiled, (*arguments, self._desk, helper, _POLLS_OF_HELPERS), bell),
                name=f"hecogrid-{helper}",
                daemon=True,
            )
            for helper, bell in enumerate(self._bells, 1)
        ]
        for thread in self.threads:
            thread.start()
        weakref.finalize(self, _send_away, self._desk, self._bells)

    def play(self, task: int, views: U8, last_views: U8) -> None:
        """
        Do one task together.

        :param task: see :func:`~hecogrid_envs.core.sharing.play_share`, as the arrays
        """
        if self._posted is not None:  # an interrupt came between the last task and its end
            self._finish()
        self._posted = views, last_views
        if self._post(self._desk, task, views, last_views):
            self._ring()
        self._finish()

    def _finish(self) -> None:
        while not self._lead():
            time.sleep(0)
        self._posted = None

    def _ring(self) -> None:
        for helper, bell in enumerate(self._bells, 1):
            if self.is_asleep(helper):
                bell.release()

    def is_asleep(self, helper: int) -> bool:
        """
        Whether a helper waits for its bell.

        :param helper: from 1 on
        """
        return bool(self._asleep(self._desk, helper))


def _serve(compiled: Any, arguments: tuple[Any, ...], bell: threading.Semaphore) -> None:
    while not compiled(*arguments):
        bell.acquire()


def _send_away(desk: I64, bells: list[threading.Semaphore]) -> None:
    post_leave(desk)
    for bell in bells:
        bell.release()


class Shares:
    """
    Plays whole tasks: on the calling thread and, if there are more, on helpers that start with the first task.

    :param games: E games
    :param book: their rules
    :param work: their workspace
    :param n_threads: threads, the calling one included
    """

    def __init__(self, games: Games, book: RuleBook, work: Workspace, n_threads: int):
        self._arguments = (games, book, work)
        n_games = len(games.rng)
        edges = np.linspace(0, n_games, min(n_threads, n_games) + 1).astype(int).tolist()
        self._shares = list(pairwise(edges))
        self._helpers: Helpers | None = None
        self._play = entry_point(play_share, *self._arguments, 0, NOTHING, NOTHING, 0, 0)

    def play(self, task: int, views: U8 = NOTHING, last_views: U8 = NOTHING) -> None:
        """
        Do one task for all games.

        :param task: see :func:`~hecogrid_envs.core.sharing.play_share`
        :param views: contiguous, of the task
        :param last_views: as well
        """
        if len(self._shares) == 1:
            self._play(*self._arguments, task, views, last_views, *self._shares[0])
            return
        if self._helpers is None or self._helpers.process != os.getpid():
            self._helpers = Helpers(self._arguments, self._shares)
        self._helpers.play(task, views, last_views)

    def play_game(self, task: int, game: int, views: U8) -> None:
        """
        Do one task for one game.

        :param task: see :func:`~hecogrid_envs.core.sharing.play_share`
        :param game: index
        :param views: of the task, for all games
        """
        self._play(*self._arguments, task, views, NOTHING, game, game + 1)

    def draw(self, codes: U8, facing: U8, out: U8) -> None:
        """
        Draw some views.

        :param codes: (B * V * V,) of B views
        :param facing: (B,) directions of the viewers
        :param out: (B * V t * V t * 3,) pixels to write
        """
        _, book, work = self._arguments
        atlas = (work.atlas, work.turn_bytes, book.view_size, work.tile)
        draw_pictures(codes, facing, *atlas, out, 0, len(facing))
