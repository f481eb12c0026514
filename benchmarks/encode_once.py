"""
Measure what encoding equal observations once saves: the share of unique observations and teams in minibatches, and the
time of an update with and without it, for an untrained and a trained policy.

``python -m benchmarks.encode_once [TRAINED.zip]`` prints Markdown. The trained policy is one of ``python -m
sb3_saf.train --algo saf --env TeamSupport-v0 --size small -n 20000``; without a file, it is trained first. Vectors are
random observations, which are practically never equal.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

import sb3_saf
from sb3_saf.networks.row_encoder import unique_rows
from sb3_saf.training.settings import load_settings

#: Games, steps of a rollout, minibatches timed.
GAMES: Final = 16
STEPS: Final = 50
ROUNDS: Final = 10


def codes(observation: str) -> VecEnv:
    """Create games of TeamSupport at size small, with codes or pixels."""
    level = dict(load_settings("saf", "TeamSupport-v0", "small").env_kwargs)
    return sb3_saf.make_team_env("TeamSupport", GAMES, seed=1, **{**level, "observation": observation})


def vectors() -> VecEnv:
    """Create games whose observations are 18 random numbers, as many as simple_spread's."""
    from tests.toy_teams import ToyTeams

    return ToyTeams(spaces.Box(-1.0, 1.0, (18,), np.float32), n_agents=5, n_games=GAMES, n_views=100_000)


def minibatches(env: VecEnv, encode_once: bool, trained: Path | None) -> tuple[PPO, list[Any]]:
    """Create a policy and the minibatches of one of its rollouts."""
    th.manual_seed(0)
    small = load_settings("saf", "TeamSupport-v0", "small").hyperparams["policy_kwargs"]
    widths = {name: value for name, value in small.items() if name != "features_extractor_class"}
    policy_kwargs = {**widths, "encode_once": encode_once}
    settings = sb3_saf.ppo_settings(env, n_steps=STEPS, policy_kwargs=policy_kwargs, seed=0)
    model = PPO("SAFPolicy", env, device="cpu", **settings)
    if trained is not None:
        sb3_saf.load_weights(model, trained)
    model.learning_rate = 0.0
    model.n_epochs = 1
    model.learn(STEPS * env.num_envs)
    return model, list(model.rollout_buffer.get(model.batch_size))


def share_of_unique(samples: list[Any]) -> tuple[float, float]:
    """Return the shares of unique observations and of unique teams, mean over minibatches."""
    shares = []
    for sample in samples:
        teams = sample.observations.teams.observations
        own = teams.flatten(0, 1)
        shares.append((len(unique_rows(own).index) / len(own), len(unique_rows(teams).index) / len(teams)))
    first, second = np.mean(shares, axis=0)
    return float(first), float(second)


def seconds_of_update(model: PPO, samples: list[Any]) -> float:
    """Return the processor time of one forward and backward pass over a rollout."""
    model.policy.set_training_mode(True)
    start = time.process_time()
    for sample in samples:
        actions = sample.actions.long().flatten()
        values, log_prob, entropy = model.policy.evaluate_actions(sample.observations, actions)
        assert entropy is not None
        (values.mean() + log_prob.mean() + entropy.mean()).backward()
    return time.process_time() - start


def row(name: str, env: VecEnv, trained: Path | None) -> str:
    """Return one line of the table: both variants take turns, the best time of each counts."""
    ways = [minibatches(env, encode_once, trained) for encode_once in (True, False)]
    observations, teams = share_of_unique(ways[0][1])
    once, every = np.min([[seconds_of_update(*way) for way in ways] for _ in range(ROUNDS)], axis=0) * 1e3
    return f"| {name} | {observations:.0%} | {teams:.0%} | {once:.0f} ms | {every:.0f} ms | {every / once:.2f} |"


def trained_here(folder: Path) -> Path:
    """Train SAF for 20,000 game steps."""
    from sb3_saf.training.run import train

    train(load_settings("saf", "TeamSupport-v0", "small", overrides={"game_steps": 20_000}), 0, folder)
    return folder / "model.zip"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trained", nargs="?", type=Path, help="a saved model of SAF at size small")
    parser.add_argument("--folder", type=Path, default=Path("runs/encode_once"), help="for the model trained here")
    options = parser.parse_args()
    th.set_num_threads(1)
    trained = options.trained or trained_here(options.folder)
    print("| observations of | unique | unique teams | update, equal ones once | every row | ratio |")
    print("| --- | --- | --- | --- | --- | --- |")
    ways: list[tuple[str, Any, Path | None]] = [
        ("an untrained policy, tile codes", lambda: codes("tiles"), None),
        ("a trained policy, tile codes", lambda: codes("tiles"), trained),
        ("an untrained policy, pixels", lambda: codes("rgb"), None),
        ("an untrained policy, vectors", vectors, None),
    ]
    for name, make, weights in ways:
        print(row(name, make(), weights), flush=True)


if __name__ == "__main__":
    main()
