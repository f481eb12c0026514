"""
How kernels are compiled, and kept on disk.

Numba takes compiled code for fresh as long as the file of its function is as it was. These kernels are compiled into
one another across files, so here they are fresh only as long as all of these files are.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from numba import typeof
from numba.core.registry import CPUDispatcher

Function = TypeVar("Function", bound=Callable[..., Any])

_PACKAGE = Path(__file__).resolve().parents[1]


def _fingerprint() -> str:
    digest = hashlib.sha256()
    for source in sorted([*_PACKAGE.glob("core/*.py"), _PACKAGE / "constants.py", _PACKAGE / "tiles.py"]):
        digest.update(source.read_bytes())
    return digest.hexdigest()


_FINGERPRINT = _fingerprint()


class _Inner(CPUDispatcher):
    """
    A function that only kernels call.

    It has no wrapper for Python, which takes half of the time to compile a small function: a wrapper takes apart some
    45 arrays. Numba would jump to an address that is not there.
    """

    def __call__(self, *_args: Any, **_kwargs: Any) -> Any:
        raise TypeError(f"{self.py_func.__name__} is compiled for kernels only: mark it as an entry to call it")


def _compiled(function: Function, entry: bool = False, **options: bool) -> Function:
    options |= {"nopython": True, "nogil": True, "no_cfunc_wrapper": True, "no_cpython_wrapper": not entry}
    compiled: Any = (CPUDispatcher if entry else _Inner)(function, targetoptions=options)
    compiled.enable_caching()
    compiled._cache._cache_file._source_stamp = _FINGERPRINT
    result: Function = compiled
    return result


def kernel(function: Function) -> Function:
    """Compile a function that may slice and allocate: what happens once per episode."""
    return _compiled(function)


def hot(function: Function) -> Function:
    """
    Compile an outer loop of every step.

    Without the runtime of reference counts, whose atomic increments around every array access cost more than the rules
    do; such functions cannot slice or allocate.
    """
    return _compiled(function, _nrt=False)


def inlined(function: Function) -> Function:
    """Compile a part of a hot loop into it: a call would pass every array of a batch on the stack."""
    return _compiled(function, _nrt=False, forceinline=True)


def kernel_entry(function: Function) -> Function:
    """As :func:`kernel`, for Python to call."""
    return _compiled(function, entry=True)


def hot_entry(function: Function) -> Function:
    """As :func:`hot`, for Python to call."""
    return _compiled(function, entry=True, _nrt=False)


def entry_point(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """
    Find the machine code for some arguments, to be called without numba's dispatcher.

    At each call that looks at the type of every array of a batch, some 45, which takes longer than stepping ten games.
    Says so on standard error, once, if there is something to compile first.

    :param function: an entry
    :param arguments: of the types that it will be called with; others must not follow
    """
    signature = tuple(map(typeof, arguments))
    if not _is_known(function, signature):
        _announce_compilation()
    compiled: Callable[..., Any] = function.compile(signature)  # type: ignore[attr-defined]
    return compiled


def _is_known(function: Any, signature: tuple[Any, ...]) -> bool:
    """Whether the code for a signature is in memory or on disk."""
    if signature in function.overloads:
        return True
    kept = function._cache
    return kept._index_key(signature, function.targetctx.codegen()) in kept._cache_file._load_index()


@cache
def _announce_compilation() -> None:
    print("hecogrid_envs: compiling the kernels, once on this machine (about 10 seconds)", file=sys.stderr, flush=True)
