"""
Check that memory stays constant in long runs: resident memory of the process by steps, and its slope after warm-up.

``python -m benchmarks.soak`` plays 10^8 agent-steps of all three tasks, 10 agents in each of 128 games; ``--training
MINUTES`` trains SAF at the zoo's size ``small`` instead. Both print a line per part and write a figure.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import psutil
from matplotlib.figure import Figure
from stable_baselines3.common.callbacks import BaseCallback

import sb3_saf
from hecogrid_envs import TASK_NAMES
from sb3_saf import make_vec_env
from sb3_saf.training.settings import load_settings

N_GAMES: Final = 128
#: Share of the samples that is left out of the slope.
WARM_UP: Final = 0.2
#: Memory samples per part.
N_SAMPLES: Final = 200
_MB: Final = 2**20


class Soak(NamedTuple):
    """
    Memory during a run.

    :param name: of the run
    :param steps: agent-steps done at each sample
    :param memory: resident MB at each sample
    :param seconds: of the run
    """

    name: str
    steps: list[float]
    memory: list[float]
    seconds: float

    @property
    def slope(self) -> float:
        """MB per million agent-steps after warm-up, by least squares."""
        late = slice(int(WARM_UP * len(self.steps)), None)
        return float(np.polyfit(np.array(self.steps[late]) / 1e6, self.memory[late], 1)[0])

    @property
    def spread(self) -> float:
        """Difference of the largest and the smallest sample after warm-up, in MB."""
        late = self.memory[int(WARM_UP * len(self.memory)) :]
        return max(late) - min(late)

    def __str__(self) -> str:
        rate = self.steps[-1] / self.seconds / 1e6
        return (
            f"{self.name}: {self.steps[-1] / 1e6:,.1f} M agent-steps in {self.seconds:,.0f} s ({rate:.2g} M/s); memory "
            f"{self.memory[-1]:,.1f} MB at the end, slope {self.slope:+.5f} MB per million agent-steps, largest less "
            f"smallest {self.spread:.2f} MB"
        )


def resident() -> float:
    """Return the resident memory of this process in MB."""
    return float(psutil.Process().memory_info().rss) / _MB


def soak(name: str, agent_steps: int, play: Callable[[], int]) -> Soak:
    """
    Repeat some work.

    :param name: of the work
    :param agent_steps: in total
    :param play: does a part and returns its agent-steps
    """
    steps: list[float] = []
    memory: list[float] = []
    done, began = 0, time.perf_counter()
    while done < agent_steps:
        done += play()
        if done >= agent_steps * len(steps) / N_SAMPLES:
            steps.append(float(done))
            memory.append(resident())
    return Soak(name, steps, memory, time.perf_counter() - began)


def environments(agent_steps: int) -> Iterator[Soak]:
    """Play a third of the steps in each task, resets included."""
    for task in TASK_NAMES:
        venv = make_vec_env(task, N_GAMES, seed=0, observation="tiles")
        actions = np.random.default_rng(0).integers(7, size=(64, venv.num_envs))
        venv.reset()

        def play(venv: object = venv, actions: np.ndarray = actions) -> int:
            for row in actions:
                venv.step(row)  # type: ignore[attr-defined]
            return int(actions.size)

        yield soak(task, agent_steps // len(TASK_NAMES), play)
        venv.close()


class MemoryCallback(BaseCallback):
    """
    Sample the memory at every rollout, and end training after a given time.

    :param minutes: of training
    """

    def __init__(self, minutes: float) -> None:
        super().__init__()
        self.seconds = 60 * minutes
        self.steps: list[float] = []
        self.memory: list[float] = []
        self.began = time.perf_counter()

    def _on_rollout_start(self) -> None:
        self.steps.append(float(self.model.num_timesteps))
        self.memory.append(resident())

    def _on_step(self) -> bool:
        return time.perf_counter() - self.began < self.seconds


def training(algo: str, minutes: float, folder: Path) -> Soak:
    """Train the zoo's size ``small`` with monitor, evaluation and exact checkpoints, as its command does."""
    settings = load_settings(algo, "TeamSupport-v0", "small")
    env = settings.make_env(0, monitor_dir=folder)
    evaluation = sb3_saf.TeamEvalCallback(
        settings.make_env(0, evaluation=True, n_envs=16), n_eval_episodes=16, eval_freq=20_000, verbose=0
    )
    model, memory = settings.make_model(env, 0), MemoryCallback(minutes)
    sb3_saf.resumable_learn(model, 10**12, folder / "checkpoints", [evaluation, memory], every_game_steps=20_000)
    seconds = time.perf_counter() - memory.began
    return Soak(f"training {algo} at small", memory.steps, memory.memory, seconds)


def draw(soaks: list[Soak], path: Path) -> None:
    """Draw memory against steps, one part after the other."""
    figure = Figure(figsize=(7, 3), dpi=110, layout="constrained")
    axes = figure.subplots()
    begin = 0.0
    for one in soaks:
        axes.plot((begin + np.array(one.steps)) / 1e6, one.memory, label=one.name)
        begin += one.steps[-1]
    top = 1.2 * max(max(one.memory) for one in soaks)
    axes.set(xlabel="agent-steps (millions)", ylabel="resident memory (MB)", ylim=(0, top))
    axes.legend(loc="lower right")
    figure.savefig(path)


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").strip().splitlines()[0])
    parser.add_argument("--agent-steps", type=float, default=1e8, help="of the environments")
    parser.add_argument("--training", type=float, metavar="MINUTES", help="train instead")
    parser.add_argument("--algo", default="saf")
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/soak"), help="for the figure and the training's files"
    )
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    soaks = []
    parts = (
        environments(int(options.agent_steps))
        if options.training is None
        else iter([training(options.algo, options.training, options.folder)])
    )
    for one in parts:
        print(one, flush=True)
        soaks.append(one)
    name = "soak_environments.png" if options.training is None else f"soak_{options.algo}.png"
    draw(soaks, options.folder / name)
    print(f"figure: {options.folder / name}")


if __name__ == "__main__":
    main()
