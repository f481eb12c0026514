"""An agent's view: visibility on bit masks, the view in tile codes, and its pixels."""

from __future__ import annotations

import numpy as np

from hecogrid_envs.core.jit import copy_16, hot, inlined, load_word, store_word
from hecogrid_envs.core.occupancy import agent_code, plane_offset
from hecogrid_envs.core.types import U8, Games, World, whole

_ONE = np.uint64(1)
_BYTE = np.uint64(255)
_WORD_BYTES = 8
_CHUNK_BYTES = 16


@inlined
def view_corner(games: Games, world: World, e: int, agent: int) -> int:
    """Return the offset of the top left cell of an agent's view in the plane turned for it."""
    facing, x, y = whole(games.direction[e, agent]), whole(games.x[e, agent]), whole(games.y[e, agent])
    here = plane_offset(world, facing, x, y)
    return here - (world.view_size - 1 - world.view_offset) * world.stride - world.view_size // 2


@inlined
def _spread_right(seen: np.uint64, clear: np.uint64, size: int) -> np.uint64:
    """Return the cells that light reaches from ``seen`` towards larger columns through ``clear`` cells, by doubling."""
    reached, path = seen & clear, clear
    shift = 1
    while shift < size:
        reached |= path & (reached << np.uint64(shift))
        path &= path << np.uint64(shift)
        shift *= 2
    return reached


@inlined
def _spread_left(seen: np.uint64, clear: np.uint64, size: int) -> np.uint64:
    """As :func:`_spread_right`, towards smaller columns."""
    reached, path = seen & clear, clear
    shift = 1
    while shift < size:
        reached |= path & (reached >> np.uint64(shift))
        path &= path >> np.uint64(shift)
        shift *= 2
    return reached


@inlined
def look(games: Games, world: World, e: int, agent: int) -> None:
    """
    Compute which cells of its view an agent sees, and store them in ``games.sight``.

    Rows are words, bit i is column i. The sweeps of the rule book go from the agent's column to the last column,
    then from one beyond the agent's column down to column 1; a cell that is lit and clear lights its neighbour in the
    row, the cell in the next row and the diagonal between them.
    """
    size = world.view_size
    own_row, own_column = size - 1 - world.view_offset, size // 2
    every = (_ONE << np.uint64(size)) - _ONE
    rightwards = every & ~((_ONE << np.uint64(own_column)) - _ONE)
    leftwards = every & ((_ONE << np.uint64(own_column + 2)) - _ONE) & ~_ONE
    words = (e * world.n_agents + agent) * size
    bits = (e * 4 + games.direction[e, agent]) * world.bits_bytes
    corner = view_corner(games, world, e, agent)
    for row in range(size):
        games.sight[np.uint64(words + row)] = 0
    games.sight[np.uint64(words + own_row)] = _ONE << np.uint64(own_column)
    # Upwards from the agent's row, then downwards from it. Row 0 is not swept, since it has no next row; the rows
    # behind the agent are dark until the second pass.
    for sweep in range(2):
        row = own_row
        while (sweep == 0 and row >= 1) or (sweep == 1 and row < size):
            following = row - 1 if sweep == 0 else row + 1
            bit = corner + row * world.stride
            walls = load_word(games.wall_bits, bits + (bit >> 3)) >> np.uint64(bit & 7)
            clear = ~walls & every
            seen = games.sight[np.uint64(words + row)]
            right = _spread_right(seen & rightwards, clear & rightwards, size)
            seen |= (right | (right << _ONE)) & every
            left = _spread_left(seen & leftwards, clear & leftwards, size)
            games.sight[np.uint64(words + row)] = seen | left | (left >> _ONE)
            if 0 <= following < size:
                lit = right | (right << _ONE) | left | (left >> _ONE)
                games.sight[np.uint64(words + following)] |= lit & every
            row = following
    games.sight_known[e, agent] = 1


@hot
def observe_tiles(games: Games, world: World, out: U8, first: int, last: int) -> None:
    """Write the views of games ``first`` to ``last - 1`` as tile codes, (n * N * V * V,), n = last - first."""
    size = world.view_size
    n_words = (size + _WORD_BYTES - 1) // _WORD_BYTES
    own = (size - 1 - world.view_offset) * size + size // 2
    end = (last - first) * world.n_agents * size * size
    start = 0
    for e in range(first, last):
        for agent in range(world.n_agents):
            if not games.sight_known[e, agent]:
                look(games, world, e, agent)
            words = (e * world.n_agents + agent) * size
            source = (e * 4 + games.direction[e, agent]) * world.plane_bytes + view_corner(games, world, e, agent)
            for row in range(size):
                seen = games.sight[np.uint64(words + row)]
                for k in range(n_words):
                    mask = world.spread[(seen >> np.uint64(_WORD_BYTES * k)) & _BYTE]
                    codes = load_word(games.planes, source + row * world.stride + _WORD_BYTES * k) & mask
                    to = start + row * size + _WORD_BYTES * k
                    if to + _WORD_BYTES <= end:
                        # Writes past the row's end; the next row or view, written later, overwrites that.
                        store_word(out, to, codes)
                    else:
                        for i in range(min(end - to, size - _WORD_BYTES * k)):
                            out[to + i] = np.uint8((codes >> np.uint64(8 * i)) & _BYTE)
            ground = games.terrain[e, games.y[e, agent] * world.width + games.x[e, agent]]
            out[start + own] = agent_code(ground, games.colour[e, agent], 3)
            start += size * size


@hot
def draw_pictures(
    codes: U8, directions: U8, atlas: U8, turn_bytes: int, size: int, tile: int, out: U8, first: int, last: int
) -> None:
    """
    Turn the views of games ``first`` to ``last - 1`` into pixels.

    It takes only the arrays it needs, so that the innermost loops keep them in registers.

    :param codes: (n * N * V * V,) their tile codes, n = last - first
    :param directions: (E, N) that agents face
    :param atlas: see :class:`World`
    :param turn_bytes: see :class:`World`
    :param size: V
    :param tile: t
    :param out: (n * N * V t * V t * 3,)
    """
    n_agents = directions.shape[1]
    line, tile_bytes = 3 * tile, 3 * tile * tile
    # The last views that a chunk may reach into are drawn line by line: nothing overwrites the excess after them.
    repairing = 1 + (_CHUNK_BYTES - 1) // (size * size * tile_bytes)
    n_quick = (last - first) * n_agents - repairing if line <= _CHUNK_BYTES else 0
    view = 0
    for e in range(first, last):
        for agent in range(n_agents):
            turned = directions[e, agent] * turn_bytes
            to = view * size * size * tile_bytes
            for row in range(size):
                cell = (view * size + row) * size
                for pixel_row in range(tile):
                    source = turned + pixel_row * line
                    if view < n_quick:
                        # Each copy writes more than a tile's line; later copies overwrite the excess.
                        for column in range(size):
                            # An unsigned index avoids the check for negative indices.
                            copy_16(out, to, atlas, source + whole(codes[np.uint64(cell + column)]) * tile_bytes)
                            to += line
                    else:
                        for column in range(size):
                            _copy_line(out, to, atlas, source + whole(codes[cell + column]) * tile_bytes, line)
                            to += line
            view += 1


@inlined
def _copy_line(out: U8, to: int, atlas: U8, source: int, line: int) -> None:
    """Copy exactly one line of a tile."""
    if line < _WORD_BYTES:
        for k in range(line):
            out[to + k] = atlas[source + k]
        return
    for k in range(0, line - _WORD_BYTES, _WORD_BYTES):
        store_word(out, to + k, load_word(atlas, source + k))
    # The last word overlaps the one before it.
    store_word(out, to + line - _WORD_BYTES, load_word(atlas, source + line - _WORD_BYTES))
