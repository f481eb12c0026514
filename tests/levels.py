"""
Levels drawn as text, for tests.

=======  ===================================================
``#``    wall
``.``    empty
``$``    treasure
``o``    collected treasure
``k``    key
``>v<^`` agent on an empty cell, facing east, south, west, north
=======  ===================================================

Drawn agents are numbered in reading order: line by line, left to right.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

State = dict[str, npt.NDArray[Any]]

FACING = {">": 0, "v": 1, "<": 2, "^": 3}
TREASURES = {"$": 1, "o": 2}


def level(text: str, agents: Sequence[tuple[int, int, int, bool]] = (), carrying: Collection[int] = ()) -> State:
    """
    Read a level.

    :param text: W lines of W characters; blank lines around it and spaces before and after each line are ignored
    :param agents: further agents as (x, y, direction, has key), numbered after those drawn; use it for agents on
        treasures and in shared cells
    :param carrying: numbers of drawn agents that carry a key
    :return: the state mapping
    """
    lines = [line.strip() for line in text.strip().splitlines()]
    size = len(lines)
    if any(len(line) != size for line in lines):
        raise ValueError(f"level must be as wide as high, got {size} lines of lengths {[len(line) for line in lines]}")
    state: State = {
        "walls": np.zeros((size, size), dtype=bool),
        "treasures": np.zeros((size, size), dtype=np.uint8),
        "keys": np.zeros((size, size), dtype=bool),
    }
    everyone = []
    for y, line in enumerate(lines):
        for x, char in enumerate(line):
            if char in FACING:
                everyone.append((x, y, FACING[char], False))
            elif char not in "#.$ok":
                raise ValueError(f"level must be drawn with #.$ok>v<^, got {char!r} at x={x}, y={y}")
            state["walls"][x, y] = char == "#"
            state["treasures"][x, y] = TREASURES.get(char, 0)
            state["keys"][x, y] = char == "k"
    everyone += agents
    state["agent_pos"] = np.array([(x, y) for x, y, _, _ in everyone], dtype=np.int64).reshape(-1, 2)
    state["agent_dir"] = np.array([direction for _, _, direction, _ in everyone], dtype=np.int64)
    state["agent_has_key"] = np.array([key or i in carrying for i, (_, _, _, key) in enumerate(everyone)], dtype=bool)
    return state


def params_for(state: Mapping[str, npt.NDArray[Any]]) -> dict[str, Any]:
    """
    Parameters of a world that the state fits into.

    :return: n_agents, grid_size, and as many treasures and keys as the state has on the map; no clutter
    """
    return {
        "n_agents": len(state["agent_pos"]),
        "grid_size": len(state["walls"]),
        "n_treasures": int(np.count_nonzero(state["treasures"])),
        "n_keys": int(np.count_nonzero(state["keys"])),
        "clutter_density": 0.0,
    }
