"""
How kernels are compiled: parts of one function, :func:`hecogrid_envs.core.play.play`, which numba keeps on disk.

Parts have no wrappers for Python, since only kernels call them: that halves the time to compile. They are plain Python
functions where Python calls them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

from numba.extending import register_jitable

Function = TypeVar("Function", bound=Callable[..., Any])

_PACKAGE: Final = Path(__file__).resolve().parents[1]
_NO_WRAPPERS: Final = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def kernel(function: Function) -> Function:
    """Compile a part that may slice and allocate: what happens once per episode."""
    return _part(function)


def hot(function: Function) -> Function:
    """
    Compile an outer loop of every step.

    It cannot slice or allocate: without reference counts, whose atomic increments cost more than the rules do.
    """
    return _part(function, _nrt=False)


def inlined(function: Function) -> Function:
    """Compile a part into its hot loop: a call would pass every array of a batch on the stack."""
    return _part(function, _nrt=False, forceinline=True)


def _part(function: Function, **options: bool) -> Function:
    part: Function = register_jitable(**_NO_WRAPPERS, **options)(function)
    return part


def source_key() -> int:
    """
    Return a number that changes with every file that kernels are compiled from.

    Numba takes compiled code for fresh as long as the file of its function is unchanged and the function's closure
    holds the same values, so the compiled function has this number in its closure.
    """
    digest = hashlib.sha256()
    sources = [
        *_PACKAGE.glob("core/*.py"),
        *_PACKAGE.glob("tasks/*.py"),
        _PACKAGE / "constants.py",
        _PACKAGE / "tiles.py",
    ]
    for source in sorted(sources):
        digest.update(source.read_bytes())
    return int.from_bytes(digest.digest()[:7], "big")
