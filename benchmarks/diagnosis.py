"""
Diagnose why methods differ, from the trained teams of an experiment: ``python -m benchmarks.diagnosis FOLDER``.

Plays episodes with the team of every finished cell and inspects critic, knowledge source and pool
(``sb3_saf.inspect_team``): how well values predict returns, whether messages matter, how the pool is used; also the
return of the most likely actions (``greedy``). Means over seeds; one row per method and level.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import torch as th

import sb3_saf
from sb3_saf.experiments.definitions import Cell, Level
from sb3_saf.experiments.results import Results
from sb3_saf.training.folders import Run


def cells(results: Results, setting: str = "*") -> Iterator[Cell]:
    """Return the trained teams of an experiment's folder; ``setting`` is e.g. TeamSupport-c2-h1."""
    for model in sorted(results.folder.glob(f"cells/{setting}/*/*/model.zip")):
        run = Run(model.parent)
        options = run.description["options"]
        yield Cell(options["method"], run.settings.env_id, Level.of(**options["level"]), run.seed)


def look(cell: Cell, results: Results, n_episodes: int) -> dict[str, float]:
    """Return numbers by name."""
    config = results.config()
    if config is None:
        raise ValueError(f"{results.folder} does not say how its cells were trained: settings.json is missing")
    settings = config.settings(cell)
    env = settings.make_env(cell.seed, evaluation=True, n_envs=16)
    # Made on the games of training, whose rollouts its minibatches fit.
    model = settings.make_model(settings.make_env(cell.seed), cell.seed, device="cpu")
    sb3_saf.load_weights(model, results.cell_folder(cell) / "model.zip")
    scalars: dict[str, Any] = dict(sb3_saf.inspect_team(model, env, n_episodes).scalars)
    greedy = sb3_saf.evaluate_team(model, env, n_eval_episodes=n_episodes, deterministic=True)
    return {name: float(value) for name, value in scalars.items() if value is not None} | {"greedy": greedy.mean}


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="*", metavar="SETTING", help="such as TeamSupport-c2-h1; a pattern")
    parser.add_argument("--episodes", type=int, default=32)
    parser.add_argument("--csv", type=Path, help="keep the numbers of every team here")
    options = parser.parse_args()
    th.set_num_threads(1)
    results = Results(options.folder)
    looks = [
        {"task": cell.task, "level": cell.level.slug, "method": cell.method, "seed": cell.seed}
        | look(cell, results, options.episodes)
        for cell in cells(results, options.only)
    ]
    if not looks:
        parser.exit(
            1,
            f"no trained team under {options.folder / 'cells' / options.only}: expected the folder of an experiment "
            "(-f of python -m sb3_saf.experiments run), and a setting that it has\n",
        )
    teams = pd.DataFrame(looks)
    if options.csv is not None:
        teams.to_csv(options.csv, index=False, float_format="%.4f", lineterminator="\n")
    means = teams.drop(columns="seed").groupby(["task", "level", "method"]).mean().sort_index(axis=1)
    print(f"| task | level | method | {' | '.join(means)} |\n|{' --- |' * (3 + len(means.columns))}")
    for key, row in means.iterrows():
        shown = ["" if pd.isna(value) else f"{value:.2f}" for value in row]
        print(f"| {' | '.join([*map(str, tuple(key)), *shown])} |")


if __name__ == "__main__":
    main()
