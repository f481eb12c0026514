"""
Checks of the data in a checkpoint before loading.

A checksum detects damage, not manipulation: invalid values could make compiled code access memory out of bounds.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces

from sb3_saf.checkpoints.data import Tree
from sb3_saf.teams.errors import CheckpointError
from sb3_saf.teams.rows import bounds_of

_LARGEST: Final = 2**63


def refused(where: str, expected: str, got: object) -> CheckpointError:
    """Return the error for an invalid value."""
    return CheckpointError(
        f"the checkpoint does not fit: expected {where} to be {expected}, got {got}; it was changed, or is that of "
        "another model"
    )


def check_keys(value: Tree, keys: Iterable[object], where: str) -> None:
    """Check that a value is a dict with exactly these keys."""
    expected = list(keys)
    if not isinstance(value, dict):
        raise refused(where, "a dict", type(value).__name__)
    if different := set(expected) ^ set(value):
        name = min(map(repr, different))
        raise refused(where, f"a dict of {', '.join(map(repr, expected))}", f"one that differs in {name}")


def check_whole(value: Tree, where: str, low: int = 0, high: int = _LARGEST) -> None:
    """Check that a value is an integer from ``low`` to ``high``."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not low <= value <= high:
        raise refused(where, f"a whole number from {low} to {high}", repr(value))


def check_real(value: Tree, where: str, finite: bool = True) -> None:
    """Check that a value is a number."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise refused(where, "a number", repr(value)[:80])
    if finite and not -_LARGEST <= value <= _LARGEST:
        raise refused(where, "a finite number", repr(value)[:80])


def check_text(value: Tree, where: str) -> None:
    """Check that a value is text."""
    if not isinstance(value, str):
        raise refused(where, "text", type(value).__name__)


def check_name(value: Tree, where: str) -> None:
    """Check that a value is a plain file or folder name without a path."""
    check_text(value, where)
    if value in ("", ".", "..") or os.path.basename(value) != value or "\0" in value or "\\" in value:
        raise refused(where, "a plain name", repr(value))


def check_list(value: Tree, where: str, length: int | None = None) -> None:
    """Check that a value is a list, of the given length if any."""
    if not isinstance(value, list) or length not in (None, len(value)):
        what = "a list" if length is None else f"a list of {length}"
        raise refused(where, what, type(value).__name__ if not isinstance(value, list) else f"one of {len(value)}")


def check_array(value: Tree, shape: tuple[int, ...], dtype: npt.DTypeLike, where: str) -> None:
    """Check that a value is an array of this shape and dtype."""
    if not isinstance(value, np.ndarray) or value.shape != shape or value.dtype != np.dtype(dtype):
        raise refused(where, f"an array of shape {shape} and {np.dtype(dtype)}", _form(value))


def check_tensor(value: Tree, like: th.Tensor, where: str) -> None:
    """Check that a value is a tensor of the same shape and dtype."""
    if not isinstance(value, th.Tensor) or value.shape != like.shape or value.dtype != like.dtype:
        raise refused(where, f"a tensor of shape {tuple(like.shape)} and {like.dtype}", _form(value))


def check_range(value: npt.NDArray[Any], low: float, high: float, where: str) -> None:
    """Check that the entries of an array are in a range."""
    if value.size and (value.min() < low or value.max() > high):
        raise refused(where, f"from {low} to {high}", f"{value.min()} to {value.max()}")


def check_like(value: Tree, own: Tree, where: str) -> None:
    """Check that a tree matches another in keys, lengths, kinds of numbers, and shapes and dtypes of arrays."""
    if isinstance(own, th.Tensor):
        check_tensor(value, own, where)
    elif isinstance(own, np.ndarray):
        check_array(value, own.shape, own.dtype, where)
    elif isinstance(own, Mapping):
        check_keys(value, own, where)
        for key, part in own.items():
            check_like(value[key], part, f"{where}[{key!r}]")
    elif isinstance(own, (list, tuple)):
        if not isinstance(value, (list, tuple)) or len(value) != len(own):
            raise refused(where, f"a list of {len(own)}", _form(value))
        for i, part in enumerate(own):
            check_like(value[i], part, f"{where}[{i}]")
    elif isinstance(own, (bool, np.bool_, str)) or own is None:
        if type(value) is not type(own):
            raise refused(where, f"of type {type(own).__name__}", _form(value))
    elif isinstance(own, (int, np.integer)):
        check_whole(value, where, -(2**200), 2**200)  # generators have large integers
    else:
        check_real(value, where)


def check_observations(value: Tree, space: spaces.Space[Any], n_rows: int, where: str) -> None:
    """
    Check the observations of rows. Integers must lie in the space, since networks use them as table indices.

    :param value: (B, ...) of every key
    :param space: observation space of one row
    :param n_rows: B
    :param where: its name in errors
    """
    if isinstance(space, spaces.Dict):
        check_keys(value, space.spaces, where)
        for key, part in space.spaces.items():
            check_observations(value[key], part, n_rows, f"{where}[{key!r}]")
        return
    shape = (n_rows, *(space.shape or ()))
    if not isinstance(value, np.ndarray) or value.shape != shape or value.dtype.kind != np.dtype(space.dtype).kind:
        raise refused(where, f"an array of shape {shape} as of {space}", _form(value))
    if value.dtype.kind in "biu":
        _check_in(value, space, where)


def _check_in(value: npt.NDArray[Any], space: spaces.Space[Any], where: str) -> None:
    low, high = bounds_of(space)
    if ((value < low) | (value > high)).any():
        raise refused(where, f"in {space}", f"{value.min()} to {value.max()}")


def _form(value: object) -> str:
    if isinstance(value, (np.ndarray, th.Tensor)):
        return f"shape {tuple(value.shape)} and {value.dtype}"
    return repr(value)[:80]
