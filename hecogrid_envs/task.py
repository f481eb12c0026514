"""Declarations of tasks, by name, and the documentation text that they share."""

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


#: Documentation of all tasks, appended to the page of each.
COMMON_PAGE = """\
## Description

A cooperative gridworld from HECOGrid (arXiv 2210.03022) with two dials: **coordination**, how many agents one treasure
needs, and **heterogeneity**, how many zones (vertical stripes) with different dynamics the map has. The outer ring of
the map is wall. Treasures, clutter walls and keys lie on distinct random cells; agents start on random cells that they
may stand on, facing random directions. Agents may share a cell. Walls and keys block movement; treasures do not.

## Actions

`Discrete(7)`. The table holds in zone 0. In zone z the integers are permuted: with P the 5040 permutations of (0..6)
in lexicographic order, command k is triggered by the integer `P[500 * z][k]`. The zone is that of the agent's cell when
the step begins. Agents act one after the other, each seeing the effects of those before it, in an order drawn anew
each step (`agent_order="random"`) or by index.

| integer | command | effect |
| --- | --- | --- |
| 0 | left | turn left |
| 1 | right | turn right |
| 2 | forward | enter the cell in front unless it holds a wall or a key; try to collect a treasure there |
| 3 | pickup | try to collect the treasure underfoot; take the key in front if carrying none |
| 4 | drop | put a carried key on the cell in front if nothing and nobody is there |
| 5 | toggle | none |
| 6 | done | none |

## Observation

Each agent sees the `view_size` x `view_size` cells around its front, turned so that it faces up; it stands in the
middle column, `view_offset` rows above the bottom. Walls hide what lies behind them. With `observation="rgb"`:
`Box(0, 255, (28, 28, 3), uint8)` for the defaults (7 cells of 4 pixels). With `observation="tiles"` the same view is
one code per cell, a `TileSpace` of shape (7, 7): its `atlas` turns codes into exactly those pixels. An agent's colour
tells its zone, or that it carries a key; `agent_colours="none"` hides zones, `"action"` shows the integer of the
agent's last action instead. In a cell with several agents the viewer draws itself, otherwise the first
to arrive.

## State

`state()` is the whole game in planes, (W, H, 10) float32. `get_state()` and `set_state(mapping)`, also
`reset(options={"state": mapping})`, use plain arrays: `walls` (W, H), `treasures` (W, H) with 0 none, 1 available,
2 collected, `keys` (W, H), `agent_pos` (N, 2) as x, y, `agent_dir` (N,), `agent_has_key` (N,).

## Reward and end

Every treasure collected in a step is worth 1 to the team, shared equally. With 10 agents and 2 treasures collected in
one step each agent receives 0.2. The team's return, summed over agents and steps, is the number of treasures collected.
A collected treasure stays on the map in another colour and never pays again. Nobody dies; the episode is truncated
after `max_cycles` game steps.

## Arguments

All parameters with defaults and ranges: `hecogrid_envs.HECOGridParams`. `rules="released"` reproduces the code that
published numbers came from instead of the paper's rules: zones `x // (W // h)`, agents' colours one step old and blue
before the first step, support counted around the agent before it acts, KeyForTreasure with support instead of a shared
cell, other colours of collected treasures and key carriers, and directions kept from the last episode (east at first,
and after every explicit seed).

## Version history

* v0: first version
"""
