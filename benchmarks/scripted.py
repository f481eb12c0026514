"""
Measure how well scripted teams play, as a reference for trained ones: ``python -m benchmarks.scripted``.

Besides a random team there are two scripted ones, which know the rules, including the zones:

- **7 x 7 views**: each agent knows what it currently sees, and how long it has waited. It goes to the treasure that it
  reaches soonest, with a preference for those with other agents nearby, and waits there for some steps; otherwise it
  moves towards agents that it sees, or straight on with random turns. In KeyForTreasure every agent fetches a key
  first.
- **full sight**: groups of c agents that see the whole map. A group goes to the free treasure that its c-th member
  reaches soonest, by shortest path, and waits there for the rest. In KeyForTreasure one agent of each group fetches a
  key.

Games: the zoo's size ``small``, twice as many agents at the same density, and the paper's.
Means and 95 % intervals (Student's t) over games. The scripts know the actions of each zone, so heterogeneity affects
only the random team.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from benchmarks.scripted_teams import TEAMS
from hecogrid_envs import TASK_NAMES
from hecogrid_envs.batch import GameBatch
from hecogrid_envs.params import HECOGridParams
from sb3_saf.evaluation import confidence_interval

#: Size ``small``, and twice as many agents at the same density.
SIZES: Final[tuple[dict[str, int], ...]] = (
    {"n_agents": 5, "grid_size": 15, "n_treasures": 25, "n_keys": 8},
    {"n_agents": 10, "grid_size": 22, "n_treasures": 50, "n_keys": 16},
    {},  # the paper's: the games' own defaults
)


class Row(NamedTuple):
    """A line of the table: level, team, team return and the ends of its interval."""

    task: str
    coordination: int
    heterogeneity: int
    n_agents: int
    grid_size: int
    n_treasures: int
    name: str
    mean: float
    low: float
    high: float


def play(name: str, batch: GameBatch, seed: int) -> int:
    """Return the team return of the current episode in the only game of a batch."""
    params = batch.params
    team = TEAMS[name](params, np.random.default_rng(seed))
    zones, action_of = params.zone_of_column(), np.argsort(params.command_of(), axis=1)
    while not batch.truncated[0]:
        batch.step(action_of[zones[batch.columns], team(batch)])
    return int(batch.collected[0])


def measure(name: str, task: str, level: dict[str, Any], n_games: int) -> Row:
    """Play a number of games, the same for all teams."""
    params = HECOGridParams(observation="tiles", **level)
    batch = GameBatch(task, params)
    returns = []
    for seed in range(n_games):
        batch.reset(seeds=[seed])
        returns.append(play(name, batch, seed))
    numbers = [float(np.mean(returns)), *confidence_interval(returns)]
    cell = (params.coordination, params.heterogeneity, params.n_agents, params.grid_size, params.n_treasures)
    return Row(task, *cell, name, *(round(number, 2) for number in numbers))


def table(rows: list[Row]) -> Iterator[str]:
    """Format rows as a Markdown table, line by line."""
    yield "| task | c | agents | team | return | 95 % interval |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for row in rows:
        returns = f"{row.mean:.1f} of {row.n_treasures} | [{row.low:.1f}, {row.high:.1f}]"
        yield f"| {row.task} | {row.coordination} | {row.n_agents} | {row.name} | {returns} |"


def main() -> None:
    """Print the table, and write it to a file if given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=TASK_NAMES, default=list(TASK_NAMES))
    parser.add_argument("--coordination", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--games", type=int, default=32, help="games of each row")
    parser.add_argument("--csv", type=Path, help="file to write the rows to, such as results/scale.csv")
    options = parser.parse_args()
    levels = [
        (task, {**size, "coordination": c}) for size, task, c in product(SIZES, options.tasks, options.coordination)
    ]
    rows = [measure(name, task, level, options.games) for task, level in levels for name in TEAMS]
    print("\n".join(table(rows)))
    if options.csv is not None:
        with options.csv.open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerows([Row._fields, *rows])


if __name__ == "__main__":
    main()
