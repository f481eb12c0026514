"""Small teams for tests of policies: spaces, rows, and a vector environment with joint observations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_saf.teams.rows import TeamSpaces
from tests.team_venv import PlainVenv

VECTOR = spaces.Box(-1.0, 1.0, (5,), np.float32)
PICTURE = spaces.Box(0, 255, (3, 12, 12), np.uint8)


class CodeSpace(spaces.Box):
    """Views as tile codes, 4 pixels per tile."""

    def __init__(self, shape: tuple[int, ...] = (3, 3), n_codes: int = 20) -> None:
        super().__init__(0, n_codes - 1, shape, np.uint8)
        self.atlas = np.random.default_rng(0).integers(0, 256, (n_codes, 4, 4, 3), dtype=np.uint8)


def samples(space: spaces.Space[Any], count: int, seed: int = 0) -> npt.NDArray[Any]:
    """Return random own observations (count, *shape)."""
    space.seed(seed)
    return np.stack([np.asarray(space.sample()) for _ in range(count)])


def team_rows(
    own: spaces.Space[Any], n_agents: int = 3, n_games: int = 4, n_views: int = 5, seed: int = 0
) -> dict[str, th.Tensor]:
    """Return rows of whole teams with few distinct views, so that many repeat."""
    rng = np.random.default_rng(seed)
    views = samples(own, n_views, seed)[rng.integers(n_views, size=(n_games, n_agents))]
    return {
        "obs": th.as_tensor(views.reshape(-1, *views.shape[2:])),
        "team": th.as_tensor(np.repeat(views, n_agents, axis=0)),
        "agent": th.arange(n_agents).repeat(n_games),
    }


def gather_rows(obs: PyTorchObs, rows: Sequence[int] | th.Tensor) -> dict[str, th.Tensor]:
    """Some rows of a batch."""
    assert isinstance(obs, dict)
    return {key: value[rows] for key, value in obs.items()}


def to_numpy(obs: dict[str, th.Tensor]) -> dict[str, np.ndarray]:
    """Return rows as an environment does."""
    return {key: value.numpy() for key, value in obs.items()}


class ToyTeams(PlainVenv):
    """
    Games of ``length`` steps with random views; rewards depend on the first number of an agent's view and its action.

    :param own: space of own observations
    :param action_space: action space
    :param n_agents: N
    :param n_games: E
    :param n_views: unique own observations that occur
    :param length: steps per episode
    """

    def __init__(
        self,
        own: spaces.Space[Any] = VECTOR,
        action_space: spaces.Space[Any] | None = None,
        n_agents: int = 3,
        n_games: int = 4,
        n_views: int = 20,
        length: int = 5,
    ):
        self.n_agents, self.n_games, self.length = n_agents, n_games, length
        self._views = samples(own, n_views)
        self._rng = np.random.default_rng(0)
        self._time = 0
        action_space = spaces.Discrete(3) if action_space is None else action_space
        super().__init__(n_agents * n_games, TeamSpaces(own, n_agents).to_dict_space(), action_space)

    def _observe(self) -> dict[str, np.ndarray]:
        drawn = self._rng.integers(len(self._views), size=(self.n_games, self.n_agents))
        views = self._views[drawn]
        self._first = views.reshape(self.num_envs, -1)[:, 0].astype(np.float64)
        return {
            "obs": views.reshape(-1, *views.shape[2:]),
            "team": np.repeat(views, self.n_agents, axis=0),
            "agent": np.tile(np.arange(self.n_agents), self.n_games),
        }

    def reset(self) -> VecEnvObs:
        self._rng = np.random.default_rng(self._seeds[0])
        self._time = 0
        return self._observe()

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = np.asarray(actions, dtype=np.float64).reshape(self.num_envs, -1)

    def step_wait(self) -> VecEnvStepReturn:
        rewards = (self._first * self._actions[:, 0] - 0.1 * self._actions.sum(axis=1)).astype(np.float32)
        self._time += 1
        done = self._time % self.length == 0
        obs = self._observe()
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if done:
            for row, info in enumerate(infos):
                info["terminal_observation"] = {key: value[row] for key, value in obs.items()}
                info["TimeLimit.truncated"] = True
        return obs, rewards, np.full(self.num_envs, done), infos
