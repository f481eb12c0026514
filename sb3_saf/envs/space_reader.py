"""Readers that check a game's observations against their space and convert them to the form of rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

from sb3_saf.networks.encoders import Part, PartsSpace
from sb3_saf.teams.rows import FIXED_SHAPE, Array, bounds_of


def parts_of(space: spaces.Space[Any]) -> dict[Any, spaces.Space[Any]]:
    """Return the parts of a Dict or a Tuple by key or index; nothing for other spaces."""
    if isinstance(space, spaces.Dict):
        return dict(space.spaces)
    if isinstance(space, spaces.Tuple):
        return dict(enumerate(space.spaces))
    return {}


def leaves_of(space: spaces.Space[Any]) -> list[spaces.Space[Any]]:
    """Return the innermost spaces of nested Dicts and Tuples."""
    if not isinstance(space, (spaces.Dict, spaces.Tuple)):
        return [space]
    return [leaf for part in parts_of(space).values() for leaf in leaves_of(part)]


def counted_from_zero(space: spaces.Space[Any]) -> spaces.Space[Any]:
    """
    Return the space with every ``start`` at 0; the same object if it has that already.

    Stable-Baselines3 encodes and samples Discrete and MultiDiscrete from 0, whatever their start.
    """
    if isinstance(space, spaces.Discrete) and space.start != 0:
        return spaces.Discrete(int(space.n))
    if isinstance(space, spaces.MultiDiscrete) and np.any(space.start != 0):
        return spaces.MultiDiscrete(space.nvec, dtype=space.dtype.type)
    parts = parts_of(space)
    shifted = {key: counted_from_zero(part) for key, part in parts.items()}
    if all(shifted[key] is part for key, part in parts.items()):
        return space
    if isinstance(space, spaces.Dict):
        return spaces.Dict(list(shifted.items()))  # a dict would be sorted by key
    return spaces.Tuple(tuple(shifted.values()))


def first_value(space: spaces.Space[Any]) -> Any:
    """Return the ``start`` of Discrete and MultiDiscrete, 0 for other spaces."""
    return space.start if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)) else 0


class SpaceReader:
    """
    Check and convert a game's values for one space.

    Shape and kind of the numbers must be those of the space. Integers outside the bounds, which index tables, are
    refused. With ``notes``, NaN and infinity are refused, too, and floats outside the bounds are noted once.

    :param space: the game's space: of fixed shape, or a Dict or Tuple of such spaces
    :param notes: gets the first note
    :param float64: whether Boxes of float64 stay so; they become float32 otherwise
    """

    def __init__(self, space: spaces.Space[Any], notes: list[str] | None = None, float64: bool = True) -> None:
        self.space = space
        #: Space of the results of :meth:`read`.
        self.rows: spaces.Space[Any] = counted_from_zero(space)
        if not float64 and isinstance(space, spaces.Box) and space.dtype == np.float64:
            with np.errstate(over="ignore"):
                self.rows = spaces.Box(space.low.astype(np.float32), space.high.astype(np.float32), dtype=np.float32)
        self._notes = notes
        self._parts = {key: SpaceReader(part, notes) for key, part in parts_of(space).items()}
        if not self._parts and isinstance(space, FIXED_SHAPE):
            self._start = first_value(space)
            self._is_shifted = bool(np.any(self._start != 0))
            self._shape, self._dtype = space.shape, np.dtype(space.dtype)
            self._is_float = self._dtype.kind == "f"
            self._low, self._high = None, None
            if notes is not None or not self._is_float:
                low, high = bounds_of(space)
                limits = (-np.inf, np.inf) if self._is_float else _limits(self._dtype)
                self._low, self._high = _unless_always(low, limits[0]), _unless_always(high, limits[1])

    def blank(self) -> Any:
        """Return an observation of zeros."""
        return _zeros(self.rows)

    def read(self, value: Any, owner: str) -> Any:
        """
        Check a value and convert it to the space's shape and dtype, counted from 0.

        :param value: value from the game
        :param owner: owner of the value, for the message
        :raises ValueError: if it does not lie in the space
        """
        if not self._parts:
            return self._read_array(value, owner)
        if isinstance(self.space, spaces.Dict):
            if not isinstance(value, Mapping) or set(value) != set(self._parts):
                got = list(value) if isinstance(value, Mapping) else type(value).__name__
                raise ValueError(f"observation of {owner}: expected a dict with {list(self._parts)}, got {got}")
            return {key: part.read(value[key], f"{owner}, {key!r}") for key, part in self._parts.items()}
        if not isinstance(value, (tuple, list)) or len(value) != len(self._parts):
            raise ValueError(f"observation of {owner}: expected {len(self._parts)} parts, got {value!r}")
        return tuple(part.read(value[i], f"{owner}, part {i}") for i, part in self._parts.items())

    def _read_array(self, value: Any, owner: str) -> Array:
        array = value if type(value) is np.ndarray else _as_array(value)
        if array.dtype != self._dtype or array.shape != self._shape:
            if array.shape != self._shape or not np.can_cast(array.dtype, self._dtype, "same_kind"):
                raise ValueError(
                    f"observation of {owner}: expected {self._dtype} of shape {self._shape}, "
                    f"got {array.dtype} of shape {array.shape}"
                )
            if self._is_float:  # bounds are rounded to the dtype, so values must be before they are compared
                array = array.astype(self._dtype)
        if self._notes is not None and self._is_float and not np.isfinite(array).all():
            raise ValueError(
                f"observation of {owner}: expected finite values, got {array[~np.isfinite(array)].reshape(-1)[0]}"
            )
        if self._high is not None and _any_above(array, self._high):
            self._report(array, array > self._high, owner)
        if self._low is not None and (array < self._low).any():
            self._report(array, array < self._low, owner)
        if self._is_shifted:
            array = array - self._start
        with np.errstate(over="ignore"):
            return array.astype(self.rows.dtype, copy=False)

    def _report(self, array: Array, outside: Any, owner: str) -> None:
        """Raise ValueError for integers outside the bounds, note floats."""
        low, high = bounds_of(self.space)
        message = (
            f"observation of {owner}: expected values from {np.min(low)} to {np.max(high)} as in {self.space}, got "
            f"{array[outside].reshape(-1)[0]}"
        )
        if not self._is_float:
            raise ValueError(f"{message}; make the space as wide as what the game gives")
        if self._notes is not None and not any(note.startswith("observation of") for note in self._notes):
            self._notes.append(message)


class FlatReader(SpaceReader):
    """
    Read a Dict or Tuple as one vector, as ``gymnasium.spaces.flatten`` makes it.

    :param space: see :class:`SpaceReader`
    :param notes: see :class:`SpaceReader`
    :param float64: see :class:`SpaceReader`
    """

    def __init__(self, space: spaces.Space[Any], notes: list[str] | None = None, float64: bool = True) -> None:
        super().__init__(space, notes)
        self._structured = self.rows
        flat = spaces.flatten_space(self._structured)
        assert isinstance(flat, spaces.Box)
        leaves = leaves_of(self._structured)
        if any(_is_picture(leaf) for leaf in leaves):
            flat = PartsSpace(flat, _parts_of_vector(leaves))
        elif flat.dtype == np.float64 and not (float64 and any(leaf.dtype == np.float64 for leaf in leaves)):
            # Mixed integers and float32 would give float64, which takes twice the memory.
            flat = spaces.Box(flat.low.astype(np.float32), flat.high.astype(np.float32), dtype=np.float32)
        self.rows = flat

    def read(self, value: Any, owner: str) -> Any:
        """Check a value and flatten it (see the base class)."""
        return np.asarray(spaces.flatten(self._structured, super().read(value, owner)), dtype=self.rows.dtype)


def _is_picture(space: spaces.Space[Any]) -> bool:
    return isinstance(space, spaces.Box) and is_image_space(space)


def _parts_of_vector(leaves: Sequence[spaces.Space[Any]]) -> tuple[Part, ...]:
    ends = np.cumsum([spaces.flatdim(leaf) for leaf in leaves]).tolist()
    return tuple(
        Part(start, stop, leaf.shape if _is_picture(leaf) else None)
        for leaf, start, stop in zip(leaves, [0, *ends], ends, strict=False)
    )


def can_be_flattened(space: spaces.Space[Any]) -> bool:
    """Return whether a space is a Dict or a Tuple of pictures, scalars and vectors."""
    leaves = leaves_of(space)
    return space not in leaves and all(
        isinstance(leaf, FIXED_SHAPE) and (len(leaf.shape or ()) <= 1 or _is_picture(leaf)) for leaf in leaves
    )


def checked_actions(space: spaces.Space[Any], agents: Sequence[Any], n_rows: int, actions: npt.ArrayLike) -> Array:
    """
    Check the actions of all rows and convert them to the dtype of their space.

    :param space: action space of a row
    :param agents: N names, for messages
    :param n_rows: B
    :param actions: (B, ...)
    :return: a copy
    :raises ValueError: naming the first row with actions that are not in the space
    """
    array = np.asarray(actions)
    shape = (n_rows, *(space.shape or ()))
    dtype = np.dtype(space.dtype)
    if array.shape != shape or array.dtype.kind not in _kinds_of_actions(space):
        raise ValueError(
            f"expected actions from {space} for {shape[0]} rows, {dtype} of shape {shape}, "
            f"got {array.dtype} of shape {array.shape}"
        )
    if dtype.kind == "f":  # bounds are rounded to the dtype, so actions must be before they are compared
        with np.errstate(over="ignore"):
            array = array.astype(dtype, copy=False)
    elif array.dtype.kind == "f" and isinstance(space, spaces.Box):
        array = np.rint(array)
    low, high = bounds_of(space)
    inside = (array >= low) & (array <= high)
    if isinstance(space, spaces.MultiBinary):
        inside &= (array == 0) | (array == 1)
    if not inside.all():
        row = int(np.argwhere(~inside)[0, 0])
        game, agent = divmod(row, len(agents))
        raise ValueError(f"expected actions from {space}, got {array[row]} in row {row} (game {game}, {agents[agent]})")
    return np.array(array, dtype=dtype)  # a copy: the caller may reuse its array


def _kinds_of_actions(space: spaces.Space[Any]) -> str:
    """Return the allowed dtype kinds of actions; SB3's policies give floats for MultiBinary and for every Box."""
    if isinstance(space, spaces.MultiBinary):
        return "biuf"
    return "fiu" if isinstance(space, spaces.Box) else "iu"


def _as_array(value: Any) -> Array:
    try:
        return np.asarray(value)
    except ValueError:  # lists of unequal lengths
        return np.asarray(None)


def _limits(dtype: np.dtype[Any]) -> tuple[int, int]:
    return (0, 1) if dtype.kind == "b" else (np.iinfo(dtype).min, np.iinfo(dtype).max)


def _unless_always(bound: Any, limit: float) -> Any:
    """Return a bound, as one number if all entries have the same; None if it is the limit of the dtype."""
    if np.all(bound == limit):
        return None
    first = np.asarray(bound).reshape(-1)[0]
    return first if np.all(bound == first) else bound


def _any_above(array: Array, high: Any) -> bool:
    # One pass over the array if one number bounds all entries: tile codes are checked at every step.
    return bool((array.max() > high) if np.ndim(high) == 0 else (array > high).any())


def _zeros(space: spaces.Space[Any]) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: _zeros(part) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_zeros(part) for part in space.spaces)
    assert space.shape is not None
    return np.zeros(space.shape, space.dtype)
