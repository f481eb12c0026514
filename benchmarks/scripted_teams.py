"""
Scripted teams, which know the rules; used by ``python -m benchmarks.scripted``.

A team is created for one episode and returns the commands of all agents, step by step, for the only game of a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Final

import numpy as np
import numpy.typing as npt
from numba import njit

from hecogrid_envs.batch import GameBatch
from hecogrid_envs.constants import N_ACTIONS, STEP, Command, TreasureState
from hecogrid_envs.params import HECOGridParams

Cell = tuple[int, int]
Cells = npt.NDArray[np.bool_]
Costs = npt.NDArray[np.float64]
Commands = npt.NDArray[np.int64]

#: With 7 x 7 views: extra actions that an agent accepts for a treasure with agents nearby, steps that it waits on a
#: treasure, steps for which it then ignores treasures; probabilities of moving towards others and of turning with a
#: free way ahead.
DETOUR, PATIENCE, LEAVE = 6, 6, 6
FOLLOW, TURN = 0.7, 0.1


@njit()
def cost_to_go(passable: Cells, costs: Costs) -> Costs:
    """
    Compute the least number of actions to a target, plus the target's cost, from every cell and direction.

    :param passable: (W, W) cells that agents can enter
    :param costs: (W, W) of ending at a cell; infinite for cells that are no target
    :return: (W, W, 4)
    """
    width = len(costs)
    best = np.repeat(costs, 4).reshape(width, width, 4)
    queue = [(x, y, d) for x, y, d in np.ndindex(width, width, 4) if costs[x, y] < np.inf]
    read = 0
    while read < len(queue):
        x, y, d = queue[read]
        read += 1
        stepped = ((x - STEP[d, 0]) % width, (y - STEP[d, 1]) % width, d)
        for before in (stepped, (x, y, (d + 1) % 4), (x, y, (d + 3) % 4)):
            if passable[before[0], before[1]] and best[before] > best[x, y, d] + 1:
                best[before] = best[x, y, d] + 1
                queue.append(before)
    return best


class Sight:
    """The state of the only game of a batch; planes are indexed ``[x, y]``, rows are agents."""

    def __init__(self, batch: GameBatch):
        state = batch.get_state()
        self.treasures: Cells = state["treasures"] == TreasureState.AVAILABLE
        self.keys, self.position, self.direction = state["keys"], state["agent_pos"], state["agent_dir"]
        self.passable: Cells = ~(state["walls"] | self.keys)
        self.needs_key = ~state["agent_has_key"] & (batch.task == "KeyForTreasure")

    def costs_of(self, cells: Iterable[Cell]) -> Costs:
        """Return costs (W, W) that are zero at some cells and infinite elsewhere."""
        costs = np.full(self.treasures.shape, np.inf)
        for cell in cells:
            costs[cell] = 0
        return costs

    def command(self, agent: int, field: Costs) -> Command:
        """Choose the command that lowers the cost to go; at a target, pickup, which also serves to wait."""
        (x, y), d = self.position[agent], self.direction[agent]
        front = tuple(self.position[agent] + STEP[d])
        after = {
            Command.FORWARD: field[(*front, d)],
            Command.LEFT: field[x, y, d - 1],
            Command.RIGHT: field[x, y, (d + 1) % 4],
        }
        best = min(after, key=lambda command: float(after[command]))
        at_end = after[best] >= field[x, y, d]
        return Command.PICKUP if at_end or (best == Command.FORWARD and self.keys[front]) else best


class FullSight:
    """Groups that see the whole map (see :mod:`benchmarks.scripted`)."""

    def __init__(self, params: HECOGridParams, _rng: np.random.Generator):
        self.c = params.coordination
        self.groups: list[list[int]] = []
        self.goals: dict[int, Cell] = {}

    def __call__(self, batch: GameBatch) -> Commands:
        """Return the commands of all agents, (N,)."""
        sight = Sight(batch)
        self.groups = self.groups or self._make_groups(sight.position)
        to_key = cost_to_go(sight.passable, np.where(sight.keys, 0.0, np.inf))
        commands = np.full(len(sight.position), Command.DONE, dtype=np.int64)
        for number, group in enumerate(self.groups):
            field = to_key if sight.needs_key[group].all() else self._field_of_goal(number, sight)
            for agent in group:
                commands[agent] = sight.command(agent, field)
        return commands

    def _make_groups(self, position: npt.NDArray[np.int64]) -> list[list[int]]:
        """Form groups of c nearby agents; remaining agents join the nearest group."""
        distance = np.abs(position[:, None] - position).sum(axis=2)
        left, groups = list(range(len(position))), []
        while len(left) >= self.c:
            groups.append(sorted(left, key=lambda agent: int(distance[left[0], agent]))[: self.c])
            left = [agent for agent in left if agent not in groups[-1]]
        for agent in left:
            min(groups, key=lambda group: int(distance[agent, group].min())).append(agent)
        return groups

    def _field_of_goal(self, number: int, sight: Sight) -> Costs:
        """Compute the cost to go to the group's treasure, which stays the same until it is collected."""
        goal, others = self.goals.pop(number, None), set(self.goals.values())
        if goal is None or not sight.treasures[goal]:
            cells: list[Cell] = [(x, y) for x, y in np.argwhere(sight.treasures).tolist() if (x, y) not in others]
            goal = min(cells, key=lambda cell: self._arrival(number, sight, cell), default=None)
        if goal is None:
            return cost_to_go(sight.passable, sight.costs_of([]))
        self.goals[number] = goal
        return cost_to_go(sight.passable, sight.costs_of([goal]))

    def _arrival(self, number: int, sight: Sight, cell: Cell) -> float:
        """Count the actions until c members of a group can be at a cell."""
        group, field = self.groups[number], cost_to_go(sight.passable, sight.costs_of([cell]))
        x, y = sight.position[group].T
        return float(np.sort(field[x, y, sight.direction[group]])[self.c - 1])


class OwnViews:
    """Agents that know only what they currently see (see :mod:`benchmarks.scripted`)."""

    def __init__(self, params: HECOGridParams, rng: np.random.Generator):
        self.c, self.radius, self.rng = params.coordination, params.support_radius, rng
        self.waited, self.leaves = np.zeros((2, params.n_agents), dtype=np.int64)

    def __call__(self, batch: GameBatch) -> Commands:
        """Return the commands of all agents, (N,)."""
        sight, view = Sight(batch), batch.fields_of_view()
        return np.array([self._command(agent, sight, view[agent]) for agent in range(len(view))], dtype=np.int64)

    def _command(self, agent: int, sight: Sight, view: Cells) -> Command:
        position = sight.position[agent]
        others = {(x, y) for x, y in sight.position.tolist() if view[x, y]} - {tuple(position.tolist())}
        passable = sight.passable | ~view
        costs = self._costs(agent, sight, view, others)
        self.leaves[agent] -= self.leaves[agent] > 0
        if np.isfinite(costs).any():
            command = sight.command(agent, cost_to_go(passable, costs))
            waits = bool(sight.treasures[tuple(position)]) and command == Command.PICKUP
            self.waited[agent] = self.waited[agent] + 1 if waits else 0
            if self.waited[agent] > PATIENCE:
                self.leaves[agent] = LEAVE
            return command
        if others and self.c > 1 and self.rng.random() < FOLLOW:
            return sight.command(agent, cost_to_go(passable, sight.costs_of(others)))
        ahead = passable[tuple(position + STEP[sight.direction[agent]])]
        straight = ahead and self.rng.random() >= TURN
        return Command.FORWARD if straight else Command(int(self.rng.integers(Command.FORWARD)))

    def _costs(self, agent: int, sight: Sight, view: Cells, others: set[Cell]) -> Costs:
        """Return the costs of ending at keys or else treasures, (W, W); those without agents nearby cost more."""
        if sight.needs_key[agent]:
            return np.where(sight.keys & view, 0.0, np.inf)
        costs = np.full(view.shape, np.inf)
        for cell in np.argwhere(sight.treasures & view & (self.leaves[agent] == 0)):
            company = sum(bool(max(abs(cell - other)) <= self.radius) for other in others)
            costs[tuple(cell)] = 0 if company >= self.c - 1 else DETOUR
        return costs


class Random:
    """Agents that act at random."""

    def __init__(self, params: HECOGridParams, rng: np.random.Generator):
        self.n_agents, self.rng = params.n_agents, rng

    def __call__(self, _batch: GameBatch) -> Commands:
        """Return the commands of all agents, (N,)."""
        return self.rng.integers(N_ACTIONS, size=self.n_agents)


Team = Callable[[GameBatch], Commands]
TEAMS: Final[dict[str, Callable[[HECOGridParams, np.random.Generator], Team]]] = {
    "random": Random,
    "7 x 7 views": OwnViews,
    "full sight": FullSight,
}
