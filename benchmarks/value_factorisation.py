"""
Measure whether value factorisation learns TeamSupport: ``python -m benchmarks.value_factorisation --algorithm qplex``.

The small size of the experiments (5 agents, grid 15, 25 treasures), the light encoder; team returns over new games,
compared with a random team. Also prints the training speed.
"""

from __future__ import annotations

import argparse
import time
from typing import Any, Final

from sb3_saf import QPLEX, LightEncoder, RandomPolicy, evaluate_team, make_team_env

#: Name to policy and mixer.
ALGORITHMS: Final[dict[str, tuple[str, Any]]] = {
    "qplex": ("QPLEXPolicy", "qplex"),
    "qplex-pool": ("QPLEXPoolPolicy", "qplex"),
    "qplex-lstm": ("QPLEXLstmPolicy", "qplex"),
    "qmix": ("QPLEXPolicy", "qmix"),
    "vdn": ("QPLEXPolicy", "vdn"),
}
SMALL: Final[dict[str, Any]] = {"n_agents": 5, "grid_size": 15, "n_treasures": 25, "n_keys": 8}
N_GAMES: Final = 32
N_EPISODES: Final = 64
EVALUATION_SEED: Final = 10_000


def main() -> None:
    """Train, evaluate, compare."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.value_factorisation", description=__doc__)
    parser.add_argument("--algorithm", choices=list(ALGORITHMS), default="qplex")
    parser.add_argument("--task", default="TeamSupport")
    parser.add_argument("--coordination", type=int, default=1)
    parser.add_argument("--game-steps", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--gamma", type=float, default=0.9)
    parser.add_argument("--detach-state", action="store_true", help="keep the mixer's gradient from the encoder")
    options = parser.parse_args()
    level = {**SMALL, "coordination": options.coordination}
    env = make_team_env(options.task, n_envs=N_GAMES, seed=options.seed, **level)
    policy, mixer = ALGORITHMS[options.algorithm]
    kwargs = {"features_extractor_class": LightEncoder, "detach_state": options.detach_state}
    model = QPLEX(policy, env, mixer=mixer, gamma=options.gamma, seed=options.seed, device="cpu", policy_kwargs=kwargs)
    start = time.perf_counter()
    model.learn(options.game_steps * env.n_agents)
    speed = options.game_steps / (time.perf_counter() - start)
    test = make_team_env(options.task, n_envs=N_EPISODES, seed=EVALUATION_SEED + options.seed, **level)
    trained = evaluate_team(model, test, N_EPISODES, deterministic=True)
    explored = evaluate_team(model, test, N_EPISODES, deterministic=False)
    random = evaluate_team(RandomPolicy(model.action_space, seed=options.seed), test, N_EPISODES)
    print(f"{options.algorithm}, {options.task}, {options.game_steps:,} game steps at {speed:,.0f} per second")
    print(f"  greedy              {trained}")
    print(f"  epsilon {model.exploration_rate:.2f}        {explored}")
    print(f"  random              {random}", flush=True)


if __name__ == "__main__":
    main()
