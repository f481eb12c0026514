"""
Rows of teams: keys, spaces and layout of the observations of a vector environment of flattened teams.

Letters: E games, N agents, B = E * N rows. Rows are game-major, then agent: row ``e * N + i`` is agent ``i`` of game
``e``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first

TeamKey = Literal["obs", "team", "agent"]

#: The row's own observation.
OBS_KEY: Final = "obs"
#: The own observations of all agents of the row's team, in index order.
TEAM_KEY: Final = "team"
#: The index of the row's agent in its team.
AGENT_KEY: Final = "agent"
TEAM_KEYS: Final[tuple[TeamKey, ...]] = get_args(TeamKey)

OptionalKey = Literal["active", "action_mask", "state"]

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
#: Keys that only some environments provide.
OPTIONAL_KEYS: Final[tuple[OptionalKey, ...]] = get_args(OptionalKey)
ALL_KEYS: Final[frozenset[str]] = frozenset(TEAM_KEYS + OPTIONAL_KEYS)

Array = npt.NDArray[Any]

#: Spaces whose samples have one shape and dtype.
FIXED_SHAPE: Final = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Box)


class AgentSpace(spaces.Discrete):
    """
    Discrete(N), the index of an agent in its team, with the agents' names.

    :param n_agents: N
    :param names: PettingZoo's names of the agents in index order; None if they are unknown
    """

    def __init__(self, n_agents: int, names: Sequence[Any] | None = None) -> None:
        super().__init__(n_agents)
        self.names = None if names is None else tuple(names)


class TeamSpaces(NamedTuple):
    """
    Parts of the Dict observation of ``CentralizedValueWrapper``.

    :param own: space of one agent's own observation (key ``"obs"``), shape ``(*shape)``
    :param team: Box of all own observations of a team (key ``"team"``), shape ``(N, *shape)``, dtype as in ``own``
    :param agent: Discrete(N), the agent's index (key ``"agent"``)
    :param n_agents: N
    :param active: MultiBinary(N), which agents of the team take part (key ``"active"``); None if all always do
    :param action_mask: MultiBinary(A), the row's legal actions (key ``"action_mask"``); None if all always are
    :param state: space of the game's state (key ``"state"``), or None
    """

    own: spaces.Space[Any]
    team: spaces.Box
    agent: spaces.Discrete
    n_agents: int
    active: spaces.MultiBinary | None = None
    action_mask: spaces.MultiBinary | None = None
    state: spaces.Space[Any] | None = None

    @classmethod
    def of(
        cls,
        own: spaces.Space[Any],
        n_agents: int,
        active: bool = False,
        n_masked_actions: int | None = None,
        state: spaces.Space[Any] | None = None,
        names: Sequence[Any] | None = None,
    ) -> TeamSpaces:
        """
        Return the spaces of a team whose agents share one observation space.

        :param own: Box, Discrete, MultiDiscrete or MultiBinary
        :param n_agents: N
        :param active: whether rows have ``"active"``
        :param n_masked_actions: A if rows have action masks
        :param state: space of the game's state if rows have it
        :param names: the agents' names in index order, if they are known
        :raises ValueError: if ``own`` is another kind of space
        """
        low, high = bounds_of(own)
        team = spaces.Box(
            np.repeat(low[np.newaxis], n_agents, axis=0),
            np.repeat(high[np.newaxis], n_agents, axis=0),
            dtype=low.dtype.type,
        )
        return cls(
            own,
            team,
            AgentSpace(n_agents, names),
            n_agents,
            spaces.MultiBinary(n_agents) if active else None,
            None if n_masked_actions is None else spaces.MultiBinary(n_masked_actions),
            None if state is None else _checked_state(state),
        )

    @classmethod
    def from_observation_space(cls, space: spaces.Space[Any]) -> TeamSpaces:
        """
        Split the Dict observation space of ``CentralizedValueWrapper`` into its parts.

        :param space: observation space of an algorithm, a policy or a buffer
        :raises ValueError: if the space is not that of a team, with a fix
        """
        if not isinstance(space, spaces.Dict) or not set(TEAM_KEYS) <= set(space.spaces) <= ALL_KEYS:
            raise ValueError(_not_a_team_space(f"got {space}"))
        own, team, agent = (space.spaces[key] for key in TEAM_KEYS)
        if not isinstance(agent, spaces.Discrete) or agent.start != 0:
            raise ValueError(_not_a_team_space(f"its {AGENT_KEY!r} must be Discrete(N) from 0, got {agent}"))
        n_agents = int(agent.n)
        expected = (n_agents, *(own.shape or ()))
        if not isinstance(team, spaces.Box) or team.shape != expected or team.dtype != own.dtype:
            raise ValueError(
                _not_a_team_space(
                    f"its {TEAM_KEY!r} must be a Box of shape {expected} and dtype {own.dtype}, got {team}"
                )
            )
        active, action_mask, state = (space.spaces.get(key) for key in OPTIONAL_KEYS)
        if active is not None and active != spaces.MultiBinary(n_agents):
            raise ValueError(_not_a_team_space(f"its {ACTIVE_KEY!r} must be MultiBinary({n_agents}), got {active}"))
        if action_mask is not None and not (
            isinstance(action_mask, spaces.MultiBinary) and len(action_mask.shape) == 1
        ):
            raise ValueError(_not_a_team_space(f"its {ACTION_MASK_KEY!r} must be MultiBinary(A), got {action_mask}"))
        if state is not None:
            _checked_state(state)
        return cls(own, team, agent, n_agents, active, action_mask, state)  # type: ignore[arg-type]

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of a row's observation."""
        optional = {ACTIVE_KEY: self.active, ACTION_MASK_KEY: self.action_mask, STATE_KEY: self.state}
        return (*TEAM_KEYS, *(key for key, space in optional.items() if space is not None))

    @property
    def names(self) -> tuple[Any, ...] | None:
        """The agents' names in index order; None if they are unknown."""
        return getattr(self.agent, "names", None)

    @property
    def own_shape(self) -> tuple[int, ...]:
        """Shape of one agent's own observation; ``()`` for Discrete."""
        return self.team.shape[1:]

    def to_dict_space(self) -> spaces.Dict:
        """Return the observation space of one row; ``own`` stays the same object."""
        parts: dict[str, spaces.Space[Any] | None] = {
            OBS_KEY: self.own,
            TEAM_KEY: self.team,
            AGENT_KEY: self.agent,
            ACTIVE_KEY: self.active,
            ACTION_MASK_KEY: self.action_mask,
            STATE_KEY: self.state,
        }
        return spaces.Dict({key: part for key, part in parts.items() if part is not None})


def _checked_state(state: spaces.Space[Any]) -> spaces.Space[Any]:
    if isinstance(state, FIXED_SHAPE):
        return state
    raise ValueError(
        f"the space of {STATE_KEY!r} must be Box, Discrete, MultiDiscrete or MultiBinary, got {state}; flatten it first"
    )


def check_masks(action_mask: spaces.Space[Any] | None, action_space: spaces.Space[Any]) -> None:
    """Raise ValueError unless the space of action masks, if there is one, fits the actions."""
    if action_mask is None:
        return
    if not isinstance(action_space, spaces.Discrete) or action_mask != spaces.MultiBinary(int(action_space.n)):
        raise ValueError(
            f"expected {ACTION_MASK_KEY!r} to be MultiBinary(A) where actions are Discrete(A), got {action_mask} for "
            f"{action_space}"
        )


def bounds_of(space: spaces.Space[Any]) -> tuple[Array, Array]:
    """
    Return the lowest and the highest value of each entry, both included, in the space's shape and dtype.

    :param space: a space of fixed shape
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
