"""Any PettingZoo ParallelEnv as a Stable-Baselines3 VecEnv, through SuperSuit."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_saf.checkpoints.checks import check_array, check_keys, check_like, check_list, check_whole
from sb3_saf.envs import game_layers
from sb3_saf.envs.game_copies import check_signature, signature
from sb3_saf.envs.game_form import AskMasks, GameForm, MakeEnv, Signals, check_is_parallel, first_infos_of, game_form
from sb3_saf.envs.space_reader import checked_actions, counted_from_zero, first_value
from sb3_saf.envs.supersuit_games import GameSource, Question, TeamConcatVecEnv
from sb3_saf.envs.supersuit_workers import WorkerGames
from sb3_saf.teams.checks import check_count
from sb3_saf.teams.conversion import AgentConversion, conversions_of
from sb3_saf.teams.rows import Array
from sb3_saf.teams.vec_env import TeamVecEnv, chosen_indices


class SuperSuitVecEnv(TeamVecEnv):
    """
    Games of a PettingZoo ParallelEnv as rows of one VecEnv, flattened by SuperSuit.

    Agents are in the order of ``possible_agents``. The N rows of a team are done together, when its last agent has
    ended. The row of an agent that ended earlier (or has not joined) holds zeros and no reward, and its infos hold
    ``"active": False``; the info of the step at which it ended holds its ``"terminal_observation"``.

    Infos of done rows hold ``"terminal_observation"`` and ``"TimeLimit.truncated"`` (True if that row's agent was
    truncated and not terminated at that step); reset infos are in ``reset_infos`` only. A game's own infos named
    ``"episode"``, ``"active"``, ``"terminal_observation"`` or ``"TimeLimit.truncated"``, which Stable-Baselines3 or
    this package uses, are renamed: ``"game_episode"``, ...

    Observations and actions of Discrete and MultiDiscrete spaces are counted from 0 in rows, whatever the ``start``
    of the game's space. Actions of a Box of integers may be given as floats, which are rounded.

    ``get_attr``, ``set_attr``, ``env_method``, ``env_is_wrapped`` and ``get_images`` take and return rows, as SB3's
    callers expect, and apply to the row's game. ``env_method`` without indices therefore calls a game's method N times:
    for a method that changes the game use :meth:`game_method`. ``action_masks`` is the exception, for sb3-contrib: it
    is called once per game, and if it returns a dict by agent, each row gets its own agent's mask.

    With signals, the observation of a row is a Dict of ``"obs"``, the agent's own observation, and

    - ``"active"``, Discrete(2): 1 while the row's agent takes part. In the last observation of an episode: 1 if the
      agent was stopped by a time limit;
    - ``"action_mask"``, MultiBinary(A): 1 for legal actions; zeros for agents that do not act;
    - ``"state"``: the game's ``state()``, in the rows of all its agents, active or not.

    An exception in a game is raised unchanged, also from a worker process; call ``reset`` afterwards.

    :param make_env: a function that makes the environment, or an environment, which is copied for each game. For worker
        processes cloudpickle must be able to pickle it
    :param n_games: E, number of games
    :param seed: seed of the games, as in :meth:`seed`
    :param n_cpus: number of worker processes; 1 keeps all games in this process
    :param active: whether rows have ``"active"``
    :param action_masks: None leaves observations unchanged. ``"auto"`` adds masks to rows if the game gives any, in
        observations of the form {"observation", "action_mask"} or in ``infos[agent]["action_mask"]``, True requires
        them, False adds none; all three split observations of that form, and flatten Dicts and Tuples of scalars and
        vectors to one vector, as ``gymnasium.spaces.flatten`` does
    :param state: whether rows have the game's ``state()``
    :raises ValueError: if the environment is no ParallelEnv, cannot be copied, its agents differ in their spaces, or a
        requested signal is missing
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
    ) -> None:
        n_games = check_count("n_games", n_games)
        n_cpus = min(check_count("n_cpus", n_cpus), n_games)
        source, form, self.conversions = _source_and_form(make_env, n_cpus, Signals(active, action_masks, state))
        self.possible_agents = list(form.agents)
        self._game_action_space = form.action_space
        self._closed = self._begun = self._has_warned = False
        self._actions: Array | None = None
        self._games = (
            TeamConcatVecEnv(source, form, range(n_games))
            if n_cpus == 1
            else WorkerGames(source, form, n_games, n_cpus)
        )
        try:
            super().__init__(
                n_games, len(form.agents), form.rows.to_row_space(), counted_from_zero(form.action_space), seed
            )
        except BaseException:
            self.close()
            raise

    # ---- episodes

    def reset(self) -> VecEnvObs:
        """Begin an episode in every game; a pending step is cancelled."""
        self._check_open()
        self._begun, self._actions = False, None
        options = [own or None for own in self._options[:: self.n_agents]]
        observations, self.reset_infos = self._games.reset_all(self._seeds_of_games(), options)
        self._next_seeds = None
        self._reset_options()
        self._begun = True
        return cast(VecEnvObs, observations)

    def step_async(self, actions: npt.ArrayLike) -> None:
        """
        Store the actions of the next step.

        :param actions: actions of the B rows; those of agents that have ended are ignored
        :raises ValueError: if one is not in the action space; no game is stepped then
        """
        self._check_open()
        if not self._begun:
            raise RuntimeError("no episode has begun (or one was stopped by an error): call reset() before step()")
        self._actions = checked_actions(self.action_space, self.possible_agents, self.num_envs, actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Step all games; return observations, rewards (float32), dones (bool) and infos of the B rows."""
        if self._actions is None:
            raise RuntimeError("no step has been started: call step_async(actions) before step_wait()")
        actions = _in_games_form(self._game_action_space, self._actions)
        self._begun, self._actions = False, None
        step = self._games.play(actions)
        self._begun = True
        for row in np.flatnonzero(step.dones).tolist():
            self.reset_infos[row] = step.reset_infos[row]
        if step.notes and not self._has_warned:
            self._has_warned = True
            warnings.warn(f"{step.notes[0]}; later ones are not reported", UserWarning, stacklevel=2)
        return step.observations, step.rewards, step.dones, step.infos

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

    def checkpoint_state(self) -> dict[str, Any]:
        """Copy all games; pickled ones are signed (see :mod:`sb3_saf.envs.game_copies`)."""
        self._check_open()
        snapshots = self._games.snapshots()
        for snapshot in snapshots:
            if "pickled" in snapshot:
                snapshot["signature"] = signature(snapshot["pickled"])
        return {
            "seeds": list(self.seeded_with),
            "next_seeds": self._seeds_of_games(),
            "begun": self._begun,
            "warned": self._has_warned,
            "games": snapshots if self._begun else [],
        }

    def check_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Check that a state is valid for these games, and that pickled games have this user's signature."""
        where = "the state of the games"
        check_keys(state, ("seeds", "next_seeds", "begun", "warned", "games"), where)
        for name in ("seeds", "next_seeds"):
            check_list(state[name], f"{name} of the games", self.n_games)
            for seed in state[name]:
                if seed is not None:
                    check_whole(seed, "the seed of a game")
        check_like([state["begun"], state["warned"]], [True, True], where)
        check_list(state["games"], where, self.n_games if state["begun"] else 0)
        for game in state["games"]:
            content = ("pickled", "signature") if "pickled" in game else ("state",)
            check_keys(game, ("n_steps", "ended", *content), "the state of a game")
            check_whole(game["n_steps"], "the steps of a game")
            check_like(game["ended"], [True] * self.n_agents, "the agents that have ended")
            if "pickled" in game:
                check_array(game["pickled"], np.shape(game["pickled"]), np.uint8, "a pickled game")
                check_signature(game["pickled"], game["signature"])

    def load_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of :meth:`checkpoint_state`."""
        self.check_checkpoint_state(state)
        if state["begun"]:
            self._games.restore(state["games"])
        self.seeded_with = tuple(state["seeds"])
        self._next_seeds = None if None in state["next_seeds"] else list(state["next_seeds"])
        self._begun, self._has_warned, self._actions = state["begun"], state["warned"], None
        self.reset_infos = [{} for _ in range(self.num_envs)]

    # ---- queries by row

    def _ask(self, questions: Sequence[Question]) -> list[Any]:
        self._check_open()
        answers = self._games.ask(questions)
        return [answers[place] for place in range(len(questions))]

    def _ask_rows(self, indices: VecEnvIndices, function: Callable[..., Any], *args: Any) -> list[Any]:
        """Query the games of some rows, once each; return for each row the answer of its game."""
        games = [row // self.n_agents for row in chosen_indices(indices, self.num_envs)]
        asked = list(dict.fromkeys(games))
        answers = dict(zip(asked, self._ask([Question(game, function, args) for game in asked]), strict=True))
        return [answers[game] for game in games]

    def has_attr(self, attr_name: str) -> bool:
        """Return whether all games, or wrappers around them, have an attribute."""
        return all(self._ask_rows(None, game_layers.has_attribute, attr_name))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Get an attribute of the rows' games, or of wrappers around them; worker processes return copies."""
        return self._ask_rows(indices, game_layers.get_attribute, attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the rows' games, or of the wrappers around them that have it; once per game."""
        self._ask_rows(indices, game_layers.set_attribute, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the rows' games, once for every row; ``action_masks`` once per game (see the class)."""
        rows = chosen_indices(indices, self.num_envs)
        if method_name == "action_masks" and not method_args and not method_kwargs:
            masks = self._ask_rows(rows, game_layers.action_masks, self.possible_agents)
            return [mask[row % self.n_agents] for row, mask in zip(rows, masks, strict=True)]
        return self._call([row // self.n_agents for row in rows], method_name, method_args, method_kwargs)

    def game_method(
        self, method_name: str, *args: Any, games: int | Iterable[int] | None = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method once per game (see the base class)."""
        return self._call(chosen_indices(games, self.n_games, "game"), method_name, args, kwargs)

    def _call(self, games: Sequence[int], *call: Any) -> list[Any]:
        return self._ask([Question(game, game_layers.call_method, call) for game in games])

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Return whether the rows' games are wrapped in a wrapper."""
        names = wrapper_class.__module__, wrapper_class.__qualname__
        return self._ask_rows(indices, game_layers.is_wrapped, *names)


def _source_and_form(
    make_env: MakeEnv, n_cpus: int, signals: Signals
) -> tuple[GameSource, GameForm, tuple[AgentConversion, ...]]:
    """Determine form and conversions of the game from an example, and return them with the source of the games."""
    is_factory = not isinstance(make_env, (ParallelEnv, AECEnv)) and callable(make_env)
    example: Any = make_env() if is_factory else make_env
    check_is_parallel(example, is_factory)
    try:
        source = GameSource(make_env, is_factory, n_cpus)
        form = game_form(example, partial(first_infos_of, source.build), signals)
        game, row_actions = getattr(example, "unequal", example), counted_from_zero(form.action_space)
        conversions = conversions_of(game, form.rows.own, row_actions, form.masks == "info" and game is example)
    finally:
        if is_factory:
            # Games may require a reset before they are closed; the example has none.
            with suppress(Exception):
                example.close()
    return source, form, conversions


def _in_games_form(space: spaces.Space[Any], actions: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Shift actions to the ``start`` of the game's space."""
    start = first_value(space)
    return (actions + start).astype(actions.dtype, copy=False) if np.any(start != 0) else actions
