"""
E games of one task, stepped and observed by one compiled call; their arrays, and snapshots.

A snapshot holds terrain, agents, their order of arrival, counters and random generators; derived data (agents by cell,
tile codes) are computed on loading. Letters: E games, N agents, W columns and rows.
"""

from __future__ import annotations

import secrets
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from threading import Timer
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import typeof

from hecogrid_envs.constants import (
    AGENT_PALETTE,
    BLUE_INDEX,
    KEY_CARRIER_INDEX,
    N_ACTIONS,
    ZONE_COLOURS,
    Terrain,
    TreasureState,
)
from hecogrid_envs.constants import STEP as STEP_AHEAD
from hecogrid_envs.core.occupancy import arrive
from hecogrid_envs.core.rng import generator_word
from hecogrid_envs.core.types import BEGIN, PICTURES, REDRAW, RESET, RESTART, STEP, TILES, U8, Buffers, Games, World
from hecogrid_envs.params import MAX_CODED_TILE_SIZE, HECOGridParams, whole_number
from hecogrid_envs.state import StateMapping, check_state, state_of
from hecogrid_envs.task import DECLARED, TaskName, check_task
from hecogrid_envs.tiles import FIRST_TERRAIN, INVISIBLE, turned_atlases

Snapshot = Mapping[str, npt.NDArray[Any]]

#: Arrays of games that a snapshot stores as they are.
_STORED: Final = (
    *("rng", "terrain", "x", "y", "direction", "has_key", "colour", "order", "steps", "collected", "collected_now"),
)

#: Kernels load whole words, so every byte array ends with room for one word per eight columns of a view.
SLACK: Final = 64


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
    return World(
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
        spread=np.array(spread, dtype=np.uint64),
        tile=params.view_tile_size,
        atlas=np.concatenate([atlases.reshape(-1), np.zeros(SLACK, dtype=np.uint8)]),
        turn_bytes=0 if params.view_tile_size <= MAX_CODED_TILE_SIZE else atlases[0].size,
    )


def empty_games(world: World, n_games: int) -> Games:
    """Return E games that have not begun."""
    agents, cells = (n_games, world.n_agents), (n_games, world.width * world.width)
    games = Games(
        rng=np.zeros(n_games, dtype=np.uint64),
        terrain=np.zeros(cells, dtype=np.uint8),
        head=np.full(cells, -1, dtype=np.int16),
        tail=np.full(cells, -1, dtype=np.int16),
        crowd=np.zeros(cells, dtype=np.int16),
        after=np.full(agents, -1, dtype=np.int16),
        before=np.full(agents, -1, dtype=np.int16),
        x=np.full(agents, 1, dtype=np.int32),
        y=np.full(agents, 1, dtype=np.int32),
        direction=np.zeros(agents, dtype=np.uint8),
        has_key=np.zeros(agents, dtype=np.uint8),
        colour=np.zeros(agents, dtype=np.uint8),
        order=np.zeros(agents, dtype=np.int32),
        sight=np.zeros(n_games * world.n_agents * world.view_size, dtype=np.uint64),
        sight_known=np.zeros(agents, dtype=np.uint8),
        # Cells beyond the map count as empty.
        planes=np.full(n_games * 4 * world.plane_bytes, FIRST_TERRAIN + Terrain.EMPTY, dtype=np.uint8),
        wall_bits=np.zeros(n_games * 4 * world.bits_bytes, dtype=np.uint8),
        steps=np.zeros(n_games, dtype=np.int32),
        collected=np.zeros(n_games, dtype=np.int32),
        collected_now=np.zeros(n_games, dtype=np.int32),
    )
    games.order[...] = np.arange(world.n_agents)
    return games


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
        try:
            check_state(state_of(snapshot, game), params)
        except ValueError as error:
            raise ValueError(f"invalid snapshot: game {game}: {error}") from error


#: Passed where no views are requested.
_NO_VIEWS: Final[U8] = np.zeros(0, dtype=np.uint8)
_SECONDS_WITHOUT_A_WORD: Final = 4.0


class GameBatch:
    """
    Batch of games with the same task and parameters; levels and random streams differ.

    :param task: a name in :data:`hecogrid_envs.TASK_NAMES`, such as ``"TeamSupport"``
    :param params: parameters of all games
    :param n_games: E
    :raises ValueError: for an unknown task or objects that do not fit on the map
    """

    def __init__(self, task: str, params: HECOGridParams, n_games: int = 1):
        self.task: TaskName = check_task(task)
        params.check_fits(self.task)
        self.params = params
        self.n_games = whole_number("n_games", n_games, 1, 2**31 - 1)
        self._world = world_of(self.task, params)
        self._games = empty_games(self._world, self.n_games)
        self._seeded = np.zeros(self.n_games, dtype=bool)
        self._begun = False
        n, v, pixels = params.n_agents, params.view_size, params.view_pixels
        tiles = params.observation == "tiles"
        self._view_task = TILES if tiles else PICTURES
        self._view_shape = (n, v, v) if tiles else (n, pixels, pixels, 3)
        self._buffers = Buffers(
            actions=np.zeros(self.n_games * n, dtype=np.uint8),
            fresh=np.zeros(self.n_games, dtype=np.uint8),
            codes=np.zeros(self.n_games * n * v * v, dtype=np.uint8),
        )
        self._kernel = self._compiled_kernel()

    def _compiled_kernel(self) -> Callable[..., None]:
        # Circular import: the kernels contain the conditions of all tasks, and the tasks' games are made of batches.
        from hecogrid_envs.core.play import play

        arguments = (self._games, self._world, self._buffers, 0, _NO_VIEWS, _NO_VIEWS, 0, 0)
        # Said if it takes long, that is if numba's cache does not have the code.
        text = "hecogrid_envs: loading the kernels; once on this machine they are compiled, about 10 seconds"
        timer = Timer(_SECONDS_WITHOUT_A_WORD, partial(print, text, file=sys.stderr, flush=True))
        timer.start()
        try:
            # Compiled for these types and called directly: saves the type dispatch on some 40 arrays in each call.
            kernel: Callable[..., None] = play.compile(tuple(map(typeof, arguments)))
        finally:
            timer.cancel()
        return kernel

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in ("_world", "_kernel")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._world = world_of(self.task, self.params)
        self._kernel = self._compiled_kernel()

    def _play(
        self, task: int, views: U8 = _NO_VIEWS, last_views: U8 = _NO_VIEWS, first: int = 0, end: int | None = None
    ) -> None:
        """
        Do one task for games ``first`` to ``end - 1``, all by default; see :func:`hecogrid_envs.core.play.play`.

        :param views: (end - first, ...), or empty
        :param last_views: (end - first, ...), or empty
        """
        own, last, end = views.reshape(-1), last_views.reshape(-1), self.n_games if end is None else end
        self._kernel(self._games, self._world, self._buffers, task, own, last, first, end)

    def reset(self, which: npt.NDArray[np.bool_] | None = None, seeds: Sequence[int | None] | None = None) -> None:
        """
        Give games new levels.

        :param which: (E,) the games to reset; all by default
        :param seeds: (E,) a seed starts a game's randomness and history anew, None continues it
        """
        chosen = np.ones(self.n_games, dtype=bool) if which is None else np.asarray(which)
        if chosen.dtype != np.bool_ or chosen.shape != (self.n_games,):
            raise ValueError(f"which must be {self.n_games} booleans, one per game, got {which!r}")
        if seeds is not None and len(seeds) != self.n_games:
            raise ValueError(f"seeds must be {self.n_games}, one per game, got {len(seeds)}")
        for e in np.flatnonzero(chosen).tolist():
            self._seed(e, None if seeds is None else seeds[e])
        self._buffers.fresh[...] = chosen
        self._play(RESET)

    def _seed(self, game: int, seed: int | None) -> None:
        if seed is None and self._seeded[game]:
            return
        self._games.rng[game] = generator_word(secrets.randbits(63) if seed is None else seed)
        # Released rules keep directions from the last episode; a seed starts the history anew, facing east.
        self._games.direction[game] = 0
        self._seeded[game] = True

    def step(self, actions: npt.NDArray[np.integer[Any]]) -> None:
        """
        Play one game step in all games; games that are over continue until :meth:`reset`.

        :param actions: (E, N) integers from 0 to 6
        """
        self._accept(actions)
        self._play(STEP)

    def _step_checked(self, actions: npt.NDArray[np.uint8]) -> None:
        """As :meth:`step`, without checking the actions: a second check takes a tenth of a single game's step."""
        self._take(actions)
        self._play(STEP)

    def observe(self, out: U8 | None = None) -> U8:
        """
        Return the views of all agents.

        :param out: contiguous array to write to; a new one by default
        :return: (E, N, V, V) tile codes or (E, N, V t, V t, 3) pixels, as ``params.observation`` says
        """
        out = self._array_for_views("out", out)
        self._play(self._view_task, out)
        return out

    def advance(
        self, actions: npt.NDArray[np.integer[Any]], out: U8 | None = None, last: U8 | None = None
    ) -> tuple[U8, npt.NDArray[np.bool_]]:
        """
        Play one game step in all games, give games that are over a new level, and observe: :meth:`step`,
        ``reset(truncated)`` and :meth:`observe` in one compiled call.

        :attr:`rewards` are the rewards of the step, also for games that were reset.

        :param actions: (E, N) integers from 0 to 6
        :param out: contiguous array to write views to; a new one by default
        :param last: contiguous array of the same shape; the final views of games that are over are written to their
            rows, other rows are unchanged. By default final views are not computed
        :return: views as of :meth:`observe`, and (E,) whether the step was the last of an episode
        :raises ValueError: for invalid actions or arrays, or a game that has not begun
        """
        self._accept(actions)
        out = self._array_for_views("out", out)
        last_views = _NO_VIEWS if last is None else self._array_for_views("last", last)
        self._play(STEP | RESTART | self._view_task, out, last_views)
        return out, self._buffers.fresh.astype(bool)

    def _accept(self, actions: npt.NDArray[np.integer[Any]]) -> None:
        """Check and store the actions of a step."""
        actions = np.asarray(actions)
        shape = (self.n_games, self.params.n_agents)
        if actions.shape != shape:
            raise ValueError(f"actions must have shape {shape}, (games, agents), got {actions.shape}")
        if actions.dtype.kind not in "iu":
            raise ValueError(f"actions must be integers, got {actions.dtype}")
        # Negative numbers are large when read as unsigned.
        if actions.view(f"u{actions.itemsize}").max() >= N_ACTIONS:
            game, agent = np.argwhere((actions < 0) | (actions >= N_ACTIONS))[0].tolist()
            got = f"{actions[game, agent]} for agent {agent} of game {game}"
            raise ValueError(f"actions must be from 0 to {N_ACTIONS - 1}, got {got}")
        self._take(actions)

    def _take(self, actions: npt.NDArray[np.integer[Any]]) -> None:
        if not self._begun and not self._seeded.all():
            game = int(np.flatnonzero(~self._seeded)[0])
            raise ValueError(f"game {game} has not begun: call reset() before a step")
        self._begun = True
        self._buffers.actions[...] = actions.reshape(-1)

    def _array_for_views(self, name: str, given: U8 | None) -> U8:
        shape = (self.n_games, *self._view_shape)
        if given is None:
            return np.empty(shape, dtype=np.uint8)
        expected = f"{name} must be a contiguous and writeable uint8 array of shape {shape}"
        if not isinstance(given, np.ndarray):
            raise ValueError(f"{expected}, got {type(given).__name__}")
        contiguous, writeable = given.flags.c_contiguous, given.flags.writeable
        if given.shape != shape or given.dtype != np.uint8 or not contiguous or not writeable:
            raise ValueError(f"{expected}, got {given.dtype} {given.shape}, {contiguous=}, {writeable=}")
        return given

    def observe_game(self, game: int) -> U8:
        """
        Return the views of the agents of one game.

        :return: as :meth:`observe` without its first axis
        """
        return self._views_of_game(game, self._view_task, self._view_shape)

    def _views_of_game(self, game: int, task: int, shape: tuple[int, ...]) -> U8:
        game = whole_number("game", game, 0, self.n_games - 1)
        out = np.empty(shape, dtype=np.uint8)
        self._play(task, out, first=game, end=game + 1)
        return out

    @property
    def rewards(self) -> npt.NDArray[np.float64]:
        """(E,) reward of each agent of a game in the last step: treasures collected / N."""
        return self._games.collected_now / self.params.n_agents

    @property
    def truncated(self) -> npt.NDArray[np.bool_]:
        """(E,) whether the episode is over."""
        return self._games.steps >= self.params.max_cycles

    @property
    def steps(self) -> npt.NDArray[np.int32]:
        """(E,) game steps since the reset."""
        return self._games.steps

    @property
    def collected(self) -> npt.NDArray[np.int32]:
        """(E,) treasures collected since the reset: the team's return so far."""
        return self._games.collected

    @property
    def columns(self) -> npt.NDArray[np.int32]:
        """(E, N) the column x in which each agent stands."""
        return self._games.x

    @property
    def order(self) -> npt.NDArray[np.int32]:
        """(E, N) the order in which agents acted in the last step."""
        return self._games.order

    def get_state(self, game: int = 0) -> StateMapping:
        """Copy the state of one game (see :class:`~hecogrid_envs.state.StateMapping`)."""
        return state_of(self._games._asdict(), whole_number("game", game, 0, self.n_games - 1))

    def set_state(self, mapping: object, game: int = 0) -> None:
        """
        Start an episode of one game from a given state; agents in one cell arrived in index order.

        :param mapping: see :class:`~hecogrid_envs.state.StateMapping`
        :raises ValueError: naming the first fault of an inconsistent mapping
        """
        game = whole_number("game", game, 0, self.n_games - 1)
        state = check_state(mapping, self.params)
        games, width = self._games, self.params.grid_size
        self._seed(game, None)
        terrain = np.zeros((width, width), dtype=np.uint8)
        terrain[state["walls"]] = Terrain.WALL
        terrain[state["treasures"] == TreasureState.AVAILABLE] = Terrain.TREASURE
        terrain[state["treasures"] == TreasureState.COLLECTED] = Terrain.COLLECTED
        terrain[state["keys"]] = Terrain.KEY
        games.terrain[game] = terrain.T.reshape(-1)
        games.x[game], games.y[game] = state["agent_pos"].T
        games.direction[game] = state["agent_dir"]
        games.has_key[game] = state["agent_has_key"]
        self._play(BEGIN, first=game, end=game + 1)

    def snapshot(self) -> dict[str, npt.NDArray[Any]]:
        """
        Copy the complete state of the games, random generators included; see :meth:`restore`.

        :return: arrays by name, with games along the first axis; ``rank`` (E, N) counts the agents that arrived earlier
            in the same cell
        """
        before = self._games.before
        ranks, previous = np.zeros(before.shape, dtype=np.int32), before.astype(np.int64)
        while (there := previous >= 0).any():
            ranks += there
            earlier = np.take_along_axis(before, np.maximum(previous, 0), axis=1)
            previous = np.where(there, earlier, -1)
        stored = {name: getattr(self._games, name).copy() for name in _STORED}
        return {"seeded": self._seeded.copy(), **stored, "rank": ranks}

    def restore(self, snapshot: Mapping[str, npt.NDArray[Any]]) -> None:
        """
        Restore a snapshot of a batch with the same task, parameters and number of games.

        :param snapshot: result of :meth:`snapshot`; copied
        :raises ValueError: naming the first array with a wrong shape or dtype, or with values that are no indices of
            cells, directions, colours or agents; the games are then unchanged
        """
        check_snapshot(snapshot, self.snapshot(), self.params)
        games, begun = self._games, snapshot["seeded"]
        for name, empty in empty_games(self._world, self.n_games)._asdict().items():
            getattr(games, name)[...] = empty
        for name in _STORED:
            getattr(games, name)[begun] = snapshot[name][begun]
        cells = games.y * self.params.grid_size + games.x
        for game in np.flatnonzero(begun).tolist():
            for agent in np.argsort(snapshot["rank"][game], kind="stable").tolist():
                arrive(games, game, agent, int(cells[game, agent]))
        self._play(REDRAW)
        self._seeded[...] = begun
        self._begun = False  # looked up at the next step

    def fields_of_view(self, game: int = 0) -> npt.NDArray[np.bool_]:
        """
        Return which cells each agent sees.

        :return: (N, W, H)
        """
        state, side, width = self.get_state(game), self.params.view_size, self.params.grid_size
        n_agents, offset = self.params.n_agents, self.params.view_offset
        codes = self._views_of_game(game, TILES, (n_agents, side, side))
        agent, row, column = np.nonzero(codes != INVISIBLE)
        ahead, aside = (side - 1 - offset - row)[:, np.newaxis], (column - side // 2)[:, np.newaxis]
        facing = state["agent_dir"][agent]
        cells = state["agent_pos"][agent] + ahead * STEP_AHEAD[facing] + aside * STEP_AHEAD[(facing + 1) % 4]
        on_map = ((cells >= 0) & (cells < width)).all(axis=1)
        seen = np.zeros((n_agents, width, width), dtype=np.bool_)
        seen[agent[on_map], cells[on_map, 0], cells[on_map, 1]] = True
        return seen
