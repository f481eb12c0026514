"""Vector environments of flattened teams: their base classes, and questions about their layers and rows."""

from __future__ import annotations

import math
import reprlib
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from numbers import Integral
from typing import Any, Final, TypeVar, cast

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecMonitor, is_vecenv_wrapped
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, tile_images

from sb3_saf.teams.checks import NonFiniteError, check_count, check_whole_teams
from sb3_saf.teams.randomness import game_seeds
from sb3_saf.teams.rows import IS_SUCCESS, Array, bounds_of

#: Attributes with the shape of a vector environment of flattened teams.
_TEAM_ATTRIBUTES: Final = ("n_agents", "n_games")

Value = TypeVar("Value")


def chosen_indices(indices: int | Iterable[int] | None, n: int, kind: str = "row") -> list[int]:
    """
    Return the selected indices out of n rows (or games).

    :param indices: one, several, or None for all; negative ones count from the end
    :param kind: ``"row"`` or ``"game"``, for the message
    :raises ValueError: for an index out of range
    """
    listed = range(n) if indices is None else [indices] if isinstance(indices, Integral) else indices
    chosen = [int(index) for index in cast(Iterable[int], listed)]
    for index in chosen:
        if not -n <= index < n:
            raise ValueError(f"there is no {kind} {index}: expected 0 to {n - 1}")
    return [index % n for index in chosen]


class TeamVecEnv(VecEnv):
    """
    Base of vector environments with one row per agent: row ``e * N + i`` is agent ``i`` of game ``e``.

    :param observation_space: of a row
    :param action_space: of a row
    :param seed: see :meth:`seed`
    """

    #: N names of the agents.
    possible_agents: list[Any]
    #: Whether an episode has begun, and the actions of its next step.
    _begun = False
    _actions: Array | None = None

    def __init__(
        self,
        n_games: int,
        n_agents: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        seed: int | None,
    ) -> None:
        self.n_games = n_games
        self.n_agents = n_agents
        super().__init__(n_games * n_agents, observation_space, action_space)
        self.seed(seed)

    def settings(self) -> dict[str, Any]:
        """Return what determines the games except their seeds, as plain data: a run resumes only with equal ones."""
        return {}

    def per_row(self, of_games: Iterable[Value]) -> list[Value]:
        """Repeat one value per game for each row of the game."""
        return [value for value in of_games for _ in range(self.n_agents)]

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """
        Set the seeds of the games for the next reset; later episodes continue each game's random stream.

        :param seed: game ``e`` starts from ``game_seeds(seed, E)[e]``; None for fresh entropy
        :return: (B,) the seed of each row's game
        """
        chosen = game_seeds(seed, self.n_games)
        #: Last seeds of the games, which distinguish evaluation from training; None if drawn at random.
        self.seeded_with: tuple[int | None, ...] = (None,) * self.n_games if seed is None else tuple(chosen)
        #: Seeds for the next reset; None continues the games' random streams.
        self._next_seeds: list[int] | None = chosen
        return self.per_row(chosen)

    def step_async(self, actions: npt.ArrayLike) -> None:
        """
        Store the actions of the next step.

        :param actions: actions of the B rows; those of agents that have ended are ignored
        :raises ValueError: if one is not in the action space; no game is stepped then
        """
        if not self._begun:
            raise ValueError("no episode has begun (or one was stopped by an error): call reset() before step()")
        self._actions = self.checked_actions(actions)

    def actions_of_step(self) -> Array:
        """Return the actions of the step that has been started, which is over then."""
        if self._actions is None:
            raise RuntimeError("no step has been started: call step_async(actions) before step_wait()")
        actions, self._actions = self._actions, None
        return actions

    def checked_actions(self, actions: npt.ArrayLike) -> Array:
        """
        Check the actions of all rows and convert them to the dtype of their space.

        :param actions: (B, ...)
        :return: a copy
        :raises ValueError: naming the first row with actions that are not in the space
        """
        space, array = self.action_space, np.asarray(actions)
        shape, dtype = (self.num_envs, *(space.shape or ())), np.dtype(space.dtype)
        # SB3's policies give floats for MultiBinary and for every Box.
        kinds = {spaces.MultiBinary: "biuf", spaces.Box: "fiu"}.get(type(space), "iu")
        if array.shape != shape or array.dtype.kind not in kinds:
            raise ValueError(
                f"expected actions from {space} for {shape[0]} rows, {dtype} of shape {shape}, "
                f"got {array.dtype} of shape {array.shape}"
            )
        if dtype.kind == "f":  # bounds are rounded to the dtype, so actions must be before they are compared
            with np.errstate(over="ignore"):
                array = array.astype(dtype, copy=False)
        elif array.dtype.kind == "f" and isinstance(space, spaces.Box):
            array = np.rint(array)
        low, high = bounds_of(space)
        inside = (array >= low) & (array <= high)
        if isinstance(space, spaces.MultiBinary):
            inside &= (array == 0) | (array == 1)
        if not inside.all():
            row = int(np.argwhere(~inside)[0, 0])
            game, agent = divmod(row, self.n_agents)
            name = self.possible_agents[agent]
            raise ValueError(f"expected actions from {space}, got {array[row]} in row {row} (game {game}, {name})")
        return np.array(array, dtype=dtype)  # a copy: the caller may reuse its array

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """
        Set the options of the next reset.

        :param options: one dict for all games, or a list with one per row, of which a game takes that of its first row
        """
        if isinstance(options, (list, tuple)) and len(options) != self.num_envs:
            raise ValueError(
                f"expected a dict for all games or a list of {self.num_envs} dicts, one per row ({self.n_games} games "
                f"of {self.n_agents} agents), got {len(options)}"
            )
        super().set_options(options)

    def game_method(
        self, method_name: str, *args: Any, games: int | Iterable[int] | None = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method once per game of ``games``, None for all; return one result per game."""
        raise NotImplementedError

    def get_images(self) -> Sequence[npt.NDArray[Any] | None]:
        """Return one picture per row, None unless the render mode is ``"rgb_array"``; rows of a game share one."""
        return self.per_row(self.game_method("render") if self.render_mode == "rgb_array" else [None] * self.n_games)

    def render(self, mode: str | None = None) -> npt.NDArray[Any] | None:
        """
        Draw every game once.

        :param mode: None, or the environment's own
        :return: one picture of all games for ``"rgb_array"``, else None
        """
        if self.render_mode is None or mode not in (None, self.render_mode):
            return super().render(mode)  # raises an explaining error
        pictures = self.game_method("render")
        return tile_images(pictures) if self.render_mode == "rgb_array" else None


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

    :return: N, or None if no layer states it
    """
    *_, innermost = layers(venv)
    stating = (layer for layer in layers(venv) if _has_own(layer, "n_agents"))
    value = getattr(next(stating, innermost), "n_agents", None)
    return None if value is None else check_count("n_agents", value)


def _has_own(layer: VecEnv, name: str) -> bool:
    return name in vars(layer) or hasattr(type(layer), name)


def shares_reward(venv: VecEnv) -> bool:
    """
    Return whether all agents of a team are known to receive the same reward.

    Layers with an attribute ``shares_reward`` say so: ``SharedReward``, HECOGrid, SMAX, Overcooked.
    """
    found: list[Any] = [layer for layer in layers(venv) if _has_own(layer, "shares_reward")]
    return any(layer.shares_reward for layer in found)


def share_of_sum(venv: VecEnv) -> float:
    """
    Return the factor that makes the sum of a team's rewards, which may repeat its reward for each agent, its return.

    Layers with an attribute ``share_of_sum`` say so: ``TeamMonitor`` and ``SharedReward``.
    """
    found: list[Any] = [layer for layer in layers(venv) if _has_own(layer, "share_of_sum")]
    return math.prod(layer.share_of_sum for layer in found)


def require_n_agents(venv: VecEnv, n_agents: int | None = None) -> int:
    """
    Return N of a vector environment of flattened teams, checked against its number of rows.

    :param n_agents: N if known; None reads it from the environment
    :raises ValueError: if N is unknown, contradicts the environment or does not divide B
    """
    if not isinstance(venv, VecEnv):
        raise ValueError(
            f"expected a VecEnv of flattened teams, got {reprlib.repr(venv)}; build it with sb3_saf.make_team_env(...)"
        )
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


def agent_names(venv: VecEnv) -> list[str]:
    """Return the names of the N agents, in index order; their indices if the environment does not name them."""
    n_agents = require_n_agents(venv)
    named = (vars(layer)["possible_agents"] for layer in layers(venv) if "possible_agents" in vars(layer))
    return [str(name) for name in next(named, range(n_agents))]


def team_dones(dones: Array, n_agents: int, alone: bool = False) -> npt.NDArray[np.bool_]:
    """
    Return which games have ended.

    :param dones: (B,) one flag per row, of any dtype
    :param alone: whether rows may be done before their team, as those of agents that a time limit has stopped are above
        ``CentralizedValueWrapper(time_limit="bootstrap")``
    :return: (E,)
    :raises ValueError: if the flags differ within a team
    """
    by_game = np.asarray(dones).astype(bool).reshape(-1, n_agents)
    if not by_game.any():  # as at most steps
        return np.zeros(len(by_game), dtype=np.bool_)
    ended = np.asarray(by_game.all(axis=1))
    differ = by_game.any(axis=1) & ~ended
    if differ.any() and not alone:
        game = int(differ.argmax())
        raise ValueError(
            f"expected one done flag for a whole team, got {by_game[game].tolist()} for the agents of game {game}; "
            "a team episode ends for all agents at once: keep agents that are out of the game as idle rows until then "
            "(sb3_saf.make_team_env does so), or check n_agents and the order of rows (game-major, then agent)"
        )
    return ended


def episode_value(infos: Iterable[Mapping[str, Any]], key: str) -> Any:
    """
    Return an entry that is of the whole episode from the last infos of a game's agents; None if none of them has it.

    :param key: its name; ``"is_success"`` is whether all agents that report it succeeded
    """
    values = [info[key] for info in infos if info.get(key) is not None]
    if key == IS_SUCCESS and values:
        return all(bool(np.all(value)) for value in values)  # also a list of one for each agent
    return values[0] if values else None


def check_other_games(training: VecEnv, evaluation: VecEnv) -> None:
    """
    Check that evaluation does not use the games of training.

    :param training: environment of teams; one without an attribute ``seeded_with`` passes
    :raises ValueError: if both are the same games, or contain one with the same seed
    """
    if [*layers(training)][-1] is [*layers(evaluation)][-1]:
        raise ValueError("expected games of evaluation that are not trained on, got the games of training themselves")
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

    :param values: (B, ...) one entry per row
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
    entries, others = values[row].reshape(-1), int(bad.sum()) - 1
    raise NonFiniteError(
        f"{name} must be finite, got {entries[~np.isfinite(entries)][0]} at step {step} for agent {agent} of game "
        f"{game}{f' (and {others} more rows)' if others else ''}; repair the environment, learning from it would ruin "
        "the model"
    )


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
        n_agents = require_n_agents(venv, n_agents)
        super().__init__(venv, observation_space=observation_space)
        self.n_agents = n_agents
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
            return [vars(self)[attr_name] for _ in chosen_indices(indices, self.num_envs)]
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
        return [False for _ in chosen_indices(indices, self.num_envs)]

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
