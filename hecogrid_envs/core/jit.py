"""How kernels are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

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
