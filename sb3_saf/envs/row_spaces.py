"""Parts of the rows of a vector environment of flattened teams, before ``CentralizedValueWrapper`` joins teams."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first

from sb3_saf.envs.teams import (
    ACTION_MASK_KEY,
    ACTIVE_KEY,
    ALL_KEYS,
    OBS_KEY,
    OPTIONAL_KEYS,
    STATE_KEY,
    TEAM_KEYS,
    check_masks,
)

_ROW_KEYS: Final = (OBS_KEY, *OPTIONAL_KEYS)


class RowSpaces(NamedTuple):
    """
    The parts of a row's observation.

    Rows of a VecEnv of flattened teams are own observations, or Dicts with the key ``"obs"`` and any of

    - ``"active"``, Discrete(2): 1 while the row's agent takes part;
    - ``"action_mask"``, MultiBinary(A): 1 for legal actions, where actions are Discrete(A);
    - ``"state"``: the state of the row's game, equal in all its rows.

    :param own: space of the row's own observation
    :param active: whether rows have ``"active"``
    :param n_masked_actions: A if rows have masks, else None
    :param state: space of the game's state if rows have it
    :param is_dict: whether rows are Dicts
    """

    own: spaces.Space[Any]
    active: bool = False
    n_masked_actions: int | None = None
    state: spaces.Space[Any] | None = None
    is_dict: bool = False

    @classmethod
    def of(cls, space: spaces.Space[Any], action_space: spaces.Space[Any]) -> RowSpaces:
        """
        Split the observation space of rows into its parts.

        :param space: observation space of the VecEnv
        :param action_space: its action space
        :raises ValueError: if the space has rows of teams already, or an optional key has another form
        """
        if not isinstance(space, spaces.Dict):
            return cls(space)
        keys = set(space.spaces)
        if set(TEAM_KEYS) <= keys <= ALL_KEYS:
            raise ValueError(
                "expected a VecEnv of own observations, got one that already has the Dict observation of "
                "CentralizedValueWrapper; wrap it once (sb3_saf.make_team_env has done so)"
            )
        if OBS_KEY not in keys or not keys <= set(_ROW_KEYS):
            return cls(space)  # an own observation of an unknown form, which TeamSpaces refuses
        active, action_mask, state = (space.spaces.get(key) for key in OPTIONAL_KEYS)
        if active is not None and active != spaces.Discrete(2):
            raise ValueError(f"expected {ACTIVE_KEY!r} of a row to be Discrete(2), got {active}")
        check_masks(action_mask, action_space)
        n_masked = None if action_mask is None else int((action_mask.shape or ())[0])
        return cls(space.spaces[OBS_KEY], active is not None, n_masked, state, is_dict=True)

    def to_space(self) -> spaces.Space[Any]:
        """Return the observation space of a row."""
        if not self.is_dict:
            return self.own
        row: dict[str, spaces.Space[Any]] = {OBS_KEY: self.own}
        if self.active:
            row[ACTIVE_KEY] = spaces.Discrete(2)
        if self.n_masked_actions is not None:
            row[ACTION_MASK_KEY] = spaces.MultiBinary(self.n_masked_actions)
        if self.state is not None:
            row[STATE_KEY] = self.state
        return spaces.Dict(row)

    def entries(self, obs: Any, what: str) -> Mapping[str, Any]:
        """
        Return the parts of rows.

        :param obs: own observations, or Dicts where the space is a Dict
        :param what: name of the rows, for the message
        :raises ValueError: if keys are missing
        """
        if not self.is_dict:
            return {OBS_KEY: obs}
        keys = self._keys
        if not isinstance(obs, Mapping) or any(key not in obs for key in keys):
            got = sorted(obs) if isinstance(obs, Mapping) else type(obs).__name__
            raise ValueError(f"expected {what} to be a dict with the keys {keys}, got {got}")
        return {key: obs[key] for key in keys}

    @property
    def _keys(self) -> list[str]:
        told = (True, self.active, self.n_masked_actions is not None, self.state is not None)
        return [key for key, is_told in zip(_ROW_KEYS, told, strict=True) if is_told]


def channels_first(space: spaces.Space[Any]) -> spaces.Space[Any]:
    """
    Return a space with channels first for channel-last images, else the same object.

    :param space: of own observations or states; with an attribute ``atlas`` it holds codes, not pixels
    """
    if hasattr(space, "atlas") or not isinstance(space, spaces.Box) or not is_image_space(space):
        return space
    if is_image_space_channels_first(space):
        return space
    height, width, channels = space.shape
    return spaces.Box(0, 255, (channels, height, width), np.uint8)
