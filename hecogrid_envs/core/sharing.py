"""One share of a batch's work, and helpers that wait for the next without leaving compiled code."""

from __future__ import annotations

from typing import Final, NamedTuple

from hecogrid_envs.core.atomic import bytes_at, load_shared, store_shared, take_shared
from hecogrid_envs.core.batch_step import mark_games_over, step_games
from hecogrid_envs.core.generation import new_level
from hecogrid_envs.core.jit import hot_entry, kernel, kernel_entry
from hecogrid_envs.core.types import I64, U8, Games, RuleBook
from hecogrid_envs.core.view import draw_pictures, observe_tiles

#: What a share can be: any sum of these, done in this order.
STEP: Final = 1
RESTART: Final = 2
RESET: Final = 4
TILES: Final = 8
PICTURES: Final = 16
_LEAVE: Final = 32

#: Numbers of the desk, over which the calling thread and its helpers talk; arrays are an address and a length.
_TICKET: Final = 0
_TASK: Final = 1
_VIEWS: Final = 2
_LAST: Final = 4
#: Games that are done.
FINISHED: Final = 8
#: Numbers from one part of the desk to the next. Half a part is a cache line, so that writing does not disturb others.
DESK_PART: Final = 16
#: Numbers of a thread's part: the next piece of its share that nobody has taken yet, then what stays as it is.
NEXT: Final = 0
FIRST: Final = 8
END: Final = 9
_ASLEEP: Final = 10
#: Sixteenths of a share at which it is cut into pieces: as much as a thread does that is slowed down to 70 %, then
#: little by little, since the last piece to be done is waited for.
_CUTS: Final = (0, 11, 13, 15, 16)
PIECES: Final = len(_CUTS) - 1


class Workspace(NamedTuple):
    """
    What a batch keeps beside its games. E games, N agents, V = view size, t = tile size.

    :param actions: (E * N,) what agents do in the next step, 0 to 6
    :param fresh: (E,) 1 for games that ``RESET`` is to give a new level, or to which ``RESTART`` gave one, 0 for others
    :param codes: (E * N * V * V,) where views in tile codes are kept on the way to pixels
    :param facing: (E * N,) directions of the agents, the games' own
    :param atlas: see :func:`~hecogrid_envs.core.view.draw_pictures`
    :param turn_bytes: see there
    :param tile: t
    """

    actions: U8
    fresh: U8
    codes: U8
    facing: U8
    atlas: U8
    turn_bytes: int
    tile: int


@kernel_entry
def play_share(
    games: Games, book: RuleBook, work: Workspace, task: int, views: U8, last_views: U8, first: int, end: int
) -> None:
    """
    Do one task for games ``first`` to ``end - 1``.

    :param task: a sum of ``STEP``, ``RESTART`` (a new level for games that are over) or ``RESET`` (for those that
        ``work.fresh`` marks), and ``TILES`` or ``PICTURES``
    :param views: (E * N * V * V,) codes or (E * N * V t * V t * 3,) pixels to write; empty if the task has no views
    :param last_views: as ``views``, for the last views of games that are over, written nowhere else; empty for none
    """
    if task & STEP:
        step_games(games, book, work.actions, first, end)
    if task & RESTART:
        mark_games_over(games, book, work.fresh, first, end)
    if task & (RESTART | RESET):
        for e in range(first, end):
            if not work.fresh[e]:
                continue
            if len(last_views):
                _observe(games, book, work, task, last_views, e, e + 1)
            paid = games.paid[e]
            new_level(games, book, e)
            if task & RESTART:
                games.paid[e] = paid  # by the last step; still to be read
    _observe(games, book, work, task, views, first, end)


@kernel
def _observe(games: Games, book: RuleBook, work: Workspace, task: int, out: U8, first: int, end: int) -> None:
    """Write views as ``TILES`` or ``PICTURES`` in ``task`` say."""
    if task & TILES:
        observe_tiles(games, book, out, first, end)
    elif task & PICTURES:
        observe_tiles(games, book, work.codes, first, end)
        atlas = (work.atlas, work.turn_bytes, book.view_size, work.tile)
        draw_pictures(work.codes, work.facing, *atlas, out, first * book.n_agents, end * book.n_agents)


@kernel_entry
def lead(games: Games, book: RuleBook, work: Workspace, desk: I64, polls: int) -> bool:
    """
    Take games of the task on the desk until none is left, the last share first, then wait for those that helpers took.

    :param polls: looks at the desk before giving up
    :return: whether all is done; else call again
    """
    _take_games(games, book, work, desk, len(desk) // DESK_PART - 1)
    n_games = desk[len(desk) - DESK_PART + END]
    while load_shared(desk, FINISHED) != n_games:
        polls -= 1
        if polls < 0:
            return False
    return True


@kernel
def _take_games(games: Games, book: RuleBook, work: Workspace, desk: I64, own: int) -> None:
    """
    Play games of the task on the desk, first those of one's own share, then what others have not come to.

    A processor that is slower for a while, or busy with something else, does less then, and nobody waits for a helper
    that is not awake yet. Shares keep most games in the cache of the processor that played them before.

    :param own: part of the desk, from 1 on
    """
    n_shares, played = len(desk) // DESK_PART - 1, 0
    for turn in range(n_shares):
        part = (1 + (own - 1 + turn) % n_shares) * DESK_PART
        start = desk[part + FIRST]
        n_games = desk[part + END] - start
        while load_shared(desk, part + NEXT) < PIECES:
            piece = take_shared(desk, part + NEXT, 1)
            if piece >= PIECES:
                break
            first = start + n_games * _CUTS[piece] // 16
            last = start + n_games * _CUTS[piece + 1] // 16
            # Read only now: as long as a piece is taken and not done, no other task comes to the desk.
            views = bytes_at(desk[_VIEWS], desk[_VIEWS + 1])
            last_views = bytes_at(desk[_LAST], desk[_LAST + 1])
            play_share(games, book, work, desk[_TASK], views, last_views, first, last)
            played += last - first
    if played:
        take_shared(desk, FINISHED, played)


@hot_entry
def post(desk: I64, task: int, views: U8, last_views: U8) -> bool:
    """
    Put a task on the desk; helpers that are awake begin at once.

    :param desk: (DESK_PART * (1 + shares),)
    :param views: of the task; stays where it is until the task is done
    :param last_views: of the task, as well
    :return: whether a helper must be woken
    """
    desk[_TASK] = task
    desk[_VIEWS], desk[_VIEWS + 1] = views.ctypes.data, len(views)
    desk[_LAST], desk[_LAST + 1] = last_views.ctypes.data, len(last_views)
    store_shared(desk, FINISHED, 0)
    n_shares = len(desk) // DESK_PART - 1
    for share in range(1, n_shares + 1):
        # A helper that still looks for games of the last task may take of this one from here on.
        store_shared(desk, share * DESK_PART + NEXT, 0)
    store_shared(desk, _TICKET, desk[_TICKET] + 1)
    sleeps = False
    for helper in range(1, n_shares):
        sleeps |= is_asleep(desk, helper)
    return sleeps


@hot_entry
def post_leave(desk: I64) -> None:
    """Send the helpers away."""
    desk[_TASK] = _LEAVE
    store_shared(desk, _TICKET, desk[_TICKET] + 1)


@hot_entry
def is_asleep(desk: I64, helper: int) -> bool:
    """
    Whether a helper waits for its bell.

    :param helper: from 1 on
    """
    return load_shared(desk, helper * DESK_PART + _ASLEEP) != 0


@kernel_entry
def serve(games: Games, book: RuleBook, work: Workspace, desk: I64, helper: int, polls: int) -> bool:
    """
    Help with whatever comes, until nothing has come for a while.

    :param helper: whose share comes first, from 1 on
    :param polls: looks at the desk before going to sleep
    :return: whether the helper has been sent away; else it is to wait for its bell and come back
    """
    asleep = helper * DESK_PART + _ASLEEP
    store_shared(desk, asleep, 0)
    idle, seen = 0, -1
    while True:
        ticket = load_shared(desk, _TICKET)
        if ticket == seen:
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
        _take_games(games, book, work, desk, helper)
        seen = ticket
        idle = 0
