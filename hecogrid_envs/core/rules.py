"""One agent's action: movement, keys, collecting. Reads as the rule book does."""

from __future__ import annotations

from hecogrid_envs.constants import Command, Terrain
from hecogrid_envs.core.generation import present_colour
from hecogrid_envs.core.jit import inlined
from hecogrid_envs.core.occupancy import arrive, count_around, leave, redraw_cell
from hecogrid_envs.core.types import Games, RuleBook, whole

_EMPTY = int(Terrain.EMPTY)
_WALL = int(Terrain.WALL)
_TREASURE = int(Terrain.TREASURE)
_COLLECTED = int(Terrain.COLLECTED)
_KEY = int(Terrain.KEY)

_LEFT = int(Command.LEFT)
_RIGHT = int(Command.RIGHT)
_FORWARD = int(Command.FORWARD)
_PICKUP = int(Command.PICKUP)
_DROP = int(Command.DROP)

_TEAM_TOGETHER = 0
_TEAM_SUPPORT = 1
_KEY_FOR_TREASURE = 2


@inlined
def act(games: Games, book: RuleBook, e: int, agent: int, action: int) -> None:
    """Let one agent act; it sees the effects of those who acted before it."""
    command = book.command_of[book.zone_of_column[games.x[e, agent]], action]
    if book.released:
        # Others see the agent as it was when it acted, before its action.
        games.colour[e, agent] = present_colour(games, book, e, agent)
    if command in (_LEFT, _RIGHT):
        turn = 3 if command == _LEFT else 1
        games.direction[e, agent] = (games.direction[e, agent] + turn) & 3
        games.sight_known[e, agent] = 0
    elif command == _FORWARD:
        _forward(games, book, e, agent)
    elif command == _PICKUP:
        _pick_up(games, book, e, agent)
    elif command == _DROP:
        _drop(games, book, e, agent)
    if not book.released:
        games.colour[e, agent] = present_colour(games, book, e, agent)
    redraw_cell(games, book, e, whole(games.x[e, agent]), whole(games.y[e, agent]))


@inlined
def _front(games: Games, e: int, agent: int) -> tuple[int, int]:
    """Cell in front of an agent; agents are never on the outer wall, so it exists."""
    direction = games.direction[e, agent]
    dx = (direction == 0) - (direction == 2)
    dy = (direction == 1) - (direction == 3)
    return whole(games.x[e, agent]) + dx, whole(games.y[e, agent]) + dy


@inlined
def _forward(games: Games, book: RuleBook, e: int, agent: int) -> None:
    front_x, front_y = _front(games, e, agent)
    front = front_y * book.width + front_x
    ground = games.terrain[e, front]
    if ground in (_WALL, _KEY):
        return
    x, y = whole(games.x[e, agent]), whole(games.y[e, agent])
    leave(games, e, agent, y * book.width + x)
    redraw_cell(games, book, e, x, y)
    games.x[e, agent] = front_x
    games.y[e, agent] = front_y
    arrive(games, e, agent, front)
    games.sight_known[e, agent] = 0
    if ground == _TREASURE:
        _try_to_collect(games, book, e, agent, x, y)


@inlined
def _pick_up(games: Games, book: RuleBook, e: int, agent: int) -> None:
    x, y = whole(games.x[e, agent]), whole(games.y[e, agent])
    if games.terrain[e, y * book.width + x] == _TREASURE:
        _try_to_collect(games, book, e, agent, x, y)
    front_x, front_y = _front(games, e, agent)
    front = front_y * book.width + front_x
    if games.terrain[e, front] == _KEY and not games.has_key[e, agent]:
        games.has_key[e, agent] = 1
        games.terrain[e, front] = _EMPTY
        redraw_cell(games, book, e, front_x, front_y)


@inlined
def _drop(games: Games, book: RuleBook, e: int, agent: int) -> None:
    front_x, front_y = _front(games, e, agent)
    front = front_y * book.width + front_x
    nothing_there = games.terrain[e, front] == _EMPTY and games.crowd[e, front] == 0
    if games.has_key[e, agent] and nothing_there:
        games.has_key[e, agent] = 0
        games.terrain[e, front] = _KEY
        redraw_cell(games, book, e, front_x, front_y)


@inlined
def _try_to_collect(games: Games, book: RuleBook, e: int, agent: int, old_x: int, old_y: int) -> None:
    """Collect the treasure under an agent if the task's condition holds; (old_x, old_y) is where its action began."""
    if book.task == _KEY_FOR_TREASURE and not games.has_key[e, agent]:
        return
    x, y = whole(games.x[e, agent]), whole(games.y[e, agent])
    cell = y * book.width + x
    if book.task == _TEAM_TOGETHER or (book.task == _KEY_FOR_TREASURE and not book.released):
        helpers = games.crowd[e, cell]
    elif book.released:
        helpers = _supporters_before(games, book, e, agent, old_x, old_y)
    else:
        helpers = count_around(games, book, e, x, y)
    if helpers >= book.coordination:
        games.terrain[e, cell] = _COLLECTED
        games.paid[e] += 1


@inlined
def _supporters_before(games: Games, book: RuleBook, e: int, agent: int, old_x: int, old_y: int) -> int:
    """Agents around the cell where the action began, at that moment: the others have not moved since."""
    radius = book.support_radius
    still_near = abs(games.x[e, agent] - old_x) <= radius and abs(games.y[e, agent] - old_y) <= radius
    return count_around(games, book, e, old_x, old_y) - still_near + 1
