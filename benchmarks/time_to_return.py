"""
Measure the processor time until a training reaches a given team return.

``python -m benchmarks.time_to_return runs/experiments/small coordination --reach 15`` reads the learning curves of
finished cells. For each method, task and level it prints the processor seconds and the game steps after which the mean
team return of the training episodes, over five points of the curve, first reached ``--reach``: the median over seeds,
and each seed. Seeds that never reach it count as infinite.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import pandas as pd

from sb3_saf.experiments.tables import read_results

#: Points of a curve that are averaged; a single one is noisy.
_WINDOW = 5


def reached(curve: pd.DataFrame, value: float) -> tuple[float, float]:
    """Return the processor seconds and the game steps after which a curve first reached a value."""
    curve = curve.sort_values("game_steps")
    there = curve[curve["score"].rolling(_WINDOW).mean() >= value]
    if there.empty:
        return math.inf, math.inf
    first = there.iloc[0]
    return float(first["processor_seconds"]), float(first["game_steps"])


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of the results")
    parser.add_argument("experiment", help="such as coordination")
    parser.add_argument("--reach", type=float, required=True, help="team return")
    options = parser.parse_args()
    curves = read_results(options.folder, options.experiment).curves
    print("| task | level | method | processor s, median | by seed | game steps, median |")
    print("| --- | --- | --- | --- | --- | --- |")
    for (task, level, method), rows in curves.groupby(["task", "level", "method"]):
        times = pd.DataFrame(
            [reached(curve, options.reach) for _, curve in rows.groupby("seed")], columns=["seconds", "steps"]
        )
        by_seed = ", ".join(f"{seconds:.0f}" for seconds in times["seconds"])
        medians = times.median()
        print(f"| {task} | {level} | {method} | {medians['seconds']:.0f} | {by_seed} | {medians['steps']:,.0f} |")


if __name__ == "__main__":
    main()
