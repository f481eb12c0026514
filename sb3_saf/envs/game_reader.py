"""How a PettingZoo game is read: its observations, action masks and state as the parts of rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_saf.envs.audit import (
    Trial,
    agents_of,
    mask_key_of,
    mask_of,
    observation_of,
    own_part,
    space_of,
    without_mask,
)
from sb3_saf.envs.gymnasium_team import INFO_MASKS
from sb3_saf.envs.space_reader import FlatReader, SpaceReader, can_be_flattened, counted_from_zero
from sb3_saf.teams.conversion import conversions_of
from sb3_saf.teams.rows import ACTION_MASK_KEY, ACTIVE_KEY, FIXED_SHAPE, STATE_KEY, TeamSpaces, n_mask_entries

AnyParallelEnv: TypeAlias = "ParallelEnv[Any, Any, Any]"
MakeEnv: TypeAlias = "Callable[[], AnyParallelEnv] | AnyParallelEnv"

#: Whether to use action masks: if there are any, always (required), never.
AskMasks: TypeAlias = Literal["auto"] | bool

#: Places of masks in a game.
_MaskSource = Literal["observation", "info"]


class GameReader:
    """
    Reader of a game whose agents have equal spaces.

    :param env: the game
    :param trial: its trial episode
    :param active: whether rows have ``"active"``
    :param action_masks: ``"auto"`` for masks if any, True to require them, False for none; None keeps observations
        unchanged
    :param state: whether rows have the game's state
    :param float64: whether observations of float64 stay so
    :raises ValueError: if agents differ in their spaces, or a requested signal is missing
    """

    def __init__(
        self,
        env: Any,
        trial: Trial,
        active: bool = False,
        action_masks: AskMasks | None = None,
        state: bool = False,
        float64: bool = True,
    ) -> None:
        self.agents = tuple(agents_of(env))
        #: Warnings about the game.
        self.notes = list(trial.notes)
        self._observed = common_space(env, "observation", self.agents)
        #: The game's action space of each agent.
        self.action_space = common_space(env, "action", self.agents)
        self._mask_key: Any = None
        own = self._observed
        if action_masks is not None:
            self._mask_key, notes = mask_key_of(self._observed, self.action_space)
            self.notes += notes
            own = own if self._mask_key is None else without_mask(own, self._mask_key)
        self._masks_are_optional = False
        self._masks = self._mask_source(action_masks, trial) if action_masks else None
        self.watches_masks = action_masks == "auto" and self._masks is None
        keep = float64 or action_masks is None
        is_flat = action_masks is not None and can_be_flattened(own)
        self._own = (FlatReader if is_flat else SpaceReader)(own, float64=keep)
        self._state = SpaceReader(_state_space(env), float64=keep) if state else None
        #: The form of the rows.
        self.rows = TeamSpaces(
            self._own.rows,
            len(self.agents),
            active,
            n_mask_entries(self.action_space) if self._masks else None,
            None if self._state is None else self._state.rows,
            self.agents,
            is_dict=active or self._masks is not None or state,
        )
        self.blank = self._own.blank()
        #: How each agent's observations and actions become those of rows, for models that act on the game's own.
        self.conversions = conversions_of(
            trial.env,
            self._own.rows,
            counted_from_zero(self.action_space),
            self._masks == "info" and trial.env is env and not self._masks_are_optional,
            {} if action_masks is None else trial.mask_keys,
        )

    def _mask_source(self, action_masks: AskMasks, trial: Trial) -> _MaskSource | None:
        if self._mask_key is not None:
            return "observation"
        if n_mask_entries(self.action_space) is None:
            if action_masks is True:
                raise ValueError(
                    f"action masks are for Discrete, MultiDiscrete and MultiBinary actions, got {self.action_space}; "
                    "pass action_masks=False, or make the actions Discrete in a wrapper of the environment"
                )
            return None
        self._info_key = next((key for key in INFO_MASKS if key in trial.n_masks), ACTION_MASK_KEY)
        n_given = trial.n_masks.get(self._info_key, 0)
        self._masks_are_optional = 0 < n_given < trial.n_turns and action_masks == "auto"
        if self._masks_are_optional:
            self.notes.append(
                f"{self._info_key!r} is in some infos and not in others ({n_given} of {trial.n_turns} in a trial "
                "episode): where it is missing, all actions are taken to be legal"
            )
        return "info" if n_given or action_masks is True else None

    def own(self, observations: Mapping[Any, Any], agent: Any, place: str, required: bool) -> Any:
        """
        Return an agent's own observation, zeros if there is none and none is required.

        :param observations: by agent
        :param place: game and step, for the message
        :param required: whether the agent takes part
        """
        if not required and observations.get(agent) is None:
            return self.blank
        observation = observation_of(observations, agent, place)
        if self._mask_key is not None:
            if not isinstance(observation, Mapping) or not set(self._observed.spaces) <= set(observation):  # type: ignore[attr-defined]
                got = list(observation) if isinstance(observation, Mapping) else type(observation).__name__
                keys = list(self._observed.spaces)  # type: ignore[attr-defined]
                raise ValueError(f"observation of {agent} {place}: expected a dict with {keys}, got {got}")
            observation = own_part(observation, self._observed, self._mask_key)
        return self._own.read(observation, f"{agent} {place}")

    def signals(
        self,
        observations: Mapping[Any, Any],
        infos: Mapping[Any, Any],
        agent: Any,
        place: str,
        active: bool,
        over: bool = False,
    ) -> dict[str, Any]:
        """
        Return what an agent's row has beside its own observation and the state.

        :param active: whether the agent takes part
        :param over: whether these are the last observations of the episode, on which no agent acts
        """
        signals: dict[str, Any] = {ACTIVE_KEY: int(active)} if self.rows.has_active else {}
        if self.rows.n_masked_actions is not None:
            mask = self._mask(observations, infos, agent, place, over) if active else None
            signals[ACTION_MASK_KEY] = np.zeros(self.rows.n_masked_actions, np.int8) if mask is None else mask
        return signals

    def _mask(
        self, observations: Mapping[Any, Any], infos: Mapping[Any, Any], agent: Any, place: str, over: bool
    ) -> npt.NDArray[np.int8] | None:
        inside = self._masks == "observation"
        source, key = (observations, self._mask_key) if inside else (infos, self._info_key)
        value = (source.get(agent) or {}).get(key)
        if value is None and over:
            return None
        if value is None and self._masks_are_optional:
            assert self.rows.n_masked_actions is not None
            return np.ones(self.rows.n_masked_actions, np.int8)
        return mask_of(value, self.action_space, f"the {self._masks} of {agent} {place}", key)

    def state(self, env: Any, place: str) -> dict[str, Any]:
        """Return the game's state as an entry of rows, nothing if they have none."""
        return {} if self._state is None else {STATE_KEY: self._state.read(env.state(), f"the state {place}")}


def common_space(env: Any, kind: str, agents: tuple[Any, ...]) -> spaces.Space[Any]:
    """Return the space of all agents; raise ValueError if they differ."""
    by_agent = {agent: space_of(env, kind, agent) for agent in agents}
    first = by_agent[agents[0]]
    others = [f"{agent} has {space}" for agent, space in by_agent.items() if space != first]
    if others:
        raise ValueError(
            f"expected one {kind} space for all agents, got: {agents[0]} has {first}, {', '.join(others)}; make them "
            "equal with sb3_saf.EqualSpaces(env)"
        )
    return first


def _state_space(env: Any) -> spaces.Space[Any]:
    for layer in (env, getattr(env, "unwrapped", None)):
        space = None
        with suppress(AttributeError, NotImplementedError):
            space = layer.state_space  # type: ignore[union-attr]
        if isinstance(space, FIXED_SHAPE):
            return space
    raise ValueError(
        f"state=True needs an environment with state() and a state_space of Box, Discrete, MultiDiscrete or "
        f"MultiBinary, got {env} with {getattr(env, 'state_space', 'no state_space')}; leave state out, or "
        "give the environment both"
    )
