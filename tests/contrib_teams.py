"""Toy teams for MaskablePPO: some actions are masked."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from tests.toy_teams import ToyTeams

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
