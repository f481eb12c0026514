"""
A second implementation of the rules: one HECOGrid world in plain Python, to test the fast kernels.

It shares no code with ``hecogrid_envs`` and is not optimised. The rule book is what ``hecogrid_envs/task.py`` says of
all tasks, and the numbered list of ``docs/reference/differences.md``, whose numbers are the rows here:

=====================  ==============================================================================
rules                  here
=====================  ==============================================================================
Parameters             ``DEFAULTS``, ``ReferenceWorld.__init__``
World, State           ``set_state``, ``get_state`` (``cells`` keeps the order of arrival)
Actions                ``zone_of_column``, ``command``, ``step``, ``_forward``, ``_pickup``, ``_drop``
Collecting             ``_try_to_collect``, ``_enough_agents``
Reward and end         the last line of ``step``; the environment handles the time limit
Observation            ``visible``, ``view_cell``, ``observe``, ``_draw_tile``, ``_colour``
Paper and released     each ``self.released``, with the number of its row
=====================  ==============================================================================

Row 6 (directions at reset) and the generation of levels are not included: a world starts from a state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import permutations
from typing import Any

import numpy as np
import numpy.typing as npt

Colour = tuple[int, int, int]
Cell = tuple[int, int]
Image = npt.NDArray[np.uint8]
Inside = Callable[[float, float], bool]

DEFAULTS: dict[str, Any] = {
    "n_agents": 10,
    "grid_size": 30,
    "coordination": 1,
    "heterogeneity": 1,
    "n_treasures": 100,
    "n_keys": 30,
    "clutter_density": 0.1,
    "view_size": 7,
    "view_tile_size": 4,
    "view_offset": 1,
    "support_radius": 2,
    "max_cycles": 50,
    "rules": "paper",
    "agent_order": "random",
    "observation": "rgb",
    "agent_colours": "zone",
}
TASKS = ("TeamTogether", "TeamSupport", "KeyForTreasure")

LEFT, RIGHT, FORWARD, PICKUP, DROP, TOGGLE, DONE = range(7)
EAST, SOUTH, WEST, NORTH = range(4)
STEPS = {EAST: (1, 0), SOUTH: (0, 1), WEST: (-1, 0), NORTH: (0, -1)}
NO_TREASURE, AVAILABLE, COLLECTED = range(3)
ORDERS_OF_ACTIONS = list(permutations(range(7)))  # lexicographic, because the input is sorted

INVISIBLE: Colour = (35, 25, 30)
WALL: Colour = (74, 65, 42)
YELLOW: Colour = (255, 255, 0)
GREEN: Colour = (0, 255, 0)
BLUE: Colour = (0, 0, 255)
PINK: Colour = (255, 0, 189)
GREY: Colour = (100, 100, 100)
BLACK: Colour = (0, 0, 0)
ZONE_COLOURS: list[Colour] = [
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
]


class ReferenceWorld:
    """
    One world that follows the rule book.

    :param task: ``"TeamTogether"``, ``"TeamSupport"`` or ``"KeyForTreasure"``
    :param params: parameters with the rule book's names; missing ones have the rule book's defaults
    """

    def __init__(self, task: str, **params: Any) -> None:
        if task not in TASKS:
            raise ValueError(f"task must be one of {TASKS}, got {task!r}")
        unknown = set(params) - set(DEFAULTS)
        if unknown:
            raise ValueError(f"params must be among {sorted(DEFAULTS)}, got {sorted(unknown)}")
        values = {**DEFAULTS, **params}
        self.task = task
        self.n_agents: int = values["n_agents"]
        self.size: int = values["grid_size"]
        self.coordination: int = values["coordination"]
        self.heterogeneity: int = values["heterogeneity"]
        self.view: int = values["view_size"]
        self.tile: int = values["view_tile_size"]
        self.offset: int = values["view_offset"]
        self.radius: int = values["support_radius"]
        self.released: bool = values["rules"] == "released"
        self.colours: str = values["agent_colours"]

    # ------------------------------------------------------------------------------------------------ World, State

    def set_state(self, state: Mapping[str, Any]) -> None:
        """
        Start from a state. Agents in one cell are assumed to have arrived in index order, before the first step.

        :param state: the rule book's mapping; arrays or nested lists
        """
        size, n = self.size, self.n_agents
        everywhere = [(x, y) for x in range(size) for y in range(size)]
        self.walls: set[Cell] = {(x, y) for x, y in everywhere if state["walls"][x][y]}
        self.keys: set[Cell] = {(x, y) for x, y in everywhere if state["keys"][x][y]}
        self.treasures: dict[Cell, int] = {
            (x, y): int(state["treasures"][x][y]) for x, y in everywhere if state["treasures"][x][y] != NO_TREASURE
        }
        self.pos: list[Cell] = [(int(x), int(y)) for x, y in state["agent_pos"]]
        self.dir: list[int] = [int(d) for d in state["agent_dir"]]
        self.has_key: list[bool] = [bool(k) for k in state["agent_has_key"]]
        self.cells: dict[Cell, list[int]] = {}  # agents in each occupied cell, in order of arrival
        for agent in range(n):
            self.cells.setdefault(self.pos[agent], []).append(agent)
        self.last_action = [-1] * n
        self.last_shown: list[Colour] = [BLUE] * n  # released rules, row 2: blue before the first step

    def get_state(self) -> dict[str, npt.NDArray[Any]]:
        """
        The rule book's arrays. They do not hold the order of arrival, nor the stale colours of the released rules.

        :return: walls (W, H), treasures (W, H), keys (W, H), agent_pos (N, 2), agent_dir (N,), agent_has_key (N,)
        """
        walls = np.zeros((self.size, self.size), dtype=bool)
        keys = np.zeros((self.size, self.size), dtype=bool)
        treasures = np.zeros((self.size, self.size), dtype=np.uint8)
        for cell in self.walls:
            walls[cell] = True
        for cell in self.keys:
            keys[cell] = True
        for cell, status in self.treasures.items():
            treasures[cell] = status
        return {
            "walls": walls,
            "treasures": treasures,
            "keys": keys,
            "agent_pos": np.array(self.pos, dtype=np.int64).reshape(self.n_agents, 2),
            "agent_dir": np.array(self.dir, dtype=np.int64),
            "agent_has_key": np.array(self.has_key, dtype=bool),
        }

    def agents_in(self, cell: Cell) -> list[int]:
        """
        Return the agents in a cell.

        :return: agent indices in order of arrival
        """
        return list(self.cells.get(cell, []))

    # ----------------------------------------------------------------------------------------------------- Actions

    def zone_of_column(self, x: int) -> int:
        """
        Return the zone of column x.

        The released formula (row 1) gives one or more extra zones if h does not divide W.
        """
        if self.released:
            return x // (self.size // self.heterogeneity)
        return x * self.heterogeneity // self.size

    def command(self, zone: int, action: int) -> int:
        """
        Return the command of an action integer in a zone.

        The rule book does not define what follows the last of the 5040 permutations (with the released rules there are
        enough zones to get there); here the list starts again.
        """
        stride = 500 if self.heterogeneity <= 11 else 5040 // self.heterogeneity
        triggered_by = ORDERS_OF_ACTIONS[(stride * zone) % 5040]
        return triggered_by.index(action)

    def step(self, actions: Sequence[int], order: Sequence[int] | None = None) -> list[float]:
        """
        Let every agent act once.

        :param actions: one action integer per agent, by agent index
        :param order: order in which agents act; default: by index
        :return: each agent's reward
        """
        if order is None:
            order = range(self.n_agents)
        n_collected = 0
        for agent in order:
            # No other agent can move this agent, so its cell is still the one in which the step began.
            zone = self.zone_of_column(self.pos[agent][0])
            self.last_action[agent] = int(actions[agent])
            self.last_shown[agent] = self._present_colour(agent)
            n_collected += self._act(agent, self.command(zone, int(actions[agent])))
        return [n_collected / self.n_agents] * self.n_agents

    def _act(self, agent: int, command: int) -> int:
        if command == LEFT:
            self.dir[agent] = (self.dir[agent] - 1) % 4
        elif command == RIGHT:
            self.dir[agent] = (self.dir[agent] + 1) % 4
        elif command == FORWARD:
            return self._forward(agent)
        elif command == PICKUP:
            return self._pickup(agent)
        elif command == DROP:
            self._drop(agent)
        return 0

    def front(self, agent: int) -> Cell:
        """The cell that an agent faces."""
        (x, y), (dx, dy) = self.pos[agent], STEPS[self.dir[agent]]
        return (x + dx, y + dy)

    def _forward(self, agent: int) -> int:
        before, after = self.pos[agent], self.front(agent)
        if after in self.walls or after in self.keys:
            return 0
        self.cells[before].remove(agent)
        if not self.cells[before]:
            del self.cells[before]
        self.cells.setdefault(after, []).append(agent)
        self.pos[agent] = after
        return self._try_to_collect(agent, before)

    def _pickup(self, agent: int) -> int:
        # In this order: a key picked up by this action is too late for the treasure in the same cell.
        n_collected = self._try_to_collect(agent, self.pos[agent])
        if self.front(agent) in self.keys and not self.has_key[agent]:
            self.keys.remove(self.front(agent))
            self.has_key[agent] = True
        return n_collected

    def _drop(self, agent: int) -> None:
        front = self.front(agent)
        occupied = front in self.walls or front in self.keys or front in self.treasures or front in self.cells
        if self.has_key[agent] and not occupied:
            self.keys.add(front)
            self.has_key[agent] = False

    # -------------------------------------------------------------------------------------------------- Collecting

    def _try_to_collect(self, agent: int, before: Cell) -> int:
        """
        Collect the treasure under an agent if the task allows it.

        :param before: the agent's cell before its action
        :return: treasures collected, 0 or 1
        """
        cell = self.pos[agent]
        if self.treasures.get(cell) != AVAILABLE:
            return 0
        if self.task == "KeyForTreasure" and not self.has_key[agent]:
            return 0
        if not self._enough_agents(agent, before):
            return 0
        self.treasures[cell] = COLLECTED
        return 1

    def _enough_agents(self, agent: int, before: Cell) -> bool:
        here = self.pos[agent]
        if self.task == "TeamTogether":
            helpers = len(self.cells[here])
        elif self.task == "TeamSupport":
            helpers = self._agents_around(agent, before if self.released else here)  # row 3
        elif self.released:
            helpers = self._agents_around(agent, before)  # row 4
        else:
            helpers = len(self.cells[here])
        return helpers >= self.coordination

    def _agents_around(self, agent: int, centre: Cell) -> int:
        """Return the agents within the support radius of a cell, always including the acting agent."""
        count = 1
        for other, (x, y) in enumerate(self.pos):
            distance = max(abs(x - centre[0]), abs(y - centre[1]))
            if other != agent and distance <= self.radius:
                count += 1
        return count

    # ------------------------------------------------------------------------------------------------- Observation

    def view_cell(self, agent: int, column: int, row: int) -> Cell:
        """
        Return the map cell at a place of an agent's view; row 0 is the farthest ahead.

        :return: (x, y), possibly beyond the map
        """
        x, y = self.pos[agent]
        forward_x, forward_y = STEPS[self.dir[agent]]
        right_x, right_y = STEPS[(self.dir[agent] + 1) % 4]
        ahead = (self.view - 1 - self.offset) - row
        aside = column - self.view // 2
        return (x + ahead * forward_x + aside * right_x, y + ahead * forward_y + aside * right_y)

    def visible(self, agent: int) -> npt.NDArray[np.bool_]:
        """
        Return which cells of its view an agent sees, given the walls.

        :return: (view_size, view_size), indexed [column, row] as in the rule book
        """
        side = self.view
        ax, ay = side // 2, side - 1 - self.offset
        transparent = {(i, j): self.view_cell(agent, i, j) not in self.walls for i in range(side) for j in range(side)}
        seen = {(ax, ay)}

        def look(i: int, j: int, di: int, dj: int) -> None:
            if (i, j) in seen and transparent[i, j]:
                seen.update(c for c in [(i + di, j), (i, j + dj), (i + di, j + dj)] if c in transparent)

        for j in range(ay + 1, 0, -1):
            for i in range(ax, side):
                look(i, j, +1, -1)
            for i in range(ax + 1, 0, -1):
                look(i, j, -1, -1)
        for j in range(ay, side):
            for i in range(ax, side):
                look(i, j, +1, +1)
            for i in range(ax + 1, 0, -1):
                look(i, j, -1, +1)
        return np.array([[(i, j) in seen for j in range(side)] for i in range(side)])

    def observe(self, agent: int) -> Image:
        """
        An agent's picture.

        :return: (P, P, 3) with P = view_size * view_tile_size, indexed [pixel row, pixel column, channel]
        """
        t = self.tile
        tiles = np.empty((self.view, self.view, t, t, 3), dtype=np.uint8)
        seen = self.visible(agent)
        for i in range(self.view):
            for j in range(self.view):
                cell = self.view_cell(agent, i, j)
                tiles[j, i] = self._draw_cell(agent, cell) if seen[i, j] else _solid(t, INVISIBLE)
        # Tiles, including keys and grid lines, are drawn with north up and rotate with the map.
        turned = np.rot90(tiles, self.dir[agent] - NORTH, axes=(2, 3))
        return turned.swapaxes(1, 2).reshape(self.view * t, self.view * t, 3)

    def _draw_cell(self, viewer: int, cell: Cell) -> Image:
        """A visible cell as drawn on a map with north up."""
        if cell in self.walls:
            return _plain(self.tile, WALL)
        if cell in self.keys:
            return _finish(_key_tile(self.tile))
        agents = self.agents_in(cell)
        agent_tile = None
        if agents:
            drawn = viewer if viewer in agents else agents[0]
            agent_tile = _agent_tile(self.tile, self.dir[drawn], self._colour(drawn))
        if cell in self.treasures:
            colour = self._treasure_colour(self.treasures[cell])
            if agent_tile is None:
                return _plain(self.tile, colour)
            return _finish(_blend(_solid(self.tile, colour), agent_tile))
        return _plain(self.tile, BLACK) if agent_tile is None else _finish(agent_tile)

    def _treasure_colour(self, status: int) -> Colour:
        if status == AVAILABLE:
            return YELLOW if self.task == "TeamTogether" else GREEN
        return BLACK if self.released and self.task == "TeamTogether" else GREY  # row 5

    def _colour(self, agent: int) -> Colour:
        return self.last_shown[agent] if self.released else self._present_colour(agent)  # row 2

    def _present_colour(self, agent: int) -> Colour:
        if self.has_key[agent]:
            return BLUE if self.released else PINK  # row 5
        if self.colours == "action":
            return ZONE_COLOURS[self.last_action[agent] + 1]
        if self.colours == "none":
            return ZONE_COLOURS[0]
        return ZONE_COLOURS[self.zone_of_column(self.pos[agent][0]) % len(ZONE_COLOURS)]


# ------------------------------------------------------------------------------------------------------ Pixels of tiles


@cache
def _solid(t: int, colour: Colour) -> Image:
    return np.full((t, t, 3), colour, dtype=np.uint8)


@cache
def _plain(t: int, colour: Colour) -> Image:
    return _finish(_solid(t, colour))


def _finish(tile: Image) -> Image:
    """Add the thin grid line of large tiles, on the top row and the right column, if a corner is pure black."""
    t = len(tile)
    grey = max(0, min(20, t - 10))
    corners = [tile[0, 0], tile[0, t - 1], tile[t - 1, 0], tile[t - 1, t - 1]]
    if not any((corner == 0).all() for corner in corners):
        return tile
    line = np.zeros_like(tile)
    line[0, :] = grey
    line[:, t - 1] = grey
    return tile + line


def _blend(treasure: Image, agent: Image) -> Image:
    """Blend: treasure where the agent's tile is dark, agent where it is bright; fractions are truncated."""
    below, above = treasure.astype(int), agent.astype(int)
    a = above.sum(axis=2, keepdims=True)
    most = a.max()
    return ((below * (most - a) + above * a) // most).astype(np.uint8)


@cache
def _key_tile(t: int) -> Image:
    yellow_parts = [
        _rectangle(0.50, 0.63, 0.31, 0.88),
        _rectangle(0.38, 0.50, 0.59, 0.66),
        _rectangle(0.38, 0.50, 0.81, 0.88),
        _disc(0.56, 0.28, 0.190),
    ]
    hole = _disc(0.56, 0.28, 0.064)
    return _draw_shape(t, lambda x, y: any(part(x, y) for part in yellow_parts) and not hole(x, y), YELLOW)


@cache
def _agent_tile(t: int, heading: int, colour: Colour) -> Image:
    return _draw_shape(t, _turned(_triangle((0.12, 0.19), (0.87, 0.50), (0.12, 0.81)), heading), colour)


def _draw_shape(t: int, inside: Inside, colour: Colour) -> Image:
    """
    Draw a shape on black, sampled at the centres of 3 x 3 points per pixel.

    The truncated mean of n coloured points out of 9 is ``n * channel // 9``.
    """
    image = np.zeros((t, t, 3), dtype=np.uint8)
    for y in range(t):
        for x in range(t):
            points = [((3 * x + i + 0.5) / (3 * t), (3 * y + j + 0.5) / (3 * t)) for i in range(3) for j in range(3)]
            n = sum(inside(px, py) for px, py in points)
            image[y, x] = [n * channel // 9 for channel in colour]
    return image


def _rectangle(left: float, right: float, top: float, bottom: float) -> Inside:
    return lambda x, y: left <= x <= right and top <= y <= bottom


def _disc(cx: float, cy: float, radius: float) -> Inside:
    return lambda x, y: (x - cx) * (x - cx) + (y - cy) * (y - cy) <= radius * radius


def _turned(inside: Inside, quarters: int) -> Inside:
    """Rotate a shape clockwise (on the screen, y down) around the tile's centre, by rotating points back."""
    angle = quarters * math.pi / 2
    cos, sin = math.cos(-angle), math.sin(-angle)

    def turned(x: float, y: float) -> bool:
        dx, dy = x - 0.5, y - 0.5
        return inside(0.5 + dx * cos - dy * sin, 0.5 + dy * cos + dx * sin)

    return turned


def _triangle(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> Inside:
    """
    Return points on the same side of each edge, or on it.

    Up to 128 pixels per tile, sample points lie on an edge only at 100, where the result depends on rounding.
    """

    def side(p: tuple[float, float], q: tuple[float, float], x: float, y: float) -> float:
        return (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])

    return lambda x, y: side(a, b, x, y) >= 0 and side(b, c, x, y) >= 0 and side(c, a, x, y) >= 0
