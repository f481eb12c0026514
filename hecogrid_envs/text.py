"""
Games as text: one character per cell, then the agents with index, place and ground, for which a cell has no room.

::

    step 3  collected 1
    0000111
    #######
    #$_k.W#
    #v2.^.#
    #######
    agents 0^4,2$ 1>2,2 2v1,2 3W2,2 4W5,1
    legend: # wall  . floor  $ treasure  _ collected  k key  > v < ^ agent  E S W N agent with a key  2-9 + several
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from hecogrid_envs.constants import TreasureState

WALL: Final = "#"
FLOOR: Final = "."
TREASURE: Final = "$"
COLLECTED: Final = "_"
KEY: Final = "k"
#: An agent by its direction (east, south, west, north), without and with a key.
AGENT: Final = ">v<^"
CARRIER: Final = "ESWN"
#: Ten or more agents in one cell.
MANY: Final = "+"

LEGEND: Final = (
    "legend: # wall  . floor  $ treasure  _ collected  k key  > v < ^ agent  E S W N agent with a key  2-9 + several"
)

_ZONE_DIGITS: Final = "0123456789abcdefghijklmnopqrstuvwxyz"
_PAGE_WIDTH: Final = 100


class _Agent(NamedTuple):
    x: int
    y: int
    direction: int
    has_key: bool


def render_text(
    state: Mapping[str, Any],
    *,
    zones: Sequence[int] | npt.NDArray[np.integer[Any]] | None = None,
    step: int | None = None,
    collected: int | None = None,
) -> str:
    """
    Write a state as text.

    :param zones: (W,) zone of each column, written above the map as digits and letters
    :param step: game steps so far
    :return: lines, without a final newline
    """
    lines = []
    known = [f"{name} {value}" for name, value in (("step", step), ("collected", collected)) if value is not None]
    if known:
        lines.append("  ".join(known))
    if zones is not None:
        lines.append("".join(_ZONE_DIGITS[int(zone) % len(_ZONE_DIGITS)] for zone in zones))
    lines += ["".join(row) for row in _characters(state).T]
    return "\n".join([*lines, *_agent_lines(state), LEGEND])


def _characters(state: Mapping[str, Any]) -> npt.NDArray[np.str_]:
    """Return the character of each cell, (W, H)."""
    treasures = np.asarray(state["treasures"])
    characters = np.full(treasures.shape, FLOOR)
    characters[np.asarray(state["walls"], dtype=bool)] = WALL
    characters[treasures == TreasureState.AVAILABLE] = TREASURE
    characters[treasures == TreasureState.COLLECTED] = COLLECTED
    characters[np.asarray(state["keys"], dtype=bool)] = KEY
    agents = _agents(state)
    for agent in agents:
        characters[agent.x, agent.y] = (CARRIER if agent.has_key else AGENT)[agent.direction]
    for (x, y), count in Counter((agent.x, agent.y) for agent in agents).items():
        if count > 1:
            characters[x, y] = str(count) if count <= 9 else MANY
    return characters


def _agents(state: Mapping[str, Any]) -> list[_Agent]:
    positions = np.asarray(state["agent_pos"]).reshape(-1, 2).tolist()
    directions, keys = np.asarray(state["agent_dir"]).tolist(), np.asarray(state["agent_has_key"]).tolist()
    return [_Agent(x, y, int(d), bool(key)) for (x, y), d, key in zip(positions, directions, keys, strict=True)]


def _agent_lines(state: Mapping[str, Any]) -> list[str]:
    """List the agents as ``index, direction, x,y, ground``, wrapped into lines of a page's width."""
    grounds = {TreasureState.NONE: "", TreasureState.AVAILABLE: TREASURE, TreasureState.COLLECTED: COLLECTED}
    lines: list[str] = []
    for index, agent in enumerate(_agents(state)):
        ground = grounds[TreasureState(int(state["treasures"][agent.x, agent.y]))]
        word = f" {index}{(CARRIER if agent.has_key else AGENT)[agent.direction]}{agent.x},{agent.y}{ground}"
        if not lines or len(lines[-1]) + len(word) > _PAGE_WIDTH:
            lines.append("agents")
        lines[-1] += word
    return lines
