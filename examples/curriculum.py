"""
Coordination 3, with and without a curriculum. ``python examples/curriculum.py``

Where a treasure needs three agents at once, a team that acts at random is (almost) never paid, and nothing is learned.
So train where it is paid, and move on with what was learned: one agent, then two, then three. The same number of game
steps at coordination 3 from the start is the comparison, and every method gets both.

Settings are those of the zoo's size ``small`` (5 agents, 15 x 15 cells, 25 treasures). Every run leaves a row in the
output as it ends, and a row that is there is not run again, so an interrupted program goes on where it was.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch as th

import sb3_saf
from sb3_saf.evaluation import confidence_interval
from sb3_saf.training.settings import load_settings

N_EPISODES = 64
RANDOM = "random"


class Stage(NamedTuple):
    """Some training at one level: agents that a treasure needs, and steps of the game."""

    coordination: int
    game_steps: int


#: What is compared: a plan of training by name. All have as many game steps.
PLANS: dict[str, tuple[Stage, ...]] = {
    "curriculum": (Stage(1, 30_000), Stage(2, 60_000), Stage(3, 60_000)),
    "direct": (Stage(3, 150_000),),
}


class Run(NamedTuple):
    """One training: a row of the output before it has a return."""

    env_id: str
    algo: str
    plan: str
    seed: int


def train_and_test(run: Run) -> float:
    """Mean team return over fresh games at coordination 3, actions sampled."""
    th.set_num_threads(1)
    test = load_settings("ippo", run.env_id, "small", {"coordination": 3})
    games = test.make_env(run.seed, evaluation=True, n_envs=N_EPISODES)
    if run.algo == RANDOM:
        policy = sb3_saf.RandomPolicy(games.action_space, seed=run.seed)
        return sb3_saf.evaluate_team(policy, games, n_eval_episodes=N_EPISODES, deterministic=False).mean
    model = None
    for number, stage in enumerate(PLANS[run.plan]):
        settings = load_settings(run.algo, run.env_id, "small", {"coordination": stage.coordination})
        # Other games in every stage: what moves on is the model, its optimiser included.
        env = settings.make_env(1_000 * number + run.seed)
        if model is None:
            model = settings.make_model(env, run.seed, device="cpu")
        else:
            model.set_env(env)
        model.learn(stage.game_steps * env.n_agents, reset_num_timesteps=number == 0)
    assert model is not None  # plans have stages
    return sb3_saf.evaluate_team(model, games, n_eval_episodes=N_EPISODES, deterministic=False).mean


def read(path: Path) -> dict[Run, float]:
    """Runs that have ended."""
    if not path.exists():
        return {}
    with path.open(newline="") as file:
        rows = csv.DictReader(file)
        return {Run(row["env"], row["algo"], row["plan"], int(row["seed"])): float(row["return"]) for row in rows}


def execute(runs: list[Run], path: Path, workers: int) -> None:
    """Run what is missing, each in a process of its own kind, and write a row as it ends."""
    done = read(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        futures = {pool.submit(train_and_test, run): run for run in runs if run not in done}
        for future in as_completed(futures):
            is_new = not path.exists()
            with path.open("a", newline="") as file:
                writer = csv.writer(file, lineterminator="\n")
                if is_new:
                    writer.writerow(["env", "algo", "plan", "seed", "return"])
                writer.writerow([*futures[future], future.result()])
            print(*futures[future], future.result(), flush=True)


def table(results: dict[Run, float]) -> Iterator[str]:
    """Markdown: mean over seeds and 95 % interval (Student's t)."""
    yield "| environment | method | plan | seeds | team return at coordination 3 |"
    yield "| --- | --- | --- | --- | --- |"
    for env_id, algo, plan in sorted({run[:3] for run in results}):
        returns = [value for run, value in results.items() if run[:3] == (env_id, algo, plan)]
        shown = f"{np.mean(returns):.2f}"
        if len(returns) > 1:
            low, high = confidence_interval(returns)
            shown += f" [{low:.2f}, {high:.2f}]"
        yield f"| {env_id} | {algo} | {plan} | {len(returns)} | {shown} |"


def main() -> None:
    """Run what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="+", default=["TeamTogether-v0"])
    parser.add_argument("--algos", nargs="+", default=["saf", "mappo", "ippo"])
    parser.add_argument("--plans", nargs="+", choices=list(PLANS), default=list(PLANS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--output", type=Path, default=Path("results/curriculum.csv"))
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    runs = [
        Run(env_id, algo, plan, seed)
        for seed in options.seeds
        for env_id in options.envs
        for algo in options.algos
        for plan in options.plans
    ]
    runs += [Run(env_id, RANDOM, "", seed) for env_id in options.envs for seed in options.seeds]
    execute(runs, options.output, options.workers)
    print("\n".join(table(read(options.output))))


if __name__ == "__main__":
    main()
