"""
Measure whether value normalisation, the agent's identity and orthogonal initialisation help MAPPO.
``python -m benchmarks.value_details``

All eight combinations of the three are trained with the same seeds on three tasks: two probes (``tests/probe_envs``,
noise 10, three agents), one with a team reward and one with individual rewards, and HECOGrid's TeamSupport (three
agents, 8 x 8 cells, 8 treasures, coordination 2). Each run has two scores of the policy as it acts in training:

- *whole*: its mean over the whole training, higher for faster learning;
- *end*: its mean over the last quarter of the training.

Probes: the exact probability that an agent chooses the right action (chance: 0.5). TeamSupport: team return, treasures
of 8.

The effect of a detail is the mean difference between the combinations with it and those without it, one number per
seed; its 95 % interval is Student's t over seeds. If the interval contains 0, the experiment shows no effect. Effects
of identity and initialisation are computed separately for runs with and without value normalisation.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from itertools import product
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import CategoricalDistribution
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_saf import LightEncoder, TeamRolloutBuffer, confidence_interval, make_team_env
from tests.probe_envs import JointAction, OwnActionInOthersNoise, Probe

N_AGENTS: Final = 3
DETAILS: Final = ("normalize_values", "agent_identity", "ortho_init")
LEVEL: Final[dict[str, Any]] = {"n_agents": N_AGENTS, "grid_size": 8, "n_treasures": 8, "coordination": 2}

Floats = npt.NDArray[np.float64]


class Scores(NamedTuple):
    """
    Scores of one run; see the module's docstring.

    :param whole: mean over the training
    :param end: mean over its last quarter
    """

    whole: float
    end: float

    @classmethod
    def of(cls, curve: list[float]) -> Scores:
        """Compute the scores from one number per rollout."""
        return cls(float(np.mean(curve)), float(np.mean(curve[-max(1, len(curve) // 4) :])))


class Curve(BaseCallback):
    """
    Records one number per rollout.

    :param score: from the model
    """

    def __init__(self, score: Callable[[PPO], float]) -> None:
        super().__init__()
        self.score = score
        self.curve: list[float] = []

    def _on_rollout_end(self) -> None:
        assert isinstance(self.model, PPO)
        self.curve.append(self.score(self.model))

    def _on_step(self) -> bool:
        return True


def run_probe(probe: Probe, seed: int, n_updates: int, max_grad_norm: float, details: dict[str, bool]) -> Scores:
    """Train once on a probe."""
    rows = 32 * 4 * N_AGENTS
    model = PPO(
        "MAPPOPolicy",
        make_team_env(probe, n_envs=32),
        n_steps=4,
        batch_size=rows,
        n_epochs=10,
        learning_rate=3e-3,
        ent_coef=0.01,
        max_grad_norm=max_grad_norm,
        rollout_buffer_class=TeamRolloutBuffer,
        policy_kwargs={"net_arch": [32], "features_extractor_kwargs": {"features_dim": 16}, **details},
        seed=seed,
        device="cpu",
    )
    bits = probe.contexts().reshape(-1, probe.n_bits)
    own = th.as_tensor(bits, dtype=th.float32)

    def right(model: PPO) -> float:
        assert isinstance(model.policy, ActorCriticPolicy)
        distribution = model.policy.get_distribution(own)
        assert isinstance(distribution, CategoricalDistribution)
        ones = distribution.distribution.probs[:, 1].detach().numpy()
        return float(np.where(bits[:, 0] > 0, ones, 1.0 - ones).mean())

    callback = Curve(right)
    model.learn(rows * n_updates, callback=callback)
    return Scores.of(callback.curve)


def run_team_support(seed: int, n_updates: int, details: dict[str, bool]) -> Scores:
    """Train once on HECOGrid: a rollout is one episode of each of 32 games."""
    rows = 32 * 50 * N_AGENTS
    model = PPO(
        "MAPPOPolicy",
        make_team_env("TeamSupport", n_envs=32, **LEVEL),
        n_steps=50,
        batch_size=rows // 4,
        n_epochs=4,
        learning_rate=7e-4,
        ent_coef=0.01,
        max_grad_norm=10.0,
        rollout_buffer_class=TeamRolloutBuffer,
        policy_kwargs={"features_extractor_class": LightEncoder, **details},
        seed=seed,
        device="cpu",
    )
    # Every row of a team gets 1/N of each treasure.
    callback = Curve(lambda model: float(model.rollout_buffer.rewards.sum() / 32))
    model.learn(rows * n_updates, callback=callback)
    return Scores.of(callback.curve)


def interval(values: Floats) -> str:
    """Return the mean and its 95 % interval."""
    low, high = confidence_interval(values)
    return f"{values.mean():+.3f} [{low:+.3f}, {high:+.3f}]"


def print_task(name: str, scores: Floats, combinations: list[dict[str, bool]]) -> None:
    """
    Print the tables of one task.

    :param scores: (combinations, seeds, 2)
    """
    print(f"\n### {name}, {scores.shape[1]} seeds\n")
    print("| " + " | ".join(DETAILS) + " | whole | end |")
    print("| --- | --- | --- | --- | --- |")
    for details, of_seeds in zip(combinations, scores, strict=True):
        switches = " | ".join("on" if details[detail] else "off" for detail in DETAILS)
        print(f"| {switches} | {interval(of_seeds[:, 0])} | {interval(of_seeds[:, 1])} |")
    print("\n| effect of | on whole | on end |")
    print("| --- | --- | --- |")
    on = {detail: np.array([details[detail] for details in combinations]) for detail in DETAILS}
    normalised, everywhere = on["normalize_values"], np.ones(len(combinations), dtype=bool)
    print_effect("normalize_values", scores, normalised, everywhere)
    for detail in DETAILS[1:]:
        print_effect(f"{detail}, values normalised", scores, on[detail], normalised)
        print_effect(f"{detail}, values raw", scores, on[detail], ~normalised)


def print_effect(name: str, scores: Floats, is_on: npt.NDArray[np.bool_], among: npt.NDArray[np.bool_]) -> None:
    """
    Print one row of the table of effects.

    :param scores: (combinations, seeds, 2)
    :param is_on: (combinations,) which of them have the detail
    :param among: (combinations,) which of them are compared
    """
    effects = scores[is_on & among].mean(axis=0) - scores[~is_on & among].mean(axis=0)
    cells = []
    for effect in effects.T:
        low, high = confidence_interval(effect)
        cells.append(interval(effect) + (", contains 0" if low <= 0 <= high else ""))
    print(f"| {name} | {cells[0]} | {cells[1]} |")


def main() -> None:
    """Run everything and print Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--probe-seeds", type=int, default=8, help="0 for no probes")
    parser.add_argument("--probe-updates", type=int, default=15, help="rollouts of 128 game steps")
    parser.add_argument("--max-grad-norm", type=float, default=0.5, help="of the probes; 0.5 is SB3's default")
    parser.add_argument("--game-seeds", type=int, default=5, help="0 for no games")
    parser.add_argument("--game-updates", type=int, default=10, help="rollouts of 1,600 game steps")
    args = parser.parse_args()
    th.set_num_threads(1)
    combinations = [dict(zip(DETAILS, on, strict=True)) for on in product((False, True), repeat=len(DETAILS))]
    tasks: dict[str, tuple[int, Callable[[int, dict[str, bool]], Scores]]] = {
        "Probe, one reward for the team": (
            args.probe_seeds,
            lambda seed, details: run_probe(
                JointAction(N_AGENTS), seed, args.probe_updates, args.max_grad_norm, details
            ),
        ),
        "Probe, one reward for each agent": (
            args.probe_seeds,
            lambda seed, details: run_probe(
                OwnActionInOthersNoise(N_AGENTS), seed, args.probe_updates, args.max_grad_norm, details
            ),
        ),
        "TeamSupport": (args.game_seeds, lambda seed, details: run_team_support(seed, args.game_updates, details)),
    }
    start = time.process_time()
    for name, (n_seeds, run) in tasks.items():
        if n_seeds == 0:
            continue
        scores = [[run(seed, details) for seed in range(n_seeds)] for details in combinations]
        print_task(name, np.array(scores), combinations)
        print(f"\n({time.process_time() - start:.0f} s of one processor so far)", flush=True)


if __name__ == "__main__":
    main()
