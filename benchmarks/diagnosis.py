"""
Diagnose why methods differ, from the trained teams of an experiment: ``python -m benchmarks.diagnosis FOLDER``.

Plays episodes with the team of every finished cell and inspects critic, knowledge source and pool
(``sb3_saf.inspect_team``): how well values predict returns, whether messages matter, how the pool is used; also which
share of actions has no effect in each zone, and the return of the most likely actions. Means over seeds; one row per
method and level.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

import sb3_saf
from hecogrid_envs.constants import Command
from hecogrid_envs.task import TaskName, check_task
from sb3_saf.evaluation import actions_of, play
from sb3_saf.experiments.definitions import Cell, Level
from sb3_saf.experiments.results import Results
from sb3_saf.inspection.recording import zones_by_attribute
from sb3_saf.training.folders import Run


def cells(results: Results, setting: str = "*") -> Iterator[Cell]:
    """Return the trained teams of an experiment's folder; ``setting`` is e.g. TeamSupport-c2-h1."""
    for model in sorted(results.folder.glob(f"cells/{setting}/*/*/model.zip")):
        run = Run(model.parent)
        level = Level.of(**run.description["options"]["level"])
        yield Cell(run.settings.algo, run.settings.env_id, level, run.seed)


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
    scalars |= useless_commands(check_task(cell.task), *commands_and_zones(model, env))
    greedy = sb3_saf.evaluate_team(model, env, n_eval_episodes=n_episodes, deterministic=True)
    return {name: float(value) for name, value in scalars.items() if value is not None} | {"greedy": greedy.mean}


def commands_and_zones(model: BaseAlgorithm, env: Any) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return the commands of one episode of every game, and the agents' zones; (steps, rows) each."""
    params = env.get_attr("params", 0)[0]
    commands, zones, act = [], [], actions_of(model, env)

    def noted(obs: Any, starts: npt.NDArray[np.bool_]) -> npt.NDArray[Any]:
        zones.append(zones_by_attribute(env))
        return act(obs, starts)

    for step in play(env, noted, env.num_envs // params.n_agents):
        commands.append(params.command_of()[zones[-1], step.actions])
    return np.stack(commands), np.stack(zones)


def useless_commands(
    task: TaskName, commands: npt.NDArray[np.uint8], zones: npt.NDArray[np.integer[Any]]
) -> dict[str, float]:
    """
    Compute the share of commands without effect: two commands never have one, and a third has none in TeamSupport and
    TeamTogether, which have no keys.

    :param task: whose rules hold
    :param commands: of agents in game steps
    :param zones: of the agents
    :return: share of all commands, by zone
    """
    nothing = [Command.TOGGLE, Command.DONE] + ([] if task == "KeyForTreasure" else [Command.DROP])
    useless = np.isin(commands, nothing)
    return {f"useless/zone_{zone}": float(useless[zones == zone].mean()) for zone in np.unique(zones)}


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="*", metavar="SETTING", help="such as TeamSupport-c2-h1; a pattern")
    parser.add_argument("--episodes", type=int, default=32)
    parser.add_argument("--json", type=Path, help="keep everything here")
    options = parser.parse_args()
    th.set_num_threads(1)
    numbers: dict[tuple[str, str, str], list[dict[str, float]]] = defaultdict(list)
    results = Results(options.folder)
    for cell in cells(results, options.only):
        numbers[cell.task, cell.level.slug, cell.method].append(look(cell, results, options.episodes))
    if not numbers:
        parser.exit(
            1,
            f"no trained team under {options.folder / 'cells' / options.only}: expected the folder of an experiment "
            "(-f of python -m sb3_saf.experiments run), and a setting that it has\n",
        )
    means = {
        key: {name: float(np.mean([one[name] for one in looks if name in one])) for name in looks[0]}
        for key, looks in numbers.items()
    }
    if options.json is not None:
        options.json.write_text(json.dumps({" ".join(key): value for key, value in means.items()}, indent=1))
    names = sorted({name for value in means.values() for name in value})
    print("| task | level | method | " + " | ".join(names) + " |\n|" + " --- |" * (3 + len(names)))
    for key, value in means.items():
        print("| " + " | ".join([*key, *(f"{value[name]:.2f}" if name in value else "" for name in names)]) + " |")


if __name__ == "__main__":
    main()
