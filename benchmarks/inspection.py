"""
Measure the cost of ``InspectionCallback`` at its default frequency: ``python -m benchmarks.inspection``.

Trains SAF as ``make train`` does (TeamSupport, 5 agents, 80 games, light encoder) with an inspection at the start and
one at the end, and relates the seconds of one inspection to those of training during the default interval. Seconds are
processor time of one core, which excludes other programs.
"""

from __future__ import annotations

import argparse
import inspect
import tempfile
import time
from typing import NamedTuple

import sb3_saf
from sb3_saf.training.settings import load_settings


class Cost(NamedTuple):
    """
    Seconds of one processor.

    :param inspection: of one inspection; the first, which imports and compiles, is left out
    :param per_game_step: of training per game step
    """

    inspection: float
    per_game_step: float

    def share(self, every_game_steps: int) -> float:
        """Share of inspections in the time of a run."""
        return self.inspection / (self.inspection + self.per_game_step * every_game_steps)


class Timed(sb3_saf.InspectionCallback):
    """Records the seconds of each inspection."""

    def _inspect(self) -> dict[str, float]:
        began = time.process_time()
        scalars = super()._inspect()
        self.costs = [*getattr(self, "costs", []), time.process_time() - began]
        return scalars


def measure(game_steps: int, pictures: bool) -> Cost:
    """
    Train for a while.

    :param game_steps: of training
    :param pictures: whether inspections draw
    """
    settings = load_settings("saf", "TeamSupport-v0", "small", overrides={"game_steps": game_steps})
    env = settings.make_env(0)
    eval_env = settings.make_env(0, evaluation=True, n_envs=16, render_mode="rgb_array")
    callback = Timed(eval_env, every_game_steps=game_steps // 3, pictures=pictures)
    with tempfile.TemporaryDirectory() as folder:
        model = settings.make_model(env, 0, tensorboard_log=folder)
        began = time.process_time()
        model.learn(settings.total_timesteps, callback=callback)
        elapsed = time.process_time() - began
    return Cost(
        sum(callback.costs[1:]) / len(callback.costs[1:]),
        (elapsed - sum(callback.costs)) / model.num_timesteps * env.n_agents,
    )


def main(arguments: list[str] | None = None) -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.inspection")
    parser.add_argument("--game-steps", type=int, default=32_000)
    options = parser.parse_args(arguments)
    every = inspect.signature(sb3_saf.InspectionCallback).parameters["every_game_steps"].default
    print("| | one inspection (s) | 1000 game steps (s) | share of the time |\n| --- | --- | --- | --- |")
    for name, pictures in (("with pictures", True), ("numbers only", False)):
        cost = measure(options.game_steps, pictures)
        print(f"| {name} | {cost.inspection:.2f} | {1000 * cost.per_game_step:.2f} | {cost.share(every):.1%} |")


if __name__ == "__main__":
    main()
