"""Numbers that threads share without a lock, and arrays by their address, neither of which numba offers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import populate_array

_I64 = ir.IntType(64)
#: Reads and writes of all threads lie in one order, which the sleeping and waking of helpers relies on.
_ORDERING = "seq_cst"
_ALIGNMENT = 8


def _element(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index], source_etype=_I64)


def _load(_typing: Any, array: Any, index: Any) -> Any:
    """``load_shared(array, index)``: an int64 as other threads left it."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _element(context, builder, signature.args[0], args[0], args[1])
        return builder.load_atomic(pointer, _ORDERING, _ALIGNMENT, typ=_I64)

    return types.int64(array, types.int64), codegen


def _store(_typing: Any, array: Any, index: Any, _value: Any) -> Any:
    """``store_shared(array, index, value)``: write an int64; whoever reads it also sees all that was written before."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _element(context, builder, signature.args[0], args[0], args[1])
        builder.store_atomic(args[2], pointer, _ORDERING, _ALIGNMENT)
        return cgutils.false_bit

    return types.boolean(array, types.int64, types.int64), codegen


def _take(_typing: Any, array: Any, index: Any, _amount: Any) -> Any:
    """``take_shared(array, index, amount)``: add to an int64, in one go; what it was before."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _element(context, builder, signature.args[0], args[0], args[1])
        return builder.atomic_rmw("add", pointer, args[2], _ORDERING)

    return types.int64(array, types.int64, types.int64), codegen


def _bytes(_typing: Any, _address: Any, _n_bytes: Any) -> Any:
    """``bytes_at(address, n_bytes)``: memory that somebody else keeps, as (n_bytes,) uint8."""
    array_type = types.Array(types.uint8, 1, "C")

    def codegen(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        array = context.make_array(array_type)(context, builder)
        data = builder.inttoptr(args[0], ir.IntType(8).as_pointer())
        one = context.get_constant(types.intp, 1)
        populate_array(array, data=data, shape=[args[1]], strides=[one], itemsize=one, meminfo=None)
        return array._getvalue()

    return array_type(types.int64, types.int64), codegen


load_shared: Callable[[npt.NDArray[np.int64], int], int] = intrinsic(_load)  # type: ignore[assignment]
store_shared: Callable[[npt.NDArray[np.int64], int, int], bool] = intrinsic(_store)  # type: ignore[assignment]
take_shared: Callable[[npt.NDArray[np.int64], int, int], int] = intrinsic(_take)  # type: ignore[assignment]
bytes_at: Callable[[int, int], npt.NDArray[np.uint8]] = intrinsic(_bytes)  # type: ignore[assignment]
