"""Errors for unknown names typed by users."""

from __future__ import annotations

from collections.abc import Iterable

from hecogrid_envs.task import did_you_mean


def unknown_name(kind: str, name: object, known: Iterable[str]) -> ValueError:
    """Return an error for an unknown name of a kind, such as ``"algorithm"``."""
    names = list(known)
    return ValueError(f"unknown {kind} {name!r}{did_you_mean(name, names)}; there is {', '.join(names)}")
