"""
Measure the speed of the HECOGrid environments on one core, compared with a memory copy and installed third-party
gridworlds; seconds to the first step; memory of a rollout.

``python -m benchmarks.environments`` prints tables and writes them to ``benchmarks/results.md``. Medians and spread
over rounds in which all rows take turns, so that changes of the machine's speed affect all of them. 128 games of 10
agents on a 30 x 30 grid, 100 treasures, random actions, resets included, unless a row says otherwise;
:mod:`benchmarks.baselines` has the settings of the others.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import platform
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import sb3_saf
from benchmarks.baselines import BASELINES
from benchmarks.batches import N_GAMES, batch_work
from benchmarks.first_call import first_call_table
from benchmarks.rates import Rate, Work, one_line, random_actions, rate, table, take_turns
from benchmarks.rollout_memory import memory_table
from benchmarks.two_threads import threads_table
from benchmarks.workers import Worker
from hecogrid_envs import TASK_NAMES, parallel_env
from sb3_saf import make_vec_env

ROUNDS = 7
SECONDS = 0.3
RESULTS = Path(__file__).parent / "results.md"
COPY = "copy"
SECOND_PROCESSOR = """128 games on two threads, beside two processes with 64 games each, which share nothing: what the
machine's second processor was worth while this ran. Medians and quartiles of ratios within a round."""


def vec_env_work(venv: Any) -> Work:
    """Step an SB3 VecEnv."""
    venv.reset()
    actions = random_actions((64, venv.num_envs))

    def work() -> int:
        venv.step(next(actions))
        return int(venv.num_envs)

    return work


def parallel_env_work() -> Work:
    """Step one PettingZoo game with its dicts."""
    env = parallel_env("TeamSupport")
    env.reset(seed=0)
    actions = iter(random_actions((64, 10)))

    def work() -> int:
        if not env.agents:
            env.reset()
        env.step(dict(zip(env.agents, next(actions).tolist(), strict=True)))
        return 10

    return work


def copy_work() -> Work:
    """Copy as many bytes as 1,280 rgb views take, a lower bound."""
    source = np.ones((N_GAMES * 10, 2352), dtype=np.uint8)
    target = np.empty_like(source)

    def work() -> int:
        np.copyto(target, source)
        return len(source)

    return work


def programs() -> dict[str, Callable[[], Work]]:
    """Return the programs of this package, and the copy."""

    def team_env() -> Any:
        return sb3_saf.make_team_env("TeamSupport", n_envs=N_GAMES, seed=0)

    large: dict[str, Any] = {"n_agents": 1000, "grid_size": 300, "n_treasures": 10_000}
    rows: dict[str, Callable[[], Work]] = {}
    for observation in ("tiles", "rgb"):
        for task in TASK_NAMES:
            rows[f"batch, {observation}, {task}"] = partial(batch_work, task, observation)
    return rows | {
        "batch, tiles, TeamSupport, two threads": lambda: batch_work("TeamSupport", "tiles", n_threads=2),
        "batch, rgb, TeamSupport, two threads": lambda: batch_work("TeamSupport", "rgb", n_threads=2),
        "batch, tiles, TeamSupport, 1 game, N = 1000, 300 x 300": lambda: batch_work(
            "TeamSupport", "tiles", n_games=1, **large
        ),
        "VecEnv.step, tiles": lambda: vec_env_work(make_vec_env("TeamSupport", N_GAMES, seed=0, observation="tiles")),
        "VecEnv.step, tiles, joint view and monitor": lambda: vec_env_work(team_env()),
        "parallel_env, rgb": parallel_env_work,
        "SuperSuit, 8 games, rgb": lambda: vec_env_work(make_vec_env("TeamSupport", 8, seed=0, backend="supersuit")),
        f"{COPY} of the bytes of rgb views": copy_work,
    }


def start_workers(stack: contextlib.ExitStack) -> dict[str, Worker]:
    """
    Start the installed baselines, and print which are missing.

    :param stack: ends them
    :return: workers by the title of their row
    """
    workers: dict[str, Worker] = {}
    for name, baseline in BASELINES.items():
        try:
            worker = stack.enter_context(Worker(name))
        except (ImportError, RuntimeError) as error:
            print(f"left out: {baseline.title} ({one_line(error)})", flush=True)
            continue
        workers[baseline.title] = worker
    return workers


def speed_table(seconds: float, rounds: int) -> str:
    """
    Measure all rows in turns.

    :param seconds: per row and round
    :return: Markdown
    """
    with contextlib.ExitStack() as stack:
        rates: dict[str, Rate] = {name: partial(rate, make()) for name, make in programs().items()}
        workers = start_workers(stack)
        rates |= {title: worker.rate for title, worker in workers.items()}
        found = table(take_turns(rates, seconds, rounds), COPY)
    versions = {BASELINES[worker.name].distribution: worker.version for worker in workers.values()}
    return f"{found}\n\nOthers: {', '.join(f'{name} {number}' for name, number in versions.items()) or 'none'}."


def machine() -> str:
    """Describe processor and versions."""
    versions = ", ".join(f"{name} {version(name)}" for name in ("numba", "numpy", "torch", "stable-baselines3"))
    hardware = f"{processor()}, {os.cpu_count()} cores, {platform.machine()}, {platform.system()}"
    return f"Python {platform.python_version()}, {versions}; {hardware}"


def processor() -> str:
    """Return the processor's name, if Linux provides it."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or "unknown processor"


def main(arguments: list[str] | None = None) -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="per row and round")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--starts", type=int, default=3, help="cold starts, each compiles the kernels")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    sections = {
        "Environments": speed_table(options.seconds, options.rounds),
        "A second processor": SECOND_PROCESSOR + "\n\n" + threads_table(),
        "First step": first_call_table(options.starts),
        "Memory of a rollout, bytes per agent-step": memory_table(),
    }
    text = "\n\n".join(f"## {title}\n\n{section}" for title, section in sections.items())
    head = f"`python -m benchmarks.environments`: medians of {options.rounds} rounds, of {options.starts} starts."
    print(text)
    options.output.write_text(f"# Results\n\n{head} {machine()}.\n\n{text}\n")


if __name__ == "__main__":
    main()
