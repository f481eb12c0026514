"""A new level: treasures, clutter and keys on distinct cells, then the agents."""

from __future__ import annotations

import numpy as np

from hecogrid_envs.constants import Terrain
from hecogrid_envs.core.jit import hot, inlined, kernel, kernel_entry
from hecogrid_envs.core.occupancy import arrive, plane_offset, redraw_cell, set_wall_bits
from hecogrid_envs.core.rng import below
from hecogrid_envs.core.types import Games, RuleBook
from hecogrid_envs.tiles import FIRST_TERRAIN

_EMPTY = int(Terrain.EMPTY)
_WALL = int(Terrain.WALL)
_TREASURE = int(Terrain.TREASURE)
_KEY = int(Terrain.KEY)


@kernel
def new_level(games: Games, book: RuleBook, e: int) -> None:
    """Reset game ``e`` to a random level."""
    _clear(games, book, e)
    _place_objects(games, book, e)
    for agent in range(book.n_agents):
        _place_agent(games, book, e, agent)
        if not book.released:
            games.direction[e, agent] = below(games.rng, e, 4)
    begin(games, book, e)


@kernel_entry
def begin(games: Games, book: RuleBook, e: int) -> None:
    """Begin an episode with the terrain, positions, directions and keys of game ``e``: all else follows from them."""
    games.steps[e] = 0
    games.collected[e] = 0
    games.paid[e] = 0
    for cell in range(book.width * book.width):
        games.head[e, cell] = -1
        games.tail[e, cell] = -1
        games.crowd[e, cell] = 0
    for agent in range(book.n_agents):
        arrive(games, e, agent, games.y[e, agent] * book.width + games.x[e, agent])
    _draw_level(games, book, e)


@kernel
def _clear(games: Games, book: RuleBook, e: int) -> None:
    """Empty map inside the outer wall, no keys in hands."""
    width = book.width
    for cell in range(width * width):
        games.terrain[e, cell] = _EMPTY
    for i in range(width):
        games.terrain[e, i] = _WALL
        games.terrain[e, (width - 1) * width + i] = _WALL
        games.terrain[e, i * width] = _WALL
        games.terrain[e, i * width + width - 1] = _WALL
    for agent in range(book.n_agents):
        games.has_key[e, agent] = 0


@kernel
def _place_objects(games: Games, book: RuleBook, e: int) -> None:
    inside = book.width - 2
    n_cells = inside * inside
    cells = np.arange(n_cells)
    n_objects = book.n_treasures + book.n_clutter + book.n_keys
    for k in range(n_objects):
        pick = k + below(games.rng, e, n_cells - k)
        cell = cells[pick]
        cells[pick] = cells[k]
        terrain = _KEY
        if k < book.n_treasures:
            terrain = _TREASURE
        elif k < book.n_treasures + book.n_clutter:
            terrain = _WALL
        games.terrain[e, (cell // inside + 1) * book.width + cell % inside + 1] = terrain


@inlined
def _place_agent(games: Games, book: RuleBook, e: int, agent: int) -> None:
    inside = book.width - 2
    while True:
        x = 1 + below(games.rng, e, inside)
        y = 1 + below(games.rng, e, inside)
        ground = games.terrain[e, y * book.width + x]
        if ground not in (_WALL, _KEY):
            break
    games.x[e, agent] = x
    games.y[e, agent] = y


@hot
def _draw_level(games: Games, book: RuleBook, e: int) -> None:
    """Derive everything that views need from terrain and agents, at the start of an episode."""
    bits = e * 4 * book.bits_bytes
    for i in range(4 * book.bits_bytes):
        games.wall_bits[np.uint64(bits + i)] = book.blank_bits[np.uint64(i)]
    _draw_terrain(games, book, e)
    for y in range(1, book.width - 1):
        for x in range(1, book.width - 1):
            ground = games.terrain[e, np.uint64(y * book.width + x)]
            if ground == _WALL:
                set_wall_bits(games, book, e, x, y)
            elif ground == _KEY:
                redraw_cell(games, book, e, x, y)
    for agent in range(book.n_agents):
        games.sight_known[e, agent] = 0
        games.colour[e, agent] = book.first_colour if book.released else present_colour(games, book, e, agent)
    for agent in range(book.n_agents):
        redraw_cell(games, book, e, games.x[e, agent], games.y[e, agent])


@inlined
def _draw_terrain(games: Games, book: RuleBook, e: int) -> None:
    """
    Write every cell inside the outer wall into the four planes, as if it looked the same from everywhere.

    The same as :func:`redraw_cell` for each, without a question per cell, whose answers no processor can guess.
    """
    stride = book.stride
    end = stride * stride - 1
    plane = e * 4 * book.plane_bytes
    for y in range(1, book.width - 1):
        cell = y * book.width + 1
        # As in plane_offset: towards larger x, by ones in one orientation, by whole rows in the other.
        along, across = plane_offset(book, 3, 1, y), plane_offset(book, 2, 1, y)
        for _ in range(book.width - 2):
            code = FIRST_TERRAIN + games.terrain[np.uint64(e), np.uint64(cell)]
            games.planes[np.uint64(plane + end - across)] = code
            games.planes[np.uint64(plane + book.plane_bytes + end - along)] = code
            games.planes[np.uint64(plane + 2 * book.plane_bytes + across)] = code
            games.planes[np.uint64(plane + 3 * book.plane_bytes + along)] = code
            cell, along, across = cell + 1, along + 1, across + stride


@inlined
def present_colour(games: Games, book: RuleBook, e: int, agent: int) -> int:
    """Palette index of an agent by its present zone and key."""
    if games.has_key[e, agent]:
        return book.key_colour
    return book.zone_colour[book.zone_of_column[games.x[e, agent]]]
