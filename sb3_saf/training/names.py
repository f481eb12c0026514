"""Names that users type: what to say when one is unknown."""

from __future__ import annotations

from collections.abc import Iterable

from hecogrid_envs.task import did_you_mean


def unknown_name(kind: str, name: object, known: Iterable[str]) -> ValueError:
    """Return an error for a name of a kind, such as ``"algorithm"``, that is none of the known ones."""
    names = list(known)
    return ValueError(f"unknown {kind} {name!r}{did_you_mean(name, names)}; there is {', '.join(names)}")
