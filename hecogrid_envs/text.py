"""
Games as text, and levels from text.

One character per cell, then a list of the agents with their index and ground, for which a cell has no room. The text
holds the complete state mapping, so that a printed game can be read back::

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

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from hecogrid_envs.constants import TreasureState
from hecogrid_envs.state import StateMapping

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
_AGENT_WORD: Final = re.compile(rf"(\d+)([{re.escape(AGENT + CARRIER)}])(\d+),(\d+)([$_]?)")
_PAGE_WIDTH: Final = 100

_Planes = tuple[npt.NDArray[np.bool_], npt.NDArray[np.uint8], npt.NDArray[np.bool_]]


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
    legend: bool = True,
) -> str:
    """
    Write a state as text.

    :param zones: (W,) zone of each column, written above the map as digits and letters
    :param step: game steps so far
    :param legend: end with a line that explains the characters
    :return: lines, without a final newline; :func:`parse_level` reads them back
    """
    lines = []
    known = [f"{name} {value}" for name, value in (("step", step), ("collected", collected)) if value is not None]
    if known:
        lines.append("  ".join(known))
    if zones is not None:
        lines.append("".join(_ZONE_DIGITS[int(zone) % len(_ZONE_DIGITS)] for zone in zones))
    lines += ["".join(row) for row in _characters(state).T]
    lines += _agent_lines(state)
    if legend:
        lines.append(LEGEND)
    return "\n".join(lines)


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


# --- reading


def parse_level(text: str) -> StateMapping:
    """
    Read a level that was printed by :func:`render_text` or drawn by hand.

    The map is the block of lines that begin with ``#``. Without an ``agents`` line the agents are numbered in reading
    order and stand on plain floor; with one, its numbers, grounds and directions apply, and agents may be left out
    of the map (``#.$.#`` with ``agents 0>2,1`` puts agent 0 on the treasure). Spaces are floor, too.

    :param text: the level; indentation, empty lines, step, zones and legend are ignored
    :return: state mapping; whether it fits an environment is checked by the environment
    :raises ValueError: naming the first line or cell that cannot be read
    """
    rows, words = _sort_lines(text)
    planes, drawn, crowds = _read_map(rows)
    if words:
        agents = _place_agents(words, planes, {(a.x, a.y) for a in drawn} | set(crowds))
    elif crowds:
        x, y = crowds[0]
        raise ValueError(f"several agents share cell ({x}, {y}); add a line that lists all, such as 'agents 0>{x},{y}'")
    else:
        agents = drawn
    walls, treasures, keys = planes
    return StateMapping(
        walls=walls,
        treasures=treasures,
        keys=keys,
        agent_pos=np.array([(agent.x, agent.y) for agent in agents], dtype=np.int64).reshape(-1, 2),
        agent_dir=np.array([agent.direction for agent in agents], dtype=np.int64),
        agent_has_key=np.array([agent.has_key for agent in agents], dtype=np.bool_),
    )


def _sort_lines(text: str) -> tuple[list[str], list[str]]:
    """Return the rows of the map, and the words of the ``agents`` lines."""
    rows: list[str] = []
    words: list[str] = []
    ended = False
    for line in map(str.strip, text.splitlines()):
        if line.startswith("agents"):
            words += line.split()[1:]
        elif line.startswith(WALL) and not ended:
            rows.append(line)
            continue
        elif line and not _is_remark(line, after_map=bool(rows)):
            raise ValueError(f"line {line!r} is no row of the map (they begin with '#'), and no 'agents' line either")
        ended = bool(rows)
    if not rows:
        raise ValueError("the text holds no map: its rows begin with '#'")
    return rows, words


def _is_remark(line: str, after_map: bool) -> bool:
    """Return whether a line is a remark: step, score and zones above the map, the legend anywhere."""
    heading = not after_map and re.fullmatch(r"(step|collected) \d+.*|[0-9a-z]+", line) is not None
    return heading or line.startswith("legend")


def _read_map(rows: list[str]) -> tuple[_Planes, list[_Agent], list[tuple[int, int]]]:
    """Return planes, agents drawn alone in their cells, and cells of crowds, both in reading order."""
    shape = (len(rows[0]), len(rows))
    walls, treasures, keys = np.zeros(shape, np.bool_), np.zeros(shape, np.uint8), np.zeros(shape, np.bool_)
    drawn: list[_Agent] = []
    crowds: list[tuple[int, int]] = []
    for y, row in enumerate(rows):
        if len(row) != shape[0]:
            raise ValueError(f"all rows of the map must be {shape[0]} long as the first is, row {y} is {len(row)}")
        for x, character in enumerate(row):
            if character == WALL:
                walls[x, y] = True
            elif character == KEY:
                keys[x, y] = True
            elif character in (TREASURE, COLLECTED):
                treasures[x, y] = TreasureState.AVAILABLE if character == TREASURE else TreasureState.COLLECTED
            elif character in AGENT + CARRIER:
                drawn.append(_Agent(x, y, (AGENT + CARRIER).index(character) % 4, character in CARRIER))
            elif character in "23456789" + MANY:
                crowds.append((x, y))
            elif character not in (FLOOR, " "):
                raise ValueError(f"cell ({x}, {y}) holds {character!r}, which means nothing ({LEGEND})")
    return (walls, treasures, keys), drawn, crowds


def _place_agents(words: list[str], planes: _Planes, occupied: set[tuple[int, int]]) -> list[_Agent]:
    """Read the ``agents`` line and place treasures under agents that stand on them."""
    walls, treasures, _ = planes
    agents: dict[int, _Agent] = {}
    for word in words:
        match = _AGENT_WORD.fullmatch(word)
        if match is None:
            raise ValueError(
                f"agent {word!r} cannot be read; write index, direction, x,y, ground, such as 0>2,1 or 3N4,5$"
            )
        index, x, y = (int(match[group]) for group in (1, 3, 4))
        if index in agents:
            raise ValueError(f"agent {index} is listed twice")
        if x >= walls.shape[0] or y >= walls.shape[1]:
            raise ValueError(
                f"agent {index} stands at ({x}, {y}), beyond the map of {walls.shape[0]} x {walls.shape[1]}"
            )
        agents[index] = _Agent(x, y, (AGENT + CARRIER).index(match[2]) % 4, match[2] in CARRIER)
        if match[5]:
            treasures[x, y] = TreasureState.AVAILABLE if match[5] == TREASURE else TreasureState.COLLECTED
    if sorted(agents) != list(range(len(agents))):
        raise ValueError(f"agents must be numbered from 0 to {len(agents) - 1}, got {sorted(agents)}")
    unknown = sorted(occupied - {(agent.x, agent.y) for agent in agents.values()})
    if unknown:
        raise ValueError(f"the map shows an agent at {unknown[0]}, the 'agents' line does not")
    return [agents[index] for index in range(len(agents))]
