"""Generation of a new level: treasures, clutter and keys on distinct cells, then the agents."""

from __future__ import annotations

import numpy as np

from hecogrid_envs.constants import BLUE_INDEX, Terrain
from hecogrid_envs.core.jit import hot, inlined, kernel
from hecogrid_envs.core.occupancy import arrive, redraw_cell, set_wall_bits
from hecogrid_envs.core.rng import below
from hecogrid_envs.core.types import Games, World, whole


@kernel
def new_level(games: Games, world: World, e: int) -> None:
    """Reset game ``e`` to a random level."""
    _clear(games, world, e)
    _place_objects(games, world, e)
    for agent in range(world.n_agents):
        _place_agent(games, world, e, agent)
        if not world.released:
            games.direction[e, agent] = below(games.rng, e, 4)
    begin(games, world, e)


@kernel
def begin(games: Games, world: World, e: int) -> None:
    """Begin an episode with the present terrain, positions, directions and keys of game ``e``; derive the rest."""
    games.steps[e] = 0
    games.collected[e] = 0
    games.collected_now[e] = 0
    for cell in range(world.width * world.width):
        games.head[e, cell] = -1
        games.tail[e, cell] = -1
        games.crowd[e, cell] = 0
    for agent in range(world.n_agents):
        arrive(games, e, agent, games.y[e, agent] * world.width + games.x[e, agent])
        games.colour[e, agent] = BLUE_INDEX if world.released else present_colour(games, world, e, agent, -1)
    redraw(games, world, e)


@kernel
def _clear(games: Games, world: World, e: int) -> None:
    """Empty the map inside the outer wall and take all keys from the agents."""
    width = world.width
    for cell in range(width * width):
        games.terrain[e, cell] = Terrain.EMPTY
    for i in range(width):
        games.terrain[e, i] = Terrain.WALL
        games.terrain[e, (width - 1) * width + i] = Terrain.WALL
        games.terrain[e, i * width] = Terrain.WALL
        games.terrain[e, i * width + width - 1] = Terrain.WALL
    for agent in range(world.n_agents):
        games.has_key[e, agent] = 0


@kernel
def _place_objects(games: Games, world: World, e: int) -> None:
    inside = world.width - 2
    n_cells = inside * inside
    cells = np.arange(n_cells)
    n_objects = world.n_treasures + world.n_clutter + world.n_keys
    for k in range(n_objects):
        pick = k + below(games.rng, e, n_cells - k)
        cell = cells[pick]
        cells[pick] = cells[k]
        terrain = Terrain.KEY
        if k < world.n_treasures:
            terrain = Terrain.TREASURE
        elif k < world.n_treasures + world.n_clutter:
            terrain = Terrain.WALL
        games.terrain[e, (cell // inside + 1) * world.width + cell % inside + 1] = terrain


@inlined
def _place_agent(games: Games, world: World, e: int, agent: int) -> None:
    inside = world.width - 2
    while True:
        x = 1 + below(games.rng, e, inside)
        y = 1 + below(games.rng, e, inside)
        ground = games.terrain[e, y * world.width + x]
        if ground not in (Terrain.WALL, Terrain.KEY):
            break
    games.x[e, agent] = x
    games.y[e, agent] = y


@hot
def redraw(games: Games, world: World, e: int) -> None:
    """Derive the data that views need from terrain and agents."""
    bits = e * 4 * world.bits_bytes
    for i in range(4 * world.bits_bytes):
        games.wall_bits[np.uint64(bits + i)] = 0
    for y in range(world.width):
        for x in range(world.width):
            if games.terrain[e, np.uint64(y * world.width + x)] == Terrain.WALL:
                set_wall_bits(games, world, e, x, y)
            redraw_cell(games, world, e, x, y)
    for agent in range(world.n_agents):
        games.sight_known[e, agent] = 0


@inlined
def present_colour(games: Games, world: World, e: int, agent: int, action: int) -> int:
    """Return the palette index of an agent by its key, its present zone, or its last action (-1 for none)."""
    if games.has_key[e, agent]:
        return world.key_colour
    if world.shows_actions:
        return whole(action) + 1
    return world.zone_colour[world.zone_of_column[games.x[e, agent]]]
