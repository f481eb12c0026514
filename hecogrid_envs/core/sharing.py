"""One share of a batch's work, and helpers that wait for the next without leaving compiled code."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from hecogrid_envs.core.atomic import bytes_at, load_shared, store_shared
from hecogrid_envs.core.batch_step import reset_games, step_games
from hecogrid_envs.core.jit import hot, kernel
from hecogrid_envs.core.types import U8, Games, RuleBook
from hecogrid_envs.core.view import draw_pictures, observe_tiles

#: What a share can be.
STEP: Final = 0
TILES: Final = 1
PICTURES: Final = 2
RESET: Final = 3
_LEAVE: Final = 4

#: Numbers of the desk, over which the calling thread and its helpers talk.
_TICKET: Final = 0
_TASK: Final = 1
_ADDRESS: Final = 2
_BYTES: Final = 3
#: Numbers from one helper's part of the desk to the next: two cache lines, so that writing does not disturb others.
DESK_PART: Final = 16
_DONE: Final = 0
_ASLEEP: Final = 1


class Pictures(NamedTuple):
    """
    What drawing needs beside the games. E games, N agents, V = view size, t = tile size.

    :param codes: (E * N * V * V,) where views in tile codes are kept on the way to pixels
    :param facing: (E * N,) directions of the agents, the games' own
    :param atlas: see :func:`~hecogrid_envs.core.view.draw_pictures`
    :param turn_bytes: see there
    :param tile: t
    """

    codes: U8
    facing: U8
    atlas: U8
    turn_bytes: int
    tile: int


@kernel
def play_share(games: Games, book: RuleBook, pictures: Pictures, task: int, array: U8, first: int, last: int) -> None:
    """
    Do one task for games ``first`` to ``last - 1``.

    :param task: ``STEP``, ``TILES``, ``PICTURES`` or ``RESET``
    :param array: (E * N,) actions, (E * N * V * V,) codes to write, (E * N * V t * V t * 3,) pixels to write, or (E,) 1
        for games to reset and 0 for others
    """
    if task == STEP:
        step_games(games, book, array, first, last)
    elif task == TILES:
        observe_tiles(games, book, array, first, last)
    elif task == RESET:
        reset_games(games, book, array, first, last)
    else:
        codes, n = pictures.codes, book.n_agents
        observe_tiles(games, book, codes, first, last)
        draw_pictures(
            codes,
            pictures.facing,
            pictures.atlas,
            pictures.turn_bytes,
            book.view_size,
            pictures.tile,
            array,
            first * n,
            last * n,
        )


@hot
def post(desk: npt.NDArray[np.int64], task: int, address: int, n_bytes: int) -> None:
    """
    Put a task on the desk; helpers that are awake begin at once.

    :param desk: (DESK_PART * (1 + helpers),)
    :param address: of the task's array
    """
    desk[_TASK], desk[_ADDRESS], desk[_BYTES] = task, address, n_bytes
    store_shared(desk, _TICKET, desk[_TICKET] + 1)


@hot
def post_leave(desk: npt.NDArray[np.int64]) -> None:
    """Send the helpers away."""
    post(desk, _LEAVE, 0, 0)


@hot
def is_asleep(desk: npt.NDArray[np.int64], helper: int) -> bool:
    """
    Whether a helper waits for its bell.

    :param helper: from 1 on
    """
    return load_shared(desk, helper * DESK_PART + _ASLEEP) != 0


@hot
def wait_for_helpers(desk: npt.NDArray[np.int64], polls: int) -> bool:
    """
    Wait until all helpers are done with the task on the desk.

    :param polls: looks at the desk before giving up
    :return: whether they are
    """
    helper, n_parts, ticket = 1, len(desk) // DESK_PART, desk[_TICKET]
    for _ in range(polls):
        while helper < n_parts and load_shared(desk, helper * DESK_PART + _DONE) == ticket:
            helper += 1
        if helper == n_parts:
            return True
    return False


@kernel
def serve(
    games: Games,
    book: RuleBook,
    pictures: Pictures,
    desk: npt.NDArray[np.int64],
    helper: int,
    first: int,
    last: int,
    polls: int,
) -> bool:
    """
    Do a helper's share of whatever comes, until nothing has come for a while.

    :param polls: looks at the desk before going to sleep
    :return: whether the helper has been sent away; else it is to wait for its bell and come back
    """
    done, asleep = helper * DESK_PART + _DONE, helper * DESK_PART + _ASLEEP
    store_shared(desk, asleep, 0)
    idle = 0
    while True:
        ticket = load_shared(desk, _TICKET)
        if ticket == desk[done]:
            idle += 1
            if idle < polls:
                continue
            store_shared(desk, asleep, 1)
            # A task that was posted before this mark shows now; whoever posts after it sees the mark and rings.
            if load_shared(desk, _TICKET) == ticket:
                return False
            store_shared(desk, asleep, 0)
            continue
        if desk[_TASK] == _LEAVE:
            return True
        array = bytes_at(desk[_ADDRESS], desk[_BYTES])
        play_share(games, book, pictures, desk[_TASK], array, first, last)
        store_shared(desk, done, ticket)
        idle = 0
