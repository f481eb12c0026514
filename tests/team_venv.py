"""A vector environment of teams with known numbers, which gives no guarantees beyond the required ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

Array = npt.NDArray[Any]
#: Own observation that agent i of game e sees at step t of episode k: (e, i, k, t) -> observation.
See = Callable[[int, int, int, int], Any]
#: Reward of agent i of game e for step t (from 1) of its episode.
Reward = Callable[[int, int, int], float]

VECTOR = spaces.Box(-np.inf, np.inf, (4,), np.float32)


def see_where(game: int, agent: int, episode: int, step: int) -> Array:
    return np.array([game, agent, episode, step], dtype=np.float32)


def reward_by_place(game: int, agent: int, step: int) -> float:
    return 100.0 * game + 10.0 * agent + step


class PlainVenv(VecEnv):
    """A vector environment whose attributes and methods are its own, for every row."""

    render_mode = None

    def close(self) -> None:
        self.closed = True

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        return [getattr(self, method_name)(*args, **kwargs) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


class TeamVenv(PlainVenv):
    """
    Flattened teams with known numbers.

    All arrays are reused: each step overwrites those of the previous one. Dones are uint8, like SuperSuit's.

    :param lengths: (E,) game steps per episode of each game
    :param n_agents: N
    :param truncate: whether episodes end by a time limit
    :param tell_size: whether there are attributes ``n_agents`` and ``n_games``
    """

    def __init__(
        self,
        lengths: Sequence[int] = (3, 2),
        n_agents: int = 3,
        own_space: spaces.Space[Any] = VECTOR,
        see: See = see_where,
        reward: Reward = reward_by_place,
        action_space: spaces.Space[Any] | None = None,
        truncate: bool = True,
        tell_size: bool = True,
    ) -> None:
        self.size = n_agents
        if tell_size:
            self.n_agents, self.n_games = n_agents, len(lengths)
        super().__init__(len(lengths) * n_agents, own_space, action_space or spaces.Discrete(5))
        self.lengths = np.array(lengths)
        self.see, self.reward, self.truncate = see, reward, truncate
        self.steps = np.zeros(len(lengths), dtype=int)
        self.episodes = np.zeros(len(lengths), dtype=int)
        self.actions: list[Array] = []
        self.n_resets = 0
        self.obs = np.zeros((self.num_envs, *(own_space.shape or ())), dtype=own_space.dtype)
        self.rewards = np.zeros(self.num_envs, dtype=np.float32)
        self.dones = np.zeros(self.num_envs, dtype=np.uint8)

    def _look(self, game: int, agent: int) -> Any:
        return self.see(game, agent, int(self.episodes[game]), int(self.steps[game]))

    def _places(self) -> list[tuple[int, int, int]]:
        return [(row, *divmod(row, self.size)) for row in range(self.num_envs)]

    def _observe(self) -> Array:
        for row, game, agent in self._places():
            self.obs[row] = self._look(game, agent)
        return self.obs

    def reset(self) -> Array:
        self.n_resets += 1
        self.steps[:] = 0
        self.episodes[:] = 0
        return self._observe()

    def step_async(self, actions: Array) -> None:
        self.actions.append(np.array(actions))

    def step_wait(self) -> VecEnvStepReturn:
        self.steps += 1
        ended = self.steps == self.lengths
        self.infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row, game, agent in self._places():
            self.rewards[row] = self.reward(game, agent, int(self.steps[game]))
            self.dones[row] = ended[game]
            if ended[game]:
                self.infos[row] = {
                    "terminal_observation": self._look(game, agent),
                    "TimeLimit.truncated": self.truncate,
                    "is_success": bool(self.episodes[game] % 2),
                    "episode_number": int(self.episodes[game]),
                }
        self.episodes[ended] += 1
        self.steps[ended] = 0
        return self._observe(), self.rewards, self.dones, self.infos

    def checkpoint_state(self) -> dict[str, Any]:
        return {"steps": self.steps.copy(), "episodes": self.episodes.copy()}

    def load_checkpoint_state(self, state: dict[str, Any]) -> None:
        self.steps, self.episodes = state["steps"], state["episodes"]


def still(venv: VecEnv) -> Array:
    """Actions of agents that do nothing."""
    return np.zeros(venv.num_envs, dtype=np.int64)


class DoublingWrapper(VecEnvWrapper):
    """Doubles rewards."""

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, rewards * 2, dones, infos
