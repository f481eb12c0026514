"""What a stranger wrote: JSON without surprises, and the entries of its objects, each checked for kind and size."""

from __future__ import annotations

import json
from collections.abc import Callable
from math import prod
from typing import Any, Final, NoReturn

from sb3_saf.export.errors import ExportError

#: Far above what anybody trains, far below what hurts: a size, the entries of an array, letters.
MAX_SIZE: Final = 1 << 20
MAX_ENTRIES: Final = 1 << 22
_MAX_TEXT: Final = 200


def strict_json(text: bytes, where: str) -> Any:
    """JSON without what Python's parser lets through: NaN, infinities, names that occur twice."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        names = [name for name, _ in pairs]
        if len(set(names)) != len(names):
            raise ValueError("a name occurs twice")
        return dict(pairs)

    def constant(name: str) -> NoReturn:
        raise ValueError(f"{name} is no number")

    try:
        return json.loads(text.decode("utf-8"), object_pairs_hook=unique, parse_constant=constant)
    except (ValueError, RecursionError) as error:
        refuse(f"{where} is not valid JSON: {error}", error)


def refuse(message: str, cause: Exception | None = None) -> NoReturn:
    """Say what is wrong with a file."""
    raise ExportError(message) from cause


def short(value: object) -> str:
    """A value for a message, cut if a stranger made it long."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # numbers of thousands of digits
        return f"a {type(value).__name__}"
    return text if len(text) <= 60 else f"{text[:57]}..."


class Entries:
    """
    The entries of a JSON object, taken out one by one.

    :param value: what should be an object
    :param where: its name, for messages
    """

    def __init__(self, value: object, where: str):
        if not isinstance(value, dict):
            refuse(f"{where} must be an object with named entries, got {short(value)}")
        self.value, self.where = value, where
        self.taken: set[str] = set()

    def raw(self, name: str) -> Any:
        """Any value."""
        if name not in self.value:
            refuse(f"{self.where} lacks {name!r}")
        self.taken.add(name)
        return self.value[name]

    def text(self, name: str) -> str:
        """A short text."""
        value = self.raw(name)
        if not isinstance(value, str) or len(value) > _MAX_TEXT:
            refuse(f"{self.where}.{name} must be a text of at most {_MAX_TEXT} letters, got {short(value)}")
        return value

    def word(self, name: str, choices: tuple[str, ...]) -> str:
        """One of a few words."""
        value = self.raw(name)
        if not isinstance(value, str) or value not in choices:
            refuse(f"{self.where}.{name} must be one of {', '.join(choices)}, got {short(value)}")
        return value

    def flag(self, name: str) -> bool:
        """True or false."""
        value = self.raw(name)
        if not isinstance(value, bool):
            refuse(f"{self.where}.{name} must be true or false, got {short(value)}")
        return value

    def size(self, name: str, most: int = MAX_SIZE) -> int:
        """A whole number of at least 1."""
        return self._size(self.raw(name), name, most)

    def _size(self, value: object, name: str, most: int = MAX_SIZE) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
            refuse(f"{self.where}.{name} must be a whole number in 1..{most}, got {short(value)}")
        return value

    def sizes(self, name: str, most: int) -> tuple[int, ...]:
        """A list of whole numbers of at least 1."""
        value = self.raw(name)
        if not isinstance(value, list) or len(value) > most:
            refuse(f"{self.where}.{name} must be a list of at most {most} whole numbers, got {short(value)}")
        return tuple(self._size(number, name) for number in value)

    def atlas(self, name: str) -> tuple[int, int, int, int] | None:
        """Shape of an atlas, or None."""
        if self.raw(name) is None:
            return None
        shape = self.sizes(name, 4)
        if len(shape) != 4 or shape[1] != shape[2] or prod(shape) > MAX_ENTRIES:
            refuse(f"{self.where}.{name} must be (codes, tile, tile, channels), got {shape}")
        return shape[0], shape[1], shape[2], shape[3]

    def optional(self, name: str, parse: Callable[[object, str], Any]) -> Any:
        """What ``parse`` makes of it, or None."""
        value = self.raw(name)
        return None if value is None else parse(value, name)

    def finish(self) -> None:
        """Refuse entries that nobody asked for."""
        unknown = sorted(set(self.value) - self.taken)
        if unknown:
            refuse(f"{self.where} has an unknown entry {short(unknown[0])}")
