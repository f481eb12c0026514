"""Numbers and colours of the rule book (HECOGrid, arXiv 2210.03022, sections 3 and 4 and appendix)."""

from __future__ import annotations

from enum import IntEnum
from typing import Final, Literal

import numpy as np

Rules = Literal["paper", "released"]
AgentOrder = Literal["random", "index"]
Observation = Literal["rgb", "tiles"]
AgentColours = Literal["zone", "none", "action"]
RenderMode = Literal["rgb_array", "human", "ansi"]


class Command(IntEnum):
    """Commands of an agent. In zone 0 the action integer is the command; elsewhere the zone permutes them."""

    LEFT = 0
    RIGHT = 1
    FORWARD = 2
    PICKUP = 3
    DROP = 4
    TOGGLE = 5
    DONE = 6


class Direction(IntEnum):
    """Directions that an agent can face; y grows downwards."""

    EAST = 0
    SOUTH = 1
    WEST = 2
    NORTH = 3


class Terrain(IntEnum):
    """Contents of a cell apart from agents."""

    EMPTY = 0
    WALL = 1
    TREASURE = 2
    COLLECTED = 3
    KEY = 4


class TreasureState(IntEnum):
    """Values of the ``treasures`` plane of a state mapping."""

    NONE = 0
    AVAILABLE = 1
    COLLECTED = 2


N_ACTIONS: Final = len(Command)

#: (dx, dy) of one step in each direction.
STEP: Final = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)], dtype=np.int64)

Colour = tuple[int, int, int]

INVISIBLE_COLOUR: Final[Colour] = (35, 25, 30)
EMPTY_COLOUR: Final[Colour] = (0, 0, 0)
WALL_COLOUR: Final[Colour] = (74, 65, 42)
KEY_COLOUR: Final[Colour] = (255, 255, 0)
YELLOW: Final[Colour] = (255, 255, 0)
GREEN: Final[Colour] = (0, 255, 0)
GREY: Final[Colour] = (100, 100, 100)
BLACK: Final[Colour] = (0, 0, 0)
#: Colours of treasures in pictures for people.
EMERALD: Final[Colour] = (38, 222, 129)
GOLD: Final[Colour] = (255, 205, 60)

#: Colours distinguishable by colour-blind people (Okabe and Ito, 2008), for pictures for people.
OKABE_ITO: Final[dict[str, Colour]] = {
    "blue": (0, 114, 178),
    "orange": (230, 159, 0),
    "purple": (204, 121, 167),
    "green": (0, 158, 115),
    "sky": (86, 180, 233),
    "vermillion": (213, 94, 0),
    "yellow": (240, 228, 66),
    "white": (240, 240, 240),
}

#: In observations: colour of an agent by its zone, repeating beyond the last.
ZONE_COLOURS: Final[tuple[Colour, ...]] = (
    (255, 0, 0),
    (255, 165, 0),
    (0, 255, 0),
    (0, 0, 255),
    (0, 139, 139),
    (112, 39, 195),
    (255, 255, 0),
    (0, 255, 255),
    (0, 128, 128),
    (39, 112, 195),
    (192, 195, 112),
    (95, 255, 128),
    (139, 128, 255),
    (128, 128, 0),
)
#: Paper rules: an agent that carries a key has a colour that no zone has.
KEY_CARRIER_COLOUR: Final[Colour] = (255, 0, 189)

#: Agent colours by index: the zones' and, last, the paper's key carrier.
AGENT_PALETTE: Final[tuple[Colour, ...]] = (*ZONE_COLOURS, KEY_CARRIER_COLOUR)
KEY_CARRIER_INDEX: Final = len(ZONE_COLOURS)
#: Released rules: agents that carry a key, and all agents before the first step, are blue.
BLUE_INDEX: Final = ZONE_COLOURS.index((0, 0, 255))

#: Zone z permutes the actions by the permutation number ``ZONE_STRIDE * z`` in lexicographic order ...
ZONE_STRIDE: Final = 500
#: ... as long as there are no more zones than this; beyond, the stride is 5040 // h.
MAX_ZONES_AT_STRIDE: Final = 11


def zone_colour(zone: int) -> Colour:
    """Return the colour of a zone in pictures for people."""
    return list(OKABE_ITO.values())[zone % len(OKABE_ITO)]
