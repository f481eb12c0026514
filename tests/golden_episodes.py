"""
Golden episodes: digests of whole episodes, so that seeded games stay the same from version to version.

``python -m tests.golden_episodes`` rewrites them; do so only for intended changes of games, and mention these in the
CHANGELOG.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

import hecogrid_envs
from hecogrid_envs import TASK_NAMES

PATH = Path(__file__).parent / "golden" / "episodes.json"


def digests() -> dict[str, str]:
    """SHA-256 of observations, rewards and states of one seeded episode per task, rules and kind of observation."""
    return {
        f"{task} {rules} {observation}": _digest(task, rules, observation)
        for task in TASK_NAMES
        for rules in ("paper", "released")
        for observation in ("rgb", "tiles")
    }


def _digest(task: str, rules: str, observation: str) -> str:
    env = hecogrid_envs.parallel_env(
        task, rules=rules, observation=observation, coordination=2, heterogeneity=4, n_treasures=200, n_keys=100
    )
    rng = np.random.default_rng(0)
    digest = hashlib.sha256()
    observations, _ = env.reset(seed=2024)
    rewards: dict[str, float] = {}
    while env.agents:
        for view in observations.values():
            digest.update(np.ascontiguousarray(view).tobytes())
        digest.update(np.array(list(rewards.values()), dtype=np.float64).tobytes())
        for array in env.get_state().values():
            digest.update(np.ascontiguousarray(array).tobytes())
        observations, rewards, *_ = env.step({agent: int(rng.integers(7)) for agent in env.agents})
    return digest.hexdigest()


if __name__ == "__main__":
    PATH.parent.mkdir(exist_ok=True)
    PATH.write_text(json.dumps(digests(), indent=2) + "\n")
    print(f"wrote {PATH}")
