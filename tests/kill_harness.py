"""
Kill a training run with SIGKILL at random moments, start it again until it is done, and compare its weights bit for bit
with those of an undisturbed run::

    python -m tests.kill_harness --kills 20

Every moment is drawn from the time that the undisturbed run takes, so kills fall into imports, rollouts, updates,
evaluations and the writing of checkpoints (which is made frequent: one per rollout).
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

N_AGENTS, N_GAMES, N_STEPS = 3, 4, 16
ROLLOUT = N_AGENTS * N_GAMES * N_STEPS


class Result(NamedTuple):
    """
    What came out.

    :param kills: how often the run was killed
    :param starts: how often it was started
    :param equal: whether weights, monitor.csv without times, and evaluations are those of the undisturbed run
    """

    kills: int
    starts: int
    equal: bool


def train(folder: Path, rollouts: int) -> None:
    """The run: started again in the same folder, it goes on."""
    import torch as th
    from stable_baselines3 import PPO

    import sb3_saf

    th.set_num_threads(1)
    task: dict[str, Any] = {"n_agents": N_AGENTS, "grid_size": 9, "n_treasures": 4, "coordination": 1, "max_cycles": 20}
    env = sb3_saf.make_team_env("TeamTogether", N_GAMES, seed=0, monitor_dir=str(folder), **task)
    eval_env = sb3_saf.make_team_env("TeamTogether", 2, seed=99, **task)
    policy = {"features_extractor_class": sb3_saf.LightEncoder, "net_arch": [16], "normalize_values": True}
    model = PPO(
        "SAFPolicy",
        env,
        learning_rate=lambda progress: 1e-3 * progress,
        n_steps=N_STEPS,
        batch_size=ROLLOUT // 4,
        n_epochs=2,
        seed=0,
        policy_kwargs=policy,
        rollout_buffer_class=sb3_saf.TeamRolloutBuffer,
        tensorboard_log=str(folder / "tb"),
    )
    evaluation = sb3_saf.TeamEvalCallback(
        eval_env, n_eval_episodes=2, eval_freq=200, log_path=str(folder), deterministic=False, verbose=0
    )
    steps = rollouts * ROLLOUT
    sb3_saf.resumable_learn(model, steps, folder / "checkpoints", evaluation, every_game_steps=1)
    weights = {name: tensor.numpy() for name, tensor in model.policy.state_dict().items()}
    np.savez(folder / "weights.npz", **weights)
    (folder / "done").touch()


def start(folder: Path, rollouts: int, *arguments: str) -> subprocess.Popen[bytes]:
    """Start the run in a process of its own."""
    command = [sys.executable, "-m", "tests.kill_harness", "--train", str(folder), "--rollouts", str(rollouts)]
    return subprocess.Popen([*command, *arguments], env={**os.environ, "OMP_NUM_THREADS": "1"})


def compare(one: Path, other: Path) -> bool:
    """Whether two finished runs are equal: weights bit for bit, episodes, evaluations."""
    return (
        _same_arrays(one / "weights.npz", other / "weights.npz")
        and _same_arrays(one / "evaluations.npz", other / "evaluations.npz")
        and _episodes(one) == _episodes(other)
    )


def _same_arrays(one: Path, other: Path) -> bool:
    with np.load(one) as a, np.load(other) as b:
        return a.files == b.files and all(a[name].tobytes() == b[name].tobytes() for name in a.files)


def _episodes(folder: Path) -> list[str]:
    """Return and length of each episode; its time differs."""
    lines = (folder / "monitor.csv").read_text().splitlines()[1:]
    return [line.rsplit(",", 1)[0] for line in lines]


def kill_until_done(folder: Path, rollouts: int, delays: Sequence[float], say: bool = False) -> Result:
    """
    Start a run, kill it after each delay, and let the last start finish.

    :param folder: with the undisturbed run in ``undisturbed``
    :param rollouts: length of the run
    :param delays: seconds from a start to its kill
    """
    killed, kills = folder / "killed", 0
    for delay in delays:
        process = start(killed, rollouts)
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        kills += process.wait() == -signal.SIGKILL
        newest = sorted(killed.glob("checkpoints/checkpoint-*"))[-1:]
        if say:
            print(f"killed after {delay:5.2f} s; newest checkpoint: {newest[0].name if newest else 'none'}", flush=True)
    if start(killed, rollouts).wait():
        raise RuntimeError("the resumed run failed")
    return Result(kills, len(delays) + 1, compare(folder / "undisturbed", killed))


def undisturbed_seconds(folder: Path, rollouts: int) -> float:
    """Make the undisturbed run: how long it takes."""
    began = time.monotonic()
    if start(folder / "undisturbed", rollouts).wait():
        raise RuntimeError("the undisturbed run failed")
    return time.monotonic() - began


def main() -> None:
    """Run the harness, or the run that it kills."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").strip().splitlines()[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--rollouts", type=int, default=60, help="length of the run")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--train", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.train is not None:
        train(options.train, options.rollouts)
        return
    moments = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        seconds = undisturbed_seconds(folder, options.rollouts)
        print(f"undisturbed run: {seconds:.1f} s")
        equal = kills = 0
        while kills < options.kills:
            # Each run is killed once, then resumed and compared.
            result = kill_until_done(folder, options.rollouts, [moments.uniform(0.3, 1.0) * seconds], say=True)
            kills += result.kills
            equal += result.equal if result.kills else 0
            print(f"{equal} of {kills} end bit-equal", flush=True)
            for path in sorted((folder / "killed").rglob("*"), reverse=True):
                path.rmdir() if path.is_dir() else path.unlink()
    sys.exit(equal != kills)


if __name__ == "__main__":
    main()
