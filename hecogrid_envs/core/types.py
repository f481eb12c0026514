"""Arguments of kernels: the games of a batch, the world they share, and buffers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

U8 = npt.NDArray[np.uint8]
I16 = npt.NDArray[np.int16]
I32 = npt.NDArray[np.int32]
U64 = npt.NDArray[np.uint64]

#: Converts to the integer type of kernels' loops; any other argument type would compile the kernel again.
whole: Callable[[Any], int] = np.int64  # type: ignore[assignment]


#: Tasks of :func:`hecogrid_envs.core.play.play`: any sum of these, done in this order.
STEP: Final = 1
RESTART: Final = 2
RESET: Final = 4
BEGIN: Final = 8
REDRAW: Final = 16
TILES: Final = 32
PICTURES: Final = 64


class World(NamedTuple):
    """
    Data that all games of a batch share. W = grid size, N = agents, V = view size, t = tile size, Z = zones.

    :param condition: number of the task's condition for collecting, in the order of the registered tasks
    :param released: whether the released rules hold
    :param random_order: whether agents act in an order drawn anew each step
    :param stride: side of a padded plane; a view never leaves it
    :param pad: cells of padding on each side
    :param plane_bytes: bytes of one padded plane, the slack for whole-word loads included
    :param bits_bytes: bytes of one plane of wall bits, slack included
    :param zone_of_column: (W,)
    :param command_of: (Z, 7) command that an action integer triggers
    :param zone_colour: (Z,) palette index of an agent
    :param shows_actions: whether an agent's colour tells its last action instead
    :param key_colour: palette index of an agent with a key
    :param spread: (256,) word whose byte i is 0xFF where bit i of the index is set
    :param tile: t
    :param atlas: (4 * n_codes * t * t * 3,) tiles for viewers facing each direction, and slack for whole chunks
    :param turn_bytes: bytes from one direction's tiles to the next; 0 if all directions may share the first
    """

    condition: int
    released: bool
    random_order: bool
    n_agents: int
    width: int
    coordination: int
    support_radius: int
    n_treasures: int
    n_clutter: int
    n_keys: int
    max_cycles: int
    view_size: int
    view_offset: int
    stride: int
    pad: int
    plane_bytes: int
    bits_bytes: int
    zone_of_column: I32
    command_of: U8
    zone_colour: U8
    shows_actions: bool
    key_colour: int
    spread: U64
    tile: int
    atlas: U8
    turn_bytes: int


class Games(NamedTuple):
    """
    The state of E games. Cells are numbered ``y * W + x``.

    :param rng: (E,) state of each game's random generator
    :param terrain: (E, W * W) :class:`~hecogrid_envs.constants.Terrain`
    :param head: (E, W * W) first agent of a cell in order of arrival, -1 if none
    :param tail: (E, W * W) last agent of a cell, -1 if none
    :param crowd: (E, W * W) agents on a cell
    :param after: (E, N) next agent in the same cell in order of arrival, -1 if none
    :param before: (E, N) previous agent in the same cell, -1 if none
    :param x: (E, N) column of each agent
    :param y: (E, N) row of each agent
    :param direction: (E, N)
    :param has_key: (E, N) 0 or 1
    :param colour: (E, N) palette index of the agent in views of other agents
    :param order: (E, N) order in which agents acted in the last step
    :param sight: (E * N * V,) bit i of word j: whether the agent sees column i of row j of its view
    :param sight_known: (E, N) 0 where ``sight`` must be computed anew
    :param planes: (E * 4 * plane_bytes,) the map in tile codes as seen by a viewer facing each direction
    :param wall_bits: (E * 4 * bits_bytes,) the walls in the same four orientations, one bit a cell
    :param steps: (E,) game steps since the reset
    :param collected: (E,) treasures collected since the reset
    :param collected_now: (E,) treasures collected in the last step
    """

    rng: U64
    terrain: U8
    head: I16
    tail: I16
    crowd: I16
    after: I16
    before: I16
    x: I32
    y: I32
    direction: U8
    has_key: U8
    colour: U8
    order: I32
    sight: U64
    sight_known: U8
    planes: U8
    wall_bits: U8
    steps: I32
    collected: I32
    collected_now: I32


class Buffers(NamedTuple):
    """
    Working memory of a batch. E games, N agents, V = view size.

    :param actions: (E * N,) what agents do in the next step, 0 to 6
    :param fresh: (E,) 1 for games that ``RESET`` will reset or that ``RESTART`` has reset, 0 for others
    :param codes: (E * N * V * V,) views in tile codes before they become pixels
    """

    actions: U8
    fresh: U8
    codes: U8
