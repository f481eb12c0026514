"""Agents by cell, in order of arrival, and the tile codes of every cell for the four directions."""

from __future__ import annotations

from hecogrid_envs.constants import AGENT_PALETTE, Terrain
from hecogrid_envs.core.jit import inlined
from hecogrid_envs.core.types import Games, World, whole
from hecogrid_envs.tiles import FIRST_AGENT, FIRST_KEY, FIRST_TERRAIN

_N_COLOURS = len(AGENT_PALETTE)


@inlined
def arrive(games: Games, e: int, agent: int, cell: int) -> None:
    """Append an agent to the order of arrival of a cell."""
    last = games.tail[e, cell]
    games.before[e, agent] = last
    games.after[e, agent] = -1
    if last < 0:
        games.head[e, cell] = agent
    else:
        games.after[e, last] = agent
    games.tail[e, cell] = agent
    games.crowd[e, cell] += 1


@inlined
def leave(games: Games, e: int, agent: int, cell: int) -> None:
    """Remove an agent from its cell; if it was first, the next becomes first."""
    previous, following = games.before[e, agent], games.after[e, agent]
    if previous < 0:
        games.head[e, cell] = following
    else:
        games.after[e, previous] = following
    if following < 0:
        games.tail[e, cell] = previous
    else:
        games.before[e, following] = previous
    games.crowd[e, cell] -= 1


@inlined
def count_around(games: Games, world: World, e: int, x: int, y: int) -> int:
    """Count the agents within ``support_radius`` (Chebyshev) of a cell."""
    total = 0
    for agent in range(world.n_agents):
        if abs(games.x[e, agent] - x) <= world.support_radius and abs(games.y[e, agent] - y) <= world.support_radius:
            total += 1
    return total


@inlined
def count_here(games: Games, world: World, e: int, agent: int) -> int:
    """Count the agents on an agent's cell, itself included."""
    return whole(games.crowd[e, games.y[e, agent] * world.width + games.x[e, agent]])


@inlined
def count_near(games: Games, world: World, e: int, agent: int, old_x: int, old_y: int) -> int:
    """
    Count the agents within ``support_radius`` of an agent, itself included.

    The released rules count around the cell where its action began, (old_x, old_y); no other agent has moved since.
    """
    x, y = whole(games.x[e, agent]), whole(games.y[e, agent])
    if not world.released:
        return count_around(games, world, e, x, y)
    radius = world.support_radius
    still_near = abs(x - old_x) <= radius and abs(y - old_y) <= radius
    return count_around(games, world, e, old_x, old_y) - still_near + 1


@inlined
def agent_code(ground: int, colour: int, direction: int) -> int:
    """Return the tile code of an agent; ``ground`` is the terrain it stands on."""
    layer = 0
    if ground == Terrain.TREASURE:
        layer = 1
    elif ground == Terrain.COLLECTED:
        layer = 2
    return FIRST_AGENT + (layer * _N_COLOURS + colour) * 4 + direction


@inlined
def plane_offset(world: World, facing: int, x: int, y: int) -> int:
    """
    Return the offset of a cell in the plane that is turned for a viewer facing ``facing``.

    In each plane the viewer looks towards smaller rows and its right is towards larger columns, so opposite directions
    read the same plane from opposite ends.
    """
    px, py = x + world.pad, y + world.pad
    upright = py * world.stride + px if facing & 1 else px * world.stride + world.stride - 1 - py
    return upright if facing >= 2 else world.stride * world.stride - 1 - upright


@inlined
def redraw_cell(games: Games, world: World, e: int, x: int, y: int) -> None:
    """Write a cell's present tile code into the four planes."""
    cell = y * world.width + x
    ground = games.terrain[e, cell]
    first = games.head[e, cell]
    # Code of the cell as seen facing north; the other directions turn it by a quarter each.
    low = FIRST_TERRAIN + ground
    turn, step = 0, 0
    if first >= 0:
        low, turn, step = agent_code(ground, games.colour[e, first], 0), games.direction[e, first] + 3, -1
    elif ground == Terrain.KEY:
        low, turn, step = FIRST_KEY, 1, 1
    plane = e * 4 * world.plane_bytes
    for facing in range(4):
        code = low + ((turn + step * facing) & 3)
        games.planes[plane + plane_offset(world, facing, x, y)] = code
        plane += world.plane_bytes


@inlined
def set_wall_bits(games: Games, world: World, e: int, x: int, y: int) -> None:
    """Mark a cell as opaque in the four orientations."""
    for facing in range(4):
        bit = plane_offset(world, facing, x, y)
        games.wall_bits[(e * 4 + facing) * world.bits_bytes + (bit >> 3)] |= 1 << (bit & 7)
