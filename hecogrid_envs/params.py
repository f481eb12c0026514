"""Parameters of a HECOGrid world, checked at construction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import permutations
from numbers import Real
from typing import Any, get_args

import numpy as np
import numpy.typing as npt

from hecogrid_envs.constants import (
    MAX_ZONES_AT_STRIDE,
    N_ACTIONS,
    ZONE_STRIDE,
    AgentColours,
    AgentOrder,
    Observation,
    Rules,
)
from hecogrid_envs.task import DECLARED, TaskName, did_you_mean

#: Largest view whose rows still fit into one unaligned 64-bit word of wall bits.
MAX_VIEW_SIZE = 57
MAX_GRID_SIZE = 1000
MAX_AGENTS = 32_000
MAX_TILE_SIZE = 128
#: Larger tiles have grid lines, which turn with the viewer, so that a tile code alone does not tell its pixels.
MAX_CODED_TILE_SIZE = 10


def whole_number(name: str, value: object, low: int, high: int, note: str = "") -> int:
    """Check that a value is an integer from ``low`` to ``high``; the ValueError names it."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not low <= value <= high:
        raise ValueError(f"{name} must be an integer from {low} to {high}{note}, got {value!r}")
    return int(value)


@dataclass(frozen=True)
class HECOGridParams:
    """
    Parameters of a world; the defaults are the paper's.

    :param n_agents: N, agents in the team
    :param grid_size: width and height of the map in cells, the outer wall included
    :param coordination: c, agents needed for one treasure, the collector included; 1 <= c <= N
    :param heterogeneity: h, number of zones (vertical stripes) with different dynamics; 1 <= h <= grid_size - 2
    :param n_treasures: treasures on the map
    :param n_keys: keys on the map; KeyForTreasure only, other tasks place none
    :param clutter_density: share of the n x n cells of the interior that are wall: ``int(density * n * n)`` cells
    :param view_size: side of an agent's square view in cells; odd
    :param view_tile_size: pixels per cell in an ``"rgb"`` observation
    :param view_offset: rows visible behind the agent
    :param support_radius: Chebyshev distance that counts as support
    :param max_cycles: game steps per episode
    :param rules: ``"paper"``, or ``"released"`` for the behaviour of the code that published numbers came from
    :param agent_order: order in which agents act within a step, ``"random"`` (drawn anew each step) or ``"index"``
    :param observation: ``"rgb"`` pictures or ``"tiles"``, the same views as one code per cell
    :param agent_colours: what an agent's colour in observations tells: its ``"zone"``, nothing (``"none"``), or the
        integer of its last ``"action"``; with the last two, zones cannot be seen
    :raises ValueError: if a value is outside its range or the objects do not fit on the map
    """

    n_agents: int = 10
    grid_size: int = 30
    coordination: int = 1
    heterogeneity: int = 1
    n_treasures: int = 100
    n_keys: int = 30
    clutter_density: float = 0.1
    view_size: int = 7
    view_tile_size: int = 4
    view_offset: int = 1
    support_radius: int = 2
    max_cycles: int = 50
    rules: Rules = "paper"
    agent_order: AgentOrder = "random"
    observation: Observation = "rgb"
    agent_colours: AgentColours = "zone"

    def __post_init__(self) -> None:
        self._check_integer("n_agents", 1, MAX_AGENTS)
        self._check_integer("grid_size", 3, MAX_GRID_SIZE)
        self._check_integer("coordination", 1, self.n_agents, " (1 <= coordination <= n_agents)")
        self._check_integer("heterogeneity", 1, self.grid_size - 2, " (1 <= heterogeneity <= grid_size - 2)")
        self._check_integer("n_treasures", 0, self.n_interior_cells)
        # Tasks without keys ignore the number, so check_fits checks whether they fit.
        self._check_integer("n_keys", 0, MAX_GRID_SIZE**2)
        self._check_integer("view_size", 1, MAX_VIEW_SIZE, " and odd")
        if self.view_size % 2 == 0:
            raise ValueError(f"view_size must be odd, from 1 to {MAX_VIEW_SIZE}, got {self.view_size!r}")
        self._check_integer("view_tile_size", 1, MAX_TILE_SIZE)
        self._check_integer("view_offset", 0, self.view_size - 1, " (0 <= view_offset < view_size)")
        self._check_integer("support_radius", 0, self.grid_size)
        self._check_integer("max_cycles", 1, 2**31 - 1)
        density = self.clutter_density
        if isinstance(density, (bool, np.bool_)) or not isinstance(density, Real) or not 0 <= density < 1:
            raise ValueError(f"clutter_density must be a number from 0 (included) to 1 (excluded), got {density!r}")
        object.__setattr__(self, "clutter_density", float(density))
        choices = {"rules": Rules, "agent_order": AgentOrder, "observation": Observation, "agent_colours": AgentColours}
        for name, allowed in choices.items():
            value, known = getattr(self, name), get_args(allowed)
            if value not in known:
                expected = " or ".join(map(repr, known))
                raise ValueError(f"{name} must be {expected}, got {value!r}{did_you_mean(value, list(known))}")
        if self.observation == "tiles" and self.view_tile_size > MAX_CODED_TILE_SIZE:
            raise ValueError(
                f"observation='tiles' needs a view_tile_size from 1 to {MAX_CODED_TILE_SIZE}, got "
                f"{self.view_tile_size}: larger tiles have grid lines that turn with the viewer, so a code alone does "
                "not tell its pixels; use observation='rgb'"
            )

    @classmethod
    def from_kwargs(cls, params: Mapping[str, Any]) -> HECOGridParams:
        """
        Build from keyword arguments.

        :raises ValueError: for an unknown name, with the nearest known one
        """
        known = [field.name for field in fields(cls)]
        for name in params:
            if name not in known:
                raise ValueError(
                    f"unknown parameter {name!r}{did_you_mean(name, known)}; the parameters are {', '.join(known)}"
                )
        return cls(**params)

    def _check_integer(self, name: str, low: int, high: int, note: str = "") -> None:
        object.__setattr__(self, name, whole_number(name, getattr(self, name), low, high, note))

    def check_fits(self, task: TaskName) -> None:
        """
        Check that treasures, clutter, keys and agents fit on the map.

        :raises ValueError: with the number of cells needed and available
        """
        n_keys = self.n_keys if DECLARED[task].has_keys else 0
        wanted = self.n_treasures + self.n_clutter + n_keys
        if wanted > self.n_interior_cells:
            raise ValueError(
                f"the map is too small: {self.n_treasures} treasures (n_treasures) + {self.n_clutter} walls "
                f"(clutter_density={self.clutter_density}) + {n_keys} keys (n_keys) need {wanted} cells, "
                f"grid_size={self.grid_size} has {self.n_interior_cells}; lower them or raise grid_size"
            )
        if self.n_clutter + n_keys >= self.n_interior_cells:
            raise ValueError(
                f"no cell is left for agents to stand on: {self.n_clutter} walls (clutter_density="
                f"{self.clutter_density}) + {n_keys} keys (n_keys) fill all {self.n_interior_cells} cells of "
                f"grid_size={self.grid_size}; lower them or raise grid_size"
            )

    @property
    def n_interior_cells(self) -> int:
        """Cells inside the outer wall."""
        return (self.grid_size - 2) ** 2

    @property
    def n_clutter(self) -> int:
        """Wall cells inside the outer wall."""
        inside = self.grid_size - 2
        return int(self.clutter_density * inside * inside)  # in the rule book's order, which decides the rounding

    @property
    def view_pixels(self) -> int:
        """Side of an ``"rgb"`` observation in pixels."""
        return self.view_size * self.view_tile_size

    def zone_of_column(self) -> npt.NDArray[np.int64]:
        """
        Return the zone of each column x.

        The released rules make one zone too many (or more) when h does not divide the width.

        :return: (grid_size,)
        """
        columns = np.arange(self.grid_size)
        if self.rules == "paper":
            return columns * self.heterogeneity // self.grid_size
        return columns // (self.grid_size // self.heterogeneity)

    def command_of(self) -> npt.NDArray[np.uint8]:
        """
        Return what each action integer triggers in each zone.

        Beyond the last permutation the table starts again; this does not occur under the paper's rules.

        :return: (n_zones, 7), the command that action integer ``a`` triggers in zone ``z``
        """
        n_zones = int(self.zone_of_column().max()) + 1
        table = np.array(list(permutations(range(N_ACTIONS))))  # in lexicographic order, (5040, 7)
        few = self.heterogeneity <= MAX_ZONES_AT_STRIDE
        stride = ZONE_STRIDE if few else len(table) // self.heterogeneity
        action_of = table[(stride * np.arange(n_zones)) % len(table)]
        return np.argsort(action_of, axis=1).astype(np.uint8)
