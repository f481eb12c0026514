"""
Rows of teams: keys, spaces and layout of the observations of a vector environment of flattened teams.

Letters: E games, N agents, B = E * N rows. Rows are game-major, then agent: row ``e * N + i`` is agent ``i`` of game
``e``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first

from sb3_saf.teams.conversion import AgentConversion

#: The row's own observation.
OBS_KEY: Final = "obs"
#: The own observations of all agents of the row's team, in index order.
TEAM_KEY: Final = "team"
#: The index of the row's agent in its team.
AGENT_KEY: Final = "agent"
TEAM_KEYS: Final = (OBS_KEY, TEAM_KEY, AGENT_KEY)

#: SB3's keys of infos: the last observation of an episode, and whether a time limit ended it.
TERMINAL_OBSERVATION: Final = "terminal_observation"
TRUNCATED: Final = "TimeLimit.truncated"
#: SB3's key of infos for success of an episode, logged as ``rollout/success_rate``.
IS_SUCCESS: Final = "is_success"
#: Entry of the last info of an episode that was cut short (``make_team_env(..., stagger=True)``).
STAGGERED: Final = "staggered"

#: Which agents of the row's team take part, in index order.
ACTIVE_KEY: Final = "active"
#: The row's own legal actions.
ACTION_MASK_KEY: Final = "action_mask"
#: The state of the row's game, for critics.
STATE_KEY: Final = "state"
#: Whether the row's agent took no part in the step before: its episode begins here, and its memory is empty.
EPISODE_START_KEY: Final = "episode_start"
#: Keys that only some environments provide.
OPTIONAL_KEYS: Final = (ACTIVE_KEY, ACTION_MASK_KEY, STATE_KEY)
ALL_KEYS: Final[frozenset[str]] = frozenset((*TEAM_KEYS, *OPTIONAL_KEYS, EPISODE_START_KEY))

Array = npt.NDArray[Any]

#: Spaces whose samples have one shape and dtype.
FIXED_SHAPE: Final = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Box)


class AgentSpace(spaces.Discrete):
    """
    Discrete(N), the index of an agent in its team, with the agents' names and conversions.

    :param names: PettingZoo's names of the agents in index order; None if they are unknown
    :param conversions: of the agents' observations and actions in the game, in index order; None if rows are the game's
    """

    def __init__(
        self,
        n_agents: int,
        names: Sequence[Any] | None = None,
        conversions: Sequence[AgentConversion] | None = None,
    ) -> None:
        super().__init__(n_agents)
        self.names = None if names is None else tuple(names)
        self.conversions = None if conversions is None else tuple(conversions)

    def __eq__(self, other: object) -> bool:
        """Compare sizes, and the places of equal names: critics, and actors that read the index, depend on it."""
        names, others = self.names or (), getattr(other, "names", None) or ()
        is_reordered = any(names.index(name) != others.index(name) for name in set(names) & set(others))
        return super().__eq__(other) and not is_reordered

    def __repr__(self) -> str:
        """Return the size, and the names if they are known."""
        return super().__repr__() if self.names is None else f"Discrete({self.n}, names={self.names})"


class NormalizedSpace(spaces.Box):
    """Box of what VecNormalize gives; saved with a model, it tells that others must normalise as well."""


class TerminalRow(dict[str, Any]):
    """
    Last observation of a row, ``infos[row]["terminal_observation"]``.

    :param entries: the observation
    :param row: index of the row, whose memory policies use for the value of the observation; (K,) for K observations
    """

    def __init__(
        self, entries: Mapping[str, Any] | Iterable[tuple[str, Any]], row: int | npt.NDArray[np.int64]
    ) -> None:
        super().__init__(entries)
        self.row = row


@dataclass(frozen=True)
class TeamSpaces:
    """
    The form of a row.

    Rows of a VecEnv of flattened teams are own observations (``is_dict=False``), or Dicts with the key ``"obs"`` and

    - ``"active"``, Discrete(2): 1 while the row's agent takes part;
    - ``"action_mask"``, MultiBinary(A): 1 for legal actions, see :func:`n_mask_entries`;
    - ``"state"``: the state of the row's game, equal in all its rows.

    ``CentralizedValueWrapper`` adds ``"team"``, ``"agent"`` and ``"episode_start"``, and makes ``"active"`` that of the
    whole team.

    :param own: space of one agent's own observation, shape ``(*shape)``: Box, Discrete, MultiDiscrete or MultiBinary
    :param has_active: whether rows have ``"active"``
    :param n_masked_actions: A if rows have action masks, else None
    :param state: space of the game's state if rows have it
    :param names: the agents' names in index order, if they are known
    :param conversions: of the agents' observations and actions in the game, in index order; None if rows are the game's
    :param has_starts: whether rows of ``CentralizedValueWrapper`` have ``"episode_start"``
    :param is_dict: whether rows below ``CentralizedValueWrapper`` are Dicts, as those with a signal always are
    :raises ValueError: if ``own`` or ``state`` is another kind of space
    """

    own: spaces.Space[Any]
    n_agents: int
    has_active: bool = False
    n_masked_actions: int | None = None
    state: spaces.Space[Any] | None = None
    names: Sequence[Any] | None = None
    conversions: Sequence[AgentConversion] | None = None
    has_starts: bool = False
    is_dict: bool = False

    def __post_init__(self) -> None:
        bounds_of(self.own)
        if self.state is not None and not isinstance(self.state, FIXED_SHAPE):
            raise ValueError(
                f"the space of {STATE_KEY!r} must be Box, Discrete, MultiDiscrete or MultiBinary, got {self.state}; "
                "flatten it first"
            )
        has_signal = self.has_active or self.n_masked_actions is not None or self.state is not None
        object.__setattr__(self, "is_dict", self.is_dict or has_signal)

    @classmethod
    def of_rows(
        cls,
        space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        n_agents: int,
        names: Sequence[Any] | None = None,
    ) -> TeamSpaces:
        """
        Split the observation space of the rows of a VecEnv of flattened teams into its parts.

        :raises ValueError: if the space has rows of teams already, or an optional key has another form
        """
        keys = set(space.spaces) if isinstance(space, spaces.Dict) else set()
        if set(TEAM_KEYS) <= keys <= ALL_KEYS:
            raise ValueError(
                "expected a VecEnv of own observations, got one that already has the Dict observation of "
                "CentralizedValueWrapper; wrap it once (sb3_saf.make_team_env has done so)"
            )
        if not isinstance(space, spaces.Dict) or OBS_KEY not in keys or not keys <= {OBS_KEY, *OPTIONAL_KEYS}:
            return cls(space, n_agents, names=names)
        active, action_mask, state = (space.spaces.get(key) for key in OPTIONAL_KEYS)
        if active is not None and active != spaces.Discrete(2):
            raise ValueError(f"expected {ACTIVE_KEY!r} of a row to be Discrete(2), got {active}")
        check_masks(action_mask, action_space)
        n_masked = None if action_mask is None else int((action_mask.shape or ())[0])
        return cls(space.spaces[OBS_KEY], n_agents, active is not None, n_masked, state, names, is_dict=True)

    @classmethod
    def from_observation_space(cls, space: spaces.Space[Any]) -> TeamSpaces:
        """
        Split the Dict observation space of ``CentralizedValueWrapper`` into its parts.

        :raises ValueError: if the space is not that of a team, with a fix
        """
        if not isinstance(space, spaces.Dict) or not set(TEAM_KEYS) <= set(space.spaces) <= ALL_KEYS:
            raise ValueError(_not_a_team_space(f"got {space}"))
        own, agent = space.spaces[OBS_KEY], space.spaces[AGENT_KEY]
        if not isinstance(agent, spaces.Discrete) or agent.start != 0:
            raise ValueError(_not_a_team_space(f"its {AGENT_KEY!r} must be Discrete(N) from 0, got {agent}"))
        active, action_mask, state, starts = (space.spaces.get(key) for key in (*OPTIONAL_KEYS, EPISODE_START_KEY))
        n_masked = None if action_mask is None else prod(action_mask.shape or ())
        names, conversions = (getattr(agent, name, None) for name in ("names", "conversions"))
        team = cls(own, int(agent.n), active is not None, n_masked, state, names, conversions, starts is not None)
        for key, part in team._joint.items():
            given = space.spaces[key]
            if (given.shape, given.dtype) != (part.shape, part.dtype):
                raise ValueError(
                    _not_a_team_space(f"its {key!r} must be of shape {part.shape} and {part.dtype}, got {given}")
                )
        return team

    @cached_property
    def team(self) -> spaces.Box:
        """Box of all own observations of a team (key ``"team"``), shape ``(N, *shape)``, dtype as in ``own``."""
        low, high = (np.repeat(bound[np.newaxis], self.n_agents, axis=0) for bound in bounds_of(self.own))
        return spaces.Box(low, high, dtype=low.dtype.type)

    @property
    def active(self) -> spaces.MultiBinary | None:
        """MultiBinary(N), which agents of the team take part (key ``"active"``); None if all always do."""
        return spaces.MultiBinary(self.n_agents) if self.has_active else None

    @property
    def action_mask(self) -> spaces.MultiBinary | None:
        """MultiBinary(A), the row's legal actions (key ``"action_mask"``); None if all always are."""
        return None if self.n_masked_actions is None else spaces.MultiBinary(self.n_masked_actions)

    @property
    def own_shape(self) -> tuple[int, ...]:
        """Shape of one agent's own observation; ``()`` for Discrete."""
        return self.own.shape or ()

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of a row's joint observation."""
        return tuple(self._joint)

    @property
    def _optional(self) -> dict[str, spaces.Space[Any]]:
        parts = {ACTIVE_KEY: self.active, ACTION_MASK_KEY: self.action_mask, STATE_KEY: self.state}
        return {key: part for key, part in parts.items() if part is not None}

    @cached_property
    def _joint(self) -> dict[str, spaces.Space[Any]]:
        agent = AgentSpace(self.n_agents, self.names, self.conversions)
        starts = {EPISODE_START_KEY: spaces.Discrete(2)} if self.has_starts else {}
        return {OBS_KEY: self.own, TEAM_KEY: self.team, AGENT_KEY: agent, **self._optional, **starts}

    def to_dict_space(self) -> spaces.Dict:
        """Return the joint observation space of a row; ``own`` stays the same object."""
        return spaces.Dict(self._joint)

    def to_row_space(self) -> spaces.Space[Any]:
        """Return the observation space of a row below ``CentralizedValueWrapper``."""
        if not self.is_dict:
            return self.own
        active = {ACTIVE_KEY: spaces.Discrete(2)} if self.has_active else {}
        return spaces.Dict({OBS_KEY: self.own, **self._optional, **active})

    def entries(self, obs: Any, what: str) -> Mapping[str, Any]:
        """Return the parts of rows below ``CentralizedValueWrapper``; raise ValueError if keys are missing."""
        if not self.is_dict:
            return {OBS_KEY: obs}
        keys = [OBS_KEY, *self._optional]
        if not isinstance(obs, Mapping) or any(key not in obs for key in keys):
            got = sorted(obs) if isinstance(obs, Mapping) else type(obs).__name__
            raise ValueError(f"expected {what} to be a dict with the keys {keys}, got {got}")
        return {key: obs[key] for key in keys}


def n_mask_entries(action_space: spaces.Space[Any]) -> int | None:
    """
    Return A, the number of entries of action masks, as in sb3-contrib; None for actions that cannot be masked.

    :param action_space: Discrete(A); MultiDiscrete, whose masks follow one another; MultiBinary(n), A = 2 n, whether 0
        and whether 1 is legal for each entry in turn
    """
    has_choices = isinstance(action_space, (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary))
    return sum(choices_of(action_space)) if has_choices and len(action_space.shape or ()) <= 1 else None


def choices_of(action_space: spaces.Space[Any]) -> tuple[int, ...]:
    """Return the number of choices of each action dimension, of which a Box has none; ValueError for other spaces."""
    if isinstance(action_space, spaces.Box):
        return ()
    if isinstance(action_space, spaces.Discrete):
        return (int(action_space.n),)
    if isinstance(action_space, spaces.MultiDiscrete) and len(action_space.shape) == 1:
        return tuple(action_space.nvec.tolist())
    if isinstance(action_space, spaces.MultiBinary):
        return (2,) * prod(action_space.shape)
    raise ValueError(
        f"expected a Discrete, MultiDiscrete (of one axis), MultiBinary or Box space, got {action_space}; flatten it "
        "in a wrapper of the environment"
    )


def first_choices(action_space: spaces.Space[Any]) -> Array:
    """Return the mask (A,) int8 that allows only the first choice of each dimension of the actions."""
    mask = np.zeros(n_mask_entries(action_space) or 0, dtype=np.int8)
    mask[np.cumsum([0, *choices_of(action_space)[:-1]])] = 1
    return mask


def allows_nothing(masks: Array, action_space: spaces.Space[Any]) -> npt.NDArray[np.bool_]:
    """Return which masks (B, A) allow no choice in some dimension of the actions, (B,)."""
    starts = np.flatnonzero(first_choices(action_space))
    return np.asarray((np.add.reduceat(masks != 0, starts, axis=1, dtype=np.int64) == 0).any(axis=1))


def are_allowed(actions: Array, masks: Array, action_space: spaces.Space[Any]) -> npt.NDArray[np.bool_]:
    """Return which actions (B, ...) are legal by their masks (B, A), (B,)."""
    starts = np.flatnonzero(first_choices(action_space)) - getattr(action_space, "start", 0)
    entries = starts + np.asarray(actions, dtype=np.int64).reshape(len(masks), -1)
    return np.asarray(np.take_along_axis(masks, entries, axis=1).all(axis=1))


def fill_idle_rows(rows: Array, active: Array) -> None:
    """
    Fill the own observations of agents that take no part with copies of those of their team that do.

    Statistics over rows (SB3's VecNormalize) then are those of agents that take part; ``CentralizedValueWrapper`` sets
    the rows of the others to zero.

    :param rows: (N, ...) own observations of a team, which are changed
    :param active: (N,) which agents take part
    """
    acting, idle = np.flatnonzero(active), np.flatnonzero(np.asarray(active) == 0)
    if len(acting) and len(idle):
        rows[idle] = rows[acting[np.arange(len(idle)) % len(acting)]]


def check_masks(action_mask: spaces.Space[Any] | None, action_space: spaces.Space[Any]) -> None:
    """Raise ValueError unless the space of action masks, if there is one, fits the actions."""
    n_entries = n_mask_entries(action_space)
    if action_mask is not None and (n_entries is None or action_mask != spaces.MultiBinary(n_entries)):
        raise ValueError(
            f"expected {ACTION_MASK_KEY!r} to be MultiBinary(A), one entry per choice of "
            f"Discrete, MultiDiscrete or MultiBinary actions, got {action_mask} for {action_space}"
        )


def bounds_of(space: spaces.Space[Any]) -> tuple[Array, Array]:
    """
    Return the lowest and the highest value of each entry, both included, in the space's shape and dtype.

    :raises ValueError: for any other space
    """
    if isinstance(space, spaces.Box):
        return space.low, space.high
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        low = np.asarray(space.start, dtype=space.dtype)
        count = space.n if isinstance(space, spaces.Discrete) else space.nvec
        return low, (low + np.asarray(count) - 1).astype(space.dtype)
    if isinstance(space, spaces.MultiBinary):
        return np.zeros(space.shape, dtype=space.dtype), np.ones(space.shape, dtype=space.dtype)
    raise ValueError(
        f"an agent's own observation space must be Box, Discrete, MultiDiscrete or MultiBinary, got {space}; "
        "flatten it in a wrapper of the environment, for instance with gymnasium.spaces.flatten"
    )


def _not_a_team_space(found: str) -> str:
    keys = ", ".join(map(repr, TEAM_KEYS))
    return (
        f"expected the Dict observation space of CentralizedValueWrapper with the keys {keys}; {found}. Build the "
        "environment with sb3_saf.make_team_env(...), or wrap a VecEnv of flattened teams: "
        "sb3_saf.CentralizedValueWrapper(venv, n_agents=N)"
    )


def check_codes_are_kept(seen: spaces.Space[Any], inner: Iterable[spaces.Space[Any]]) -> None:
    """
    Check that wrappers leave tile codes alone: without their atlas encoders would read codes as magnitudes.

    :param seen: own observations behind the wrappers
    :param inner: own observations of what they wrap
    :raises ValueError: if an inner space has an ``atlas``, and the outer one its shape or range without it
    """
    if not isinstance(seen, spaces.Box) or hasattr(seen, "atlas"):
        return
    coded = (space for space in inner if isinstance(space, spaces.Box) and hasattr(space, "atlas"))
    if any(space.shape == seen.shape or space.high.max() == seen.high.max() for space in coded):
        raise ValueError(
            f"expected wrappers that leave tile codes as they are, got {seen} without their atlas; give the game "
            "observation='rgb', or leave the wrapper out"
        )


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
