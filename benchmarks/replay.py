"""Print time and size of a replay page for an untrained SAF on TeamSupport: ``python -m benchmarks.replay``."""

from __future__ import annotations

import tempfile
import time
from contextlib import closing
from pathlib import Path

from stable_baselines3 import PPO

import sb3_saf


def measure(n_agents: int, folder: Path) -> tuple[float, int]:
    """Return processor seconds and bytes of a page, with constant density of agents and treasures."""
    size = round((90 * n_agents) ** 0.5)
    with closing(
        sb3_saf.make_team_env(
            "TeamSupport", n_envs=1, seed=0, n_agents=n_agents, grid_size=size, n_treasures=10 * n_agents
        )
    ) as env:
        model = PPO("SAFPolicy", env, seed=0, device="cpu", **sb3_saf.ppo_settings(env, "saf"))
        start = time.process_time()
        page = sb3_saf.replay(model, env, folder / f"{n_agents}.html")
        return time.process_time() - start, page.stat().st_size


def main() -> None:
    """Print a table."""
    print("| agents | processor seconds | kB |")
    print("| --- | --- | --- |")
    with tempfile.TemporaryDirectory() as name:
        measure(2, Path(name))  # warm-up: loads modules and kernels
        for n_agents in (5, 10, 50):
            seconds, size = measure(n_agents, Path(name))
            print(f"| {n_agents} | {seconds:.1f} | {size / 1000:.0f} |")


if __name__ == "__main__":
    main()
