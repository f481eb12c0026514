"""
Teams of rows: layout of the agents of a team in a vector environment.

Letters: E games, N agents, B = E * N rows. Rows are game-major, then agent: row ``e * N + i`` is agent ``i`` of game
``e``.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from numbers import Integral
from typing import Any, Final, Literal, NamedTuple, get_args

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecMonitor, is_vecenv_wrapped
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs

from sb3_saf.errors import NonFiniteError

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

#: Attributes with the shape of a vector environment of flattened teams.
_TEAM_ATTRIBUTES: Final = ("n_agents", "n_games")


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


def layers(venv: VecEnv) -> Iterator[VecEnv]:
    """Yield an environment's wrappers, outermost first, and the environment they wrap."""
    yield venv
    while isinstance(venv, VecEnvWrapper):
        venv = venv.venv
        yield venv


def find_n_agents(venv: VecEnv) -> int | None:
    """
    Return N of a vector environment of flattened teams, through any wrappers.

    SB3's look-up through wrappers fails if two layers have the attribute, so each layer is checked.

    :param venv: any vector environment
    :return: N, or None if no layer states it
    """
    *_, innermost = layers(venv)
    stating = (layer for layer in layers(venv) if _has_own(layer, "n_agents"))
    value = getattr(next(stating, innermost), "n_agents", None)
    return None if value is None else check_count("n_agents", value)


def _has_own(layer: VecEnv, name: str) -> bool:
    return name in vars(layer) or hasattr(type(layer), name)


def require_n_agents(venv: VecEnv, n_agents: int | None = None) -> int:
    """
    Return N of a vector environment of flattened teams, checked against its number of rows.

    :param venv: vector environment with B rows
    :param n_agents: N if known; None reads it from the environment
    :raises ValueError: if N is unknown, contradicts the environment or does not divide B
    """
    stated = find_n_agents(venv)
    if n_agents is not None:
        n_agents = check_count("n_agents", n_agents)
    if stated is not None and n_agents is not None and stated != n_agents:
        raise ValueError(f"n_agents={n_agents}, but the VecEnv has teams of {stated}; leave n_agents out")
    size = n_agents if n_agents is not None else stated
    if size is None:
        raise ValueError(
            f"expected a VecEnv of flattened teams that states its team size in an attribute n_agents, got "
            f"{type(venv).__name__} with {venv.num_envs} rows and no such attribute; build it with "
            "sb3_saf.make_team_env(...), or state the size: CentralizedValueWrapper(venv, n_agents=N)"
        )
    check_whole_teams(venv.num_envs, size)
    return size


def chosen_rows(indices: VecEnvIndices, n_rows: int) -> list[int]:
    """Return the rows selected by ``indices`` as in SB3's methods, None for all."""
    rows = np.arange(n_rows)
    chosen = rows if indices is None else np.atleast_1d(rows[np.asarray(indices, dtype=np.int64)])
    return [*map(int, chosen)]


def check_count(name: str, value: object) -> int:
    """Check that a value is an integer of at least 1; the ValueError contains ``name``."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Integral) or value < 1:
        raise ValueError(f"{name} must be an integer of at least 1, got {value!r}")
    return int(value)


def check_flag(name: str, value: object) -> None:
    """Check that an argument is True or False; the ValueError contains ``name``."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False, got {value!r}")


def check_choice(name: str, value: object, choices: Sequence[str]) -> None:
    """Check that an argument is one of ``choices``; the ValueError lists them."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r}")


def check_whole_teams(n_rows: int, n_agents: int, fix: str = "pass the right n_agents") -> int:
    """
    Check that the rows are a whole number of teams.

    :param n_rows: B
    :param n_agents: N
    :param fix: advice in the error message
    :return: E = B / N
    :raises ValueError: if N does not divide B
    """
    if n_rows % n_agents:
        raise ValueError(
            f"expected rows of whole teams, a multiple of n_agents={n_agents}, got {n_rows} rows "
            f"({n_rows // n_agents} teams and {n_rows % n_agents} rows over); {fix}"
        )
    return n_rows // n_agents


def team_dones(dones: Array, n_agents: int) -> npt.NDArray[np.bool_]:
    """
    Return which games have ended.

    :param dones: (B,) one flag per row, of any dtype
    :param n_agents: N
    :return: (E,)
    :raises ValueError: if the flags differ within a team
    """
    by_game = np.asarray(dones).astype(bool).reshape(-1, n_agents)
    if not by_game.any():
        return np.zeros(len(by_game), dtype=np.bool_)
    ended = by_game[:, 0]
    if (by_game != ended[:, np.newaxis]).any():
        game = int(np.flatnonzero((by_game != ended[:, np.newaxis]).any(axis=1))[0])
        raise ValueError(
            f"expected one done flag for a whole team, got {by_game[game].tolist()} for the agents of game {game}; "
            "a team episode ends for all agents at once: keep agents that are out of the game as idle rows until then "
            "(sb3_saf.make_team_env does so), or check n_agents and the order of rows (game-major, then agent)"
        )
    return ended.copy()


def check_other_games(training: VecEnv, evaluation: VecEnv) -> None:
    """
    Check that evaluation does not use the games of training.

    :param training: environment of teams; one without an attribute ``seeded_with`` passes
    :param evaluation: environment for evaluation
    :raises ValueError: if both contain a game with the same seed
    """
    common = set(game_seeds_of(training) or ()) & set(game_seeds_of(evaluation) or ()) - {None}
    if common:
        raise ValueError(
            f"expected games of evaluation that are not trained on, got {len(common)} with seeds of training games; "
            "the environments, or the algorithm and the environment of evaluation, have equal seeds; give evaluation "
            "another one, for instance make_team_env(..., seed=10_000)"
        )


def game_seeds_of(venv: VecEnv) -> tuple[int | None, ...] | None:
    """Return the last seeds of the games (None for random ones), or None if the environment does not record them."""
    *_, innermost = layers(venv)
    return getattr(innermost, "seeded_with", None)


def check_finite(name: str, values: Array, n_agents: int, step: int, games: Sequence[int] | None = None) -> None:
    """
    Raise NonFiniteError for NaN and infinity; integers are not read.

    :param name: name of the values, for the message
    :param values: (B, ...) one entry per row
    :param n_agents: N
    :param step: steps since the environment was made, for the message
    :param games: games of the rows, for the message; None for all
    :raises NonFiniteError: naming step, game and agent of the first bad row
    """
    if values.dtype.kind not in "fc" or np.isfinite(values).all():
        return
    bad = ~np.isfinite(values).reshape(len(values), -1).all(axis=1)
    row = int(np.flatnonzero(bad)[0])
    game, agent = divmod(row, n_agents)
    game = game if games is None else games[game]
    raise NonFiniteError(
        f"{name} must be finite, got {_short(values[row])} at step {step} for agent {agent} of game {game}"
        f"{_others(int(bad.sum()) - 1)}; repair the environment, learning from it would "
        "ruin the model"
    )


def _short(value: Array) -> str:
    entries = np.asarray(value).reshape(-1)
    return str(entries[~np.isfinite(entries)][0])


def _others(count: int) -> str:
    return f" (and {count} more rows)" if count else ""


class TeamVecEnvWrapper(VecEnvWrapper):
    """
    Base of wrappers around vector environments of flattened teams, with attributes ``n_agents`` and ``n_games``.

    The layers below may have these attributes, too. SB3 would call that ambiguous in a further wrapper (such as
    VecNormalize); here all layers have equal values, so it is allowed.

    SB3's ``evaluate_policy``, ``EvalCallback`` and ``VecMonitor`` count every agent as an environment: their use around
    teams, or of VecMonitor below, issues one warning with the names of the team versions.

    :param venv: vector environment with B rows
    :param n_agents: N; None reads it from ``venv``
    :param observation_space: observation space of a row if the wrapper changes it
    :raises ValueError: if N is unknown, contradicts the environment or does not divide B
    """

    def __init__(
        self, venv: VecEnv, n_agents: int | None = None, observation_space: spaces.Space[Any] | None = None
    ) -> None:
        super().__init__(venv, observation_space=observation_space)
        self.n_agents = require_n_agents(venv, n_agents)
        self.n_games = venv.num_envs // self.n_agents
        self._warned_of_rows: bool = isinstance(venv, TeamVecEnvWrapper) and venv._warned_of_rows
        if is_vecenv_wrapped(venv, VecMonitor):
            self._warn_of_rows()

    def reset(self) -> VecEnvObs:
        """Start new episodes in all games."""
        return self.venv.reset()

    def getattr_depth_check(self, name: str, already_found: bool) -> str | None:
        """See the base class; the team's shape is never ambiguous."""
        return None if name in _TEAM_ATTRIBUTES else super().getattr_depth_check(name, already_found)

    def has_attr(self, attr_name: str) -> bool:
        """See the base class; the team's shape is always known."""
        return attr_name in _TEAM_ATTRIBUTES or super().has_attr(attr_name)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """See the base class; the team's shape is answered here, even if the environments lack it."""
        if attr_name in _TEAM_ATTRIBUTES and attr_name in vars(self):
            return [vars(self)[attr_name] for _ in chosen_rows(indices, self.num_envs)]
        return super().get_attr(attr_name, indices)

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """
        See the base class; a query for SB3's ``Monitor`` issues a warning, since its caller would count rows as
        episodes.
        """
        if wrapper_class is not Monitor:
            return super().env_is_wrapped(wrapper_class, indices)
        self._warn_of_rows()
        return [False for _ in chosen_rows(indices, self.num_envs)]

    def _warn_of_rows(self) -> None:
        if self._warned_of_rows or self.n_agents == 1:
            return
        self._warned_of_rows = True
        warnings.warn(
            f"Stable-Baselines3's evaluate_policy, EvalCallback and VecMonitor take each of these {self.num_envs} rows "
            f"for an environment, but a row is one agent of a team of {self.n_agents}: they count agents for episodes, "
            "and returns of single agents. For team episodes use sb3_saf.evaluate_policy or evaluate_team, "
            "sb3_saf.TeamEvalCallback, and sb3_saf.TeamMonitor, which make_team_env has built in",
            UserWarning,
            stacklevel=4,
        )
