"""Calls of a game's ``reset`` and ``step``, with a clear word where they are not PettingZoo's."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

_RESET: Final = "(observations, infos)"
_STEP: Final = "(observations, rewards, terminations, truncations, infos)"
_SINCE: Final = "as PettingZoo 1.24 and later do"


class Step(NamedTuple):
    """
    What a step returns, each a dict by agent.

    :param observations: what each agent sees
    :param rewards: of each agent
    :param terminations: whether the game ended for an agent
    :param truncations: whether an agent was stopped
    :param infos: of each agent
    """

    observations: Mapping[Any, Any]
    rewards: Mapping[Any, Any]
    terminations: Mapping[Any, Any]
    truncations: Mapping[Any, Any]
    infos: Mapping[Any, Any]


def reset(env: Any, seed: int | None, options: dict[str, Any] | None) -> tuple[Mapping[Any, Any], Mapping[Any, Any]]:
    """
    Reset a game.

    :param env: a ParallelEnv, so it says
    :param seed: of the game
    :param options: for the game
    :return: observations and infos by agent
    :raises ValueError: if its ``reset`` is not PettingZoo's
    """
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
    """
    Step a game.

    :param env: a ParallelEnv, so it says
    :param actions: by agent
    :raises ValueError: if its ``step`` does not return what PettingZoo's does
    """
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


def _takes(function: Any, *names: str) -> bool:
    try:
        inspect.signature(function).bind(**dict.fromkeys(names))
    except TypeError:
        return False
    except ValueError:  # functions that have no signature to look at
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
