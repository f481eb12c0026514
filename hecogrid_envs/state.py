"""State of one game as plain arrays, for fixed, drawn, stored and replayed levels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final, TypedDict

import numpy as np
import numpy.typing as npt

from hecogrid_envs.constants import Terrain, TreasureState
from hecogrid_envs.params import HECOGridParams

Bools = npt.NDArray[np.bool_]


class StateMapping(TypedDict):
    """
    State of one game. W x H cells, N agents; planes are indexed ``[x, y]``.

    ``walls`` bool (W, H), ``treasures`` uint8 (W, H) with 0 none, 1 available, 2 collected, ``keys`` bool (W, H),
    ``agent_pos`` int (N, 2) as x, y, ``agent_dir`` int (N,), ``agent_has_key`` bool (N,). Last actions, which
    ``agent_colours="action"`` shows, are not part of it: views of a state that was set show none.
    """

    walls: Bools
    treasures: npt.NDArray[np.uint8]
    keys: Bools
    agent_pos: npt.NDArray[np.int64]
    agent_dir: npt.NDArray[np.int64]
    agent_has_key: Bools


#: Planes of the central view, the last axis of ``state()``.
STATE_PLANES: Final = (
    "wall",
    "treasure available",
    "treasure collected",
    "key",
    "agents facing east",
    "agents facing south",
    "agents facing west",
    "agents facing north",
    "agents with a key",
    "zone",
)


def check_state(mapping: object, params: HECOGridParams) -> StateMapping:
    """
    Check a state mapping and convert its arrays to their types.

    :raises ValueError: naming the first fault
    """
    if not isinstance(mapping, Mapping):
        raise ValueError(f"a state must be a mapping of arrays, got {type(mapping).__name__}")
    plane, n = (params.grid_size, params.grid_size), params.n_agents
    #: Shape, dtype and largest value.
    entries: dict[str, tuple[tuple[int, ...], str, int]] = {
        "walls": (plane, "bool", 1),
        "treasures": (plane, "uint8", max(TreasureState)),
        "keys": (plane, "bool", 1),
        "agent_pos": ((n, 2), "int64", params.grid_size - 1),
        "agent_dir": ((n,), "int64", 3),
        "agent_has_key": ((n,), "bool", 1),
    }
    missing = [name for name in entries if name not in mapping]
    if missing:
        raise ValueError(f"state lacks {missing[0]!r}; it needs {', '.join(entries)}")
    unknown = [name for name in mapping if name not in entries]
    if unknown:
        raise ValueError(f"state has an unknown entry {unknown[0]!r}; it needs just {', '.join(entries)}")
    arrays: Any = {name: _check_array(name, mapping[name], *entry) for name, entry in entries.items()}
    state: StateMapping = arrays
    walls, treasures, keys = state["walls"], state["treasures"] != TreasureState.NONE, state["keys"]
    ring = np.ones_like(walls)
    ring[1:-1, 1:-1] = False
    for fault, where in (
        ("the outer ring must be wall, but there is none", ring & ~walls),
        ("a treasure lies in a wall", treasures & walls),
        ("a key lies in a wall", keys & walls),
        ("a key and a treasure share a cell", keys & treasures),
    ):
        if where.any():
            raise ValueError(f"inconsistent state: {fault} at (x, y) = {_first(where)}")
    for agent, (x, y) in enumerate(state["agent_pos"]):
        for thing, occupied in (("in a wall", walls), ("on a key", keys)):
            if occupied[x, y]:
                raise ValueError(f"inconsistent state: agent {agent} stands {thing} at (x, y) = ({x}, {y})")
    return state


def state_of(games: Mapping[str, npt.NDArray[Any]], game: int) -> StateMapping:
    """
    Return the state of one game.

    :param games: arrays of E games by name: :class:`~hecogrid_envs.core.types.Games`, or a snapshot
    """
    terrain, x, y, direction, has_key = (games[name][game] for name in ("terrain", "x", "y", "direction", "has_key"))
    width = math.isqrt(terrain.size)
    terrain = terrain.reshape(width, width).T
    treasures = np.zeros((width, width), dtype=np.uint8)
    treasures[terrain == Terrain.TREASURE] = TreasureState.AVAILABLE
    treasures[terrain == Terrain.COLLECTED] = TreasureState.COLLECTED
    return StateMapping(
        walls=terrain == Terrain.WALL,
        treasures=treasures,
        keys=terrain == Terrain.KEY,
        agent_pos=np.stack([x, y], axis=1).astype(np.int64),
        agent_dir=direction.astype(np.int64),
        agent_has_key=has_key.astype(bool),
    )


def state_option(options: Mapping[str, Any] | None, params: HECOGridParams) -> StateMapping | None:
    """Return the state in the options of a reset, checked by :func:`check_state`, or None."""
    if options is None or options.get("state") is None:
        return None
    return check_state(options["state"], params)


def _check_array(name: str, value: object, shape: tuple[int, ...], kind: str, high: int) -> npt.NDArray[Any]:
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise ValueError(f"state entry {name!r} is no array: {error}") from error
    if array.shape != shape:
        raise ValueError(f"state entry {name!r} must have shape {shape}, got {array.shape}")
    if array.dtype.kind not in "bui":
        raise ValueError(f"state entry {name!r} must be {kind}, got {array.dtype}")
    wrong = (array < 0) | (array > high)
    if wrong.any():
        raise ValueError(
            f"state entry {name!r} must hold values from 0 to {high}, got {array[wrong][0]} at index {_first(wrong)}"
        )
    return array.astype(kind)


def _first(where: Bools) -> tuple[int, ...]:
    return tuple(int(i) for i in np.argwhere(where)[0])


def central_view(state: StateMapping, zone_of_column: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
    """
    Encode the whole game in planes, for a centralised critic.

    :param zone_of_column: (W,)
    :return: (W, H, 10) float32, planes as in :data:`STATE_PLANES`
    """
    width, height = state["walls"].shape
    counts = np.zeros((width, height, len(STATE_PLANES)), dtype=np.float32)
    counts[..., 0] = state["walls"]
    counts[..., 1] = state["treasures"] == TreasureState.AVAILABLE
    counts[..., 2] = state["treasures"] == TreasureState.COLLECTED
    counts[..., 3] = state["keys"]
    x, y = state["agent_pos"].T
    np.add.at(counts, (x, y, 4 + state["agent_dir"]), 1)
    np.add.at(counts, (x, y, np.full_like(x, 8)), state["agent_has_key"])
    counts[..., 9] = zone_of_column[:, None]
    return counts
