"""Toy teams for the algorithms of sb3-contrib: some actions are masked, some rewards need memory."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from tests.toy_teams import VECTOR, ToyTeams

Array = npt.NDArray[Any]


def choices_of(action_space: spaces.Space[Any]) -> list[int]:
    """Choices of each action dimension, as masks count them."""
    if isinstance(action_space, spaces.Discrete):
        return [int(action_space.n)]
    if isinstance(action_space, spaces.MultiDiscrete):
        return [int(n) for n in action_space.nvec]
    assert isinstance(action_space, spaces.MultiBinary)
    return [2] * action_space.shape[0]


def random_masks(action_space: spaces.Space[Any], n_rows: int, rng: np.random.Generator) -> Array:
    """(B, M) bool, at least one choice allowed in each dimension."""
    masks = []
    for n_choices in choices_of(action_space):
        mask = rng.random((n_rows, n_choices)) < 0.5
        mask[np.arange(n_rows), rng.integers(n_choices, size=n_rows)] = True
        masks.append(mask)
    return np.concatenate(masks, axis=1)


def is_allowed(action_space: spaces.Space[Any], actions: Array, masks: Array) -> Array:
    """(B,) whether each row's action is allowed."""
    offsets = np.cumsum([0, *choices_of(action_space)[:-1]])
    columns = np.asarray(actions).reshape(len(masks), -1).astype(int) + offsets
    return np.asarray(np.take_along_axis(masks, columns, axis=1).all(axis=1))


class MaskedTeams(ToyTeams):
    """
    ToyTeams with new random masks at each step; counts the steps of rows and those with a forbidden action.

    :param action_space: Discrete, MultiDiscrete or MultiBinary
    :param kwargs: of ToyTeams
    """

    def __init__(self, action_space: spaces.Space[Any], **kwargs: Any):
        super().__init__(action_space=action_space, **kwargs)
        self.n_actions = self.n_forbidden = 0
        self._mask_rng = np.random.default_rng(1)

    def _observe(self) -> dict[str, Array]:
        self.masks = random_masks(self.action_space, self.num_envs, self._mask_rng)
        return super()._observe()

    def step_async(self, actions: Array) -> None:
        self.n_actions += len(actions)
        self.n_forbidden += int((~is_allowed(self.action_space, actions, self.masks)).sum())
        super().step_async(actions)

    def action_masks(self) -> Array:
        return self.masks

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        return list(getattr(self, method_name)(*args, **kwargs))


class CueTeams(ToyTeams):
    """
    Each agent sees a cue of -1 or 1 at the first of three steps, then only the time. Only the last step is rewarded.

    :param pays: ``"own"``: 1 for the action that matches the own cue (0 for -1, 1 for 1), else 0; ``"mate"``: the next
        agent's cue, regardless of the action
    :param n_agents: N
    :param n_games: E
    """

    def __init__(self, pays: Literal["own", "mate"], n_agents: int = 2, n_games: int = 16):
        self.pays = pays
        super().__init__(VECTOR, spaces.Discrete(2), n_agents, n_games, length=3)

    def _observe(self) -> dict[str, Array]:
        step = self._time % self.length
        if step == 0:
            self.cues = self._rng.choice([-1.0, 1.0], size=(self.n_games, self.n_agents)).astype(np.float32)
        views = np.zeros((self.n_games, self.n_agents, 5), np.float32)
        views[:, :, 0] = self.cues if step == 0 else 0.0
        views[:, :, 1 + step] = 1.0
        return {
            "obs": views.reshape(-1, 5),
            "team": np.repeat(views, self.n_agents, axis=0),
            "agent": np.tile(np.arange(self.n_agents), self.n_games),
        }

    def step_wait(self) -> VecEnvStepReturn:
        is_last = self._time % self.length == self.length - 1
        if self.pays == "own":
            paid = (self._actions[:, 0] == (self.cues.reshape(-1) + 1) / 2).astype(np.float32)
        else:
            paid = np.roll(self.cues, -1, axis=1).reshape(-1).astype(np.float32)
        self._time += 1
        done = self._time % self.length == 0
        obs = self._observe()
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if done:
            for row, info in enumerate(infos):
                info["terminal_observation"] = {key: value[row] for key, value in obs.items()}
        return obs, paid * is_last, np.full(self.num_envs, done), infos
