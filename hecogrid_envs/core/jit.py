"""How kernels are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit, typeof

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a function that may slice and allocate: what happens once per episode."""
    compiled: Function = njit(cache=True, nogil=True)(function)  # type: ignore[assignment]
    return compiled


def hot(function: Function) -> Function:
    """
    Compile an outer loop of every step.

    Without the runtime of reference counts, whose atomic increments around every array access cost more than the rules
    do; such functions cannot slice or allocate.
    """
    compiled: Function = njit(cache=True, nogil=True, _nrt=False)(function)  # type: ignore[call-overload]
    return compiled


def inlined(function: Function) -> Function:
    """Compile a part of a hot loop into it: a call would pass every array of a batch on the stack."""
    compiled: Function = njit(cache=True, nogil=True, _nrt=False, forceinline=True)(function)  # type: ignore[call-overload]
    return compiled


def entry_point(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """
    Find the machine code for some arguments, to be called without numba's dispatcher.

    At each call that looks at the type of every array of a batch, some 45, which takes longer than stepping ten games.

    :param function: a kernel
    :param arguments: of the types that it will be called with; others must not follow
    """
    compiled: Callable[..., Any] = function.compile(tuple(map(typeof, arguments)))  # type: ignore[attr-defined]
    return compiled
