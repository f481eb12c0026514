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
    step: int,
    collected: int,
    zones: Sequence[int] | npt.NDArray[np.integer[Any]] | None = None,
) -> str:
    """
    Write a state as text.

    :param step: game steps so far
    :param collected: treasures so far
    :param zones: (W,) zone of each column, written above the map as digits and letters
    :return: lines, without a final newline
    """
    lines = [f"step {step}  collected {collected}"]
    if zones is not None:
        lines.append("".join(_ZONE_DIGITS[int(zone) % len(_ZONE_DIGITS)] for zone in zones))
    treasures = np.asarray(state["treasures"])
    ground = np.full(treasures.shape, FLOOR)
    ground[np.asarray(state["walls"], dtype=bool)] = WALL
    ground[treasures == TreasureState.AVAILABLE] = TREASURE
    ground[treasures == TreasureState.COLLECTED] = COLLECTED
    ground[np.asarray(state["keys"], dtype=bool)] = KEY
    cells, crowds, words = ground.copy(), Counter[tuple[int, int]](), []
    agents = zip(state["agent_pos"], state["agent_dir"], state["agent_has_key"], strict=True)
    for index, ((x, y), direction, has_key) in enumerate(agents):
        character = (CARRIER if has_key else AGENT)[direction]
        words.append(f"{index}{character}{x},{y}{ground[x, y].replace(FLOOR, '')}")
        crowds[x, y] += 1
        count = crowds[x, y]
        cells[x, y] = character if count == 1 else str(count) if count <= 9 else MANY
    lines += ["".join(row) for row in cells.T]
    lines += wrap(" ".join(words), _PAGE_WIDTH, initial_indent="agents ", subsequent_indent="agents ")
    return "\n".join([*lines, LEGEND])
