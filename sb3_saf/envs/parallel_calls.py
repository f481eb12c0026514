"""
Calls of a game's ``reset`` and ``step`` with checked results.

Results are dicts by agent; ``place`` is game and step, for messages. All functions raise ValueError if a result
violates PettingZoo's API.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

_RESET: Final = "(observations, infos)"
_STEP: Final = "(observations, rewards, terminations, truncations, infos)"
_SINCE: Final = "as PettingZoo 1.24 and later do"


class Step(NamedTuple):
    """
    Results of a step, each a dict by agent.

    :param observations: observation of each agent
    :param rewards: reward of each agent
    :param terminations: whether the game ended for an agent
    :param truncations: whether an agent was stopped
    :param infos: info of each agent
    """

    observations: Mapping[Any, Any]
    rewards: Mapping[Any, Any]
    terminations: Mapping[Any, Any]
    truncations: Mapping[Any, Any]
    infos: Mapping[Any, Any]


def reset(env: Any, seed: int | None, options: dict[str, Any] | None) -> tuple[Mapping[Any, Any], Mapping[Any, Any]]:
    """Reset a game; return observations and infos by agent."""
    try:
        result = env.reset(seed=seed, options=options)
    except TypeError as error:
        if _takes(env.reset, "seed", "options"):
            raise  # from inside the game
        raise ValueError(
            f"expected {env} to have reset(seed=None, options=None), {_SINCE}, got "
            f"reset{inspect.signature(env.reset)}; add the arguments and draw the episode from the seed"
        ) from error
    if not _are_dicts(result, 2):
        hint = ""
        if isinstance(result, Mapping):
            hint = (
                " (observations alone, as in older versions): return observations, {agent: {} for agent in self.agents}"
            )
        raise ValueError(f"expected reset of {env} to return {_RESET}, {_SINCE}, got {_described(result)}{hint}")
    observations, infos = result
    return observations, infos


def step(env: Any, actions: dict[Any, Any]) -> Step:
    """Step a game with actions by agent."""
    result = env.step(actions)
    if not _are_dicts(result, 5):
        hint = ""
        if _are_dicts(result, 4):
            hint = (
                " (one dict of dones, as in older versions): return terminations for agents whose game is over and, "
                "beside them, truncations for those whom a time limit stops"
            )
        raise ValueError(f"expected step of {env} to return {_STEP}, {_SINCE}, got {_described(result)}{hint}")
    return Step(*result)


def playing_agents(env: Any, possible_agents: Sequence[Any], place: str) -> set[Any]:
    """Return the agents that a game lists in ``agents``, all of which must be in ``possible_agents``."""
    agents = env.agents
    if isinstance(agents, (str, bytes)) or not isinstance(agents, Iterable):
        raise ValueError(f"expected agents of {env} to be a list of names in {place}, got {agents!r}")
    present = set(agents)
    unknown = present.difference(possible_agents)
    if unknown:
        raise ValueError(
            f"expected names from possible_agents ({list(possible_agents)}) in agents of {env} in {place}, got "
            f"{next(agent for agent in agents if agent in unknown)!r}"
        )
    return present


def number(rewards: Mapping[Any, Any], agent: Any, place: str) -> float:
    """Return the reward of an agent that acted."""
    if agent not in rewards:
        raise ValueError(
            f"expected a reward for {agent}, which acted, in {place}, got rewards for {list(rewards)}; give every "
            "agent that acts a reward, 0.0 for none"
        )
    reward = rewards[agent]
    if isinstance(reward, (float, int)):
        return reward
    array = _single(reward, "biuf")
    if array is None:
        raise ValueError(f"expected a number as the reward of {agent} in {place}, got {reward!r}")
    return float(array)


def flag(name: str, flags: Mapping[Any, Any], agent: Any, place: str) -> bool:
    """Return whether an agent was terminated or truncated (``name``); False for an agent without an entry."""
    value = flags.get(agent, False)
    if value is True or value is False:
        return value
    array = _single(value, "biuf")
    if array is None or array not in (0, 1):
        raise ValueError(f"expected True or False for {agent} in {name} in {place}, got {value!r}")
    return bool(array)


def info(infos: Mapping[Any, Any], agent: Any, place: str) -> Mapping[str, Any]:
    """Return the info of an agent, an empty one if there is none."""
    found = infos.get(agent)
    if found is None:
        return {}
    if type(found) is not dict and not isinstance(found, Mapping):
        raise ValueError(f"expected a dict as the info of {agent} in {place}, got {found!r}")
    return found


def _single(value: Any, kinds: str) -> Any:
    """Return the number of a scalar or an array of one entry, None for any other value."""
    try:
        array = np.asarray(value)
    except ValueError:
        return None
    return array.item() if array.size == 1 and array.dtype.kind in kinds else None


def _takes(function: Any, *names: str) -> bool:
    try:
        inspect.signature(function).bind(**dict.fromkeys(names))
    except TypeError:
        return False
    except ValueError:  # functions without a signature
        return True
    return True


def _are_dicts(result: Any, count: int) -> bool:
    return isinstance(result, (tuple, list)) and len(result) == count and all(isinstance(x, Mapping) for x in result)


def _described(result: Any) -> str:
    if isinstance(result, Mapping):
        return f"a dict with the keys {list(result)}"
    if isinstance(result, (tuple, list)):
        return f"{len(result)} values: {', '.join(type(value).__name__ for value in result)}"
    return f"an object of type {type(result).__name__}"
