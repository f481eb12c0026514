"""
Measure the cost of ``FiniteCallback``: processor time of training with and without it, in turns.

``python -m benchmarks.finite``. TeamSupport as in the zoo's size ``small``: SAF, 5 agents.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_saf import FiniteCallback
from sb3_saf.training.settings import load_settings

ROUNDS = 5


def make(algo: str, **overrides: Any) -> BaseAlgorithm:
    """Create a model with the zoo's settings, on games of its size ``small``."""
    settings = load_settings(algo, "TeamSupport-v0", "small", overrides=overrides)
    return settings.make_model(settings.make_env(0, n_envs=overrides.get("n_envs")), 0)


def seconds(model: BaseAlgorithm, steps: int, look: bool) -> float:
    """Return the processor time of some training."""
    began = time.process_time()
    model.learn(steps, FiniteCallback() if look else None, reset_num_timesteps=False)
    return time.process_time() - began


def main() -> None:
    """Measure and print."""
    for algo, overrides, steps in (("saf", {"n_envs": 16}, 16 * 5 * 50), ("qplex", {"learning_starts": 200}, 20_000)):
        model = make(algo, **overrides)
        seconds(model, steps, look=False)
        ratios = []
        for number in range(ROUNDS):
            pair = [seconds(model, steps, look) for look in ((True, False) if number % 2 else (False, True))]
            plain, looked = reversed(pair) if number % 2 else pair
            ratios.append(looked / plain)
        print(f"{algo}: with / without {np.median(ratios):.3f} (from {min(ratios):.3f} to {max(ratios):.3f})")


if __name__ == "__main__":
    main()
