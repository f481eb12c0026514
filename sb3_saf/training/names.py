"""Names that users type: what to say when one is unknown."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def unknown_name(kind: str, name: object, known: Iterable[str]) -> ValueError:
    """
    An error for a name that does not exist, with the nearest one that does.

    :param kind: what was named, such as ``"algorithm"``
    :param name: what came
    :param known: the names that exist
    """
    names = list(known)
    close = get_close_matches(str(name), names, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    return ValueError(f"unknown {kind} {name!r}{hint}; there is {', '.join(names)}")
