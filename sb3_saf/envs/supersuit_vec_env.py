"""Any PettingZoo ParallelEnv as a Stable-Baselines3 VecEnv, through SuperSuit."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt
from pettingzoo import AECEnv, ParallelEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_saf.envs import audit
from sb3_saf.envs.audit import Trial, check_is_parallel
from sb3_saf.envs.game_copies import check_signatures, common_settings, sign_games
from sb3_saf.envs.game_reader import AskMasks, GameReader, MakeEnv
from sb3_saf.envs.gymnasium_team import as_parallel
from sb3_saf.envs.supersuit_games import TeamConcatVecEnv, game_factory, masks_of_method
from sb3_saf.envs.supersuit_workers import WorkerGames
from sb3_saf.teams.checks import check_count
from sb3_saf.teams.vec_env import TeamVecEnv, chosen_indices

#: Episodes of each game after which games that began alike are taken to ignore their seeds.
_N_BEGINNINGS: Final = 10


class SuperSuitVecEnv(TeamVecEnv):
    """
    Games of a PettingZoo ParallelEnv as rows of one VecEnv, on SuperSuit's classes as base classes.

    Agents are in the order of ``possible_agents``. The N rows of a team are done together, when its last agent has
    ended. The row of an agent that ended earlier (or has not joined) holds zeros, and its infos hold ``"active":
    False``; its reward is what the game pays it all the same. The info of the step at which an agent ended holds its
    ``"terminal_observation"``, the last row, and ``"TimeLimit.truncated"`` (True if it was truncated and not
    terminated), and those of all rows when the game is over. Reset infos are in ``reset_infos`` only. A game's own
    infos named ``"episode"``, ``"active"``, ``"terminal_observation"`` or ``"TimeLimit.truncated"``, which
    Stable-Baselines3 or this package uses, are renamed: ``"game_episode"``, ...

    Dicts and Tuples of observations become one vector, as by ``gymnasium.spaces.flatten``, and float64 becomes float32.
    Agents with different spaces get equal ones: observations are padded with zeros, discrete actions that an agent
    lacks are masked and refused, and of a vector only the agent's own entries reach the game, clipped to its bounds.
    Discrete and MultiDiscrete are counted from 0 in rows, whatever the ``start`` of the game's space. Actions of a Box
    of integers may be given as floats, which are rounded.

    ``get_attr``, ``set_attr``, ``env_method``, ``env_is_wrapped`` and ``get_images`` take and return rows, as SB3's
    callers expect, and apply to the row's game. ``env_method`` without indices therefore calls a game's method N times:
    for a method that changes the game use :meth:`game_method`. ``action_masks`` is the exception, for sb3-contrib: it
    is called once per game, and if it returns a dict by agent, each row gets its own agent's mask.

    With signals, the observation of a row is a Dict (see :class:`~sb3_saf.teams.rows.TeamSpaces`). In the last one of
    an episode ``"active"`` is 1 if the agent was stopped by a time limit; masks of agents that do not act are zeros.

    At construction a trial episode of a copy is audited (:func:`sb3_saf.check_team_env`); in later steps shapes, and
    the bounds of integers, which index tables. An exception in a game is raised unchanged, also from a worker process;
    call ``reset`` afterwards.

    :param make_env: a function that makes the environment, or an environment, which is copied for each game. For worker
        processes cloudpickle must be able to pickle it
    :param seed: seed of the games, as in :meth:`seed`
    :param n_cpus: number of worker processes; 1 keeps all games in this process
    :param active: whether rows have ``"active"``
    :param action_masks: ``"auto"`` adds masks to rows if the game gives any, in Dicts of observations or in
        ``infos[agent]["action_mask"]``, or if agents differ in their actions; True requires them, False adds none. They
        are taken out of the observations
    :param state: whether rows have the game's ``state()``
    :raises ValueError: if the environment is no ParallelEnv or breaks its rules, cannot be copied, its agents have
        actions that one policy cannot take, or a requested signal is missing
    """

    def __init__(
        self,
        make_env: MakeEnv,
        n_games: int,
        seed: int | None = None,
        n_cpus: int = 1,
        active: bool = False,
        action_masks: AskMasks = "auto",
        state: bool = False,
    ) -> None:
        n_games = check_count("n_games", n_games)
        n_cpus = min(check_count("n_cpus", n_cpus), n_games)
        self._make_game, reader = _factory_and_reader(make_env, n_cpus, active, action_masks, state)
        for note in reader.notes:
            warnings.warn(note, UserWarning, stacklevel=2)
        self.possible_agents = list(reader.agents)
        #: How each agent's observations and actions become those of rows, for models that act on the game's own.
        self.conversions = tuple(reader.conversions.values())
        self._closed = self._has_warned = False
        #: Hashes of the first rows of each game's first episodes, to find games that ignore their seeds.
        self._beginnings: list[list[int]] = []
        self._games: TeamConcatVecEnv | WorkerGames
        if n_cpus == 1:
            self._games = TeamConcatVecEnv(self._make_game, reader, range(n_games))
        else:
            self._games = WorkerGames(self._make_game, reader, n_games, n_cpus)
        try:
            super().__init__(n_games, len(reader.agents), reader.rows.to_row_space(), reader.action_space, seed)
        except BaseException:
            self.close()
            raise

    # ---- episodes

    def reset(self) -> VecEnvObs:
        """Begin an episode in every game; a pending step is cancelled."""
        self._check_open()
        self._begun, self._actions = False, None
        options = [own or None for own in self._options[:: self.n_agents]]
        observations, self.reset_infos = self._run("reset_all", self._seeds_of_games(), options)
        self._beginnings = [[] for _ in range(self.n_games)] if self._next_seeds and self.n_games > 1 else []
        self._note_beginnings(observations, range(self.n_games))
        self._next_seeds = None
        self._reset_options()
        self._begun = True
        return cast(VecEnvObs, observations)

    def step_async(self, actions: npt.ArrayLike) -> None:
        """Store the actions of the next step (see the base class)."""
        self._check_open()
        super().step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Step all games; return observations, rewards (float32), dones (bool) and infos of the B rows."""
        actions = self.actions_of_step()
        self._begun = False
        observations, rewards, dones, infos, self.reset_infos, notes = self._run("play", actions)
        self._begun = True
        notes = [*notes, *self._note_beginnings(observations, np.flatnonzero(dones[:: self.n_agents]))]
        if notes and not self._has_warned:
            self._has_warned = True
            warnings.warn(f"{notes[0]}; later warnings are not reported", UserWarning, stacklevel=2)
        return observations, rewards, dones, infos

    def _run(self, name: str, *args: Any) -> list[Any]:
        """Call a method of :class:`TeamConcatVecEnv` in each process; return its results for all rows."""
        return [_joined(parts) for parts in zip(*self._games.run(name, *args), strict=True)]

    def _note_beginnings(self, observations: Any, begun: Iterable[int]) -> list[str]:
        """Return a warning if all games began alike in ten episodes that differ."""
        if not self._beginnings:
            return []
        parts = observations.values() if isinstance(observations, dict) else [observations]
        for game in begun:
            rows = slice(game * self.n_agents, (game + 1) * self.n_agents)
            self._beginnings[game].append(hash(b"".join(part[rows].tobytes() for part in parts)))
        if min(map(len, self._beginnings)) < _N_BEGINNINGS:
            return []
        first, *others = every = [beginnings[:_N_BEGINNINGS] for beginnings in self._beginnings]
        self._beginnings = []
        are_kept = all(len(set(beginnings[1:])) == 1 for beginnings in every)
        if are_kept and len(set().union(*every)) > 1:
            return [
                f"each game began its second to last of {_N_BEGINNINGS} episodes alike, although games, or first "
                "episodes, differ: the game seems to make its generator anew at resets without a seed; if episodes "
                "should differ, make it only if seed is not None: self.rng = np.random.default_rng(seed)"
            ]
        if len(set(first)) == 1 or any(other != first for other in others):
            return []
        return [
            f"all {self.n_games} games began alike in {_N_BEGINNINGS} episodes, which differ, although their seeds are "
            "different: the game seems to ignore reset(seed=...), so that all copies play the same; draw episodes from "
            "a generator made in reset: if seed is not None: self.rng = np.random.default_rng(seed)"
        ]

    def close(self) -> None:
        """Close all games and end the worker processes; a second call does nothing."""
        if not self._closed:
            self._closed = True
            self._games.close()

    def _seeds_of_games(self) -> list[int | None]:
        return [None] * self.n_games if self._next_seeds is None else [*self._next_seeds]

    def _check_open(self) -> None:
        if self._closed:
            raise RuntimeError("the vector environment is closed (it was closed); make a new one")

    # ---- checkpoints

    def settings(self) -> dict[str, Any]:
        """Return the settings that new games keep (see the base class)."""
        return common_settings(self._make_game)

    def checkpoint_state(self) -> dict[str, Any]:
        """Copy all games; pickled ones are signed (see :mod:`sb3_saf.envs.game_copies`)."""
        self._check_open()
        snapshots = [snapshot for some in self._games.run("snapshots", self._begun) for snapshot in some]
        sign_games(snapshots)
        return {
            "seeds": list(self.seeded_with),
            "next_seeds": self._seeds_of_games(),
            "begun": self._begun,
            "warned": self._has_warned,
            "games": snapshots,
        }

    def load_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of :meth:`checkpoint_state`; ForeignGamesError for pickled games of another user."""
        check_signatures(state["games"])
        if state["begun"]:
            self._games.run("restore", state["games"])
        self.seeded_with = tuple(state["seeds"])
        self._next_seeds = None if None in state["next_seeds"] else list(state["next_seeds"])
        self._begun, self._has_warned, self._actions = state["begun"], state["warned"], None
        self.reset_infos = [{} for _ in range(self.num_envs)]

    # ---- queries by row

    def _ask(self, games: Iterable[int], function: Callable[..., Any], *args: Any) -> list[Any]:
        """Call a function with some games, once each, and return one answer for each entry of ``games``."""
        self._check_open()
        listed = list(games)
        answers = dict(chain.from_iterable(part.items() for part in self._games.run("ask", listed, function, *args)))
        return [answers[game] for game in listed]

    def _games_of(self, rows: VecEnvIndices) -> list[int]:
        return [row // self.n_agents for row in chosen_indices(rows, self.num_envs)]

    def has_attr(self, attr_name: str) -> bool:
        """Return whether all games, or wrappers around them, have an attribute; a method if it is ``action_masks``."""
        if attr_name == "action_masks":
            return all(self._ask(range(self.n_games), audit.has_masks_method))
        return all(self._ask(range(self.n_games), audit.has_game_attribute, attr_name))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Get an attribute of the rows' games, or of wrappers around them; worker processes return copies."""
        return self._ask(self._games_of(indices), audit.game_attribute, attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the rows' games, or of the wrappers around them that have it; once per game."""
        self._ask(self._games_of(indices), audit.set_game_attribute, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the rows' games, once for every row; ``action_masks`` once per game (see the class)."""
        rows = chosen_indices(indices, self.num_envs)
        if method_name == "action_masks" and not method_args and not method_kwargs:
            masks = self._ask(self._games_of(rows), masks_of_method, self.possible_agents, self.conversions)
            return [mask[row % self.n_agents] for row, mask in zip(rows, masks, strict=True)]
        call = (_call_method, method_name, method_args, method_kwargs)
        return [self._ask([game], *call)[0] for game in self._games_of(rows)]

    def game_method(
        self, method_name: str, *args: Any, games: int | Iterable[int] | None = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method once per game (see the base class)."""
        return self._ask(chosen_indices(games, self.n_games, "game"), _call_method, method_name, args, kwargs)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Return whether the rows' games are wrapped in a wrapper."""
        return self._ask(self._games_of(indices), _is_wrapped, wrapper_class)


def _factory_and_reader(
    make_env: MakeEnv, n_cpus: int, active: bool, action_masks: AskMasks, state: bool
) -> tuple[Callable[[], Any], GameReader]:
    """Audit a copy of the game; return a function that makes games, and their reader."""
    make_env = as_parallel(make_env)
    is_factory = not isinstance(make_env, (ParallelEnv, AECEnv)) and callable(make_env)
    if not is_factory:
        check_is_parallel(make_env, is_factory)
    make_game = game_factory(make_env, is_factory, n_cpus)
    example = make_game()
    try:
        check_is_parallel(example, is_factory)
        trial = Trial(example)
        trial.play()
        return make_game, GameReader(trial, active, action_masks, state)
    finally:
        with suppress(Exception):  # of games that must be reset before they are closed
            example.close()


def _call_method(env: Any, name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
    return audit.game_attribute(env, name)(*args, **kwargs)


def _is_wrapped(env: Any, wrapper_class: type[Any]) -> bool:
    return any(isinstance(layer, wrapper_class) for layer in audit.layers_of(env))


def _joined(parts: Sequence[Any]) -> Any:
    """Join what the processes gave for their rows: arrays, arrays by key, or lists."""
    if len(parts) == 1:
        return parts[0]
    if isinstance(parts[0], dict):
        return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    return list(chain.from_iterable(parts)) if isinstance(parts[0], list) else np.concatenate(parts)
