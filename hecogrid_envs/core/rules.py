"""One agent's action: movement, keys, collecting; in the order of the rule book."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hecogrid_envs.constants import Command, Terrain
from hecogrid_envs.core.generation import present_colour
from hecogrid_envs.core.jit import inlined
from hecogrid_envs.core.occupancy import arrive, leave, redraw_cell
from hecogrid_envs.core.types import Games, World, whole
from hecogrid_envs.task import DECLARED, Condition

NumberedCondition = Callable[[int, Games, World, int, int, int, int], bool]


def _choice_of(conditions: Sequence[Condition]) -> NumberedCondition:
    """Chain conditions into one kernel, which gets the number of the one to check."""
    first, *others = conditions
    if not others:
        return inlined(lambda number, games, world, e, agent, x, y: first(games, world, e, agent, x, y))
    following = _choice_of(others)

    @inlined
    def choice(number: int, games: Games, world: World, e: int, agent: int, x: int, y: int) -> bool:
        if number == 0:
            return first(games, world, e, agent, x, y)
        return following(number - 1, games, world, e, agent, x, y)

    return choice


#: Covers the tasks declared before this module is imported, which happens when the first game is made.
_condition = _choice_of([task.condition for task in DECLARED.values()])


@inlined
def act(games: Games, world: World, e: int, agent: int, action: int) -> None:
    """Perform one agent's action; effects of agents that acted before it are visible to it."""
    command = world.command_of[world.zone_of_column[games.x[e, agent]], action]
    if world.released:
        # Others see the agent as it was when it acted, before its action.
        games.colour[e, agent] = present_colour(games, world, e, agent, action)
    if command in (Command.LEFT, Command.RIGHT):
        turn = 3 if command == Command.LEFT else 1
        games.direction[e, agent] = (games.direction[e, agent] + turn) & 3
        games.sight_known[e, agent] = 0
    elif command == Command.FORWARD:
        _forward(games, world, e, agent)
    elif command == Command.PICKUP:
        _pick_up(games, world, e, agent)
    elif command == Command.DROP:
        _drop(games, world, e, agent)
    if not world.released:
        games.colour[e, agent] = present_colour(games, world, e, agent, action)
    redraw_cell(games, world, e, whole(games.x[e, agent]), whole(games.y[e, agent]))


@inlined
def _front(games: Games, e: int, agent: int) -> tuple[int, int]:
    """Return the cell in front of an agent; agents are never on the outer wall, so it exists."""
    direction = games.direction[e, agent]
    dx = (direction == 0) - (direction == 2)
    dy = (direction == 1) - (direction == 3)
    return whole(games.x[e, agent]) + dx, whole(games.y[e, agent]) + dy


@inlined
def _forward(games: Games, world: World, e: int, agent: int) -> None:
    front_x, front_y = _front(games, e, agent)
    front = front_y * world.width + front_x
    ground = games.terrain[e, front]
    if ground in (Terrain.WALL, Terrain.KEY):
        return
    x, y = whole(games.x[e, agent]), whole(games.y[e, agent])
    leave(games, e, agent, y * world.width + x)
    redraw_cell(games, world, e, x, y)
    games.x[e, agent] = front_x
    games.y[e, agent] = front_y
    arrive(games, e, agent, front)
    games.sight_known[e, agent] = 0
    if ground == Terrain.TREASURE:
        _try_to_collect(games, world, e, agent, x, y)


@inlined
def _pick_up(games: Games, world: World, e: int, agent: int) -> None:
    x, y = whole(games.x[e, agent]), whole(games.y[e, agent])
    if games.terrain[e, y * world.width + x] == Terrain.TREASURE:
        _try_to_collect(games, world, e, agent, x, y)
    front_x, front_y = _front(games, e, agent)
    front = front_y * world.width + front_x
    if games.terrain[e, front] == Terrain.KEY and not games.has_key[e, agent]:
        games.has_key[e, agent] = 1
        games.terrain[e, front] = Terrain.EMPTY
        redraw_cell(games, world, e, front_x, front_y)


@inlined
def _drop(games: Games, world: World, e: int, agent: int) -> None:
    front_x, front_y = _front(games, e, agent)
    front = front_y * world.width + front_x
    nothing_there = games.terrain[e, front] == Terrain.EMPTY and games.crowd[e, front] == 0
    if games.has_key[e, agent] and nothing_there:
        games.has_key[e, agent] = 0
        games.terrain[e, front] = Terrain.KEY
        redraw_cell(games, world, e, front_x, front_y)


@inlined
def _try_to_collect(games: Games, world: World, e: int, agent: int, old_x: int, old_y: int) -> None:
    """Collect the treasure under an agent if the task's condition holds; (old_x, old_y) is where its action began."""
    if _condition(world.condition, games, world, e, agent, old_x, old_y):
        games.terrain[e, games.y[e, agent] * world.width + games.x[e, agent]] = Terrain.COLLECTED
        games.collected_now[e] += 1
