"""How each game gets an environment of its own: from a factory, or from copies of one environment."""

from __future__ import annotations

import itertools
import pickle
from copy import deepcopy
from typing import Any, ClassVar
from weakref import WeakValueDictionary

import cloudpickle


def dumps(content: Any) -> bytes:
    """
    Pickle, also what only cloudpickle can.

    :param content: anything; what is defined in an importable module stays what it is on the other side
    """
    try:
        return pickle.dumps(content)
    except Exception:  # pickle, and the objects it asks, have many ways to decline
        return bytes(cloudpickle.dumps(content))


class Original:
    """
    A factory, or an environment, from which games are made. It can go to another process.

    :param content: pickled factory or environment
    :param is_factory: whether it is a factory
    """

    def __init__(self, content: bytes, is_factory: bool):
        self._content, self._is_factory = content, is_factory

    def build(self) -> Any:
        """Build a game."""
        content = pickle.loads(self._content)
        return content() if self._is_factory else content


class LocalOriginal:
    """
    A factory, or an environment, that cannot be pickled, or is not worth it: for games of this process alone.

    SuperSuit pickles games even on their way to nowhere. On that way this object is a number, under which it is found
    again for as long as it is in use.

    :param content: factory or environment
    :param is_factory: whether it is a factory
    """

    _in_use: ClassVar[WeakValueDictionary[int, LocalOriginal]] = WeakValueDictionary()
    _numbers: ClassVar[itertools.count[int]] = itertools.count()

    def __init__(self, content: Any, is_factory: bool):
        # What the owner does with an environment later is no affair of the games.
        self._content, self._is_factory = content if is_factory else deepcopy(content), is_factory
        self._number = next(self._numbers)
        self._in_use[self._number] = self

    def __reduce__(self) -> Any:
        return type(self)._find, (self._number,)

    @classmethod
    def _find(cls, number: int) -> LocalOriginal:
        return cls._in_use[number]

    def build(self) -> Any:
        """Build a game."""
        return self._content() if self._is_factory else deepcopy(self._content)


def original_of(make_env: Any, is_factory: bool, n_cpus: int) -> Original | LocalOriginal:
    """
    Keep a factory or an environment.

    Pickled where that is possible, so that a function around an environment gives each game a copy of it.

    :param make_env: the factory, or the environment, which is copied as it is now
    :param is_factory: whether it is a factory
    :param n_cpus: number of processes in which games will be built; in this one alone, factories are not pickled if
        they cannot be (those of a class in a function with ``functools.lru_cache`` on its methods, for instance)
    :raises ValueError: if it cannot be copied, with what to do
    """
    try:
        return Original(dumps(make_env), is_factory)
    except Exception as error:
        if n_cpus > 1:
            raise ValueError(
                f"n_cpus={n_cpus} sends {make_env} to worker processes, but pickling it failed ({error}); move what it "
                "uses to the top level of a module (functools.lru_cache on methods of a class inside a function is "
                "such a thing), or use n_cpus=1, where nothing is sent"
            ) from error
    try:
        return LocalOriginal(make_env, is_factory)
    except Exception as error:
        raise ValueError(
            f"each game needs its own copy of {make_env}, but copying it failed ({error}); "
            "pass a function that makes the environment instead"
        ) from error
