"""
Measure what the number of agents changes: ``python -m benchmarks.team_size``.

Trains the missing teams of 2 to 50 agents on TeamSupport (c = 2, size ``small``) at constant density, about 45 cells
and 5 treasures for each agent (``sb3_saf.experiments run``, one folder for each number of agents); after an
interruption, the same command continues. Then prints a table, and draws the share of treasures collected beside
scripted teams with 7 x 7 views. The critic's explained variance is that of its target (``benchmarks.diagnosis``).
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import pandas as pd
import torch as th

from benchmarks.diagnosis import cells, look
from benchmarks.scripted import measure
from sb3_saf.experiments.cli import main as experiments
from sb3_saf.experiments.definitions import RANDOM
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.tables import read_results
from sb3_saf.training.figures import draw_levels
from sb3_saf.training.statistics import Estimate, mean_over_seeds

METHODS: Final = ("saf", "mappo", "mappo-separate", "ippo")
#: Side of the grid by number of agents.
GRID_SIZES: Final = {2: 10, 5: 15, 10: 21, 20: 30, 50: 47}
TREASURES_PER_AGENT: Final = 5
SCRIPT: Final = "7 x 7 views"
_EXPLAINED: Final = "critic/explained_variance_of_target"


def level(n_agents: int) -> dict[str, int]:
    """Return the parameters of the game for a number of agents."""
    n_treasures = TREASURES_PER_AGENT * n_agents
    return {"n_agents": n_agents, "grid_size": GRID_SIZES[n_agents], "n_treasures": n_treasures}


def run(n_agents: int, options: argparse.Namespace) -> None:
    """Train and test the missing teams of a number of agents, one after the other."""
    words = ["run", "coordination", "--size", "small", "--workers", "1", "--tasks", "TeamSupport", "--levels", "2"]
    words += ["-n", str(options.game_steps), "--methods", *options.methods, "--seeds", *map(str, options.seeds)]
    words += ["--env-kwargs", *(f"{name}:{value}" for name, value in level(n_agents).items())]
    experiments([*words, "-f", str(options.folder / str(n_agents))])


def measured(folder: Path, n_episodes: int) -> pd.DataFrame:
    """
    Return the results of one number of agents: a row for each team, with the percentage of all treasures that it
    collects and that it collected while training.

    :param n_episodes: episodes for the explained variance of critics
    """
    team, results = ["method", "seed"], Results(folder)
    tests, curves = read_results(folder, "coordination")
    learning = curves.groupby(team)["score"].mean().rename("learning").reset_index()
    looks = [(cell.method, cell.seed, look(cell, results, n_episodes)[_EXPLAINED]) for cell in cells(results)]
    table = tests.merge(learning, how="left").merge(pd.DataFrame(looks, columns=[*team, "explained"]), how="left")
    return table.assign(
        score=100 * table["return_mean"] / table["max_return"],
        learning=100 * table["learning"] / table["max_return"],
        cost=1e6 * table["processor_seconds"] / (table["game_steps"] * table["n_agents"]),
    )


def lines(table: pd.DataFrame, methods: Sequence[str]) -> Iterator[str]:
    """Yield a Markdown table, with what the first method gains over each other one, seed by seed."""
    yield "| agents | method | seeds | % of treasures | % while training | explained variance | us per agent-step |"
    yield "|" + " --- |" * 7
    for n_agents, here in table.groupby("n_agents"):
        rows_of = dict(iter(here.groupby("method")))
        by_method = {method: rows_of[method] for method in (*methods, RANDOM) if method in rows_of}
        for method, rows in by_method.items():
            trained = "" if method == RANDOM else shown(mean_over_seeds(rows["learning"].to_numpy()))
            means = ["", ""] if method == RANDOM else [f"{rows['explained'].mean():.2f}", f"{rows['cost'].mean():.0f}"]
            score = shown(mean_over_seeds(rows["score"].to_numpy()))
            yield f"| {' | '.join([str(n_agents), str(method), str(len(rows)), score, trained, *means])} |"
        first, *others = [method for method in by_method if method != RANDOM]
        for other in others:
            pair = by_method[first].merge(by_method[other], on="seed", suffixes=("", "_other"))
            gains = [(pair[name] - pair[f"{name}_other"]).to_numpy() for name in ("score", "learning")]
            score, trained = (shown(mean_over_seeds(gain)) for gain in gains)
            yield f"| {n_agents} | {first} minus {other} | {len(pair)} | {score} | {trained} | | |"


def shown(estimate: Estimate) -> str:
    """Return a mean, with its interval if there is one."""
    interval = "" if math.isnan(estimate.low) else f" [{estimate.low:.1f}, {estimate.high:.1f}]"
    return f"{estimate.value:.1f}{interval}"


def scripts(sizes: list[int], n_games: int) -> pd.DataFrame:
    """Return the percentage of treasures that scripted teams collect."""
    by_size = {n: measure(SCRIPT, "TeamSupport", {**level(n), "coordination": 2}, n_games) for n in sizes}
    rows = [(f"scripted, {SCRIPT}", n, 100 * row.mean / row.n_treasures) for n, row in by_size.items()]
    return pd.DataFrame(rows, columns=["name", "n_agents", "score"])


def main() -> None:
    """Run what is missing, print the table and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-f", "--folder", type=Path, default=Path("runs", "team_size"), help="of the trainings")
    parser.add_argument("--agents", type=int, nargs="+", choices=GRID_SIZES, default=list(GRID_SIZES))
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("-n", "--game-steps", type=int, default=60_000, help="of each training")
    parser.add_argument("--table", action="store_true", help="train nothing")
    parser.add_argument("--episodes", type=int, default=32, help="of critics and scripted teams")
    parser.add_argument("--figure", type=Path, help="draw it here")
    options = parser.parse_args()
    th.set_num_threads(1)
    for n_agents in [] if options.table else options.agents:
        run(n_agents, options)
    table = pd.concat([measured(options.folder / str(n), options.episodes) for n in options.agents], ignore_index=True)
    print("\n".join(lines(table, options.methods)))
    scripted = scripts(options.agents, options.episodes)
    print(
        "\n"
        + "\n".join(f"{row.name}, {row.n_agents} agents: {row.score:.1f} %" for row in scripted.itertuples(index=False))
    )
    if options.figure is not None:
        draw_levels(table, "n_agents", y_label="treasures collected (%)").savefig(options.figure)


if __name__ == "__main__":
    main()
