"""Batched games of an engine as a Stable-Baselines3 VecEnv with one row per agent."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_saf.envs.audit import settings_of
from sb3_saf.teams.checks import check_form
from sb3_saf.teams.rows import (
    ACTIVE_KEY,
    IS_SUCCESS,
    OBS_KEY,
    STAGGERED,
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

    :param env: the suite's environment, for attributes that all games share
    :param objects: E objects of the single games, for their attributes and methods; empty if the engine has none
    :param shares_reward: whether all agents of a team receive the same reward
    """

    def __init__(
        self,
        n_games: int,
        agents: Sequence[str],
        rows: TeamSpaces,
        action_space: spaces.Space[Any],
        env: Any = None,
        objects: Sequence[Any] = (),
        shares_reward: bool = False,
    ) -> None:
        self.n_games = n_games
        self.agents = list(agents)
        self.rows = rows
        self.action_space = action_space
        self.env = env
        self.objects = objects
        self.shares_reward = shares_reward
        #: What the games are, as plain data: only games with the same take a snapshot.
        self.settings: dict[str, Any] = {} if env is None else settings_of(env)

    def take_options(self, options: Sequence[Mapping[str, Any]]) -> None:
        """
        Take the options of the next reset.

        :param options: (E,) for each game, not all of them empty
        :raises ValueError: if the games take none, or invalid ones
        """
        raise ValueError(f"expected no options for the reset of these games, got {options[0]}")

    def shorten(self) -> npt.NDArray[np.bool_]:
        """
        Cut the episodes that have just begun: that of game ``e`` ends ``e / E`` of its length early.

        :return: (E,) which games will end early
        :raises ValueError: if episodes have no time limit that the engine could move
        """
        raise ValueError("stagger=True needs games with a time limit, which these games have not; leave it out")

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

    def picture(self, game: int) -> npt.NDArray[np.uint8]:
        """Return the suite's picture of a game, (height, width, 3); not called of games with objects, which draw it."""
        raise NotImplementedError


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
    VecEnv of a batch of games: row ``e * N + i`` is agent ``i`` of game ``e``; see :mod:`sb3_saf.suites`.

    :param seed: game ``e`` starts from ``game_seeds(seed, E)[e]``; None draws from the operating system
    :param render_mode: None or ``"rgb_array"``; games with objects of their own take all that these know
    :param stagger: whether episodes begun by :meth:`reset` end at different times: that of game ``e`` is shorter by
        ``e / E`` of its length, and its last infos have ``"staggered"``. The first observation of a game that shows the
        time that is left is still that of a whole episode
    :raises ValueError: for any other render mode
    """

    def __init__(
        self, batch: Batch, seed: int | None = None, render_mode: str | None = None, stagger: bool = False
    ) -> None:
        if render_mode not in (None, "rgb_array") and not batch.objects:
            raise ValueError(f"render_mode must be 'rgb_array' or None here, got {render_mode!r}")
        self.batch = batch
        self.possible_agents = list(batch.agents)
        self.shares_reward = batch.shares_reward
        self.render_mode = render_mode
        self._stagger = stagger
        #: Games in an episode that is shorter than others, (E,).
        self._is_short = np.zeros(batch.n_games, dtype=np.bool_)
        super().__init__(batch.n_games, len(batch.agents), batch.rows.to_row_space(), batch.action_space, seed)

    def settings(self) -> dict[str, Any]:
        """Return what the games are, and whether first episodes are shortened (see the base class)."""
        return {"stagger": self._stagger, **self.batch.settings}

    def reset(self) -> VecEnvObs:
        """Begin an episode in every game and return the rows; ValueError for options that the games do not take."""
        options = self._options[:: self.n_agents]
        if any(options):
            self.batch.take_options(options)
        self._actions = None
        rows = _filled(self.batch.reset(self._next_seeds), self.n_agents)
        if self._stagger:
            self._is_short = self.batch.shorten()
        self._next_seeds = None
        self._reset_options()
        self._begun = True
        return self._observations(rows)

    def _observations(self, rows: dict[str, Array]) -> VecEnvObs:
        return rows if self.batch.rows.is_dict else rows[OBS_KEY]

    def step_wait(self) -> VecEnvStepReturn:
        """Step all games; return observations, rewards (float32), dones (bool) and infos of the B rows."""
        actions = self.actions_of_step()
        step = self.batch.step(actions.reshape(self.n_games, self.n_agents, *actions.shape[1:]))
        rewards = np.array(step.rewards, dtype=np.float32).reshape(self.num_envs)
        dones = step.ended.repeat(self.n_agents)
        infos = self._infos(step, dones)
        self._is_short &= ~step.ended
        return self._observations(_filled(step.rows, self.n_agents)), rewards, dones, infos

    def _infos(self, step: BatchStep, dones: npt.NDArray[np.bool_]) -> list[dict[str, Any]]:
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if not dones.any():
            return infos
        last = zip(*(part[dones] for part in step.last.values()), strict=True)
        for game in step.ended.nonzero()[0].tolist():
            of_game = {TRUNCATED: bool(step.truncated[game])}
            if self._is_short[game]:
                of_game[STAGGERED] = True
            for row in range(game * self.n_agents, (game + 1) * self.n_agents):
                observation = dict(zip(step.last, next(last), strict=True))
                infos[row] = {**of_game, TERMINAL_OBSERVATION: self._observations(observation)}
            if step.won is not None:
                infos[game * self.n_agents][IS_SUCCESS] = bool(step.won[game])
        return infos

    def close(self) -> None:
        """Close the windows of games, if there are any; engines hold memory only."""
        for game in self.batch.objects:
            game.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each row's game, or of the environment that all games share."""
        if self.batch.objects:
            return [getattr(game, attr_name) for game in self._games_of(indices)]
        value = self.render_mode if attr_name == "render_mode" else getattr(self.batch.env, attr_name)
        return [value for _ in chosen_indices(indices, self.num_envs)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of each row's game."""
        for game in self._games_of(indices):
            setattr(game, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method of each row's game, once per row; :meth:`game_method` calls it once per game."""
        games = [row // self.n_agents for row in chosen_indices(indices, self.num_envs)]
        return self.game_method(method_name, *args, games=games, **kwargs)

    def game_method(
        self, method_name: str, *args: Any, games: int | Iterable[int] | None = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method once per game (see the base class); without objects of games there is ``render`` only."""
        chosen = chosen_indices(games, self.n_games, "game")
        if method_name == "render" and not self.batch.objects:
            return [self.batch.picture(game) for game in chosen]
        selected = self._games_of([game * self.n_agents for game in chosen])
        return [getattr(game, method_name)(*args, **kwargs) for game in selected]

    def _games_of(self, indices: VecEnvIndices) -> list[Any]:
        """Return the object of each row's game; AttributeError, as SB3 expects, if the engine has none."""
        if not self.batch.objects:
            raise AttributeError("these games share one engine and have no attributes or methods of their own")
        return [self.batch.objects[row // self.n_agents] for row in chosen_indices(indices, self.num_envs)]

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
    """VecEnv whose state is stored in checkpoints."""

    batch: ResumableBatch

    def checkpoint_state(self) -> dict[str, Any]:
        """Return the complete state, plain data for an environment with the same arguments."""
        return {
            "running": self._begun,
            "next_seeds": self._next_seeds,
            "is_short": self._is_short.copy(),
            "games": self.batch.snapshot() if self._begun else {},
        }

    def load_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state; the ValueError for that of other games names the first difference."""
        if state["running"]:
            if not self._begun:
                self.batch.reset([0] * self.n_games)
            check_form("the games", state["games"], self.batch.snapshot())
            self.batch.restore(state["games"])
        self._begun = state["running"]
        self._is_short = np.array(state["is_short"])
        self._next_seeds = None if state["next_seeds"] is None else list(state["next_seeds"])
