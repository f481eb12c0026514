"""Audit of other people's games: a trial episode of random legal actions, in which all that a game gives is checked."""

from __future__ import annotations

import inspect
import os
import time
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from math import isfinite, isnan
from typing import Any, Final, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv

from sb3_saf.envs.gymnasium_team import ALL, as_parallel
from sb3_saf.teams.conversion import MASK_NAMES, checked_mask, innermost, leaves_of, mask_in, read_leaves
from sb3_saf.teams.randomness import own_randomness
from sb3_saf.teams.rows import ACTION_MASK_KEY, FIXED_SHAPE, allows_nothing, n_mask_entries

#: Steps of a trial, and its limit in seconds.
TRIAL_STEPS: Final = 30
TRIAL_SECONDS: Final = 1.0

#: Packages whose objects are not searched for settings of a game, and limits of the search.
_NO_SETTINGS: Final = ("builtins", "numpy", "torch", "jax", "jaxlib", "random", "threading", "_thread", "pygame")
_MOST_SETTINGS: Final = 500
#: Attributes of attributes that settings are looked for in.
_DEPTH: Final = 2
_MOST_ITEMS: Final = 50

_RESET: Final = "(observations, infos)"
_STEP: Final = "(observations, rewards, terminations, truncations, infos)"
_SINCE: Final = "as PettingZoo 1.24 and later do"


def check_team_env(env: Any, n_steps: int = 1000, seconds: float = 10.0) -> None:
    """
    Check that a game gives what ``make_team_env`` needs, by playing random legal actions, as SB3's ``check_env`` does.

    Agents, spaces, observations, rewards, ends, infos and action masks are checked until the first episode ends, then
    games that begin with one seed, and those that follow them, are compared. ``make_team_env`` checks 30 steps, on a
    copy of the game.

    :param env: PettingZoo ParallelEnv or Gymnasium environment of several agents, which is reset and played, or a
        function that makes one
    :param n_steps: maximum number of steps
    :param seconds: time limit in seconds
    :raises ValueError: naming the agent, the step, what was expected, and what the game gave
    """
    is_made = isinstance(env, (ParallelEnv, AECEnv, gym.Env)) or not callable(env)
    game = as_parallel(env if is_made else env())
    check_is_parallel(game, is_factory=False)
    trial = Trial(game)
    trial.play(n_steps, seconds)
    if trial.error is None:
        trial.check_seed()
    for note in trial.notes:
        warnings.warn(note, UserWarning, stacklevel=2)
    if trial.error is not None:
        raise trial.error


class Trial:
    """
    Trial episode of a game.

    Errors of the game itself end the trial, so that they are raised where the game is used.

    :raises ValueError: if agents have spaces that cannot be in rows
    """

    def __init__(self, env: Any) -> None:
        self.env = env
        self.agents = tuple(agents_of(env))
        #: Warnings about the game.
        self.notes: list[str] = []
        #: Error raised by the game itself.
        self.error: BaseException | None = None
        #: By agent: times at which it could act, and how often its info had a mask then.
        self.n_turns, self.n_masks = Counter[Any](), Counter[Any]()
        self.observed = {agent: space_of(env, "observation", agent) for agent in self.agents}
        self.actions = {agent: deepcopy(space_of(env, "action", agent)) for agent in self.agents}
        #: By agent: key of the masks in its observations, None if they have none.
        self.mask_keys = {agent: self._mask_key(agent) for agent in self.agents}
        self._leaves = {agent: leaves_of(space) for agent, space in self.observed.items()}
        for space in self.actions.values():
            space.seed(0)
            if isinstance(space, spaces.Box) and ((space.low >= 1) | (space.high <= -1)).any():
                self._note(
                    f"expected Box actions around 0, got {space}: Gaussian policies begin with mean 0 and deviation 1, "
                    "which is clipped to the bounds, so that all first actions are equal and nothing may be learned; "
                    "scale the actions in your environment, best from -1 to 1"
                )

    def _mask_key(self, agent: Any) -> Any:
        """Find the masks among the entries of observations; note what looks like masks and is none."""
        observed, n_entries = self.observed[agent], n_mask_entries(self.actions[agent])
        for path, _ in innermost(observed):
            for key in filter(looks_like_mask, path[1:]):
                self._note(
                    f"observations have {key!r} inside of {path[0]!r}: it is an ordinary part of the observation; "
                    f"masks of actions are {ACTION_MASK_KEY!r} beside {path[0]!r}"
                )
        if not isinstance(observed, spaces.Dict) or len(observed.spaces) < 2:
            return None
        fitting = [key for key, space in observed.spaces.items() if space.shape == (n_entries,)]
        chosen = next((key for key in MASK_NAMES if key in fitting), None)
        for key, space in observed.spaces.items():
            if key == chosen or not looks_like_mask(key):
                continue
            if key == ACTION_MASK_KEY:
                raise ValueError(
                    f"expected {ACTION_MASK_KEY!r} in observations to have one entry per choice of "
                    f"{self.actions[agent]}, {'none can be masked' if n_entries is None else n_entries}, got {space}"
                )
            self._note(
                f"observations have {key!r}, {space}, which looks like action masks: it is an ordinary part of the "
                f"observation; masks are {ACTION_MASK_KEY!r} with one entry per choice of {self.actions[agent]}"
            )
        return chosen

    def _note(self, note: str) -> None:
        if note not in self.notes:
            self.notes.append(note)

    def play(self, n_steps: int = TRIAL_STEPS, seconds: float = TRIAL_SECONDS) -> None:
        """Play one episode, at most ``n_steps`` steps and ``seconds``; the global random generators are restored."""
        deadline = time.monotonic() + seconds
        with own_randomness(0):
            self._place = "at the reset of a trial episode"
            result = self._called(reset, self.env, 0, None)
            if result is None:
                return
            observations, infos = result
            playing = self._playing(frozenset())
            if not playing:
                raise ValueError(f"expected at least one name in agents of {self.env} after reset, got none")
            ended: frozenset[Any] = frozenset()
            for step in range(1, n_steps + 1):
                self._check_seen(observations, infos, playing)
                if not playing or time.monotonic() > deadline:
                    return
                actions = self._called(self._legal_actions, observations, infos, playing)
                result = None if actions is None else self._called(self.env.step, actions)
                if result is None:
                    return
                self._place = f"in step {step} of a trial episode"
                observations, rewards, terminations, truncations, infos = step_results(self.env, result)
                for agent in playing:
                    reward = reward_of(rewards, agent, self._place, required=True)
                    if not isfinite(reward):
                        raise ValueError(
                            f"expected a finite number as the reward of {agent} {self._place}, got {reward}"
                        )
                listed = {*playing, *self._playing(ended)}
                for name, flags in (("terminations", terminations), ("truncations", truncations)):
                    ended |= {agent for agent in listed if end_of(name, flags, agent, self._place)}
                for agent in playing:
                    if truncations.get(agent) and not terminations.get(agent):  # values may go on from there
                        observation_of(observations, agent, self._place)
                playing = self._playing(ended)
                respawned = respawn_note(self.env, ended, terminations, truncations, self._place)
                if respawned and not any(note.endswith(RESPAWNED) for note in self.notes):
                    self._note(respawned)

    def check_seed(self) -> None:
        """Note that first observations differ in two resets with one seed, or in those without that follow them."""
        with own_randomness(0):
            games = [self._called(self._first_observations, seed) for seed in (0, 0, None, 0, None)]
        if None in games:
            return
        for where, (one, other) in {"": games[:2], ", each followed by one without": games[2::2]}.items():
            for agent in self.agents:
                seen = [game[agent] for game in (one, other) if agent in game]
                if seen and (len(seen) < 2 or not all(map(np.array_equal, *seen))):
                    return self._note(
                        f"first observations of {agent} differ in two resets with the seed 0{where}: draw from the "
                        "last seed, so that evaluations play the same games again and runs can be repeated"
                    )

    def _first_observations(self, seed: int | None) -> dict[Any, list[Any]]:
        given, _ = reset(self.env, seed, None)
        playing = self._playing(frozenset())
        return {agent: list(read_leaves(self._leaves[agent], given[agent])) for agent in playing if agent in given}

    def _called(self, function: Callable[..., Any], *args: Any) -> Any:
        """Call the game; return None if it fails."""
        try:
            return function(*args)
        except FormError:
            raise
        except (Exception, SystemExit) as error:
            self.error = error
            return None

    def _playing(self, ended: frozenset[Any]) -> list[Any]:
        check_agents(self.env, self.agents, self._place)
        present = present_agents(self.env, self.agents, self._place)
        return [agent for agent in self.agents if agent in present and agent not in ended]

    def _check_seen(self, observations: Mapping[Any, Any], infos: Mapping[Any, Any], playing: Sequence[Any]) -> None:
        for agent in playing:
            observation = observation_of(observations, agent, self._place)
            try:
                self._check_observation(agent, observation)
            except ValueError as error:
                raise ValueError(f"observation of {agent} {self._place}: {error}") from None
            key = self.mask_keys[agent]
            if key is not None:
                self._check_mask(agent, key, observation[key], "observation")
        for agent in self.agents:
            info = info_of(infos, agent, self._place)
            for key in info if agent in playing else ():
                if key not in MASK_NAMES and looks_like_mask(key):
                    self._note(
                        f"infos have {key!r}, which looks like action masks, but is not used; name it "
                        f"{ACTION_MASK_KEY!r}"
                    )
            self.n_turns[agent] += agent in playing
            key = next((name for name in MASK_NAMES if info.get(name) is not None), None)
            is_read = self.mask_keys[agent] is None and n_mask_entries(self.actions[agent]) is not None
            if agent in playing and is_read and key is not None:
                self._check_mask(agent, key, info[key], "info")
                self.n_masks[agent] += 1

    def _check_observation(self, agent: Any, observation: Any) -> None:
        """Check shapes, types and bounds of integers; refuse NaN and infinity, note floats that are out of bounds."""
        for leaf, array in zip(self._leaves[agent], read_leaves(self._leaves[agent], observation), strict=True):
            if array.dtype.kind != "f":
                continue
            if not np.isfinite(array).all():
                raise ValueError(f"expected finite values, got {array[~np.isfinite(array)].reshape(-1)[0]}")
            low, high = (np.reshape(bound, leaf.shape if len(bound) > 1 else ()) for bound in (leaf.low, leaf.high))
            wrong = (array < low) | (array > high)
            if wrong.any() and not any(note.startswith("observation of") for note in self.notes):
                self._note(f"observation of {agent} {self._place}: {leaf.outside(array, wrong)}")

    def _check_mask(self, agent: Any, key: Any, mask: Any, where: str) -> None:
        try:
            flags = checked_mask(mask, n_mask_entries(self.actions[agent]) or 0)
        except ValueError as error:
            raise mask_error(error, key, f"the {where} of {agent} {self._place}") from None
        if allows_nothing(flags[np.newaxis], self.actions[agent])[0]:
            self._note(
                f"{key!r} in the {where} of {agent} {self._place} allows nothing, which training refuses: agents that "
                "have to wait need an action that does nothing"
            )

    def _legal_actions(
        self, observations: Mapping[Any, Any], infos: Mapping[Any, Any], playing: Sequence[Any]
    ) -> dict[Any, Any]:
        method = masks_method(self.env)
        told = None if method is None else method()
        actions: dict[Any, Any] = {}
        for agent in playing:
            key, info = self.mask_keys[agent], infos.get(agent) or {}
            shown = mask_in(info) if key is None else observations[agent][key]
            masks = map(np.asarray, (shown, told.get(agent) if isinstance(told, Mapping) else told))
            fitting = [mask for mask in masks if mask.shape == (n_mask_entries(self.actions[agent]),)]
            actions[agent] = legal_sample(self.actions[agent], np.logical_and.reduce(fitting) if fitting else None)
        return actions


def legal_sample(space: spaces.Space[Any], mask: Any) -> Any:
    """Draw an action that a flat mask allows; any action if it is None."""
    if mask is None:
        return space.sample()
    flags = np.asarray(mask).astype(np.int8)
    if isinstance(space, spaces.MultiDiscrete):
        return space.sample(mask=tuple(np.split(flags, np.cumsum(space.nvec)[:-1])))
    if isinstance(space, spaces.MultiBinary):
        off, on = flags.reshape(-1, 2).astype(bool).T
        return np.where(off & on, space.sample(), on).astype(space.dtype)
    return space.sample(mask=flags)


#: What is said of agents that have ended and play again.
RESPAWNED: Final = (
    "not ended any more: an agent that has ended stays out until its team's episode ends. Let agents that will return "
    "leave agents without an end: they wait, and play on"
)


def respawn_note(
    env: Any, ended: Collection[Any], terminations: Mapping[Any, Any], truncations: Mapping[Any, Any], place: str
) -> str | None:
    """Return a note if an agent has ended before this step and plays in it."""
    for agent in env.agents:
        if agent in ended and not terminations.get(agent, True) and not truncations.get(agent):
            return f"{agent} has ended and is in agents again {place}, {RESPAWNED}"
    return None


class FormError(ValueError):
    """Raised for a game that breaks PettingZoo's API."""


# ---- attributes, agents and spaces


def layers_of(env: Any) -> list[Any]:
    """Return the environment and all that it wraps, down to the bare game."""
    layers: list[Any] = [env]
    while True:
        # Not getattr: PettingZoo's wrappers forward unknown names to the environment they wrap.
        own = getattr(layers[-1], "__dict__", {})
        inner = own.get("env", own.get("aec_env"))
        if not callable(getattr(inner, "reset", None)):  # an attribute of the game's own, or none
            break
        layers.append(inner)
    bare = getattr(env, "unwrapped", layers[-1])
    return layers if any(layer is bare for layer in layers) else [*layers, bare]


def settings_of(env: Any) -> dict[str, Any]:
    """
    Return what a new game keeps of its arguments: the numbers, flags and text among its attributes, by dotted names.

    :param env: before its first episode; attributes of attributes are followed, of the game and of each of its wrappers
    """
    result: dict[str, Any] = {}
    todo = [(type(layer).__name__, layer, 0) for layer in reversed(layers_of(env)) if hasattr(layer, "__dict__")]
    visited = {id(layer) for _, layer, _ in todo}
    while todo:
        name, value, level = todo.pop()
        for key, inner in sorted(vars(value).items()) if len(result) < _MOST_SETTINGS else ():
            module = str(getattr(type(inner), "__module__", "builtins"))  # some compiled types lack it
            if _is_plain(inner):
                result[f"{name}.{key}"] = inner
                continue
            may_hold_settings = (
                module.partition(".")[0] not in _NO_SETTINGS and hasattr(inner, "__dict__") and not callable(inner)
            )
            if level < _DEPTH and id(inner) not in visited and may_hold_settings:
                visited.add(id(inner))
                todo.append((f"{name}.{key}", inner, level + 1))
    return result


def _is_plain(value: Any) -> bool:
    """Return whether a value is a number, a flag, text other than a path, or a small collection of these."""
    if isinstance(value, (list, tuple)):
        return len(value) <= _MOST_ITEMS and all(map(_is_plain, value))
    if isinstance(value, dict):
        return len(value) <= _MOST_ITEMS and all(map(_is_plain, [*value, *value.values()]))
    if type(value) is float:
        return not isnan(value)
    return value is None or type(value) in (bool, int) or (type(value) is str and os.sep not in value)


def has_game_attribute(env: Any, name: str) -> bool:
    """Return whether the game, or a wrapper around it, has an attribute."""
    return hasattr(env, name) or hasattr(env.unwrapped, name)


def game_attribute(env: Any, name: str) -> Any:
    """Return an attribute of the game or of a wrapper around it."""
    return getattr(env, name) if hasattr(env, name) else getattr(env.unwrapped, name)


def masks_method(env: Any) -> Callable[[], Any] | None:
    """Return the game's ``action_masks`` if it is what sb3-contrib calls: a method without arguments."""
    method: Any = game_attribute(env, "action_masks") if has_game_attribute(env, "action_masks") else None
    with suppress(ValueError):  # some compiled methods do not tell their arguments
        try:
            inspect.signature(method).bind()
        except TypeError:
            return None
    return cast("Callable[[], Any]", method)


def has_masks_method(env: Any) -> bool:
    """Return whether :func:`masks_method` has an answer."""
    return masks_method(env) is not None


def set_game_attribute(env: Any, name: str, value: Any) -> None:
    """Set an attribute on the outermost layer that has it itself, else on the bare game."""
    layers = layers_of(env)
    owners = (layer for layer in layers if name in getattr(layer, "__dict__", {}) or hasattr(type(layer), name))
    setattr(next(owners, layers[-1]), name, value)


def check_is_parallel(env: Any, is_factory: bool) -> None:
    """Raise ValueError unless an object (perhaps a factory's) is a ParallelEnv with agents."""
    origin = "a function that returned " if is_factory else ""
    if isinstance(env, AECEnv):
        raise ValueError(
            f"expected a PettingZoo ParallelEnv, got {origin}the AECEnv {env}; "
            "convert it with pettingzoo.utils.conversions.aec_to_parallel, or, where agents take turns, with "
            "sb3_saf.TurnsInParallel"
        )
    if not isinstance(env, ParallelEnv):
        hint = f"; pass {env.__name__}.parallel_env(...)" if hasattr(env, "parallel_env") else ""
        raise ValueError(
            "expected a PettingZoo ParallelEnv or a function that makes one, "
            f"got {origin}an object of type {type(env).__name__}{hint}"
        )
    agents = agents_of(env)
    if not agents:
        raise ValueError(f"expected {env} to list its agents in possible_agents (each gets a row), got none")
    doubles = [agent for i, agent in enumerate(agents) if agent in agents[:i]]
    if doubles:
        raise ValueError(
            f"expected different names in possible_agents of {env}, got {doubles[0]!r} more than once in {agents}"
        )


def agents_of(env: Any) -> list[Any]:
    """Return ``possible_agents`` as a list; games also give arrays, and keys of dicts."""
    agents = getattr(env, "possible_agents", None)
    return agents.tolist() if isinstance(agents, np.ndarray) else [] if agents is None else list(agents)


def check_agents(env: Any, agents: Sequence[Any], place: str) -> None:
    """Raise ValueError if ``possible_agents`` are not the agents that a game began with."""
    if (names := agents_of(env)) != list(agents):
        raise ValueError(
            f"expected the same possible_agents at all times, got {list(agents)}, and {names} {place}; a game that "
            "sets self.agents = self.possible_agents removes agents from both: write "
            "self.agents = list(self.possible_agents)"
        )


def space_of(env: Any, kind: str, agent: Any) -> spaces.Space[Any]:
    """Return the space of an agent's ``"observation"`` or ``"action"``; raise ValueError if it cannot be in rows."""
    method = getattr(env, f"{kind}_space")
    if not callable(method):
        raise ValueError(
            f"expected {kind}_space(agent) to be a method that gives an agent's space, got {type(method).__name__}; "
            f"write it as: def {kind}_space(self, agent): return self.{kind}_spaces[agent]"
        )
    space = method(agent)
    parts = [part for _, part in innermost(space)] if kind == "observation" else [space]
    if not all(isinstance(part, FIXED_SHAPE) for part in parts):
        names = ", ".join(part.__name__ for part in FIXED_SHAPE)
        containers = ", or a Dict or Tuple of those" if kind == "observation" else ""
        raise ValueError(f"expected an {kind} space that is one of {names}{containers}, got {space} for {agent}")
    if not parts or any(0 in (part.shape or ()) for part in parts):
        raise ValueError(
            f"expected an {kind} space with at least one entry, got {space} for {agent}; give agents without "
            f"{'anything to see' if kind == 'observation' else 'a choice'} one constant entry"
        )
    if kind == "observation" and isinstance(space, spaces.Box) and not space.shape:
        raise ValueError(f"expected an observation space with an axis, got {space} for {agent}; give it the shape (1,)")
    return space


def present_agents(env: Any, possible_agents: Sequence[Any], place: str) -> set[Any]:
    """Return the agents that a game lists in ``agents``, all of which must be in ``possible_agents``."""
    agents = env.agents
    if isinstance(agents, (str, bytes)) or not isinstance(agents, Iterable):
        raise ValueError(f"expected agents of {env} to be a list of names {place}, got {agents!r}")
    present = set(agents)
    unknown = present.difference(possible_agents)
    if unknown:
        raise ValueError(
            f"expected names from possible_agents ({list(possible_agents)}) in agents of {env} {place}, got "
            f"{next(agent for agent in agents if agent in unknown)!r}"
        )
    return present


# ---- results of reset and step


def reset(env: Any, seed: int | None, options: dict[str, Any] | None) -> tuple[Mapping[Any, Any], Mapping[Any, Any]]:
    """Reset a game; return observations and infos by agent."""
    try:
        result = env.reset(seed=seed, options=options)
    except TypeError as error:
        try:
            inspect.signature(env.reset).bind(seed=seed, options=options)
        except TypeError:
            raise FormError(
                f"expected {env} to have reset(seed=None, options=None), {_SINCE}, got "
                f"reset{inspect.signature(env.reset)}; add the arguments and draw the episode from the seed"
            ) from error
        except ValueError:  # functions without a signature
            pass
        raise
    if not _are_dicts(result, 2):
        hint = ""
        if isinstance(result, Mapping):
            hint = (
                " (observations alone, as in older versions): return observations, {agent: {} for agent in self.agents}"
            )
        raise FormError(f"expected reset of {env} to return {_RESET}, {_SINCE}, got {_described(result)}{hint}")
    observations, infos = result
    return observations, infos


def step_results(env: Any, result: Any) -> tuple[Mapping[Any, Any], ...]:
    """Check that a step returned five dicts by agent."""
    if not _are_dicts(result, 5):
        hint = ""
        if _are_dicts(result, 4):
            hint = (
                " (one dict of dones, as in older versions): return terminations for agents whose game is over and, "
                "beside them, truncations for those whom a time limit stops"
            )
        raise FormError(f"expected step of {env} to return {_STEP}, {_SINCE}, got {_described(result)}{hint}")
    return tuple(result)


def observation_of(observations: Mapping[Any, Any], agent: Any, place: str) -> Any:
    """Return the observation of an agent that takes part."""
    observation = observations.get(agent)
    if observation is None:
        raise ValueError(
            f"expected an observation for {agent}, which takes part or has just been truncated, {place}, got "
            f"observations for {[name for name, value in observations.items() if value is not None]}"
        )
    return observation


def reward_of(rewards: Mapping[Any, Any], agent: Any, place: str, required: bool) -> float:
    """Return the reward of an agent; agents that did not act need none."""
    reward = rewards.get(agent)
    if reward is None and not required:
        return 0.0
    if agent not in rewards:
        raise ValueError(
            f"expected a reward for {agent}, which acted, {place}, got rewards for {list(rewards)}; give every agent "
            "that acts a reward, 0.0 for none"
        )
    if isinstance(reward, (float, int)):
        return reward
    number = _single(reward)
    if number is None:
        raise ValueError(f"expected a number as the reward of {agent} {place}, got {reward!r}")
    return float(number)


def end_of(name: str, flags: Mapping[Any, Any], agent: Any, place: str) -> bool:
    """Return whether an agent, or all by ``"__all__"``, ended (``name``); False for an agent without an entry."""
    value = flags.get(agent, False)
    if value is True or (value is False and ALL not in flags):
        return value
    number = _single(value)
    if number not in (0, 1):
        raise ValueError(f"expected True or False for {agent} in {name} {place}, got {value!r}")
    return bool(number) or bool(flags.get(ALL, False))


def info_of(infos: Mapping[Any, Any], agent: Any, place: str) -> Mapping[str, Any]:
    """Return the info of an agent, an empty one if there is none."""
    info = infos.get(agent)
    if info is None:
        return {}
    if type(info) is not dict and not isinstance(info, Mapping):
        raise ValueError(f"expected a dict as the info of {agent} {place}, got {info!r}")
    return info


def _single(value: Any) -> Any:
    """Return the number of a scalar or an array of one entry, None for any other value."""
    try:
        array = np.asarray(value)
    except ValueError:
        return None
    return array.item() if array.size == 1 and array.dtype.kind in "biuf" else None


def _are_dicts(result: Any, count: int) -> bool:
    return isinstance(result, (tuple, list)) and len(result) == count and all(isinstance(x, Mapping) for x in result)


def _described(result: Any) -> str:
    if isinstance(result, Mapping):
        return f"a dict with the keys {list(result)}"
    if isinstance(result, (tuple, list)):
        return f"{len(result)} values: {', '.join(type(value).__name__ for value in result)}"
    return f"an object of type {type(result).__name__}"


# ---- action masks


def looks_like_mask(key: Any) -> bool:
    """Return whether an entry of observations or infos has a name that masks of actions have."""
    name = str(key).lower()
    of_actions = "action" in name or "move" in name
    return "mask" in name or (of_actions and any(word in name for word in ("legal", "avail", "valid")))


def without_mask(observed: spaces.Space[Any], key: Any) -> spaces.Space[Any]:
    """Return the space of observations without their masks, if they have any; of a single entry its own."""
    if key is None or not isinstance(observed, spaces.Dict):
        return observed
    others = [(name, space) for name, space in observed.spaces.items() if name != key]
    return others[0][1] if len(others) == 1 else spaces.Dict(others)


def mask_error(error: ValueError, key: Any, owner: str) -> ValueError:
    """Return the error of a mask with its name and its owner."""
    return ValueError(
        f"{key!r} in {owner}: {error}; give it at every step to every agent that acts, or pass action_masks=False"
    )
