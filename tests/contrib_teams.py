"""Toy teams for MaskablePPO: some actions are masked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from tests.toy_envs import BOX, ZEROS, Game
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


class MaskedGame(Game):
    """
    Two agents; the test ends at an illegal action.

    :param where: of masks: a key of observations, "info:KEY", or "method"
    :param others: further entries of observations
    :param actions: action space
    :param mask: the mask, or a function of the step
    :param given: steps at which infos have the mask
    """

    render_mode = "rgb_array"

    def __init__(
        self,
        where: str,
        others: dict[str, Any] | None = None,
        actions: spaces.Space[Any] | None = None,
        mask: Any = (0, 1, 0),
        given: Callable[[int], bool] = lambda step: True,
    ) -> None:
        self.in_row = where != "method" and not where.startswith("info:")
        self.where, self.key = where, where.removeprefix("info:")
        self.others = {"observation": BOX} if others is None else others
        self.actions_space = spaces.Discrete(3) if actions is None else actions
        self.mask = mask if callable(mask) else lambda step: np.array(mask, np.int8)
        self.given = given
        if where == "method":
            self.action_masks = lambda: {agent: self.mask(self.t).astype(bool) for agent in self.agents}

    def action_space(self, agent: Any) -> spaces.Space[Any]:
        return self.actions_space

    def observation_space(self, agent: Any) -> spaces.Space[Any]:
        return spaces.Dict({**self.others, self.key: spaces.MultiBinary(len(self.mask(0)))}) if self.in_row else BOX

    def see(self, agent: Any) -> Any:
        own = {name: np.zeros(space.shape, space.dtype) for name, space in self.others.items()}
        return {**own, self.key: self.mask(self.t)} if self.in_row else ZEROS

    def info(self, agent: Any) -> dict[str, Any]:
        return {self.key: self.mask(self.t)} if self.where.startswith("info:") and self.given(self.t) else {}

    def step(self, actions: dict[str, Any]) -> Any:
        for action in actions.values() if self.given(self.t) else ():
            mask = self.mask(self.t)[np.newaxis] != 0
            assert is_allowed(self.actions_space, np.asarray(action)[np.newaxis], mask).all(), f"illegal: {action}"
        return super().step(actions)

    def render(self) -> Array:
        return np.zeros((4, 4, 3), np.uint8)
