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

They play the paper's games, the first of those on which ``experiments run`` tests a team of the same seed. Means and
95 % intervals (Student's t) over games. The scripts know the actions of each zone, so heterogeneity affects only the
random team.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.scripted_teams import TEAMS
from hecogrid_envs import TASK_NAMES
from hecogrid_envs.batch import GameBatch
from hecogrid_envs.params import HECOGridParams
from sb3_saf.evaluation import confidence_interval
from sb3_saf.teams.checks import evaluation_seed
from sb3_saf.teams.randomness import game_seeds
from sb3_saf.training.folders import TEST_GAMES


class Row(NamedTuple):
    """A line of the table: game, team, team return and the ends of its interval."""

    task: str
    level: str
    team: str
    seed: int
    episodes: int
    return_mean: float
    return_low: float
    return_high: float


def test_games(seed: int, n_games: int) -> Iterator[int]:
    """Yield the seeds of the first test games of a run (``sb3_saf.training.folders.play_test``)."""
    for batch, first in enumerate(range(0, n_games, TEST_GAMES)):
        yield from game_seeds(evaluation_seed(seed, test=batch), min(TEST_GAMES, n_games - first))


def play(name: str, batch: GameBatch, seed: int) -> int:
    """Return the team return of the current episode in the only game of a batch."""
    params = batch.params
    team = TEAMS[name](params, np.random.default_rng(seed))
    zones, action_of = params.zone_of_column(), np.argsort(params.command_of(), axis=1)
    while not batch.truncated[0]:
        batch.step(action_of[zones[batch.columns], team(batch)])
    return int(batch.collected[0])


def measure(name: str, task: str, params: HECOGridParams, seed: int, n_games: int) -> Row:
    """Play a number of games, the same for all teams."""
    batch = GameBatch(task, params)
    returns: list[int] = []
    for game in test_games(seed, n_games):
        batch.reset(seeds=[game])
        returns.append(play(name, batch, seed=len(returns)))
    numbers = float(np.mean(returns)), *confidence_interval(returns)
    level = f"c{params.coordination}-h{params.heterogeneity}"
    return Row(task, level, name, seed, n_games, *(round(number, 2) for number in numbers))


def main() -> None:
    """Print a table in Markdown, and write it to a file if given."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=TASK_NAMES, default=list(TASK_NAMES))
    parser.add_argument("--coordination", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--seed", type=int, default=0, help="of the teams whose test games are played")
    parser.add_argument("--games", type=int, default=128, help="of each row")
    parser.add_argument("--csv", type=Path, help="file to write the rows to, such as results/paper/scripted.csv")
    options = parser.parse_args()
    print(f"| {' | '.join(Row._fields)} |\n|{' --- |' * len(Row._fields)}")
    rows = []
    for task, coordination, name in product(options.tasks, options.coordination, TEAMS):
        rows.append(measure(name, task, HECOGridParams(coordination=coordination), options.seed, options.games))
        print(f"| {' | '.join(map(str, rows[-1]))} |", flush=True)
    if options.csv is not None:
        with options.csv.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([Row._fields, *rows])


if __name__ == "__main__":
    main()
