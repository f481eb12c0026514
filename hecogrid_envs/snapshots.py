"""
All that the future of games depends on, and games made of it again.

A snapshot holds terrain, agents, their order of arrival, counters and random generators; what follows from these (who
stands where, what every cell looks like) is computed when it is loaded. A snapshot may come from a file, so everything
in it is checked first. Letters: E games, N agents, W columns and rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hecogrid_envs.arrays import empty_games
from hecogrid_envs.constants import AGENT_PALETTE, Terrain, TreasureState
from hecogrid_envs.core.occupancy import plane_offset
from hecogrid_envs.core.types import Games, RuleBook
from hecogrid_envs.params import HECOGridParams
from hecogrid_envs.state import check_state
from hecogrid_envs.tiles import FIRST_AGENT, FIRST_KEY, FIRST_TERRAIN

Snapshot = Mapping[str, npt.NDArray[Any]]

#: Arrays of a batch that are stored as they are.
_STORED: Final = (
    *("rng", "terrain", "x", "y", "direction", "has_key", "colour", "order", "steps", "collected", "paid"),
)
_NOBODY: Final = -1


def take_snapshot(games: Games, seeded: npt.NDArray[np.bool_]) -> dict[str, npt.NDArray[Any]]:
    """
    Copy games.

    :param games: E games
    :param seeded: (E,) which of them have begun
    :return: arrays by name, with games along the first axis; ``rank`` (E, N) counts who arrived in its cell before
    """
    stored = {name: getattr(games, name).copy() for name in _STORED}
    return {"seeded": seeded.copy(), **stored, "rank": _ranks(games)}


def _ranks(games: Games) -> npt.NDArray[np.int32]:
    """(E, N) how many agents arrived before each agent in its cell."""
    ranks = np.zeros(games.before.shape, dtype=np.int32)
    previous = games.before.astype(np.int64)
    while (previous != _NOBODY).any():
        there = previous != _NOBODY
        ranks += there
        following = np.take_along_axis(games.before, np.maximum(previous, 0), axis=1)
        previous = np.where(there, following, _NOBODY)
    return ranks


def check_snapshot(snapshot: Snapshot, games: Games, seeded: npt.NDArray[np.bool_], params: HECOGridParams) -> None:
    """
    Check that games with these parameters could be in a state.

    :param snapshot: what :func:`take_snapshot` gave
    :param games: E games of the same kind
    :param seeded: (E,)
    :param params: of the games
    :raises ValueError: naming the first fault
    """
    own = take_snapshot(games, seeded)
    if different := sorted(own.keys() ^ snapshot.keys()):
        raise ValueError(f"expected a snapshot with the arrays {sorted(own)}, they differ in {different[0]!r}")
    for name, array in own.items():
        given = snapshot[name]
        if not isinstance(given, np.ndarray) or given.shape != array.shape or given.dtype != array.dtype:
            raise ValueError(
                f"expected {name!r} of shape {array.shape} and {array.dtype}, got {np.shape(given)} and "
                f"{getattr(given, 'dtype', type(given).__name__)}; take the task, the parameters and the number of "
                "games that the snapshot was made with"
            )
    _check_values(snapshot, params.n_agents)
    for game in np.flatnonzero(snapshot["seeded"]).tolist():
        _check_game(snapshot, game, params)


def _check_values(snapshot: Snapshot, n_agents: int) -> None:
    collected = (snapshot["terrain"] == Terrain.COLLECTED).sum(axis=1)
    limits: dict[str, tuple[Any, Any]] = {
        "terrain": (0, max(Terrain)),
        "has_key": (0, 1),
        "colour": (0, len(AGENT_PALETTE) - 1),
        "steps": (0, np.iinfo(np.int32).max - 1),
        "collected": (0, collected),
        # Of the last step, which may have been in the episode before.
        "paid": (0, snapshot["terrain"].shape[1]),
    }
    for name, (low, high) in limits.items():
        wrong = (snapshot[name] < low) | (snapshot[name] > high)
        if wrong.any():
            raise ValueError(f"a snapshot has {snapshot[name][wrong][0]} in {name!r}, which no game reaches")
    if (np.sort(snapshot["order"], axis=1) != np.arange(n_agents)).any():
        raise ValueError("a snapshot has in 'order' what is no order of the agents")


def _check_game(snapshot: Snapshot, game: int, params: HECOGridParams) -> None:
    width = params.grid_size
    terrain = snapshot["terrain"][game].reshape(width, width).T
    treasures = np.zeros((width, width), dtype=np.uint8)
    treasures[terrain == Terrain.TREASURE] = TreasureState.AVAILABLE
    treasures[terrain == Terrain.COLLECTED] = TreasureState.COLLECTED
    mapping = {
        "walls": terrain == Terrain.WALL,
        "treasures": treasures,
        "keys": terrain == Terrain.KEY,
        "agent_pos": np.stack([snapshot["x"][game], snapshot["y"][game]], axis=1),
        "agent_dir": snapshot["direction"][game],
        "agent_has_key": snapshot["has_key"][game],
    }
    try:
        check_state(mapping, params)
    except ValueError as error:
        raise ValueError(f"a snapshot has a game {game} that no rules allow: {error}") from error
    cells = snapshot["y"][game] * width + snapshot["x"][game]
    for cell in np.unique(cells):
        ranks = np.sort(snapshot["rank"][game][cells == cell])
        if not np.array_equal(ranks, np.arange(len(ranks))):
            raise ValueError(f"a snapshot has in 'rank' {ranks.tolist()} for the agents of one cell of game {game}")


def load_snapshot(games: Games, book: RuleBook, snapshot: Snapshot) -> None:
    """
    Let games go on from a snapshot that passed :func:`check_snapshot`.

    :param games: E games, overwritten
    :param book: of the games
    :param snapshot: copied
    """
    blank = empty_games(book, len(games.rng))
    for name, empty in blank._asdict().items():
        getattr(games, name)[...] = empty
    for name in _STORED:
        getattr(games, name)[...] = snapshot[name]
    for game in np.flatnonzero(snapshot["seeded"]).tolist():
        _place_agents(games, book, game, snapshot["rank"][game])
        _draw(games, book, game)


def _place_agents(games: Games, book: RuleBook, game: int, ranks: npt.NDArray[np.int32]) -> None:
    """Link the agents of each cell in order of arrival."""
    cells = games.y[game] * book.width + games.x[game]
    for agent in np.argsort(ranks, kind="stable").tolist():
        cell = int(cells[agent])
        last = int(games.tail[game, cell])
        if last == _NOBODY:
            games.head[game, cell] = agent
        else:
            games.after[game, last] = agent
        games.before[game, agent] = last
        games.tail[game, cell] = agent
        games.crowd[game, cell] += 1


def _draw(games: Games, book: RuleBook, game: int) -> None:
    """Write tile codes and walls of all cells inside the outer wall, in the four orientations."""
    inside = np.arange(1, book.width - 1)
    x, y = (part.reshape(-1) for part in np.meshgrid(inside, inside))
    cells = y * book.width + x
    ground, first = games.terrain[game, cells].astype(np.int64), games.head[game, cells].astype(np.int64)
    low, turn, step = FIRST_TERRAIN + ground, np.zeros_like(ground), np.zeros_like(ground)
    is_key, is_taken = ground == Terrain.KEY, first != _NOBODY
    low[is_key], turn[is_key], step[is_key] = FIRST_KEY, 1, 1
    agents = first[is_taken]
    layer = (ground == Terrain.TREASURE) + 2 * (ground == Terrain.COLLECTED)
    low[is_taken] = FIRST_AGENT + (layer[is_taken] * len(AGENT_PALETTE) + games.colour[game, agents]) * 4
    turn[is_taken], step[is_taken] = games.direction[game, agents] + 3, -1
    planes = games.planes.reshape(len(games.rng), 4, -1)[game]
    bits = games.wall_bits.reshape(len(games.rng), 4, -1)[game]
    bits[...] = book.blank_bits.reshape(4, -1)
    for facing in range(4):
        places = plane_offset.py_func(book, facing, x, y)  # type: ignore[attr-defined]
        planes[facing, places] = low + ((turn + step * facing) & 3)
        walls = places[ground == Terrain.WALL]
        np.bitwise_or.at(bits[facing], walls >> 3, np.uint8(1) << (walls & 7).astype(np.uint8))
