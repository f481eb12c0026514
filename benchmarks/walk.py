"""
List the files of this project whose functions one short training runs.

``python -m benchmarks.walk`` trains ``PPO("SAFPolicy", env)`` for two rollouts under ``sys.setprofile``. It prints
every file of ``hecogrid_envs`` and ``sb3_saf`` in which a function ran, in the order of the first call, with its lines,
then the lines of packages and tests. Calls inside compiled kernels are not seen; their files count when Python calls
them.
"""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Iterable
from pathlib import Path
from types import FrameType

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("hecogrid_envs", "sb3_saf")


def walk(policy: str = "SAFPolicy", game_steps: int = 40) -> list[Path]:
    """
    Return the files whose functions a training runs, in the order of their first call.

    :param policy: name of a policy of PPO
    :param game_steps: length of the training, in game steps
    """
    from stable_baselines3 import PPO

    import sb3_saf

    files_run: dict[str, None] = {}

    def note(frame: FrameType, event: str, argument: object) -> None:
        # Class bodies and modules run at import, which is not part of the walk.
        if event == "call" and frame.f_code.co_flags & 0x2:  # CO_NEWLOCALS: a function
            files_run.setdefault(frame.f_code.co_filename)

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        env = sb3_saf.make_team_env("TeamSupport", n_envs=2, seed=0, n_agents=4, grid_size=8, n_treasures=6)
        model = PPO(
            policy,
            env,
            n_steps=10,
            batch_size=40,
            n_epochs=2,
            seed=0,
            device="cpu",
            rollout_buffer_class=sb3_saf.TeamRolloutBuffer,
        )
        model.learn(game_steps * env.n_agents)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    folders = tuple(str(ROOT / package) for package in PACKAGES)
    return [Path(name) for name in files_run if name.startswith(folders)]


def count_lines(paths: Iterable[Path]) -> int:
    """Return the number of lines of some files, as ``wc -l`` counts them."""
    return sum(path.read_bytes().count(b"\n") for path in paths)


def main() -> None:
    """Print the walk and the size of the project."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.walk", description=__doc__)
    parser.add_argument("--policy", default="SAFPolicy", help="a policy of PPO (default: %(default)s)")
    options = parser.parse_args()
    files = walk(options.policy)
    for number, path in enumerate(files, 1):
        print(f"{number:3} {count_lines([path]):6,}  {path.relative_to(ROOT)}")
    print(f"the walk of {options.policy}: {len(files)} files, {count_lines(files):,} lines")
    for folder in (*PACKAGES, "tests", "benchmarks"):
        sources = sorted((ROOT / folder).rglob("*.py"))
        print(f"{folder}: {len(sources)} files, {count_lines(sources):,} lines")


if __name__ == "__main__":
    main()
