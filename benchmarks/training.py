"""
Measure training speed: SAF with the paper's network, compared with a plain PyTorch loop of the same CNN.
``python -m benchmarks.training``

One round of the paper's settings on one core: a rollout (one step of every game at a time), then 10 epochs of one
minibatch. SAF runs everything: games, joint observation, knowledge source, pool, advantages, Adam. The plain loop only
encodes every row once in the rollout and once per epoch, backpropagates through the CNN, and steps Adam; either in one
minibatch, or in chunks of 640 rows, which fit the cache. Both get the same number of rows. ``--peak`` prints instead
the peak memory of one rollout and one epoch of the paper's 128 games.

SAF is measured on views of an untrained policy, many of which are equal, and on random views, which all differ.
Processor time instead of wall-clock, so that other programs matter little.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_saf import CentralizedValueWrapper, PaperCNN, TeamMonitor, TeamRolloutBuffer, make_vec_env

N_STEPS: Final = 50
N_EPOCHS: Final = 10
CHUNK: Final = 640
#: The released SAF, agent-steps per second and core (a reference value of this project).
RELEASED: Final = 169


class RandomViews(VecEnvWrapper):
    """Replaces every view by random tile codes, which all differ."""

    def __init__(self, venv: Any) -> None:
        super().__init__(venv)
        self._rng = np.random.default_rng(0)
        self._n_codes = int(venv.observation_space.high.max()) + 1
        self.n_agents, self.n_games = venv.n_agents, venv.n_games

    def _draw(self, like: Any) -> Any:
        return self._rng.integers(0, self._n_codes, size=like.shape, dtype=like.dtype)

    def reset(self) -> VecEnvObs:
        """Return random views of the first step."""
        return self._draw(self.venv.reset())

    def step_wait(self) -> VecEnvStepReturn:
        """Step the game and return random views."""
        obs, rewards, dones, infos = self.venv.step_wait()
        return self._draw(obs), rewards, dones, infos


def make_saf(n_games: int, random_views: bool, **kwargs: Any) -> PPO:
    """Create SAF as in the paper, except for the number of games."""
    venv: Any = make_vec_env("TeamSupport", n_games, seed=0, observation="tiles")
    env = CentralizedValueWrapper(TeamMonitor(RandomViews(venv) if random_views else venv))
    settings: dict[str, Any] = {"n_steps": N_STEPS, "batch_size": N_STEPS * env.num_envs, "n_epochs": N_EPOCHS}
    settings |= {"learning_rate": 7e-4, "gae_lambda": 1.0}
    return PPO(
        "SAFPolicy",
        env,
        rollout_buffer_class=TeamRolloutBuffer,
        seed=0,
        device="cpu",
        **{**settings, **kwargs},
    )


def saf_work(model: PPO) -> Callable[[], int]:
    """Run one rollout and one update."""
    assert model.env is not None
    n_rows = model.n_steps * model.env.num_envs

    def work() -> int:
        model.learn(n_rows, reset_num_timesteps=False)
        return n_rows

    return work


def bare_work(n_games: int, chunk: int | None) -> Callable[[], int]:
    """Encode random images with the paper's CNN, every row every time."""
    n_rows = N_STEPS * n_games * 10
    model = make_saf(1, random_views=False)
    assert model.env is not None
    space = model.policy.observation_space["obs"]  # type: ignore[index]
    cnn = PaperCNN(space)
    optimizer = th.optim.Adam(cnn.parameters(), lr=7e-4, eps=1e-5)
    codes = th.randint(0, int(space.high.max()) + 1, (n_rows, *space.shape), dtype=th.uint8)
    with th.no_grad():
        pictures = cnn.pixels(codes).contiguous()

    def work() -> int:
        with th.no_grad():
            for rows in pictures.split(n_games * 10):
                cnn.net(rows)
        for _ in range(N_EPOCHS):
            optimizer.zero_grad()
            for rows in pictures.split(chunk or n_rows):
                (cnn.net(rows).square().sum() / n_rows).backward()
            optimizer.step()
        return n_rows

    return work


def print_peak() -> None:
    """Print this process's peak memory after a rollout and an epoch of the paper's size; further epochs add nothing."""
    for name, random_views in (("untrained policy's views", False), ("all views differ", True)):
        saf_work(make_saf(128, random_views, n_epochs=1))()
        print(f"{name}: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.1f} GiB")


def rate(work: Callable[[], int]) -> float:
    """Return agent-steps per second of processor time."""
    start = time.process_time()
    return work() / (time.process_time() - start)


def main() -> None:
    """Measure all programs in turns and print Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--games", type=int, default=16, help="the paper has 128")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--skip-bare", action="store_true", help="measure SAF alone, without ratios")
    parser.add_argument("--peak", action="store_true", help="memory instead of speed")
    options = parser.parse_args()
    th.set_num_threads(1)
    if options.peak:
        print_peak()
        return
    n = options.games
    programs: dict[str, Callable[[], int]] = {
        "SAF, untrained policy's views": saf_work(make_saf(n, random_views=False, learning_rate=0.0)),
        "SAF, all views differ": saf_work(make_saf(n, random_views=True)),
    }
    if not options.skip_bare:
        programs["bare CNN, every row, one piece"] = bare_work(n, None)
        programs["bare CNN, every row, chunks of 640"] = bare_work(n, CHUNK)
    rates: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(options.rounds + 1):
        for name, work in programs.items():
            rates[name].append(rate(work))
    medians = {name: float(np.median(found[1:])) for name, found in rates.items()}
    print(f"{n} games x 10 agents x {N_STEPS} steps, {N_EPOCHS} epochs, one core, medians of {options.rounds} rounds\n")
    bare = [name for name in medians if name.startswith("bare")]
    heads = ["agent-steps/s", "lowest - highest", f"x released ({RELEASED}/s)", *(f"x {name}" for name in bare)]
    print("| program | " + " | ".join(heads) + " |\n|" + " --- |" * (len(heads) + 1))
    for name, median in medians.items():
        low, high = min(rates[name][1:]), max(rates[name][1:])
        ratios = [f"{median / RELEASED:.2f}", *(f"{median / medians[other]:.2f}" for other in bare)]
        print(f"| {name} | {median:,.0f} | {low:,.0f} - {high:,.0f} | " + " | ".join(ratios) + " |")


if __name__ == "__main__":
    main()
