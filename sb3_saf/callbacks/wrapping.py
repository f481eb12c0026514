"""Doing something before a method of SB3's algorithms, where SB3 has no door for it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Literal, TypeVar

from stable_baselines3.common.base_class import BaseAlgorithm

AlgorithmClass = TypeVar("AlgorithmClass", bound=type[BaseAlgorithm])


def do_before(
    algorithm_class: AlgorithmClass, method: Literal["learn", "dump_logs"], action: Callable[[BaseAlgorithm], None]
) -> AlgorithmClass:
    """
    Let an algorithm do something whenever a method is called; again, for the class or a subclass that inherits the
    method, changes nothing.

    :param algorithm_class: for instance PPO; its base classes are left alone
    :param method: its method
    :param action: is given the algorithm
    :return: the same class
    """
    original = getattr(algorithm_class, method)
    mark = f"_does_{action.__name__}"
    if getattr(original, mark, False):
        return algorithm_class

    @functools.wraps(original)
    def wrapped(self: BaseAlgorithm, *args: Any, **kwargs: Any) -> Any:
        action(self)
        return original(self, *args, **kwargs)

    setattr(wrapped, mark, True)
    setattr(algorithm_class, method, wrapped)
    return algorithm_class
