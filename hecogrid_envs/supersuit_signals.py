"""
What a game may tell beside observations: who is active, which actions are legal, the state of the whole game.

SuperSuit carries observations and nothing else safely, so signals travel inside them: a row's observation becomes a
Dict of ``"obs"`` (the agent's own observation) and the signals that were asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

#: Keys of a row's observation.
OBS: Final = "obs"
ACTIVE: Final = "active"
ACTION_MASK: Final = "action_mask"
STATE: Final = "state"

#: Where a game tells legal actions: in observations of the form {"observation", "action_mask"}, or in infos.
MaskSource = Literal["observation", "info"]
#: Whether to look for action masks: where there are any, always, never.
AskMasks = Literal["auto"] | bool

_CLASSIC: Final = {"observation", ACTION_MASK}


@dataclass(frozen=True)
class Signals:
    """
    What the rows of a game show beside observations. Without any signal, rows are observations as they are.

    - ``"active"``, Discrete(2): 1 while the row's agent takes part. In the last observation of an episode: 1 if the
      agent was stopped by a time limit, so that something would have followed.
    - ``"action_mask"``, MultiBinary(A): 1 for legal actions; zeros for agents that do not act.
    - ``"state"``: the game's ``state()``, in the rows of all its agents, active or not.

    :param raw: the agents' observations, as the game gives them
    :param own: the same without masks
    :param active: whether rows show ``"active"``
    :param masks: where masks come from, None for no masks
    :param n_actions: A, read where there are masks
    :param state: space of the game's state, None for no state
    """

    raw: spaces.Space[Any]
    own: spaces.Space[Any]
    active: bool = False
    masks: MaskSource | None = None
    n_actions: int = 0
    state: spaces.Space[Any] | None = None

    @property
    def shown(self) -> bool:
        """Whether rows are Dicts of signals."""
        return self.active or self.masks is not None or self.state is not None

    def row_space(self) -> spaces.Space[Any]:
        """Observation space of a row."""
        if not self.shown:
            return self.own
        row: dict[str, spaces.Space[Any]] = {OBS: self.own}
        if self.active:
            row[ACTIVE] = spaces.Discrete(2)
        if self.masks is not None:
            row[ACTION_MASK] = spaces.MultiBinary(self.n_actions)
        if self.state is not None:
            row[STATE] = self.state
        return spaces.Dict(row)

    def row(
        self, observation: Any, info: Mapping[str, Any], state: Any, owner: str, active: bool, over: bool
    ) -> dict[str, Any]:
        """
        One row with its signals.

        :param observation: in the form of ``raw``
        :param info: the agent's info
        :param state: the game's state where rows show it
        :param owner: the agent, for messages
        :param active: whether the agent takes part
        :param over: whether this is the last observation of an episode; nobody acts on it, so masks may be missing
        """
        row = {OBS: observation if self.own is self.raw else observation["observation"]}
        if self.active:
            row[ACTIVE] = int(active)
        if self.masks is not None:
            found = observation[ACTION_MASK] if self.masks == "observation" else info.get(ACTION_MASK)
            row[ACTION_MASK] = self._mask(found, owner, over) if active else np.zeros(self.n_actions, np.int8)
        if self.state is not None:
            row[STATE] = state
        return row

    def _mask(self, found: Any, owner: str, over: bool) -> npt.NDArray[np.int8]:
        mask = np.asarray(found)
        if mask.shape == (self.n_actions,) and mask.dtype.kind in "biuf" and ((mask == 0) | (mask == 1)).all():
            return mask.astype(np.int8)
        if over:
            return np.zeros(self.n_actions, np.int8)
        where = "the observation" if self.masks == "observation" else "the info"
        raise ValueError(
            f"expected {ACTION_MASK!r} in {where} of {owner}, {self.n_actions} zeros and ones (one per action), got "
            f"{found!r}; give it at every step to every agent that acts, or pass action_masks=False"
        )


def find_signals(
    example: Any,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    active: bool,
    action_masks: AskMasks | None,
    state: bool,
    first_infos: Callable[[], Mapping[Any, Mapping[str, Any]]],
) -> Signals:
    """
    Find out which signals a game gives.

    :param example: a ParallelEnv
    :param observation_space: of every agent
    :param action_space: of every agent
    :param active: whether rows shall tell who is active
    :param action_masks: ``"auto"`` for masks where there are any, True to insist on them, False for none; None for
        observations as they are
    :param state: whether rows shall show the game's state
    :param first_infos: gives the infos of a reset of a copy of the game; called if it may tell of masks
    :raises ValueError: if what was asked for is not there
    """
    own = observation_space
    masks: MaskSource | None = None
    if action_masks is not None and _is_classic(observation_space):
        own, masks = observation_space["observation"], "observation"  # type: ignore[index]
    elif action_masks is True or (action_masks == "auto" and isinstance(action_space, spaces.Discrete)):
        masks = "info" if action_masks is True or _in_infos(first_infos()) else None
    if not action_masks:
        masks = None
    return Signals(
        observation_space,
        own,
        active,
        masks,
        _n_actions(action_space) if masks else 0,
        _state_space(example) if state else None,
    )


def _is_classic(space: spaces.Space[Any]) -> bool:
    """Whether observations have PettingZoo's form for masks."""
    return isinstance(space, spaces.Dict) and set(space.spaces) == _CLASSIC


def _in_infos(infos: Mapping[Any, Mapping[str, Any]]) -> bool:
    return any(ACTION_MASK in (info or {}) for info in infos.values())


def _n_actions(action_space: spaces.Space[Any]) -> int:
    if not isinstance(action_space, spaces.Discrete):
        raise ValueError(
            f"action masks are for Discrete actions, got the action space {action_space}; pass action_masks=False, or "
            "make the actions Discrete in a wrapper of the environment"
        )
    return int(action_space.n)


def _state_space(example: Any) -> spaces.Space[Any]:
    for env in (example, getattr(example, "unwrapped", None)):
        space = None
        with suppress(AttributeError, NotImplementedError):
            space = env.state_space  # type: ignore[union-attr]
        if isinstance(space, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
            return space
    raise ValueError(
        f"state=True needs an environment with state() and a state_space of Box, Discrete, MultiDiscrete or "
        f"MultiBinary, got {example} with {getattr(example, 'state_space', 'no state_space')}; leave state out, or "
        "give the environment both"
    )
