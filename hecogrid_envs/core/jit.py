"""
Compiler decorators for kernels, a place for compiled code, and unaligned loads, stores and copies of words, which
NumPy's typed views lack.

Kernels are parts of one function, :func:`hecogrid_envs.core.play.play`, which numba caches on disk. Parts have no
wrappers for Python, since only kernels call them: this halves the compile time. Called from Python, they are plain
Python functions.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import config, njit, types
from numba.core import cgutils
from numba.extending import intrinsic, register_jitable

Function = TypeVar("Function", bound=Callable[..., Any])

_PACKAGE: Final = Path(__file__).resolve().parents[1]
_NO_WRAPPERS: Final = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


def cached(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """
    Compile a function for calls from Python as ``numba.njit(nogil=True, **options)`` does, and keep the code on disk.

    Numba keeps it beside the source or in the user's cache. Where neither can be written, for instance in a container
    without a home, this process and its children keep it in a temporary folder.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return njit(cache=True, nogil=True, **options)(function)
        except RuntimeError as error:
            if "no locator" not in str(error):
                raise
            folder = tempfile.mkdtemp(prefix="numba-")
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
            os.environ["NUMBA_CACHE_DIR"] = folder  # of processes that this one starts
            config.CACHE_DIR = folder  # type: ignore[attr-defined]
            warnings.warn(
                f"neither the package's folder nor the user's cache can be written: compiled code is kept in {folder} "
                "until this process ends; set NUMBA_CACHE_DIR to a folder that can be written, to compile only once",
                UserWarning,
                stacklevel=2,
            )
            return njit(cache=True, nogil=True, **options)(function)

    return decorate


def kernel(function: Function) -> Function:
    """Compile a part that runs once per episode; it may slice and allocate."""
    return _part(function)


def hot(function: Function) -> Function:
    """
    Compile an outer loop that runs in every step.

    It cannot slice or allocate: reference counts are off, since their atomic increments would cost more than the rules.
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
    Return a hash of all files that kernels are compiled from.

    Numba reuses cached code while the function's file and closure are unchanged, so the closure contains this number.
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


_I64 = ir.IntType(64)
_I8 = ir.IntType(8)
_I8X16 = ir.VectorType(_I8, 16)


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, offset: Any, to: Any = _I64) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    bytes_ = builder.bitcast(data, _I8.as_pointer())
    return builder.bitcast(builder.gep(bytes_, [offset], source_etype=_I8), to.as_pointer())


def _load(_typing: Any, array: Any, offset: Any) -> Any:
    """``load_word(array, offset)``: the eight bytes that start at byte ``offset``, as uint64."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, signature.args[0], args[0], args[1])
        return builder.load(pointer, align=1, typ=_I64)

    return types.uint64(array, types.int64), codegen


def _store(_typing: Any, array: Any, offset: Any, _word: Any) -> Any:
    """``store_word(array, offset, word)``: write eight bytes from byte ``offset`` on."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _pointer(context, builder, signature.args[0], args[0], args[1])
        builder.store(args[2], pointer, align=1)
        return cgutils.false_bit

    return types.boolean(array, types.int64, types.uint64), codegen


def _copy(_typing: Any, to: Any, to_offset: Any, source: Any, source_offset: Any) -> Any:
    """``copy_16(to, to_offset, source, source_offset)``: copy sixteen bytes."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        target = _pointer(context, builder, signature.args[0], args[0], args[1], _I8X16)
        origin = _pointer(context, builder, signature.args[2], args[2], args[3], _I8X16)
        builder.store(builder.load(origin, align=1, typ=_I8X16), target, align=1)
        return cgutils.false_bit

    return types.boolean(to, types.int64, source, types.int64), codegen


#: Typed for callers in kernels, which do not pass the typing context.
load_word: Callable[[npt.NDArray[np.uint8], int], np.uint64] = intrinsic(_load)  # type: ignore[assignment]
store_word: Callable[[npt.NDArray[np.uint8], int, np.uint64], bool] = intrinsic(_store)  # type: ignore[assignment]
copy_16: Callable[[npt.NDArray[np.uint8], int, npt.NDArray[np.uint8], int], bool] = intrinsic(_copy)  # type: ignore[assignment]
