"""
Tile codes for the possible appearances of a cell in a view, and the atlas that maps codes to pixels.

A view consists of few distinct tiles. Views are computed in codes; pixels are looked up last.
Shapes are drawn at three times the size and averaged down, as MiniGrid does.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from hecogrid_envs.constants import (
    AGENT_PALETTE,
    BLACK,
    EMPTY_COLOUR,
    INVISIBLE_COLOUR,
    KEY_COLOUR,
    WALL_COLOUR,
    Colour,
    Direction,
    Rules,
    Terrain,
)
from hecogrid_envs.params import MAX_CODED_TILE_SIZE, HECOGridParams
from hecogrid_envs.task import DECLARED, TaskName

Image = npt.NDArray[np.uint8]

INVISIBLE: Final = 0
#: Code of a cell without agents and keys: ``FIRST_TERRAIN + terrain``.
FIRST_TERRAIN: Final = 1
#: Code of a key: ``FIRST_KEY + quarter turns`` of its picture, which turns with the map.
FIRST_KEY: Final = FIRST_TERRAIN + Terrain.KEY
#: Code of an agent: ``FIRST_AGENT + (ground * len(AGENT_PALETTE) + colour) * 4 + direction relative to the viewer``,
#: ground being 0 for a plain cell, 1 for an available and 2 for a collected treasure.
FIRST_AGENT: Final = FIRST_KEY + 4
N_GROUNDS: Final = 3
N_CODES: Final = FIRST_AGENT + N_GROUNDS * len(AGENT_PALETTE) * 4

_SUPERSAMPLING: Final = 3


def tile_atlas(task: TaskName, rules: Rules, tile_size: int) -> Image:
    """
    Draw every tile code.

    :param task: decides the colour of treasures
    :param rules: decides the colour of collected treasures
    :param tile_size: t, pixels per cell; at most :data:`MAX_CODED_TILE_SIZE` for the atlas to be exact, since larger
        tiles have grid lines, which turn with the viewer
    :return: (n_codes, t, t, 3) uint8, read-only
    """
    return turned_atlases(task, rules, tile_size)[Direction.NORTH]


@lru_cache(maxsize=64)
def turned_atlases(task: TaskName, rules: Rules, tile_size: int) -> Image:
    """
    Draw every tile code for viewers facing each direction.

    :return: (4, n_codes, t, t, 3) uint8, read-only; the four are equal up to :data:`MAX_CODED_TILE_SIZE`
    """
    size, declared = tile_size, DECLARED[task]
    available, collected = declared.treasure, declared.collected
    if rules == "released":
        collected = declared.collected_released
    tiles = np.empty((N_CODES, size, size, 3), dtype=np.uint8)
    tiles[INVISIBLE] = _solid(INVISIBLE_COLOUR, size)
    solids = (EMPTY_COLOUR, WALL_COLOUR, available, collected)
    tiles[FIRST_TERRAIN:FIRST_KEY] = [_solid(colour, size) for colour in solids]
    tiles[FIRST_KEY:FIRST_AGENT] = [np.rot90(_key(size), turns) for turns in range(4)]
    code = FIRST_AGENT
    for ground in (None, available, collected):
        for colour in AGENT_PALETTE:
            agent = _agent(colour, size) if ground is None else _blend(_solid(ground, size), _agent(colour, size))
            tiles[code : code + 4] = [np.rot90(agent, -direction) for direction in range(4)]
            code += 4
    # From the map, north up, to a viewer facing a direction: counterclockwise quarter turns.
    atlases = np.stack([_with_grid_lines(tiles, facing + 1) for facing in Direction])
    atlases.flags.writeable = False
    return atlases


def _solid(colour: Colour, size: int) -> Image:
    return np.full((size, size, 3), colour, dtype=np.uint8)


def _canvas(size: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], Image]:
    """Return the centres of the supersampled pixels as x, y in [0, 1], each (3t, 3t), and the black pixels."""
    side = size * _SUPERSAMPLING
    centres = (np.arange(side) + 0.5) / side
    return *np.meshgrid(centres, centres), np.zeros((side, side, 3), dtype=np.uint8)


def _averaged(canvas: Image) -> Image:
    """Average blocks of supersampled pixels: (3t, 3t, 3) to (t, t, 3); fractions are cut off."""
    size = len(canvas) // _SUPERSAMPLING
    blocks = canvas.reshape(size, _SUPERSAMPLING, size, _SUPERSAMPLING, 3)
    return blocks.mean(axis=3).mean(axis=1).astype(np.uint8)


def _agent(colour: Colour, size: int) -> Image:
    """Draw an agent that faces east: the triangle (0.12, 0.19), (0.87, 0.50), (0.12, 0.81)."""
    x, y, canvas = _canvas(size)
    slope = (0.50 - 0.19) / (0.87 - 0.12)
    canvas[(x >= 0.12) & (y >= 0.19 + slope * (x - 0.12)) & (y <= 0.81 - slope * (x - 0.12))] = colour
    return _averaged(canvas)


def _key(size: int) -> Image:
    """Draw MiniGrid's key: a shaft with two teeth and a ring."""
    x, y, canvas = _canvas(size)
    shaft = _in_rectangle(x, y, 0.50, 0.63, 0.31, 0.88)
    teeth = _in_rectangle(x, y, 0.38, 0.50, 0.59, 0.66) | _in_rectangle(x, y, 0.38, 0.50, 0.81, 0.88)
    radius_squared = (x - 0.56) ** 2 + (y - 0.28) ** 2
    canvas[shaft | teeth | (radius_squared <= 0.190**2)] = KEY_COLOUR
    canvas[radius_squared <= 0.064**2] = BLACK
    return _averaged(canvas)


def _in_rectangle(
    x: npt.NDArray[np.float64], y: npt.NDArray[np.float64], left: float, right: float, top: float, bottom: float
) -> npt.NDArray[np.bool_]:
    return (x >= left) & (x <= right) & (y >= top) & (y <= bottom)


def _blend(ground: Image, agent: Image) -> Image:
    """Blend an agent over its ground; brighter pixels are more opaque: (ground * (A - a) + agent * a) / A."""
    alpha = agent.sum(axis=2, keepdims=True, dtype=np.int64)
    top = alpha.max()
    if top == 0:
        return ground
    return ((ground * (top - alpha) + agent * alpha) / top).astype(np.uint8)


def _with_grid_lines(tiles: Image, turns: int) -> Image:
    """Draw a thin line on the north and east side of large tiles with a pure black corner."""
    size = tiles.shape[1]
    line = np.full((size, size, 3), max(0, min(20, size - MAX_CODED_TILE_SIZE)), dtype=np.uint8)
    line[1:, :-1] = 0
    corners = tiles[:, [0, 0, -1, -1], [0, -1, 0, -1]]
    black_corner = (corners == 0).all(axis=2).any(axis=1)
    return np.where(black_corner[:, None, None, None], tiles + np.rot90(line, turns), tiles)


class TileSpace(spaces.Box):
    """
    Space of views as tile codes: ``Box(0, n_codes - 1, (view_size, view_size), uint8)`` with the pixels of each code.

    :param view_size: side of a view in cells
    :param atlas: (n_codes, t, t, 3) uint8, pixels of every code
    """

    def __init__(self, view_size: int, atlas: Image, seed: int | np.random.Generator | None = None):
        super().__init__(0, len(atlas) - 1, (view_size, view_size), np.uint8, seed=seed)
        self.atlas = atlas

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, TileSpace) and super().__eq__(other) and np.array_equal(self.atlas, other.atlas)


def observation_space(task: TaskName, params: HECOGridParams) -> spaces.Box:
    """
    Return the space of one agent's observation.

    :return: ``Box(0, 255, (V t, V t, 3), uint8)`` for ``"rgb"``, a :class:`TileSpace` for ``"tiles"``
    """
    if params.observation == "tiles":
        return TileSpace(params.view_size, tile_atlas(task, params.rules, params.view_tile_size))
    return spaces.Box(0, 255, (params.view_pixels, params.view_pixels, 3), np.uint8)
