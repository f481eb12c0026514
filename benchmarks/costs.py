"""
Compare the costs of encoders and methods: ``python -m benchmarks.costs``.

Encoders: forward and backward passes over views of HECOGrid (7 x 7 tiles, 28 x 28 pixels) and over larger images.
Methods: rollout and update of PPO on TeamSupport with 10 agents, with each encoder (``MLPEncoder`` reads the tile codes
as numbers, so it costs what vector observations cost).

Processor time of one core; programs take turns, and the table shows medians.
"""

from __future__ import annotations

import argparse
from typing import Any, Final

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from benchmarks.turns import Work, rates
from sb3_saf import LightEncoder, MLPEncoder, NatureEncoder, PaperCNN, TeamRolloutBuffer, make_team_env

N_VIEWS: Final = 128
METHODS: Final = ("IPPO", "MAPPO", "SAF")
OF_METHODS: Final = (PaperCNN, LightEncoder, MLPEncoder)
#: Height and width of images, and their encoder.
PICTURES: Final[dict[tuple[int, int], tuple[type[BaseFeaturesExtractor], ...]]] = {
    (28, 28): (PaperCNN, LightEncoder),
    (84, 84): (PaperCNN, NatureEncoder, LightEncoder),
    (280, 480): (NatureEncoder,),
}


def encoder_work(encoder_class: type[BaseFeaturesExtractor], height: int, width: int) -> tuple[Work, int]:
    """Run forward and backward over some views; also return the number of weights."""
    encoder = encoder_class(spaces.Box(0, 255, (3, height, width), np.uint8))
    pictures = th.rand(N_VIEWS if height < 100 else 16, 3, height, width)

    def work() -> int:
        encoder(pictures).square().sum().backward()
        return len(pictures)

    return work, sum(parameter.numel() for parameter in encoder.parameters())


def method_work(method: str, encoder: type[BaseFeaturesExtractor], n_games: int) -> Work:
    """Run one rollout of 25 steps and 4 epochs over it."""
    env = make_team_env("TeamSupport", n_envs=n_games, seed=0)
    n_rows = 25 * env.num_envs
    settings: dict[str, Any] = {"n_steps": 25, "batch_size": n_rows, "n_epochs": 4, "seed": 0, "device": "cpu"}
    kwargs = {"features_extractor_class": encoder}
    model = PPO(f"{method}Policy", env, rollout_buffer_class=TeamRolloutBuffer, policy_kwargs=kwargs, **settings)

    def work() -> int:
        model.learn(n_rows, reset_num_timesteps=False)
        return n_rows

    return work


def encoder_table(rounds: int) -> None:
    """Print the costs of encoders."""
    made = {
        (size, encoder): encoder_work(encoder, *size) for size, encoders in PICTURES.items() for encoder in encoders
    }
    measured = rates({key: work for key, (work, _) in made.items()}, rounds)
    print("| pixels | encoder | weights | views/s, forward and backward |\n| --- | --- | --- | --- |")
    for (size, encoder), (_, n_weights) in made.items():
        rate = np.median(measured[size, encoder])
        print(f"| {size[0]} x {size[1]} x 3 | `{encoder.__name__}` | {n_weights:,} | {rate:,.0f} |", flush=True)


def method_table(rounds: int, n_games: int) -> None:
    """Print the costs of methods."""
    programs = {
        (method, encoder): method_work(method, encoder, n_games) for method in METHODS for encoder in OF_METHODS
    }
    medians = {key: np.median(values) for key, values in rates(programs, rounds).items()}
    print("| agent-steps/s | " + " | ".join(f"`{encoder.__name__}`" for encoder in OF_METHODS) + " |")
    print("| --- |" + " --- |" * len(OF_METHODS))
    for method in METHODS:
        cells = [f"{medians[method, encoder]:,.0f}" for encoder in OF_METHODS]
        print(f"| {method} | " + " | ".join(cells) + " |")
    ratios = [f"{medians['MAPPO', encoder] / medians['SAF', encoder]:.1f}" for encoder in OF_METHODS]
    print("| SAF takes x times MAPPO's time | " + " | ".join(ratios) + " |")


def main() -> None:
    """Print both tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--games", type=int, default=16)
    options = parser.parse_args()
    th.set_num_threads(1)
    encoder_table(options.rounds)
    print()
    method_table(options.rounds, options.games)


if __name__ == "__main__":
    main()
