"""One game as SuperSuit sees it: the repairs that sit below SuperSuit's own vector environments."""

from __future__ import annotations

import os
import pickle
import traceback
from collections.abc import Callable, Container, Mapping
from copy import deepcopy
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from hecogrid_envs import supersuit_calls
from hecogrid_envs.supersuit_blueprint import AnyParallelEnv, Blueprint, blank, fitted
from hecogrid_envs.supersuit_copies import dumps

#: Key of the letters, in the options of a reset on its way down.
LETTERS = "supersuit_bridge/letters"
#: Keys of what a game packs into the infos on their way up; the bridge unpacks all of it.
REPLY = "supersuit_bridge/reply"
STEP_INFO = "supersuit_bridge/step_info"
RESET_INFOS = "supersuit_bridge/reset_infos"
FAILED_STEP = "supersuit_bridge/failed_step"

#: Something to do with a game.
Letter: TypeAlias = "Callable[[Game], Any]"
Info: TypeAlias = "dict[str, Any]"

#: Info of an agent that does not take part: it has ended before its team, or not joined yet.
INACTIVE: Info = {"active": False}

_UNCHANGING = (type(None), bool, int, float, str, np.bool_, np.int64, np.float32, np.float64)
_MISSING = object()


class Failure(NamedTuple):
    """An exception on its way from a game to whoever called the bridge."""

    error: BaseException
    trace: str

    @classmethod
    def of(cls, error: BaseException, remote: bool) -> Failure:
        """
        Pack the exception that is being handled.

        :param error: the exception
        :param remote: whether it goes to another process; one that cannot be pickled is then told in a RuntimeError
        """
        trace = traceback.format_exc()
        if remote:
            try:
                pickle.loads(pickle.dumps(error))
            except Exception:
                error = RuntimeError(f"{type(error).__name__}: {error}")
        return cls(error, trace)


class Game(ParallelEnv[Any, Any, Any]):
    """
    A PettingZoo game below SuperSuit's ``MarkovVectorEnv``.

    Upwards it looks like a game whose agents all live until the whole team is done, so that SuperSuit does not
    stop at an agent's death. Infos go up packed, because SuperSuit mixes those of the next episode's reset into
    those of the last step.

    Whatever SuperSuit has no words for (a seed for each game, attributes, methods, pictures) comes down as a
    *letter*, a function of the game, among the options of a reset. ``ConcatVecEnv`` hands the same options to all
    its games and ``seed + i`` to its i-th: with seed 0, the seed is the game's place in the list of letters.
    Letters to a worker process are pickled, and so are the replies to them.

    :param blueprint: how to build the game. That happens at the first letter, so the spare copies that SuperSuit
        makes and drops cost nothing.
    """

    def __init__(self, blueprint: Blueprint):
        self._blueprint = blueprint
        self._env: AnyParallelEnv | None = None
        self._remote = False
        self._playing: dict[Any, None] = {}  # an ordered set
        self._ended: set[Any] = set()
        self.possible_agents = list(blueprint.agents)
        self.agents = self.possible_agents
        self.metadata = blueprint.metadata
        self.render_mode = blueprint.render_mode
        self._blank = blank(blueprint.observation_space)
        self._observations = dict.fromkeys(self.possible_agents, blank(blueprint.row_space))

    @property
    def env(self) -> AnyParallelEnv:
        """The game itself."""
        if self._env is None:
            self._env = self._blueprint.build()
        return self._env

    def observation_space(self, agent: Any) -> spaces.Space[Any]:
        """Observation space of every agent's row."""
        return self._blueprint.row_space

    def action_space(self, agent: Any) -> spaces.Space[Any]:
        """Action space of every agent."""
        return self._blueprint.action_space

    # ---- called by SuperSuit

    def reset(self, seed: int | None = None, options: Info | None = None) -> tuple[dict[Any, Any], dict[Any, Info]]:
        """
        Answer the letter to this game; without letters, begin the next episode.

        :param seed: place of this game's letter
        :param options: the letters
        :return: the latest observations, and infos with the packed reply
        """
        infos: dict[Any, Info] = {agent: {} for agent in self.possible_agents}
        if options is None:  # SuperSuit's own reset, after the last step of an episode
            infos[self.agents[0]][RESET_INFOS] = self._reply_to(Game.begin)
        else:
            assert seed is not None
            letter = options[LETTERS][seed]
            self._remote = isinstance(letter, bytes)
            infos[self.agents[0]][REPLY] = self._reply_to(letter)
        return self._observations, infos

    def _reply_to(self, letter: Letter | bytes) -> Any:
        """Do what a letter says; an exception is a reply too, a worker process must survive it."""
        try:
            opened: Letter = pickle.loads(letter) if isinstance(letter, bytes) else letter
            return self._packed(opened(self), "this reply")
        except (Exception, SystemExit) as error:
            return self._packed(Failure.of(error, self._remote), "this exception")

    def _packed(self, content: Any, what: str) -> Any:
        """Make something ready for its way up; only from here to the same process may it be any object."""
        if not self._remote:
            return content
        try:
            return dumps(content)
        except Exception as error:
            raise TypeError(
                f"{what} cannot leave its worker process ({error}), it is {content!r}; "
                "make it something that can be pickled, or use n_cpus=1"
            ) from error

    def step(self, actions: dict[Any, Any]) -> Any:
        """
        Step the game; agents that have ended wait for the rest of the team.

        :param actions: of all agents
        :return: observations, rewards, terminations, truncations and infos of all agents
        """
        try:
            return self._step(actions)
        except (Exception, SystemExit) as error:
            infos: dict[Any, Info] = {agent: {} for agent in self.possible_agents}
            infos[self.agents[0]][FAILED_STEP] = self._packed(Failure.of(error, self._remote), "this exception")
            flags = dict.fromkeys(self.possible_agents, False)
            return self._observations, dict.fromkeys(self.possible_agents, 0.0), flags, flags, infos

    def _step(self, actions: dict[Any, Any]) -> Any:
        acted = self._playing
        observations, rewards, terminations, truncations, infos = supersuit_calls.step(
            self.env, {a: actions[a] for a in acted}
        )
        ended = {a for a in acted if terminations.get(a, False) or truncations.get(a, False)}
        self._ended |= ended
        self._playing = self._alive()
        over = not self._playing
        truncated = {a: over and a in acted and bool(truncations.get(a, False)) for a in self.possible_agents}
        terminated = {a: over and (not truncated[a] or bool(terminations.get(a, False))) for a in self.possible_agents}
        # An ended agent's last observation is not the input of a decision: it goes where SB3 looks for it, into
        # the info (MarkovVectorEnv does that when the team is done), and the row shows zeros.
        if over:
            self._show(observations, infos, acted, active={a for a in acted if not terminated[a]}, over=True)
        else:
            self._show(observations, infos, self._playing, active=self._playing)
        packed: dict[Any, Info] = {}
        for agent in self.possible_agents:
            info = dict(infos.get(agent) or {}) if agent in acted else INACTIVE
            if agent in ended and not over:
                info["terminal_observation"] = self._own(observations, agent)
            packed[agent] = {STEP_INFO: self._frozen(info, agent)} if info else {}
        rewards = {a: rewards.get(a, 0.0) if a in acted else 0.0 for a in self.possible_agents}
        # Copies, because the observations outlive the reset that follows, and games may reuse their arrays.
        return deepcopy(self._observations) if over else self._observations, rewards, terminated, truncated, packed

    def _frozen(self, info: Info, agent: Any) -> Any:
        """Take an info as it is now; games may go on to use theirs."""
        if not self._remote and all(type(value) in _UNCHANGING for value in info.values()):
            return dict(info)  # as good as a deep copy, and ten times faster
        try:
            return dumps(info) if self._remote else deepcopy(info)
        except Exception as error:
            raise TypeError(
                f"the info of {agent} cannot be copied ({error}), it is {info}; leave out what cannot be pickled"
            ) from error

    def close(self) -> None:
        """Close the game, once."""
        env, self._env = self._env, None
        if env is not None:
            env.close()

    # ---- helpers of step and begin

    def _alive(self) -> dict[Any, None]:
        present = set(self.env.agents)
        return {agent: None for agent in self.possible_agents if agent in present and agent not in self._ended}

    def _own(self, observations: Mapping[Any, Any], agent: Any) -> Any:
        if agent not in observations:
            return self._blank
        return fitted(self._blueprint.observation_space, observations[agent], str(agent))

    def _show(
        self,
        observations: Mapping[Any, Any],
        infos: Mapping[Any, Any],
        agents: Container[Any],
        active: Container[Any],
        over: bool = False,
    ) -> None:
        """Set the rows of ``agents`` to their observations and all others to zeros; all show the signals."""
        own = {a: self._own(observations, a) if a in agents else self._blank for a in self.possible_agents}
        signals = self._blueprint.signals
        if signals.shown:
            state = None if signals.state is None else fitted(signals.state, self.env.state(), "the state")
            own = {a: signals.row(own[a], infos.get(a) or {}, state, str(a), a in active, over) for a in own}
        self._observations = own

    # ---- what letters say

    def begin(self, seed: int | None = None, options: Info | None = None) -> list[Info]:
        """
        Begin an episode.

        :param seed: the game's seed, None to go on with its random stream
        :param options: for the game's reset
        :return: reset infos of the N agents
        """
        observations, infos = supersuit_calls.reset(self.env, seed, options)
        self._ended.clear()
        self._playing = self._alive()
        self._show(observations, infos, self._playing, active=self._playing)
        return [
            deepcopy(infos.get(agent) or {}) if agent in self._playing else dict(INACTIVE)
            for agent in self.possible_agents
        ]

    def _layers(self) -> list[Any]:
        """The environment, what it wraps, and so on to the bare game."""
        layers: list[Any] = [self.env]
        while True:
            # Not getattr: PettingZoo's wrappers pass unknown names on to what they wrap.
            own = getattr(layers[-1], "__dict__", {})
            inner = own.get("env", own.get("aec_env"))
            if inner is None:
                break
            layers.append(inner)
        bare = self.env.unwrapped
        return layers if any(layer is bare for layer in layers) else [*layers, bare]

    def has_attr(self, name: str) -> bool:
        """
        Tell whether the game, or a wrapper around it, has an attribute.

        :param name: of the attribute
        """
        return any(hasattr(layer, name) for layer in self._layers())

    def get_attr(self, name: str) -> Any:
        """
        Get an attribute of the game or of a wrapper around it.

        :param name: of the attribute
        :raises AttributeError: if none has it
        """
        for layer in self._layers():
            value = getattr(layer, name, _MISSING)
            if value is not _MISSING:
                return value
        if name == "render_mode":  # SB3 asks every environment; PettingZoo does not demand one
            return None
        raise AttributeError(f"neither {self.env} nor what it wraps has an attribute {name!r}")

    def set_attr(self, name: str, value: Any) -> None:
        """
        Set an attribute where it is: on the outermost layer that has it of its own, else on the bare game.

        :param name: of the attribute
        :param value: new value
        """
        layers = self._layers()
        owners = (x for x in layers if name in getattr(x, "__dict__", {}) or hasattr(type(x), name))
        setattr(next(owners, layers[-1]), name, value)

    def call(self, name: str, args: tuple[Any, ...], kwargs: Info, times: int = 1) -> list[Any]:
        """
        Call a method.

        :param name: of the method
        :param args: positional arguments
        :param kwargs: keyword arguments
        :param times: how often
        :return: what each call returned
        """
        method = self.get_attr(name)
        return [method(*args, **kwargs) for _ in range(times)]

    def action_masks(self) -> list[Any]:
        """
        Ask the game for the masks of its agents.

        :return: N masks. A game that answers with a dict may leave out agents that have ended: they may do anything.
        """
        masks = self.get_attr("action_masks")()
        if not isinstance(masks, Mapping):
            return [masks] * len(self.possible_agents)
        anything = np.ones_like(next(iter(masks.values())), dtype=bool) if masks else None
        return [masks.get(agent, anything) for agent in self.possible_agents]

    def is_wrapped(self, module: str, qualname: str) -> bool:
        """
        Tell whether a wrapper of a class, or one derived from it, is around the game.

        Classes are compared by name, because a class that travelled to another process may be a copy.

        :param module: of the class
        :param qualname: of the class
        """
        classes = {kind for layer in self._layers() for kind in type(layer).__mro__}
        return any((kind.__module__, kind.__qualname__) == (module, qualname) for kind in classes)

    def identity(self) -> tuple[int, int]:
        """Tell which object the bare game is: process and address."""
        return os.getpid(), id(self.env.unwrapped)
