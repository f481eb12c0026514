"""Any PettingZoo ParallelEnv as a Stable-Baselines3 VecEnv, through SuperSuit, with SuperSuit's faults repaired."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import partial
from numbers import Integral
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import (
    VecEnv,
    VecEnvIndices,
    VecEnvObs,
    VecEnvStepReturn,
    tile_images,
)

from hecogrid_envs.seeding import game_seeds
from hecogrid_envs.supersuit_blueprint import Blueprint, MakeEnv
from hecogrid_envs.supersuit_game import FAILED_STEP, REPLY, RESET_INFOS, STEP_INFO, Game, Info, Letter
from hecogrid_envs.supersuit_signals import AskMasks
from hecogrid_envs.supersuit_stack import build_stack, no_reply


class SuperSuitVecEnv(VecEnv):
    """
    Games of a PettingZoo ParallelEnv as rows of one VecEnv, flattened by SuperSuit.

    Rows are game-major, then agent: row ``game * N + agent``, agents in the order of ``possible_agents``. An episode
    is a team's: its N rows are done together, when its last agent has ended. The row of an agent that ended earlier
    (or has not joined) shows zeros, gets no reward, and its infos hold ``"active": False``; the info of the step at
    which it ended holds its ``"terminal_observation"``.

    Infos of done rows hold ``"terminal_observation"`` and ``"TimeLimit.truncated"`` (True if that row's agent was
    truncated and not terminated at that step); reset infos are in ``reset_infos`` only.

    ``get_attr``, ``set_attr``, ``env_method``, ``env_is_wrapped`` and ``get_images`` take and return rows, as SB3's
    callers expect; what is meant is the row's game. So ``env_method`` without indices calls a game's method N times:
    for a method that changes the game use :meth:`game_method`. ``action_masks`` is the exception, for sb3-contrib:
    each game is asked once, and if it answers with a dict by agent, each row gets its own agent's mask.

    On request rows carry signals. The observation of a row is then a Dict of ``"obs"``, the agent's own observation,
    and ``"active"``, ``"action_mask"``, ``"state"``; see :class:`~hecogrid_envs.supersuit_signals.Signals`.

    An exception in a game comes out of the bridge as it is, also from a worker process; afterwards call ``reset``.

    :param make_env: a function that makes the environment, or an environment; each game gets its own copy of it.
        For worker processes it must be possible to pickle it with cloudpickle
    :param n_games: E, number of games
    :param seed: of the games, as in :meth:`seed`
    :param n_cpus: number of worker processes; 1 keeps all games in this process
    :param active: whether rows tell if their agent takes part
    :param action_masks: None leaves observations as they are. ``"auto"`` shows masks in rows if the game gives any, in
        observations of the form {"observation", "action_mask"} or in ``infos[agent]["action_mask"]``, True insists on
        them, False shows none; all three take observations out of that form
    :param state: whether rows show the game's ``state()``
    :raises ValueError: if the environment is no ParallelEnv, cannot be copied, its agents differ in their spaces, or
        it does not give the signals
    """

    def __init__(
        self,
        make_env: MakeEnv,
        n_games: int,
        seed: int | None = None,
        n_cpus: int = 1,
        active: bool = False,
        action_masks: AskMasks | None = None,
        state: bool = False,
    ):
        _check_count("n_games", n_games)
        _check_count("n_cpus", n_cpus)
        blueprint = Blueprint.of(make_env, active, action_masks, state, int(n_cpus))
        self.possible_agents = list(blueprint.agents)
        self.n_agents = len(self.possible_agents)
        self.n_games = int(n_games)
        self._begun = False
        self._stepping = False
        self._stack = build_stack(blueprint, self.n_games, int(n_cpus))
        try:
            self._check_games_differ()
            super().__init__(self.n_games * self.n_agents, blueprint.row_space, blueprint.action_space)
            self.seed(seed)
        except BaseException:
            self.close()
            raise

    def _check_games_differ(self) -> None:
        count = Counter(self._ask(Game.identity))
        if max(count.values()) > 1:
            raise ValueError(
                "expected a function that makes a new environment at each call, got one that returned the same object "
                f"for {max(count.values())} games"
            )

    # ---- episodes

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """
        Seed all games, at the next reset; later episodes go on with each game's own random stream.

        :param seed: game ``i`` gets ``hecogrid_envs.seeding.game_seeds(seed, E)[i]``, whatever the number of
            processes; None for fresh entropy
        :return: for each row, the seed of its game
        """
        if seed is None:
            seed = cast(int, np.random.SeedSequence().entropy)
        if isinstance(seed, bool) or not isinstance(seed, Integral) or seed < 0:
            raise ValueError(f"seed must be an integer, 0 or larger, or None, got {seed!r}")
        #: Seeds of the games as they were last chosen, by which evaluation is told from training.
        self.seeded_with = tuple(game_seeds(int(seed), self.n_games))
        self._seeds = [game_seed for game_seed in self.seeded_with for _ in range(self.n_agents)]
        return self._seeds

    def set_options(self, options: list[Info] | Info | None = None) -> None:
        """
        Set the options of the next reset.

        :param options: for all games, or a list with those for each row, where a game takes those of its first row
        """
        if isinstance(options, (list, tuple)) and len(options) != self.num_envs:
            raise ValueError(
                f"expected a dict for all games or a list of {self.num_envs} dicts, one per row ({self.n_games} games "
                f"of {self.n_agents} agents), got {len(options)}"
            )
        super().set_options(options)

    def reset(self) -> VecEnvObs:
        """
        Begin an episode in every game.

        :return: observations of the B rows
        """
        if self._stepping:  # SB3: a reset cancels the step
            with suppress(Exception):
                self.step_wait()
        first_rows = range(0, self.num_envs, self.n_agents)
        letters: list[Letter] = [
            partial(Game.begin, seed=self._seeds[row], options=self._options[row] or None) for row in first_rows
        ]
        self._begun = False
        observations, infos_by_game = self._exchange(letters)
        self.reset_infos = [info for infos in infos_by_game for info in infos]
        self._reset_seeds()
        self._reset_options()
        self._begun = True
        return cast(VecEnvObs, observations)

    def step_async(self, actions: npt.ArrayLike) -> None:
        """
        Start a step.

        :param actions: of the B rows; those of agents that have ended are ignored
        :raises ValueError: if one is not in the action space; no game has been stepped then
        """
        self._check_free()
        if not self._begun:
            raise RuntimeError("no episode has begun (or one was stopped by an error): call reset() before step()")
        self._stack.step_async(_checked_actions(self.action_space, self.possible_agents, self.n_games, actions))
        self._stepping = True

    def step_wait(self) -> VecEnvStepReturn:
        """
        Finish the step.

        :return: observations, rewards (float32), dones (bool) and infos of the B rows
        """
        if not self._stepping:
            raise RuntimeError("no step has been started: call step_async(actions) before step_wait()")
        self._stepping = False
        step = self._stack.step_wait()
        terminations, truncations = step.terminations.astype(bool), step.truncations.astype(bool)
        dones = terminations | truncations
        self._unpack_games(step.infos, dones)
        infos: list[Info] = [
            self._stack.unpack(packed[STEP_INFO], row // self.n_agents) if STEP_INFO in packed else {}
            for row, packed in enumerate(step.infos)
        ]
        for row in np.flatnonzero(dones).tolist():
            infos[row]["TimeLimit.truncated"] = bool(truncations[row] and not terminations[row])
            infos[row]["terminal_observation"] = step.infos[row]["terminal_observation"]
        return step.observations, step.rewards.astype(np.float32), dones, infos

    def _unpack_games(self, infos: Sequence[Info], dones: npt.NDArray[np.bool_]) -> None:
        """Take out what whole games sent along with a step: errors, and reset infos of the next episode."""
        try:
            for game, row in enumerate(range(0, self.num_envs, self.n_agents)):
                self._stack.unpack(infos[row].get(FAILED_STEP), game)
                if dones[row]:
                    self.reset_infos[row : row + self.n_agents] = self._stack.unpack(infos[row][RESET_INFOS], game)
        except BaseException:
            self._begun = False
            raise

    def close(self) -> None:
        """Close all games and end the worker processes; a second time does nothing."""
        if self._stack.closed is not None:
            return
        infos = self._stack.close()
        for game in range(self.n_games):
            self._stack.unpack(infos[game * self.n_agents].get(REPLY), game)

    # ---- letters

    def _check_free(self) -> None:
        if self._stack.closed is not None:
            raise RuntimeError(f"the vector environment is closed ({self._stack.closed}); make a new one")
        if self._stepping:
            raise RuntimeError("a step is under way: call step_wait() first")

    def _exchange(self, letters: Sequence[Letter]) -> tuple[Any, list[Any]]:
        """Give each game its letter; return the observations and each game's reply."""
        self._check_free()
        observations, infos = self._stack.exchange(letters)
        packed = [infos[game * self.n_agents].get(REPLY) for game in range(self.n_games)]
        return observations, [self._stack.unpack(reply, game) for game, reply in enumerate(packed)]

    def _ask(self, letter: Letter, games: Iterable[int] | None = None) -> list[Any]:
        """Give the same letter to some games; return their replies by game, None from the others."""
        chosen = set(range(self.n_games) if games is None else games)
        return self._exchange([letter if game in chosen else no_reply for game in range(self.n_games)])[1]

    def _rows(self, indices: VecEnvIndices) -> list[int]:
        listed = [indices] if isinstance(indices, Integral) else self._get_indices(indices)
        return _checked_indices("row", listed, self.num_envs)

    def _ask_rows(self, letter: Letter, indices: VecEnvIndices) -> list[Any]:
        """Give a letter to the games of some rows, once; return for each row the reply of its game."""
        games = [row // self.n_agents for row in self._rows(indices)]
        replies = self._ask(letter, games)
        return [replies[game] for game in games]

    # ---- what SB3 asks for by row

    def has_attr(self, attr_name: str) -> bool:
        """
        Tell whether all games have an attribute.

        :param attr_name: of the game, or of a wrapper around it
        """
        return all(self._ask(partial(Game.has_attr, name=attr_name)))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        Get an attribute of the rows' games; from a worker process comes a copy.

        :param attr_name: of the game, or of a wrapper around it
        :param indices: rows
        :return: one value per row
        """
        return self._ask_rows(partial(Game.get_attr, name=attr_name), indices)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        Set an attribute of the rows' games, once per game.

        :param attr_name: of the game, or of the wrapper around it that has it
        :param value: the new value
        :param indices: rows
        """
        self._ask_rows(partial(Game.set_attr, name=attr_name, value=value), indices)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        Call a method of the rows' games, once for every row: a game with N rows among the indices is called N times.

        :param method_name: of the game, or of a wrapper around it
        :param method_args: positional arguments
        :param indices: rows
        :param method_kwargs: keyword arguments
        :return: one result per row
        """
        rows = self._rows(indices)
        if method_name == "action_masks" and not method_args and not method_kwargs:
            masks = self._ask(Game.action_masks, [row // self.n_agents for row in rows])
            return [masks[row // self.n_agents][row % self.n_agents] for row in rows]
        calls = Counter(row // self.n_agents for row in rows)
        call = partial(Game.call, name=method_name, args=method_args, kwargs=method_kwargs)
        letters: list[Letter] = [
            partial(call, times=calls[game]) if calls[game] else no_reply for game in range(self.n_games)
        ]
        results = [iter(reply or ()) for reply in self._exchange(letters)[1]]
        return [next(results[row // self.n_agents]) for row in rows]

    def game_method(self, name: str, *args: Any, games: int | Iterable[int] | None = None, **kwargs: Any) -> list[Any]:
        """
        Call a method of games, once each.

        :param name: of the method
        :param args: positional arguments
        :param games: which games, None for all
        :param kwargs: keyword arguments
        :return: one result per game
        """
        listed = range(self.n_games) if games is None else [games] if isinstance(games, Integral) else games
        chosen = _checked_indices("game", cast(Iterable[int], listed), self.n_games)
        replies = self._ask(partial(Game.call, name=name, args=args, kwargs=kwargs), chosen)
        return [replies[game][0] for game in chosen]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """
        Tell whether the rows' games are wrapped.

        :param wrapper_class: a wrapper
        :param indices: rows
        :return: one answer per row
        """
        name = partial(Game.is_wrapped, module=wrapper_class.__module__, qualname=wrapper_class.__qualname__)
        return self._ask_rows(name, indices)

    def get_images(self) -> Sequence[npt.NDArray[Any] | None]:
        """
        Draw every game.

        :return: one picture per row; rows of one game share it. None if the render mode is not ``"rgb_array"``
        """
        pictures = self._pictures() if self.render_mode == "rgb_array" else [None] * self.n_games
        return [picture for picture in pictures for _ in range(self.n_agents)]

    def _pictures(self) -> list[npt.NDArray[Any] | None]:
        return self.game_method("render")

    def render(self, mode: str | None = None) -> npt.NDArray[Any] | None:
        """
        Draw every game once.

        :param mode: None, or the environment's own
        :return: one picture of all games for ``"rgb_array"``, else None
        """
        if self.render_mode is None or mode not in (None, self.render_mode):
            return super().render(mode)  # which explains what is wrong
        pictures = self._pictures()
        return tile_images(cast(Any, pictures)) if self.render_mode == "rgb_array" else None


def supersuit_vec_env(
    make_env: MakeEnv,
    n_games: int,
    seed: int | None = None,
    n_cpus: int = 1,
    active: bool = False,
    action_masks: AskMasks | None = None,
    state: bool = False,
) -> SuperSuitVecEnv:
    """
    Flatten games of a PettingZoo ParallelEnv into the rows of one VecEnv.

    :param make_env: a function that makes the environment, or an environment
    :param n_games: E, number of games
    :param seed: of the games
    :param n_cpus: number of worker processes; 1 keeps all games in this process
    :param active: see :class:`SuperSuitVecEnv`
    :param action_masks: see :class:`SuperSuitVecEnv`
    :param state: see :class:`SuperSuitVecEnv`
    """
    return SuperSuitVecEnv(make_env, n_games, seed, n_cpus, active, action_masks, state)


def _check_count(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
        raise ValueError(f"{name} must be an integer, 1 or larger, got {value!r}")


def _checked_indices(kind: str, indices: Iterable[int], n: int) -> list[int]:
    """Count negative indices from the end."""
    listed = [int(index) for index in indices]
    for index in listed:
        if not -n <= index < n:
            raise ValueError(f"there is no {kind} {index}: expected 0 to {n - 1}")
    return [index % n for index in listed]


def _checked_actions(
    space: spaces.Space[Any], agents: Sequence[Any], n_games: int, actions: npt.ArrayLike
) -> npt.NDArray[Any]:
    """Bring the actions of all rows into the dtype of their space, or say what is wrong with them."""
    array = np.asarray(actions)
    shape = (n_games * len(agents), *cast(tuple[int, ...], space.shape))
    dtype = np.dtype(space.dtype)
    kinds = "fiu" if dtype.kind == "f" else "biu" if isinstance(space, spaces.MultiBinary) else "iu"
    if array.shape != shape or array.dtype.kind not in kinds:
        raise ValueError(
            f"expected actions from {space} for {shape[0]} rows, {dtype} of shape {shape}, "
            f"got {array.dtype} of shape {array.shape}"
        )
    if dtype.kind == "f":  # bounds are rounded to the dtype, so actions must be before they are compared
        with np.errstate(over="ignore"):
            array = array.astype(dtype, copy=False)
    low, high = _bounds(space)
    outside = np.argwhere(~((array >= low) & (array <= high)))
    if len(outside):
        row = int(outside[0, 0])
        game, agent = divmod(row, len(agents))
        raise ValueError(f"expected actions from {space}, got {array[row]} in row {row} (game {game}, {agents[agent]})")
    return array.astype(dtype, copy=False)


def _bounds(space: spaces.Space[Any]) -> tuple[Any, Any]:
    """Smallest and largest value of each entry of an action, both included."""
    if isinstance(space, spaces.Discrete):
        return space.start, space.start + space.n - 1
    if isinstance(space, spaces.MultiDiscrete):
        return space.start, space.start + space.nvec - 1
    if isinstance(space, spaces.MultiBinary):
        return 0, 1
    assert isinstance(space, spaces.Box)
    return space.low, space.high
