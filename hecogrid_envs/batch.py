"""E games of one task, stepped and observed by one compiled call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from hecogrid_envs.arrays import SLACK, aligned, empty_games, rule_book
from hecogrid_envs.constants import Terrain, TreasureState
from hecogrid_envs.core.generation import begin
from hecogrid_envs.core.sharing import PICTURES, RESET, RESTART, STEP, TILES, Workspace
from hecogrid_envs.fields_of_view import seen_cells
from hecogrid_envs.params import MAX_CODED_TILE_SIZE, HECOGridParams, TaskName, check_task
from hecogrid_envs.seeding import fresh_seed, generator_word
from hecogrid_envs.snapshots import check_snapshot, load_snapshot, take_snapshot
from hecogrid_envs.state import StateMapping, check_state
from hecogrid_envs.threads import NOTHING, Shares
from hecogrid_envs.tiles import INVISIBLE, turned_atlases

U8 = npt.NDArray[np.uint8]


class GameBatch:
    """
    Games that share a task and parameters, but neither levels nor randomness.

    :param task: ``"TeamTogether"``, ``"TeamSupport"`` or ``"KeyForTreasure"``
    :param params: parameters of all games
    :param n_games: E
    :param n_threads: threads that share steps and views, the calling one included; results do not depend on it
    :raises ValueError: for an unknown task or objects that do not fit on the map
    """

    def __init__(self, task: str, params: HECOGridParams, n_games: int = 1, n_threads: int = 1):
        self.task: TaskName = check_task(task)
        params.check_fits(self.task)
        self.params = params
        self.n_games = _positive("n_games", n_games)
        self.n_threads = _positive("n_threads", n_threads)
        atlases = turned_atlases(self.task, params.rules, params.view_tile_size)
        self._book = rule_book(self.task, params)
        self._games = empty_games(self._book, self.n_games)
        self._seeded = np.zeros(self.n_games, dtype=bool)
        self._begun = False
        n, v, pixels = params.n_agents, params.view_size, params.view_pixels
        tiles = params.observation == "tiles"
        self._view_task = TILES if tiles else PICTURES
        self._view_shape = (n, v, v) if tiles else (n, pixels, pixels, 3)
        self._actions = aligned((self.n_games, n), np.uint8)
        self._fresh = aligned(self.n_games, np.bool_)
        self._codes = aligned((self.n_games, n, v, v), np.uint8)
        self._atlas = np.concatenate([atlases.reshape(-1), np.zeros(SLACK, dtype=np.uint8)])
        self._turn_bytes = 0 if params.view_tile_size <= MAX_CODED_TILE_SIZE else atlases[0].size
        self._shares = self._new_shares()

    def _new_shares(self) -> Shares:
        work = Workspace(
            actions=self._actions.reshape(-1),
            fresh=self._fresh.view(np.uint8),
            codes=self._codes.reshape(-1),
            facing=self._games.direction.reshape(-1),
            atlas=self._atlas,
            turn_bytes=self._turn_bytes,
            tile=self.params.view_tile_size,
        )
        return Shares(self._games, self._book, work, self.n_threads)

    def __getstate__(self) -> dict[str, Any]:
        # Threads and compiled code stay with the process; a copy makes its own.
        return {name: value for name, value in self.__dict__.items() if name != "_shares"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._shares = self._new_shares()

    def reset(self, which: npt.NDArray[np.bool_] | None = None, seeds: Sequence[int | None] | None = None) -> None:
        """
        Give games new levels.

        :param which: (E,) the games to reset; all by default
        :param seeds: (E,) a seed starts a game's randomness and history anew, None continues it
        """
        chosen = np.ones(self.n_games, dtype=bool) if which is None else np.asarray(which, dtype=bool)
        if chosen.shape != (self.n_games,):
            raise ValueError(f"which must have shape ({self.n_games},), one per game, got {chosen.shape}")
        for e in np.flatnonzero(chosen).tolist():
            self._seed(e, None if seeds is None else seeds[e])
        self._fresh[...] = chosen
        self._shares.play(RESET)

    def _seed(self, game: int, seed: int | None) -> None:
        if seed is None and self._seeded[game]:
            return
        self._games.rng[game] = generator_word(fresh_seed() if seed is None else seed)
        # Released rules keep directions from the last episode; a seed starts the history anew, facing east.
        self._games.direction[game] = 0
        self._seeded[game] = True

    def step(self, actions: npt.NDArray[np.integer[Any]]) -> None:
        """
        Play one game step everywhere; games that are over play on until :meth:`reset`.

        :param actions: (E, N) integers from 0 to 6
        """
        self._take(actions)
        self._shares.play(STEP)

    def observe(self, out: U8 | None = None) -> U8:
        """
        Views of all agents.

        :param out: contiguous array to write to; a new one by default
        :return: (E, N, V, V) tile codes or (E, N, V t, V t, 3) pixels, as ``params.observation`` says
        """
        out = self._array_for_views("out", out)
        self._shares.play(self._view_task, out.reshape(-1))
        return out

    def advance(
        self, actions: npt.NDArray[np.integer[Any]], out: U8 | None = None, last: U8 | None = None
    ) -> tuple[U8, npt.NDArray[np.bool_]]:
        """
        Play one game step everywhere, give games that are over a new level, and observe: :meth:`step`,
        ``reset(truncated)`` and :meth:`observe` in one compiled call, which threads share once.

        :attr:`rewards` are those of the step, also where a new episode has begun.

        :param actions: (E, N) integers from 0 to 6
        :param out: contiguous array to write views to; a new one by default
        :param last: contiguous array of the same shape, to which the last views of games that are over are written, at
            their place; the rest of it stays as it is. By default they are not made
        :return: views as of :meth:`observe`, and (E,) whether the step was the last of an episode
        :raises ValueError: for actions or arrays that do not fit, or a game that has not begun
        """
        self._take(actions)
        out = self._array_for_views("out", out)
        last_views = NOTHING if last is None else self._array_for_views("last", last).reshape(-1)
        self._shares.play(STEP | RESTART | self._view_task, out.reshape(-1), last_views)
        return out, self._fresh.copy()

    def _take(self, actions: npt.NDArray[np.integer[Any]]) -> None:
        """Check and keep the actions of a step."""
        actions = np.asarray(actions)
        if actions.shape != self._actions.shape:
            raise ValueError(f"actions must have shape {self._actions.shape}, (games, agents), got {actions.shape}")
        if not self._begun:
            self._check_begun()
        self._actions[...] = actions

    def _check_begun(self) -> None:
        if not self._seeded.all():
            game = int(np.flatnonzero(~self._seeded)[0])
            raise ValueError(f"game {game} has not begun: call reset() before a step")
        self._begun = True

    def _array_for_views(self, name: str, given: U8 | None) -> U8:
        shape = (self.n_games, *self._view_shape)
        if given is None:
            return np.empty(shape, dtype=np.uint8)
        if given.shape != shape or given.dtype != np.uint8 or not given.flags.c_contiguous:
            raise ValueError(
                f"{name} must be a contiguous uint8 array of shape {shape}, got {given.dtype} {given.shape}"
            )
        return given

    def observe_game(self, game: int) -> U8:
        """
        Views of the agents of one game.

        :return: as :meth:`observe` without its first axis
        """
        self._shares.play_game(TILES, game, self._codes.reshape(-1))
        if self._view_task == TILES:
            return self._codes[game].copy()
        out = np.empty(self._view_shape, dtype=np.uint8)
        self._shares.draw(self._codes[game].reshape(-1), self._games.direction[game], out.reshape(-1))
        return out

    @property
    def rewards(self) -> npt.NDArray[np.float64]:
        """(E,) what each agent of a game received in the last step: treasures collected / N."""
        return self._games.paid / self.params.n_agents

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
        games, width = self._games, self.params.grid_size
        terrain = games.terrain[game].reshape(width, width).T
        treasures = np.zeros((width, width), dtype=np.uint8)
        treasures[terrain == Terrain.TREASURE] = TreasureState.AVAILABLE
        treasures[terrain == Terrain.COLLECTED] = TreasureState.COLLECTED
        return StateMapping(
            walls=terrain == Terrain.WALL,
            treasures=treasures,
            keys=terrain == Terrain.KEY,
            agent_pos=np.stack([games.x[game], games.y[game]], axis=1).astype(np.int64),
            agent_dir=games.direction[game].astype(np.int64),
            agent_has_key=games.has_key[game].astype(bool),
        )

    def set_state(self, mapping: object, game: int = 0) -> None:
        """
        Start an episode of one game from a given state; agents in one cell arrived in index order.

        :param mapping: see :class:`~hecogrid_envs.state.StateMapping`
        :raises ValueError: naming the first fault of an inconsistent mapping
        """
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
        begin(games, self._book, game)

    def snapshot(self) -> dict[str, npt.NDArray[Any]]:
        """
        Copy all that the games' future depends on, random generators included; see :meth:`restore`.

        :return: arrays by name, with games along the first axis
        """
        return take_snapshot(self._games, self._seeded)

    def check_snapshot(self, snapshot: Mapping[str, npt.NDArray[Any]]) -> None:
        """
        Check that the games could be in a state.

        :param snapshot: what :meth:`snapshot` gave
        :raises ValueError: naming the first array that does not fit, or the first value that no game reaches
        """
        check_snapshot(snapshot, self._games, self._seeded, self.params)

    def restore(self, snapshot: Mapping[str, npt.NDArray[Any]]) -> None:
        """
        Go on from a snapshot of a batch with the same task, parameters and number of games.

        :param snapshot: what :meth:`snapshot` gave; copied
        :raises ValueError: see :meth:`check_snapshot`; nothing is changed then
        """
        self.check_snapshot(snapshot)
        load_snapshot(self._games, self._book, snapshot)
        self._seeded[...] = snapshot["seeded"]
        self._begun = False  # looked up at the next step

    def fields_of_view(self, game: int = 0) -> npt.NDArray[np.bool_]:
        """
        Which cells each agent sees.

        :return: (N, W, H)
        """
        self._shares.play_game(TILES, game, self._codes.reshape(-1))
        state = self.get_state(game)
        return seen_cells(
            self._codes[game] != INVISIBLE,
            state["agent_pos"],
            state["agent_dir"],
            self.params.view_offset,
            self.params.grid_size,
        )


def _positive(name: str, value: int) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{name} must be an integer of at least 1, got {value!r}")
    return int(value)
