"""HECOGrid as a vector environment: one row per agent, game-major, then agent."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any, ClassVar, Literal, TypeVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from hecogrid_envs.batch import GameBatch, check_actions
from hecogrid_envs.constants import N_ACTIONS, RenderMode
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.state import state_option
from hecogrid_envs.tasks import TASKS
from hecogrid_envs.tiles import observation_space
from sb3_saf.teams.vec_env import TeamVecEnv, chosen_indices

Backend = Literal["native", "supersuit"]
U8 = npt.NDArray[np.uint8]
Value = TypeVar("Value")


class NativeVecEnv(TeamVecEnv):
    """
    Games driven by the batched core.

    Games reset by themselves at their time limit; the last observation is then in
    ``infos[row]["terminal_observation"]`` and ``infos[row]["TimeLimit.truncated"]`` is True.

    :param batch: the games
    :param seed: game ``e`` starts from ``game_seeds(seed, E)[e]``; None draws from the operating system
    :param render_mode: as in :func:`hecogrid_envs.parallel_env`
    :param stagger: whether episodes begun by :meth:`reset` end at different times: that of game ``e`` is shorter by
        ``e / E`` of its length, and its last info has ``"staggered"``
    """

    #: All agents of a team receive the same reward.
    shares_reward: ClassVar[bool] = True

    def __init__(
        self,
        batch: GameBatch,
        seed: int | None = None,
        render_mode: RenderMode | None = None,
        stagger: bool = False,
    ):
        self.batch = batch
        self.params = batch.params
        env_class = TASKS[batch.task]
        self.games: list[HECOGridEnv] = [env_class.of_batch(batch, e, render_mode) for e in range(batch.n_games)]
        #: Names of the agents of every game, in index order.
        self.possible_agents = list(self.games[0].possible_agents)
        self._stagger = stagger
        #: Games in an episode that is shorter than others, (E,).
        self._is_short = np.zeros(batch.n_games, dtype=bool)
        self._actions: U8 | None = None
        self._running = False
        own_space = observation_space(batch.task, batch.params)
        #: Final views of episodes, written by the batch, (E, N, *observation shape).
        self._last: U8 = np.empty((batch.n_games, batch.params.n_agents, *own_space.shape), dtype=np.uint8)
        super().__init__(batch.n_games, batch.params.n_agents, own_space, spaces.Discrete(N_ACTIONS), seed)

    def reset(self) -> U8:
        """Start new episodes in all games and return views, (B, *observation shape)."""
        options = enumerate(self._options[:: self.n_agents])
        states = {game: state_option(given, self.params) for game, given in options if given}
        self.batch.reset(seeds=self._next_seeds)
        if self._stagger:
            self.batch.steps[:] = np.arange(self.n_games) * self.params.max_cycles // self.n_games
            self._is_short = self.batch.steps > 0
        for game, state in states.items():
            if state is not None:
                self.batch.set_state(state, game)
        for env in self.games:
            env.agents = list(env.possible_agents)
        self._next_seeds = None
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._running = True
        return self._rows(self.batch.observe())

    def _rows(self, per_game: U8) -> U8:
        return per_game.reshape(self.num_envs, *per_game.shape[2:])

    def step_async(self, actions: npt.NDArray[np.integer[Any]]) -> None:
        """
        Store the actions of the next step.

        :param actions: (B,) integers from 0 to 6
        :raises ValueError: for a wrong shape, type or value, or a step without a reset
        """
        if not self._running:
            raise ValueError("the games have not begun: call reset() before step()")
        actions = np.asarray(actions)
        if actions.shape != (self.num_envs,):
            raise ValueError(
                f"actions must have shape ({self.num_envs},), one per agent of {self.n_games} games x {self.n_agents} "
                f"agents, got {actions.shape}"
            )
        check_actions(actions)
        self._actions = actions.astype(np.uint8)

    def step_wait(self) -> VecEnvStepReturn:
        """
        Play one game step.

        :return: observations (B, *observation shape), rewards (B,) float32, dones (B,) bool, infos
        """
        if self._actions is None:
            raise RuntimeError("no step has been started: call step_async(actions) before step_wait()")
        actions = self._actions.reshape(self.n_games, self.n_agents)
        self._actions = None
        views, over = self.batch.advance(actions, last=self._last)
        rewards = np.repeat(self.batch.rewards.astype(np.float32), self.n_agents)
        dones = np.repeat(over, self.n_agents)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        last = self._rows(self._last)
        for row in np.flatnonzero(dones):
            infos[row] = {"TimeLimit.truncated": True, "terminal_observation": last[row].copy()}
            if self._is_short[row // self.n_agents]:
                infos[row]["staggered"] = True
            self.reset_infos[row] = {}
        self._is_short &= ~over
        return self._rows(views), rewards, dones, infos

    def checkpoint_state(self) -> dict[str, Any]:
        """Return the complete state as plain data."""
        return {
            "task": self.batch.task,
            "params": asdict(self.params),
            "n_games": self.n_games,
            "running": self._running,
            "seeds": self.per_row(self._next_seeds or [None] * self.n_games),
            "games": self.batch.snapshot(),
        }

    def check_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Check that a checkpoint is a valid state of these games."""
        own = self.checkpoint_state()
        if different := sorted(own.keys() ^ state.keys()):
            raise ValueError(f"expected the state of games with {', '.join(own)}, they differ in {different[0]!r}")
        for name in ("task", "n_games"):
            if own[name] != state[name]:
                raise ValueError(f"expected games with {name}={own[name]!r}, got a state with {name}={state[name]!r}")
        params = state["params"] if isinstance(state["params"], Mapping) else {}
        for name, value in own["params"].items():
            if params.get(name) != value:
                raise ValueError(f"expected games with {name}={value!r}, got a state with {name}={params.get(name)!r}")
        if not isinstance(state["running"], bool) or not isinstance(state["games"], Mapping):
            raise ValueError("expected the state of games with 'running' true or false and arrays in 'games'")
        _check_seeds(state["seeds"], self.n_games, self.n_agents)
        self.batch.check_snapshot(state["games"])
        if state["running"] and not state["games"]["seeded"].all():
            raise ValueError("expected running games to have begun, got a state in which one has not")

    def load_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of :meth:`checkpoint_state`; the observations are those of that state."""
        self.check_checkpoint_state(state)
        self.batch.restore(state["games"])
        self._running = state["running"]
        seeds = state["seeds"][:: self.n_agents]
        self._next_seeds = None if None in seeds else seeds
        for env in self.games:
            env.agents = list(env.possible_agents) if self._running else []

    def close(self) -> None:
        """Close the windows, if any."""
        for env in self.games:
            env.close()

    def _games_of(self, indices: VecEnvIndices) -> list[HECOGridEnv]:
        return [self.games[row // self.n_agents] for row in chosen_indices(indices, self.num_envs)]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each row's game."""
        return [getattr(env, attr_name) for env in self._games_of(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of each row's game."""
        for env in self._games_of(indices):
            setattr(env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of each row's game, once per row; :meth:`game_method` calls it once per game."""
        return [getattr(env, method_name)(*method_args, **kwargs) for env in self._games_of(indices)]

    def game_method(
        self, method_name: str, *args: Any, games: int | Iterable[int] | None = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method once per game (see the base class)."""
        chosen = chosen_indices(games, self.n_games, "game")
        return [getattr(self.games[game], method_name)(*args, **kwargs) for game in chosen]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each row: none is wrapped in a Gymnasium wrapper."""
        return [False for _ in chosen_indices(indices, self.num_envs)]


def _check_seeds(seeds: Any, n_games: int, n_agents: int) -> None:
    """Check the seeds of the next reset, one for each row."""
    is_seed = [seed is None or (isinstance(seed, int) and 0 <= seed < 2**128) for seed in seeds] if seeds else []
    if not isinstance(seeds, list) or len(seeds) != n_games * n_agents or not all(is_seed):
        raise ValueError(
            f"expected {n_games * n_agents} seeds of at least 0 or None, one for each row, got {seeds!r:.80}"
        )
