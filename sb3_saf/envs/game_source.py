"""How each game gets an environment of its own: from a factory, or from copies of one environment."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import cloudpickle


class GameSource:
    """
    A factory, or an environment as it is now, from which games are made.

    It is kept pickled where that is possible, so that a function around an environment gives each game a copy of it.

    :param make_env: the factory or the environment
    :param is_factory: which of the two it is
    :param n_cpus: number of processes in which games will be made; if this is the only one, a factory need not be
        picklable (that of a class in a function with ``functools.lru_cache`` on its methods is not, for instance)
    :raises ValueError: if it cannot be copied, with what to do
    """

    def __init__(self, make_env: Any, is_factory: bool, n_cpus: int) -> None:
        self._is_factory = is_factory
        self._pickled: bytes | None = None
        self._original: Any = None
        try:
            self._pickled = cloudpickle.dumps(make_env)
        except Exception as error:
            if n_cpus > 1:
                raise ValueError(
                    f"n_cpus={n_cpus} sends {make_env} to worker processes, but pickling it failed ({error}); move "
                    "what it uses to the top level of a module (functools.lru_cache on methods of a class inside a "
                    "function is such a thing), or use n_cpus=1, where nothing is sent"
                ) from error
            self._original = make_env if is_factory else _deep_copy(make_env)

    def build(self) -> Any:
        """Make a game."""
        if self._pickled is not None:
            content = cloudpickle.loads(self._pickled)
            return content() if self._is_factory else content
        return self._original() if self._is_factory else deepcopy(self._original)


def _deep_copy(env: Any) -> Any:
    try:
        return deepcopy(env)
    except Exception as error:
        raise ValueError(
            f"each game needs its own copy of {env}, but copying it failed ({error}); "
            "pass a function that makes the environment instead"
        ) from error
