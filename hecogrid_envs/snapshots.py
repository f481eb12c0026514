"""
Snapshots of the complete state of games, and games restored from them.

A snapshot holds terrain, agents, their order of arrival, counters and random generators; derived data (agents by cell,
tile codes) are computed on loading. A snapshot may come from a file, so all of it is checked first. Letters: E games, N
agents, W columns and rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hecogrid_envs.arrays import empty_games
from hecogrid_envs.constants import AGENT_PALETTE, Terrain
from hecogrid_envs.core.occupancy import arrive
from hecogrid_envs.core.types import Games, World
from hecogrid_envs.params import HECOGridParams
from hecogrid_envs.state import check_state, state_of

Snapshot = Mapping[str, npt.NDArray[Any]]

#: Arrays of a batch that are stored as they are.
_STORED: Final = (
    *("rng", "terrain", "x", "y", "direction", "has_key", "colour", "order", "steps", "collected", "collected_now"),
)
_NOBODY: Final = -1


def take_snapshot(games: Games, seeded: npt.NDArray[np.bool_]) -> dict[str, npt.NDArray[Any]]:
    """Copy E games: arrays by name; ``rank`` (E, N) counts the agents that arrived earlier in the same cell."""
    stored = {name: getattr(games, name).copy() for name in _STORED}
    return {"seeded": seeded.copy(), **stored, "rank": _ranks(games)}


def _ranks(games: Games) -> npt.NDArray[np.int32]:
    """Return how many agents arrived earlier in each agent's cell, (E, N)."""
    ranks = np.zeros(games.before.shape, dtype=np.int32)
    previous = games.before.astype(np.int64)
    while (previous != _NOBODY).any():
        there = previous != _NOBODY
        ranks += there
        following = np.take_along_axis(games.before, np.maximum(previous, 0), axis=1)
        previous = np.where(there, following, _NOBODY)
    return ranks


def check_snapshot(snapshot: Snapshot, games: Games, seeded: npt.NDArray[np.bool_], params: HECOGridParams) -> None:
    """Check a snapshot against games of the same kind; see ``GameBatch.check_snapshot``."""
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
        # Counts the last step, which may belong to the previous episode.
        "collected_now": (0, snapshot["terrain"].shape[1]),
    }
    for name, (low, high) in limits.items():
        wrong = (snapshot[name] < low) | (snapshot[name] > high)
        if wrong.any():
            raise ValueError(f"a snapshot has {snapshot[name][wrong][0]} in {name!r}, which no game reaches")
    if (np.sort(snapshot["order"], axis=1) != np.arange(n_agents)).any():
        raise ValueError("a snapshot has in 'order' what is no order of the agents")


def _check_game(snapshot: Snapshot, game: int, params: HECOGridParams) -> None:
    names = ("terrain", "x", "y", "direction", "has_key")
    mapping = state_of(*(snapshot[name][game] for name in names))
    try:
        check_state(mapping, params)
    except ValueError as error:
        raise ValueError(f"a snapshot has a game {game} that no rules allow: {error}") from error
    cells = snapshot["y"][game] * params.grid_size + snapshot["x"][game]
    for cell in np.unique(cells):
        ranks = np.sort(snapshot["rank"][game][cells == cell])
        if not np.array_equal(ranks, np.arange(len(ranks))):
            raise ValueError(f"a snapshot has in 'rank' {ranks.tolist()} for the agents of one cell of game {game}")


def load_snapshot(games: Games, world: World, snapshot: Snapshot) -> None:
    """Restore games from a checked snapshot; their cells must be redrawn afterwards."""
    blank = empty_games(world, len(games.rng))
    for name, empty in blank._asdict().items():
        getattr(games, name)[...] = empty
    for name in _STORED:
        getattr(games, name)[...] = snapshot[name]
    cells = games.y * world.width + games.x
    for game in np.flatnonzero(snapshot["seeded"]).tolist():
        for agent in np.argsort(snapshot["rank"][game], kind="stable").tolist():
            arrive(games, game, agent, int(cells[game, agent]))
