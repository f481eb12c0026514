"""
Arrays of a batch: the data its games share, games that have not begun, and snapshots.

A snapshot holds terrain, agents, their order of arrival, counters and random generators; derived data (agents by cell,
tile codes) are computed on loading. Letters: E games, N agents, W columns and rows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hecogrid_envs.constants import AGENT_PALETTE, BLUE_INDEX, KEY_CARRIER_INDEX, ZONE_COLOURS, Terrain
from hecogrid_envs.core.occupancy import arrive, plane_offset
from hecogrid_envs.core.types import Games, World
from hecogrid_envs.params import MAX_CODED_TILE_SIZE, HECOGridParams
from hecogrid_envs.state import check_state, state_of
from hecogrid_envs.task import DECLARED, TaskName
from hecogrid_envs.tiles import FIRST_TERRAIN, turned_atlases

Snapshot = Mapping[str, npt.NDArray[Any]]

#: Arrays of games that a snapshot stores as they are.
_STORED: Final = (
    *("rng", "terrain", "x", "y", "direction", "has_key", "colour", "order", "steps", "collected", "collected_now"),
)

#: Kernels load whole words, so every byte array ends with room for one word per eight columns of a view.
SLACK: Final = 64

#: Visibility in views of at most this many columns is looked up in a table.
_TABLED_COLUMNS: Final = 8

#: Size of a cache line in bytes.
_CACHE_LINE: Final = 64


def aligned(shape: int | tuple[int, ...], dtype: npt.DTypeLike, value: int = 0) -> npt.NDArray[Any]:
    """
    Make an array that shares no cache line with another array.

    If games divide evenly between threads, no two threads write to the same line (no false sharing).
    """
    n_bytes = math.prod((shape,) if isinstance(shape, int) else shape) * np.dtype(dtype).itemsize
    memory = np.empty(n_bytes + 2 * _CACHE_LINE, dtype=np.uint8)
    start = -memory.ctypes.data % _CACHE_LINE
    array = memory[start : start + n_bytes].view(dtype).reshape(shape)
    array[...] = value
    return array


def world_of(task: TaskName, params: HECOGridParams) -> World:
    """Return the data that all games of a batch share."""
    view, offset = params.view_size, params.view_offset
    pad = max(view - 1 - offset, offset, view // 2)
    stride = params.grid_size + 2 * pad
    zone_of_column = params.zone_of_column()
    n_zones = int(zone_of_column.max()) + 1
    released = params.rules == "released"
    atlases = turned_atlases(task, params.rules, params.view_tile_size)
    spread = [sum(0xFF << (8 * i) for i in range(8) if bits >> i & 1) for bits in range(256)]
    world = World(
        condition=list(DECLARED).index(task),
        released=released,
        random_order=params.agent_order == "random",
        n_agents=params.n_agents,
        width=params.grid_size,
        coordination=params.coordination,
        support_radius=params.support_radius,
        n_treasures=params.n_treasures,
        n_clutter=params.n_clutter,
        n_keys=params.n_keys if DECLARED[task].has_keys else 0,
        max_cycles=params.max_cycles,
        view_size=view,
        view_offset=offset,
        stride=stride,
        pad=pad,
        plane_bytes=stride * stride + SLACK,
        bits_bytes=(stride * stride + 7) // 8 + SLACK,
        zone_of_column=zone_of_column.astype(np.int32),
        command_of=params.command_of(),
        zone_colour=(np.arange(n_zones) * (params.agent_colours == "zone") % len(ZONE_COLOURS)).astype(np.uint8),
        shows_actions=params.agent_colours == "action",
        key_colour=BLUE_INDEX if released else KEY_CARRIER_INDEX,
        first_colour=BLUE_INDEX,
        blank_planes=np.zeros(0, dtype=np.uint8),
        blank_bits=np.zeros(0, dtype=np.uint8),
        spread=np.array(spread, dtype=np.uint64),
        swept=_swept_rows(view) if view <= _TABLED_COLUMNS else np.zeros(0, dtype=np.uint16),
        tile=params.view_tile_size,
        atlas=np.concatenate([atlases.reshape(-1), np.zeros(SLACK, dtype=np.uint8)]),
        turn_bytes=0 if params.view_tile_size <= MAX_CODED_TILE_SIZE else atlases[0].size,
    )
    return _with_blank_map(world)


def _swept_rows(size: int) -> npt.NDArray[np.uint16]:
    """Return the table that :class:`~hecogrid_envs.core.types.World` calls ``swept``."""
    cells, own = 1 << size, size // 2
    clear, seen = np.divmod(np.arange(cells * cells), cells)
    following = np.zeros_like(seen)
    for column, towards in [(i, i + 1) for i in range(own, size)] + [(i, i - 1) for i in range(own + 1, 0, -1)]:
        lights = (seen & clear) >> column & 1
        seen |= lights << towards
        following |= lights << column | lights << towards
    return (seen % cells | following % cells << _TABLED_COLUMNS).astype(np.uint16)


def _with_blank_map(world: World) -> World:
    """Return the world with the planes of an empty map, which resets copy. Cells beyond the map count as empty."""
    planes = np.full((4, world.plane_bytes), FIRST_TERRAIN + Terrain.EMPTY, dtype=np.uint8)
    bits = np.zeros((4, world.bits_bytes), dtype=np.uint8)
    outer = np.ones((world.width, world.width), dtype=bool)
    outer[1:-1, 1:-1] = False
    x, y = np.nonzero(outer)
    for facing in range(4):
        cells: npt.NDArray[Any] = plane_offset(world, facing, x, y)  # type: ignore[arg-type, assignment] # of all at once
        planes[facing, cells] = FIRST_TERRAIN + Terrain.WALL
        np.bitwise_or.at(bits[facing], cells >> 3, np.uint8(1) << (cells & 7).astype(np.uint8))
    return world._replace(blank_planes=planes.reshape(-1), blank_bits=bits.reshape(-1))


def empty_games(world: World, n_games: int) -> Games:
    """Return E games that have not begun."""
    agents, cells = (n_games, world.n_agents), (n_games, world.width * world.width)
    games = Games(
        rng=aligned(n_games, np.uint64),
        terrain=aligned(cells, np.uint8),
        head=aligned(cells, np.int16, -1),
        tail=aligned(cells, np.int16, -1),
        crowd=aligned(cells, np.int16),
        after=aligned(agents, np.int16, -1),
        before=aligned(agents, np.int16, -1),
        x=aligned(agents, np.int32, 1),
        y=aligned(agents, np.int32, 1),
        direction=aligned(agents, np.uint8),
        has_key=aligned(agents, np.uint8),
        colour=aligned(agents, np.uint8),
        order=aligned(agents, np.int32),
        sight=aligned(n_games * world.n_agents * world.view_size, np.uint64),
        sight_known=aligned(agents, np.uint8),
        planes=aligned(n_games * 4 * world.plane_bytes, np.uint8),
        wall_bits=aligned(n_games * 4 * world.bits_bytes, np.uint8),
        steps=aligned(n_games, np.int32),
        collected=aligned(n_games, np.int32),
        collected_now=aligned(n_games, np.int32),
    )
    games.order[...] = np.arange(world.n_agents)
    games.planes.reshape(n_games, -1)[...] = world.blank_planes  # the outer wall and what lies beyond it stay
    return games


def take_snapshot(games: Games, seeded: npt.NDArray[np.bool_]) -> dict[str, npt.NDArray[Any]]:
    """Copy E games: arrays by name; ``rank`` (E, N) counts the agents that arrived earlier in the same cell."""
    ranks = np.zeros(games.before.shape, dtype=np.int32)
    previous = games.before.astype(np.int64)
    while (there := previous >= 0).any():
        ranks += there
        earlier = np.take_along_axis(games.before, np.maximum(previous, 0), axis=1)
        previous = np.where(there, earlier, -1)
    stored = {name: getattr(games, name).copy() for name in _STORED}
    return {"seeded": seeded.copy(), **stored, "rank": ranks}


def check_snapshot(snapshot: Snapshot, example: Snapshot, params: HECOGridParams) -> None:
    """
    Check that the kernels can index with a snapshot, whose values they do not check.

    :raises ValueError: naming the first array that differs in shape or dtype, or a value out of range
    """
    for name, array in example.items():
        given = np.asarray(snapshot.get(name))
        if (given.shape, given.dtype) != (array.shape, array.dtype):
            raise ValueError(
                f"invalid snapshot: expected `{name}` as {array.dtype} {array.shape}, got {given.dtype} {given.shape}; "
                "take the task, the parameters and the number of games that it was made with"
            )
    for name, high in {"terrain": max(Terrain), "has_key": 1, "colour": len(AGENT_PALETTE) - 1}.items():
        if (highest := int(snapshot[name].max())) > high:
            raise ValueError(f"invalid snapshot: `{name}` must be at most {high}, got {highest}")
    if (np.sort(snapshot["order"], axis=1) != np.arange(params.n_agents)).any():
        raise ValueError("invalid snapshot: `order` is not a permutation of the agents")
    for game in np.flatnonzero(snapshot["seeded"]).tolist():
        names = ("terrain", "x", "y", "direction", "has_key")
        try:
            check_state(state_of(*(snapshot[name][game] for name in names)), params)
        except ValueError as error:
            raise ValueError(f"invalid snapshot: game {game}: {error}") from error


def load_snapshot(games: Games, world: World, snapshot: Snapshot) -> None:
    """Restore games from a checked snapshot; their cells must be redrawn afterwards."""
    for name, empty in empty_games(world, len(games.rng))._asdict().items():
        getattr(games, name)[...] = empty
    begun = snapshot["seeded"]
    for name in _STORED:
        getattr(games, name)[begun] = snapshot[name][begun]
    cells = games.y * world.width + games.x
    for game in np.flatnonzero(begun).tolist():
        for agent in np.argsort(snapshot["rank"][game], kind="stable").tolist():
            arrive(games, game, agent, int(cells[game, agent]))
