"""Unaligned loads, stores and copies of whole words on byte arrays, which NumPy's typed views cannot express."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

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


#: Functions for kernels: an intrinsic is called without the typing context that it is written with.
load_word: Callable[[npt.NDArray[np.uint8], int], np.uint64] = intrinsic(_load)  # type: ignore[assignment]
store_word: Callable[[npt.NDArray[np.uint8], int, np.uint64], bool] = intrinsic(_store)  # type: ignore[assignment]
copy_16: Callable[[npt.NDArray[np.uint8], int, npt.NDArray[np.uint8], int], bool] = intrinsic(_copy)  # type: ignore[assignment]
