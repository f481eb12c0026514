"""
Speed of the HECOGrid environments on one core, beside a memory copy and, where installed, other gridworlds.

``python -m benchmarks.environments`` prints a table and writes it to ``benchmarks/results.md``. Medians and spread
over rounds in which all rows take turns, so that a machine whose speed drifts does so for all of them. 128 games of 10
agents on a 30 x 30 grid, 100 treasures, random actions, resets included, unless a row says otherwise.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import sb3_saf
from hecogrid_envs import TASK_NAMES, GameBatch, HECOGridParams, game_seeds, make_vec_env, parallel_env

N_GAMES = 128
ROUNDS = 7
SECONDS = 0.3
RESULTS = Path(__file__).parent / "results.md"

#: Does some work and says how many agent-steps it was.
Work = Callable[[], int]


class Row(NamedTuple):
    """One line of the table: agent-steps per second of every round."""

    name: str
    rates: list[float]

    @property
    def median(self) -> float:
        """Median over rounds."""
        return float(np.median(self.rates))


def batch_work(task: str, observation: str, n_threads: int = 1, n_games: int = N_GAMES, **params: Any) -> Work:
    """Step and observe a batch, games resetting at their time limit."""
    all_params = HECOGridParams.from_kwargs({"observation": observation, **params})
    batch = GameBatch(task, all_params, n_games, n_threads)
    batch.reset(seeds=game_seeds(0, n_games))
    out = batch.observe()
    actions = _actions((64, n_games, all_params.n_agents))

    def work() -> int:
        batch.advance(next(actions), out)
        return n_games * all_params.n_agents

    return work


def vec_env_work(venv: Any) -> Work:
    """Step an SB3 VecEnv."""
    venv.reset()
    actions = _actions((64, venv.num_envs))

    def work() -> int:
        venv.step(next(actions))
        return int(venv.num_envs)

    return work


def parallel_env_work() -> Work:
    """One PettingZoo game with its dicts."""
    env = parallel_env("TeamSupport")
    env.reset(seed=0)
    actions = iter(_actions((64, 10)))

    def work() -> int:
        if not env.agents:
            env.reset()
        env.step(dict(zip(env.agents, next(actions).tolist(), strict=True)))
        return 10

    return work


def copy_work() -> Work:
    """The floor: copy as many bytes as 1,280 rgb views take."""
    source = np.ones((N_GAMES * 10, 2352), dtype=np.uint8)
    target = np.empty_like(source)

    def work() -> int:
        np.copyto(target, source)
        return len(source)

    return work


def pursuit_work() -> Work:
    """PettingZoo's SISL pursuit, 10 pursuers."""
    import pettingzoo

    env: Any = pettingzoo.make("parallel", "sisl/pursuit_v5", n_pursuers=10)
    env.reset(seed=0)
    actions = _actions((64, 10), n_actions=5)

    def work() -> int:
        if not env.agents:
            env.reset()
        n_agents = len(env.agents)
        env.step(dict(zip(env.agents, next(actions).tolist()[:n_agents], strict=True)))
        return n_agents

    return work


def minigrid_work() -> Work:
    """MiniGrid, one agent, rgb partial view with tiles of 4 pixels."""
    import gymnasium
    from minigrid.wrappers import RGBImgPartialObsWrapper

    env = RGBImgPartialObsWrapper(gymnasium.make("MiniGrid-FourRooms-v0"), tile_size=4)
    env.reset(seed=0)
    actions = _actions((4096,))

    def work() -> int:
        _, _, terminated, truncated, _ = env.step(int(next(actions)))
        if terminated or truncated:
            env.reset()
        return 1

    return work


def _actions(shape: tuple[int, ...], n_actions: int = 7) -> Iterator[Any]:
    table = np.random.default_rng(0).integers(0, n_actions, size=shape)

    def forever() -> Iterator[Any]:
        while True:
            yield from table

    return forever()


def programs() -> dict[str, Callable[[], Work]]:
    """Rows of the table by name; what is not installed is left out when it is made."""

    def team_env() -> Any:
        return sb3_saf.make_team_env("TeamSupport", n_envs=N_GAMES, seed=0)

    large: dict[str, Any] = {"n_agents": 1000, "grid_size": 300, "n_treasures": 10_000}
    rows: dict[str, Callable[[], Work]] = {}
    for observation in ("tiles", "rgb"):
        for task in TASK_NAMES:
            rows[f"batch, {observation}, {task}"] = lambda t=task, o=observation: batch_work(t, o)  # type: ignore[misc]
    rows |= {
        "batch, tiles, TeamSupport, two threads": lambda: batch_work("TeamSupport", "tiles", n_threads=2),
        "batch, rgb, TeamSupport, two threads": lambda: batch_work("TeamSupport", "rgb", n_threads=2),
        "batch, tiles, TeamSupport, 1 game, N = 1000, 300 x 300": lambda: batch_work(
            "TeamSupport", "tiles", n_games=1, **large
        ),
        "VecEnv.step, tiles": lambda: vec_env_work(make_vec_env("TeamSupport", N_GAMES, seed=0, observation="tiles")),
        "VecEnv.step, tiles, joint view and monitor": lambda: vec_env_work(team_env()),
        "parallel_env, rgb": parallel_env_work,
        "SuperSuit, 8 games, rgb": lambda: vec_env_work(make_vec_env("TeamSupport", 8, seed=0, backend="supersuit")),
        "copy of the bytes of rgb views": copy_work,
        "PettingZoo SISL pursuit, 10 pursuers": pursuit_work,
        "MiniGrid, rgb partial, 4 px": minigrid_work,
    }
    return rows


def measure(seconds: float, rounds: int) -> list[Row]:
    """Let all rows take turns."""
    works: dict[str, Work] = {}
    for name, make in programs().items():
        try:
            works[name] = make()
        except ImportError as error:
            print(f"left out: {name} ({error})")
    for work in works.values():
        _rate(work, seconds)
    rates: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            rates[name].append(_rate(work, seconds))
    return [Row(name, row) for name, row in rates.items()]


def _rate(work: Work, seconds: float) -> float:
    start, done = time.perf_counter(), 0
    while time.perf_counter() - start < seconds:
        done += work()
    return done / (time.perf_counter() - start)


def table(rows: list[Row]) -> str:
    """Markdown, every row also as a ratio to the copy of the same run."""
    copy = next(row.median for row in rows if row.name.startswith("copy"))
    lines = ["| what | agent-steps/s | lowest - highest | ratio to the copy |", "| --- | --- | --- | --- |"]
    for row in rows:
        low, high = min(row.rates), max(row.rates)
        lines.append(f"| {row.name} | {row.median:,.0f} | {low:,.0f} - {high:,.0f} | {row.median / copy:.4f} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="per row and round")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    text = table(measure(options.seconds, options.rounds))
    versions = ", ".join(f"{name} {version(name)}" for name in ("numba", "numpy", "stable-baselines3", "pettingzoo"))
    machine = f"Python {platform.python_version()}, {versions}; {platform.machine()}, {platform.system()}"
    print(text)
    head = f"`python -m benchmarks.environments`: medians of {options.rounds} rounds. {machine}."
    options.output.write_text(f"# Environments\n\n{head}\n\n{text}\n")


if __name__ == "__main__":
    main()
