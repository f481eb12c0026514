"""
Games as text: one character per cell, then a list of the agents with their index and ground, for which a cell has no
room::

    step 3  collected 1
    000000111111
    ############
    #.>.$..k.W.#
    #.#._2.....#
    ############
    agents 0>2,1 1W9,1 2^5,2$ 3<5,2$
    legend: # wall  . floor  $ treasure  _ collected  k key  > v < ^ agent  E S W N agent with a key  2-9 + several
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from textwrap import wrap
from typing import Any, Final

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


def render_text(
    state: Mapping[str, Any],
    *,
    zones: Sequence[int] | npt.NDArray[np.integer[Any]] | None = None,
    step: int | None = None,
    collected: int | None = None,
    legend: bool = True,
) -> str:
    """
    Write a state as text.

    :param zones: (W,) zone of each column, written above the map as digits and letters
    :param step: game steps so far
    :param collected: treasures collected so far
    :param legend: end with a line that explains the characters
    :return: lines, without a final newline
    """
    lines = []
    known = [f"{name} {value}" for name, value in (("step", step), ("collected", collected)) if value is not None]
    if known:
        lines.append("  ".join(known))
    if zones is not None:
        lines.append("".join(_ZONE_DIGITS[int(zone) % len(_ZONE_DIGITS)] for zone in zones))
    treasures = np.asarray(state["treasures"])
    characters = np.full(treasures.shape, FLOOR)
    characters[np.asarray(state["walls"], dtype=bool)] = WALL
    characters[treasures == TreasureState.AVAILABLE] = TREASURE
    characters[treasures == TreasureState.COLLECTED] = COLLECTED
    characters[np.asarray(state["keys"], dtype=bool)] = KEY
    positions = [(int(x), int(y)) for x, y in np.reshape(state["agent_pos"], (-1, 2))]
    agents = [
        (CARRIER if has_key else AGENT)[int(direction)]
        for direction, has_key in zip(state["agent_dir"], state["agent_has_key"], strict=True)
    ]
    # Each agent as ``index, direction, x,y, ground``.
    words = []
    for index, ((x, y), agent) in enumerate(zip(positions, agents, strict=True)):
        ground = ("", TREASURE, COLLECTED)[int(treasures[x, y])]
        words.append(f"{index}{agent}{x},{y}{ground}")
        characters[x, y] = agent
    for (x, y), count in Counter(positions).items():
        if count > 1:
            characters[x, y] = str(count) if count <= 9 else MANY
    lines += ["".join(row) for row in characters.T]
    if words:
        lines += wrap(" ".join(words), _PAGE_WIDTH, initial_indent="agents ", subsequent_indent="agents ")
    if legend:
        lines.append(LEGEND)
    return "\n".join(lines)
