"""Declarations of tasks, by name."""

from __future__ import annotations

from collections.abc import Callable
from difflib import get_close_matches
from typing import TYPE_CHECKING, Final, NamedTuple

from hecogrid_envs.constants import EMERALD, GREEN, GREY, Colour

if TYPE_CHECKING:
    from hecogrid_envs.core.types import Games, World

#: Name of a declared task, such as ``"TeamSupport"``; :func:`check_task` checks it.
TaskName = str

#: ``condition(games, world, e, agent, old_x, old_y)``: whether an agent collects the treasure on its cell, a kernel
#: (:func:`hecogrid_envs.core.jit.inlined`). (old_x, old_y) is the cell where the agent's action began.
Condition = Callable[["Games", "World", int, int, int, int], bool]


class Task(NamedTuple):
    """
    Declaration of a task: everything in which tasks differ.

    :param name: its name
    :param condition: decides whether an agent collects a treasure
    :param has_keys: whether ``n_keys`` keys lie on the map
    :param treasure: colour of treasures in observations
    :param collected: colour of collected treasures in observations
    :param collected_released: the same under the released rules
    :param gem: colour of treasures in pictures for people
    """

    name: TaskName
    condition: Condition
    has_keys: bool = False
    treasure: Colour = GREEN
    collected: Colour = GREY
    collected_released: Colour = GREY
    gem: Colour = EMERALD


#: The declared tasks; each file in ``hecogrid_envs/tasks`` adds one.
DECLARED: Final[dict[TaskName, Task]] = {}


def check_task(task: object) -> TaskName:
    """Check a task's name; the ValueError suggests the nearest known name."""
    if isinstance(task, str) and task in DECLARED:
        return task
    raise ValueError(f"unknown task {task!r}{did_you_mean(task, list(DECLARED))}; the tasks are {', '.join(DECLARED)}")


def did_you_mean(value: object, known: list[str]) -> str:
    """Return `` (did you mean 'name'?)`` with the nearest known name, or an empty string if none is near."""
    close = get_close_matches(str(value), known, n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
