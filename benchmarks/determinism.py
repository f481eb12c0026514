"""
Measure which changes affect the bits of a training: ``python -m benchmarks.determinism`` prints the table.

SAF trains on TeamSupport for a few rollouts, once unchanged and once with each change. Weights are compared bit for
bit; if they differ, the table shows the largest difference.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3 import PPO

import sb3_saf

TASK: Final[dict[str, Any]] = {"n_agents": 4, "grid_size": 10, "n_treasures": 8, "coordination": 2, "max_cycles": 20}
N_GAMES, N_STEPS, ROLLOUTS = 8, 20, 5
Weights = dict[str, npt.NDArray[Any]]


class Change(NamedTuple):
    """
    One change of the training.

    :param name: for the table
    :param env: arguments of make_team_env
    :param policy: arguments of the policy
    :param threads: number of torch threads
    :param variables: environment variables that libraries read when they are loaded
    """

    name: str
    env: dict[str, Any] = {}
    policy: dict[str, Any] = {}
    threads: int = 1
    variables: dict[str, str] = {}


CHANGES: Final = (
    Change("the same again"),
    Change("another process", variables={"OMP_NUM_THREADS": "1"}),
    Change("games on 2 threads", env={"n_threads": 2}),
    Change("games through SuperSuit", env={"backend": "supersuit"}),
    Change("games through SuperSuit in 2 processes", env={"backend": "supersuit", "n_cpus": 2}),
    Change("pixels instead of tiles", env={"observation": "rgb"}),
    Change("every row encoded, not each distinct view once", policy={"encode_once": False}),
    Change("views encoded 7 at a time instead of 512", policy={"chunk_size": 7}),
    Change("torch on 2 threads", threads=2),
    Change("a processor without AVX-512", variables={"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2"}),
    Change("a processor without AVX", variables={"ATEN_CPU_CAPABILITY": "default", "ONEDNN_MAX_CPU_ISA": "SSE41"}),
)


def train(change: Change) -> Weights:
    """Return the weights after some rollouts."""
    th.set_num_threads(change.threads)
    env = sb3_saf.make_team_env("TeamSupport", N_GAMES, seed=0, **{**TASK, **change.env})
    model = PPO(
        "SAFPolicy",
        env,
        n_steps=N_STEPS,
        batch_size=160,
        n_epochs=2,
        seed=0,
        rollout_buffer_class=sb3_saf.TeamRolloutBuffer,
        policy_kwargs={"features_extractor_class": sb3_saf.PaperCNN, **change.policy},
    )
    model.learn(ROLLOUTS * N_STEPS * env.num_envs)
    env.close()
    return {name: tensor.numpy().copy() for name, tensor in model.policy.state_dict().items()}


def train_elsewhere(change: Change) -> Weights:
    """Train in a separate process with its environment variables."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "weights.npz")
        command = [sys.executable, "-m", "benchmarks.determinism", "--train", change.name, "--file", str(file)]
        subprocess.run(command, env={**os.environ, **change.variables}, check=True)
        with np.load(file) as arrays:
            return dict(arrays)


def verdict(one: Weights, other: Weights) -> str:
    """Describe the result: equal, or the largest difference."""
    if all(one[name].tobytes() == other[name].tobytes() for name in one):
        return "bit-equal"
    return f"differs by {max(float(np.abs(one[name] - other[name]).max()) for name in one):.1g}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").strip().splitlines()[0])
    parser.add_argument("--train", help=argparse.SUPPRESS)
    parser.add_argument("--file", help=argparse.SUPPRESS)
    options = parser.parse_args()
    by_name = {change.name: change for change in CHANGES}
    if options.train is not None:
        np.savez(options.file, allow_pickle=False, **train(by_name[options.train]))
        return
    reference = train(Change("reference"))
    for change in CHANGES:
        weights = train_elsewhere(change) if change.variables else train(change)
        print(f"| {change.name} | {verdict(reference, weights)} |", flush=True)
    two, again = (train(Change("two threads", threads=2)) for _ in range(2))
    print(f"| torch on 2 threads, the same again | {verdict(two, again)} |")


if __name__ == "__main__":
    main()
