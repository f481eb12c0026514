"""What an agent sees: visibility on bit masks, the view in tile codes, and its pixels."""

from __future__ import annotations

import numpy as np

from hecogrid_envs.core.jit import hot, hot_entry, inlined
from hecogrid_envs.core.occupancy import agent_code, plane_offset
from hecogrid_envs.core.types import U8, Games, RuleBook, whole
from hecogrid_envs.core.words import copy_16, load_word, store_word

_ONE = np.uint64(1)
_BYTE = np.uint64(255)
_WORD_BYTES = 8
_CHUNK_BYTES = 16


@inlined
def view_corner(games: Games, book: RuleBook, e: int, agent: int) -> int:
    """Offset of the top left cell of an agent's view in the plane turned for it."""
    facing, x, y = whole(games.direction[e, agent]), whole(games.x[e, agent]), whole(games.y[e, agent])
    here = plane_offset(book, facing, x, y)
    return here - (book.view_size - 1 - book.view_offset) * book.stride - book.view_size // 2


@inlined
def _spread_right(seen: np.uint64, clear: np.uint64, size: int) -> np.uint64:
    """Cells that light reaches from ``seen`` towards larger columns through ``clear`` cells, by doubling."""
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
def look(games: Games, book: RuleBook, e: int, agent: int) -> None:
    """
    Compute which cells of its view an agent sees and keep it in ``games.sight``.

    Rows are words, bit i is column i. The sweeps of the rule book go from the agent's column to the last column,
    then from one beyond the agent's column down to column 1; a cell that is lit and clear lights its neighbour in the
    row, the cell in the next row and the diagonal between them.
    """
    size = book.view_size
    own_row, own_column = size - 1 - book.view_offset, size // 2
    every = (_ONE << np.uint64(size)) - _ONE
    rightwards = every & ~((_ONE << np.uint64(own_column)) - _ONE)
    leftwards = every & ((_ONE << np.uint64(own_column + 2)) - _ONE) & ~_ONE
    words = (e * book.n_agents + agent) * size
    bits = (e * 4 + games.direction[e, agent]) * book.bits_bytes
    corner = view_corner(games, book, e, agent)
    for row in range(size):
        games.sight[np.uint64(words + row)] = 0
    games.sight[np.uint64(words + own_row)] = _ONE << np.uint64(own_column)
    # Upwards from the agent's row, then downwards from it. Row 0 hands on to no row and is not swept;
    # the rows behind the agent are dark until the second pass.
    for sweep in range(2):
        row = own_row
        while (sweep == 0 and row >= 1) or (sweep == 1 and row < size):
            following = row - 1 if sweep == 0 else row + 1
            bit = corner + row * book.stride
            walls = load_word(games.wall_bits, bits + (bit >> 3)) >> np.uint64(bit & 7)
            clear = ~walls & every
            seen = games.sight[np.uint64(words + row)]
            if size <= _WORD_BYTES:
                swept = np.uint64(book.swept[(clear << np.uint64(size)) | seen])
                seen, lit = swept & _BYTE, swept >> np.uint64(_WORD_BYTES)
            else:
                right = _spread_right(seen & rightwards, clear & rightwards, size)
                seen |= (right | (right << _ONE)) & every
                left = _spread_left(seen & leftwards, clear & leftwards, size)
                seen |= left | (left >> _ONE)
                lit = right | (right << _ONE) | left | (left >> _ONE)
            games.sight[np.uint64(words + row)] = seen
            if 0 <= following < size:
                games.sight[np.uint64(words + following)] |= lit & every
            row = following
    games.sight_known[e, agent] = 1


@hot
def observe_tiles(games: Games, book: RuleBook, out: U8, first: int, last: int) -> None:
    """
    Write the views of games ``first`` to ``last - 1`` as tile codes.

    :param out: (E * N * V * V,)
    """
    size = book.view_size
    n_words = (size + _WORD_BYTES - 1) // _WORD_BYTES
    own = (size - 1 - book.view_offset) * size + size // 2
    end = last * book.n_agents * size * size
    for e in range(first, last):
        for agent in range(book.n_agents):
            if not games.sight_known[e, agent]:
                look(games, book, e, agent)
            words = (e * book.n_agents + agent) * size
            start = words * size
            source = (e * 4 + games.direction[e, agent]) * book.plane_bytes + view_corner(games, book, e, agent)
            for row in range(size):
                seen = games.sight[np.uint64(words + row)]
                for k in range(n_words):
                    mask = book.spread[(seen >> np.uint64(_WORD_BYTES * k)) & _BYTE]
                    codes = load_word(games.planes, source + row * book.stride + _WORD_BYTES * k) & mask
                    to = start + row * size + _WORD_BYTES * k
                    if to + _WORD_BYTES <= end:
                        # Writes past the row's end; the next row or view, written later, repairs it.
                        store_word(out, to, codes)
                    else:
                        for i in range(min(end - to, size - _WORD_BYTES * k)):
                            out[to + i] = np.uint8((codes >> np.uint64(8 * i)) & _BYTE)
            ground = games.terrain[e, games.y[e, agent] * book.width + games.x[e, agent]]
            out[start + own] = agent_code(ground, games.colour[e, agent], 3)


@hot_entry
def draw_pictures(
    codes: U8, facing: U8, atlas: U8, turn_bytes: int, size: int, tile: int, out: U8, first: int, last: int
) -> None:
    """
    Turn views in tile codes into pixels.

    :param codes: (B * V * V,) codes of B views
    :param facing: (B,) directions of the viewers
    :param atlas: (4 * n_codes * t * t * 3,) tiles for viewers facing each direction, and slack for whole chunks
    :param turn_bytes: bytes from one direction's tiles to the next; 0 if all directions may share the first
    :param size: V
    :param tile: t
    :param out: (B * V t * V t * 3,)
    :param first: first view to draw
    :param last: one beyond the last view to draw
    """
    line, tile_bytes = 3 * tile, 3 * tile * tile
    # As many views as a chunk may reach into are drawn line by line: nothing repairs what lies beyond the last.
    repairing = 1 + (_CHUNK_BYTES - 1) // (size * size * tile_bytes)
    quick = max(first, last - repairing) if line <= _CHUNK_BYTES else first
    _draw_in_chunks(codes, facing, atlas, turn_bytes, size, tile, out, first, quick)
    for view in range(quick, last):
        turned = facing[view] * turn_bytes
        to = view * size * size * tile_bytes
        for row in range(size):
            cell = (view * size + row) * size
            for pixel_row in range(tile):
                source = turned + pixel_row * line
                for column in range(size):
                    _copy_line(out, to, atlas, source + np.int64(codes[cell + column]) * tile_bytes, line)
                    to += line


@inlined
def _draw_in_chunks(
    codes: U8, facing: U8, atlas: U8, turn_bytes: int, size: int, tile: int, out: U8, first: int, last: int
) -> None:
    """As :func:`draw_pictures`, copying more than a tile's line; what comes next, written later, repairs it."""
    line, tile_bytes = 3 * tile, 3 * tile * tile
    for view in range(first, last):
        turned = facing[view] * turn_bytes
        to = view * size * size * tile_bytes
        for row in range(size):
            cell = (view * size + row) * size
            for pixel_row in range(tile):
                source = turned + pixel_row * line
                for column in range(size):
                    # An unsigned index spares the check for counting from the end.
                    copy_16(out, to, atlas, source + np.int64(codes[np.uint64(cell + column)]) * tile_bytes)
                    to += line


@inlined
def _copy_line(out: U8, to: int, atlas: U8, source: int, line: int) -> None:
    """Copy one line of a tile and nothing beyond it."""
    if line < _WORD_BYTES:
        for k in range(line):
            out[to + k] = atlas[source + k]
        return
    for k in range(0, line - _WORD_BYTES, _WORD_BYTES):
        store_word(out, to + k, load_word(atlas, source + k))
    # The last word overlaps the one before it.
    store_word(out, to + line - _WORD_BYTES, load_word(atlas, source + line - _WORD_BYTES))
