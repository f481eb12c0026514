"""
Measure the speed of HECOGrid on one core, beside a memory copy and Pursuit, a gridworld of PettingZoo's SISL.

``python -m benchmarks.environments`` (``make bench``) prints a table and writes it to ``benchmarks/results.md``.
Medians and spread over rounds in which all rows take turns, so that changes of the machine's speed affect all of them.
128 games of 10 agents on a 30 x 30 grid, 100 treasures, random actions, resets included, unless a row says otherwise.
Pursuit has 10 pursuers and episodes of 50 steps, too, on its own map of 16 x 16.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import pettingzoo

import sb3_saf
from benchmarks.turns import Work, rates
from hecogrid_envs import TASK_NAMES, GameBatch, HECOGridParams, parallel_env
from sb3_saf.training.folders import software_versions

N_GAMES: Final = 128
N_AGENTS: Final = 10
COPY: Final = "copy of the bytes of rgb views"
RESULTS: Final = Path(__file__).parent / "results.md"


def random_actions(shape: tuple[int, ...], n_actions: int = 7) -> Iterator[Any]:
    """
    Yield actions drawn beforehand, endlessly.

    :param shape: number of actions, then the shape of one
    :param n_actions: exclusive upper bound of the actions
    """
    actions = np.random.default_rng(0).integers(0, n_actions, size=shape)
    while True:
        yield from actions


def batch_work(task: str, observation: str, n_games: int = N_GAMES, **params: Any) -> Work:
    """Step and observe a batch, whose games reset at their time limit."""
    all_params = HECOGridParams.from_kwargs({"observation": observation, **params})
    batch = GameBatch(task, all_params, n_games)
    batch.reset(seeds=sb3_saf.game_seeds(0, n_games))
    out = batch.observe()
    actions = random_actions((64, n_games, all_params.n_agents))

    def work() -> int:
        batch.advance(next(actions), out)
        return n_games * all_params.n_agents

    return work


def vec_env_work(env: Any) -> Work:
    """Step an SB3 VecEnv."""
    env.reset()
    actions = random_actions((64, env.num_envs))

    def work() -> int:
        env.step(next(actions))
        return int(env.num_envs)

    return work


def parallel_work(env: Any, n_actions: int) -> Work:
    """Step one PettingZoo game with its dicts."""
    env.reset(seed=0)
    actions = random_actions((64, N_AGENTS), n_actions)

    def work() -> int:
        if not env.agents:
            env.reset()
        agents = list(env.agents)
        env.step(dict(zip(agents, next(actions).tolist()[: len(agents)], strict=True)))
        return len(agents)

    return work


def copy_work() -> Work:
    """Copy as many bytes as 1,280 rgb views take, a lower bound."""
    source = np.ones((N_GAMES * N_AGENTS, 2352), dtype=np.uint8)
    target = np.empty_like(source)

    def work() -> int:
        np.copyto(target, source)
        return len(source)

    return work


def programs() -> dict[str, Work]:
    """Return what is measured, by title."""
    large: dict[str, Any] = {"n_agents": 1000, "grid_size": 300, "n_treasures": 10_000}
    views = [(observation, task) for observation in ("tiles", "rgb") for task in TASK_NAMES]
    return {
        **{f"batch, {observation}, {task}": batch_work(task, observation) for observation, task in views},
        "batch, tiles, TeamSupport, 1 game, N = 1000, 300 x 300": batch_work("TeamSupport", "tiles", 1, **large),
        "VecEnv.step, tiles": vec_env_work(
            sb3_saf.make_vec_env("TeamSupport", n_envs=N_GAMES, seed=0, observation="tiles")
        ),
        "VecEnv.step, tiles, joint view and monitor": vec_env_work(
            sb3_saf.make_team_env("TeamSupport", n_envs=N_GAMES, seed=0)
        ),
        "parallel_env, rgb": parallel_work(parallel_env("TeamSupport"), n_actions=7),
        "SuperSuit, 8 games, rgb": vec_env_work(
            sb3_saf.make_vec_env("TeamSupport", n_envs=8, seed=0, backend="supersuit")
        ),
        COPY: copy_work(),
        "PettingZoo SISL pursuit, 10 pursuers, 16 x 16": parallel_work(
            pettingzoo.make("parallel", "sisl/pursuit_v5", n_pursuers=N_AGENTS, max_cycles=50), n_actions=5
        ),
    }


def table(measured: dict[str, list[float]]) -> str:
    """Format rates as Markdown: median, spread, and the ratio to the copy."""
    copy = float(np.median(measured[COPY]))
    lines = ["| what | agent-steps/s | lowest - highest | ratio to the copy |", "| --- | --- | --- | --- |"]
    for title, values in measured.items():
        median = float(np.median(values))
        lines.append(f"| {title} | {median:,.0f} | {min(values):,.0f} - {max(values):,.0f} | {median / copy:.3g} |")
    return "\n".join(lines)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=0.3, help="per row and round")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):  # one core, before JAX starts its threads
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    text = table(rates(programs(), options.rounds, options.seconds))
    print(text)
    versions = software_versions()
    machine = ", ".join(f"{name} {versions[name]}" for name in ("processor", "python", "numba", "numpy", "torch"))
    head = f"`python -m benchmarks.environments`: medians of {options.rounds} rounds on one core; {machine}."
    options.output.write_text(f"# Speed of the games\n\n{head}\n\n{text}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
