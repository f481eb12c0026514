"""Batched games of an engine as a Stable-Baselines3 VecEnv with one row per agent."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_saf.checkpoints.checks import check_keys, check_like, check_list, check_whole
from sb3_saf.envs.space_reader import checked_actions
from sb3_saf.teams.checks import check_count
from sb3_saf.teams.rows import (
    ACTIVE_KEY,
    IS_SUCCESS,
    OBS_KEY,
    TERMINAL_OBSERVATION,
    TRUNCATED,
    Array,
    TeamSpaces,
    fill_idle_rows,
)
from sb3_saf.teams.vec_env import TeamVecEnv, chosen_indices


class BatchStep(NamedTuple):
    """
    Results of one step of E games; ended games have begun their next episode.

    :param rows: (B, ...) observations of the rows, entries of a Dict by key
    :param rewards: (E, N) rewards of the suite
    :param ended: (E,) bool
    :param truncated: (E,) bool, games ended by a time limit only
    :param last: (B, ...) the rows before new episodes began; used where ``ended``
    :param won: (E,) bool, None if the suite does not report wins
    """

    rows: dict[str, Array]
    rewards: Array
    ended: npt.NDArray[np.bool_]
    truncated: npt.NDArray[np.bool_]
    last: dict[str, Array]
    won: npt.NDArray[np.bool_] | None = None


class Batch(ABC):
    """
    Base of E games of N agents in one engine. Returned arrays are not modified later.

    :param n_games: E
    :param agents: N names
    :param rows: spaces of a row's observation
    :param action_space: action space of a row
    :param env: the suite's environment, for its attributes
    """

    def __init__(
        self, n_games: int, agents: Sequence[str], rows: TeamSpaces, action_space: spaces.Space[Any], env: Any
    ) -> None:
        self.n_games = n_games
        self.agents = list(agents)
        self.rows = rows
        self.action_space = action_space
        self.env = env

    @abstractmethod
    def reset(self, seeds: Sequence[int] | None) -> dict[str, Array]:
        """
        Begin an episode in every game.

        :param seeds: (E,) 32 bits each; None to continue the games' random streams
        :return: (B, ...) rows
        """

    @abstractmethod
    def step(self, actions: Array) -> BatchStep:
        """
        Step every game.

        :param actions: (E, N, ...) from the action space
        """

    @abstractmethod
    def picture(self, game: int) -> npt.NDArray[np.uint8]:
        """Return the suite's picture of a game, (height, width, 3)."""


class ResumableBatch(Batch):
    """Base of batches with snapshots."""

    @abstractmethod
    def snapshot(self) -> dict[str, Array]:
        """Return a copy of the complete state, random state included."""

    @abstractmethod
    def restore(self, state: Mapping[str, Array]) -> None:
        """Restore a snapshot of equal names, shapes and dtypes."""


class BatchVecEnv(TeamVecEnv):
    """
    VecEnv of a batch of games: row ``e * N + i`` is agent ``i`` of game ``e``.

    Observations of rows are Dicts, see :class:`sb3_saf.teams.rows.TeamSpaces`. Infos of done rows hold
    ``"terminal_observation"`` and ``"TimeLimit.truncated"``; that of agent 0 also ``"is_success"`` if the suite reports
    wins. All other infos are one empty dict.

    :param batch: the games
    :param seed: game ``e`` starts from ``game_seeds(seed, E)[e]``; None draws from the operating system
    :param render_mode: None or ``"rgb_array"``
    :raises ValueError: for any other render mode
    """

    def __init__(self, batch: Batch, seed: int | None = None, render_mode: str | None = None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be 'rgb_array' or None here, got {render_mode!r}")
        self.batch = batch
        self.possible_agents = list(batch.agents)
        self.render_mode = render_mode
        self.metadata = {"render_modes": ["rgb_array"]}
        self._actions: Array | None = None
        self._running = False
        n_games = check_count("n_envs", batch.n_games)
        super().__init__(n_games, len(batch.agents), batch.rows.to_row_space(), batch.action_space, seed)

    def reset(self) -> dict[str, Array]:
        """
        Begin an episode in every game.

        :return: (B, ...) rows
        :raises ValueError: for options, which these games do not support
        """
        if any(self._options):
            raise ValueError(f"expected no options for the reset of batched games, got {self._options[0]}")
        self._actions = None
        rows = _filled(self.batch.reset(self._next_seeds), self.n_agents)
        self._next_seeds = None
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._running = True
        return rows

    def step_async(self, actions: npt.ArrayLike) -> None:
        """
        Store the actions of the next step.

        :param actions: (B, ...) from the action space
        :raises ValueError: for a wrong shape, type or value, or a step without a reset
        """
        if not self._running:
            raise ValueError("the games have not begun: call reset() before step()")
        self._actions = checked_actions(self.action_space, self.possible_agents, self.num_envs, actions)

    def step_wait(self) -> VecEnvStepReturn:
        """
        Step all games.

        :return: observations (B, ...), rewards (B,) float32, dones (B,) bool, infos
        """
        if self._actions is None:
            raise RuntimeError("no step has been started: call step_async(actions) before step_wait()")
        actions = self._actions.reshape(self.n_games, self.n_agents, *self._actions.shape[1:])
        self._actions = None
        step = self.batch.step(actions)
        rewards = np.array(step.rewards, dtype=np.float32).reshape(self.num_envs)
        dones = step.ended.repeat(self.n_agents)
        return _filled(step.rows, self.n_agents), rewards, dones, self._infos(step, dones)

    def _infos(self, step: BatchStep, dones: npt.NDArray[np.bool_]) -> list[dict[str, Any]]:
        infos: list[dict[str, Any]] = [{}] * self.num_envs
        if not dones.any():
            return infos
        last = zip(*(part[dones] for part in step.last.values()), strict=True)
        for row in dones.nonzero()[0].tolist():
            game, agent = divmod(row, self.n_agents)
            info = {
                TRUNCATED: bool(step.truncated[game]),
                TERMINAL_OBSERVATION: dict(zip(step.last, next(last), strict=True)),
            }
            if step.won is not None and agent == 0:
                info[IS_SUCCESS] = bool(step.won[game])
            infos[row] = info
            self.reset_infos[row] = {}
        return infos

    def close(self) -> None:
        """Do nothing: engines hold memory only."""

    def get_images(self) -> Sequence[npt.NDArray[np.uint8] | None]:
        """Return one picture per row, None unless the render mode is ``"rgb_array"``; rows of a game share one."""
        games = range(self.n_games)
        return self.per_row(self.batch.picture(game) if self.render_mode == "rgb_array" else None for game in games)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the suite's environment, which all rows share."""
        value = self.render_mode if attr_name == "render_mode" else getattr(self.batch.env, attr_name)
        return [value for _ in chosen_indices(indices, self.num_envs)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Raise an error: all games share one engine with fixed parameters."""
        raise AttributeError(f"games of an engine have no attributes of their own, got {attr_name!r}; make new games")

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Raise an error: all games share one engine without objects for single games."""
        raise AttributeError(f"games of an engine have no methods of their own, got {method_name!r}")

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each row: none is wrapped in a Gymnasium wrapper."""
        return [False for _ in chosen_indices(indices, self.num_envs)]


def _filled(rows: dict[str, Array], n_agents: int) -> dict[str, Array]:
    """Fill the own observations of agents that take no part, see :func:`sb3_saf.teams.rows.fill_idle_rows`."""
    if ACTIVE_KEY not in rows or rows[ACTIVE_KEY].all():
        return rows
    own, active = np.array(rows[OBS_KEY]), rows[ACTIVE_KEY].reshape(-1, n_agents)
    by_game = own.reshape(-1, n_agents, *own.shape[1:])
    for game in np.flatnonzero((active == 0).any(axis=1)):
        fill_idle_rows(by_game[game], active[game])
    return {**rows, OBS_KEY: own}


class ResumableBatchVecEnv(BatchVecEnv):
    """
    VecEnv whose state is stored in checkpoints.

    :param batch: games with snapshots
    :param seed: see the base class
    :param render_mode: see the base class
    """

    batch: ResumableBatch

    def checkpoint_state(self) -> dict[str, Any]:
        """
        Return the complete state as plain data.

        :return: for :meth:`load_checkpoint_state` of an environment with the same arguments
        """
        return {
            "running": self._running,
            "next_seeds": self._next_seeds,
            "games": self.batch.snapshot() if self._running else {},
        }

    def check_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """
        Check that a state is valid for these games.

        :param state: result of :meth:`checkpoint_state`
        :raises ValueError: naming the first difference
        """
        check_keys(dict(state), ("running", "next_seeds", "games"), "the games")
        check_like(state["running"], False, "'running' of the games")
        if (seeds := state["next_seeds"]) is not None:
            check_list(seeds, "the seeds of the games", self.n_games)
            for seed in seeds:
                check_whole(seed, "a seed of the games", high=2**63 - 1)
        if state["running"]:
            check_like(state["games"], self._example(), "the games")

    def _example(self) -> dict[str, Array]:
        """Return a state of these games, which are reset first if they have not begun."""
        if not self._running:
            self.batch.reset([0] * self.n_games)
        return self.batch.snapshot()

    def load_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """
        Restore a state; the observations are those of that state.

        :param state: result of :meth:`checkpoint_state`
        :raises ValueError: see :meth:`check_checkpoint_state`
        """
        self.check_checkpoint_state(state)
        if state["running"]:
            self.batch.restore(state["games"])
        self._running = state["running"]
        self._next_seeds = None if state["next_seeds"] is None else list(state["next_seeds"])
