"""Games of HECOGrid, batched in compiled code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from hecogrid_envs import TASKS, GameBatch, HECOGridParams
from hecogrid_envs.constants import N_ACTIONS, RenderMode
from hecogrid_envs.state import StateMapping, state_option
from hecogrid_envs.tiles import observation_space
from sb3_saf.suites.engines.batch import BatchStep, ResumableBatch, ResumableBatchVecEnv
from sb3_saf.teams.rows import OBS_KEY, Array, TeamSpaces


class HECOGridGames(ResumableBatch):
    """E games of a task."""

    def __init__(self, batch: GameBatch, render_mode: RenderMode | None = None) -> None:
        games = [TASKS[batch.task].of_batch(batch, game, render_mode) for game in range(batch.n_games)]
        own, n_agents = observation_space(batch.task, batch.params), batch.params.n_agents
        rows = TeamSpaces(own, n_agents)
        actions = spaces.Discrete(N_ACTIONS)
        super().__init__(batch.n_games, games[0].possible_agents, rows, actions, objects=games, shares_reward=True)
        self.settings = {"task": batch.task, **asdict(batch.params)}
        self._batch = batch
        self._states: dict[int, StateMapping] = {}
        #: Last views of episodes, written by the batch, (E, N, ...).
        self._last = np.empty((batch.n_games, n_agents, *own.shape), dtype=np.uint8)

    def take_options(self, options: Sequence[Mapping[str, Any]]) -> None:
        """Begin the next episode of a game from ``options[game]["state"]``, if there is one (see the base class)."""
        states = {game: state_option(given, self._batch.params) for game, given in enumerate(options)}
        self._states = {game: state for game, state in states.items() if state is not None}

    def reset(self, seeds: Sequence[int] | None) -> dict[str, Array]:
        """Begin an episode in every game (see the base class)."""
        self._batch.reset(seeds=seeds)
        for game, state in self._states.items():
            self._batch.set_state(state, game)
        self._states = {}
        self._begin()
        return self._rows(self._batch.observe())

    def _begin(self) -> None:
        for game in self.objects:
            game.agents = list(game.possible_agents)

    def shorten(self) -> npt.NDArray[np.bool_]:
        """Shorten the episodes that have just begun (see the base class)."""
        self._batch.steps[:] = np.arange(self.n_games) * self._batch.params.max_cycles // self.n_games
        return self._batch.steps > 0

    def step(self, actions: Array) -> BatchStep:
        """Step every game (see the base class)."""
        views, ended = self._batch.advance(actions, last=self._last)
        rewards = np.broadcast_to(self._batch.rewards[:, np.newaxis], actions.shape)
        return BatchStep(self._rows(views), rewards, ended, ended, self._rows(self._last))

    def _rows(self, views: Array) -> dict[str, Array]:
        return {OBS_KEY: views.reshape(-1, *views.shape[2:])}

    def snapshot(self) -> dict[str, Array]:
        """Return a copy of the state of all games (see the base class)."""
        return self._batch.snapshot()

    def restore(self, state: Mapping[str, Array]) -> None:
        """Restore a snapshot (see the base class)."""
        self._batch.restore(state)
        self._begin()


def vec_env(
    task: str,
    n_envs: int,
    seed: int | None,
    *,
    state: bool = False,
    render_mode: RenderMode | None = None,
    stagger: bool = False,
    **params: Any,
) -> ResumableBatchVecEnv:
    """
    Make games of a task.

    :param task: a name of ``hecogrid_envs.TASK_NAMES``
    :param state: must be False: the engine gives views only
    :param params: fields of :class:`hecogrid_envs.HECOGridParams`
    :raises ValueError: for an unknown parameter or a value out of range, or if a state is requested
    """
    if state:
        raise ValueError(f"state=True needs backend='supersuit' for {task}: its engine gives views only")
    batch = GameBatch(task, HECOGridParams.from_kwargs(params), n_envs)
    return ResumableBatchVecEnv(HECOGridGames(batch, render_mode), seed, render_mode, stagger)
