"""
Train a team on a PettingZoo environment and compare it with a random one.

    python examples/train_pettingzoo.py --env simple_spread --algo SAF --game-steps 300000

The environments and their settings are in ``ENVIRONMENTS`` below; the results are in README.md beside this file.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import torch as th
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from sb3_saf import RandomPolicy, TeamRolloutBuffer, TurnsInParallel, evaluate_team, make_team_env
from sb3_saf.envs.joint_observation import CentralizedValueWrapper
from sb3_saf.evaluation import EvaluationResult

#: Evaluation games have other seeds than training games.
EVALUATION_SEED = 10_000


def hanabi(**params: Any) -> ParallelEnv[Any, Any, Any]:
    """Create Hanabi, whose players take turns, in parallel form."""
    from pettingzoo.classic import hanabi_v5

    return TurnsInParallel(hanabi_v5.env(**params))


def module_env(module: str, **params: Any) -> ParallelEnv[Any, Any, Any]:
    """Create an environment from a module with ``parallel_env``."""
    return import_module(module).parallel_env(**params)


class Example(NamedTuple):
    """
    An environment and its settings.

    :param make: its factory
    :param params: the factory's arguments
    :param n_games: games played at once
    :param n_steps: game steps per rollout
    :param ppo: differences from :data:`PPO_SETTINGS`
    """

    make: Callable[..., ParallelEnv[Any, Any, Any]]
    params: dict[str, Any] = {}
    n_games: int = 16
    n_steps: int = 100
    ppo: dict[str, Any] = {}


PPO_SETTINGS: dict[str, Any] = {
    "n_epochs": 5,
    "learning_rate": 5e-4,
    "ent_coef": 0.01,
    "gae_lambda": 0.95,
    "rollout_buffer_class": TeamRolloutBuffer,
}

WALKERS = {"terminate_on_fall": False, "remove_on_fall": True, "shared_reward": False, "max_cycles": 200}
SPREAD = {"learning_rate": 1e-3, "n_epochs": 10, "gamma": 0.9, "ent_coef": 0.003}
ENVIRONMENTS: dict[str, Example] = {
    # Rewards follow moves within a few steps; with gamma=0.99 nothing is learned in so few steps.
    "simple_spread": Example(partial(module_env, "mpe2.simple_spread_v3"), n_steps=50, ppo=SPREAD),
    "simple_spread_continuous": Example(
        partial(module_env, "mpe2.simple_spread_v3"),
        {"continuous_actions": True},
        n_steps=50,
        ppo={**SPREAD, "ent_coef": 0.0},
    ),
    # A speaker that cannot move and a listener that cannot speak have different spaces.
    "speaker_listener": Example(partial(module_env, "mpe2.simple_speaker_listener_v4"), n_steps=50),
    "pursuit": Example(partial(module_env, "pettingzoo.sisl.pursuit_v5"), {"max_cycles": 200}, n_games=8),
    # Walkers that fall are removed, the others continue.
    "multiwalker": Example(
        partial(module_env, "pettingzoo.sisl.multiwalker_v9"), WALKERS, n_games=8, ppo={"ent_coef": 0.0}
    ),
    "hanabi": Example(
        hanabi, {"colors": 2, "ranks": 5, "players": 2, "hand_size": 2, "max_information_tokens": 3}, n_games=16
    ),
}


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("--env", choices=ENVIRONMENTS, default="simple_spread")
    parser.add_argument("--algo", choices=("SAF", "MAPPO", "IPPO"), default="MAPPO")
    parser.add_argument("--state", action="store_true", help="the environment's state() as the input of MAPPO's critic")
    parser.add_argument("--game-steps", type=int, default=200_000, help="steps of the game, not of its agents")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=100, help="episodes of each evaluation")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--output", type=Path, help="file for the model")
    options = parser.parse_args(arguments)
    if options.state and options.algo != "MAPPO":
        parser.error("--state is for --algo MAPPO")
    return options


def make_env(options: argparse.Namespace, n_games: int, seed: int) -> CentralizedValueWrapper:
    """Make the games."""
    example = ENVIRONMENTS[options.env]
    return make_team_env(example.make, n_games, seed, state=options.state, **example.params)


def train(options: argparse.Namespace) -> PPO:
    """Train with normalised rewards; evaluations count the environment's own rewards."""
    example = ENVIRONMENTS[options.env]
    env = make_env(options, example.n_games, options.seed)
    settings = {"batch_size": example.n_games * example.n_steps * env.n_agents // 4, **PPO_SETTINGS, **example.ppo}
    settings["batch_size"] -= settings["batch_size"] % env.n_agents
    policy_kwargs = {"critic_input": "state"} if options.state else {}
    model = PPO(
        f"{options.algo}Policy",
        VecNormalize(env, norm_obs=False, gamma=settings.get("gamma", 0.99)),
        n_steps=example.n_steps,
        seed=options.seed,
        device="cpu",
        policy_kwargs=policy_kwargs,
        **settings,
    )
    # SB3 counts every agent's step.
    model.learn(options.game_steps * env.n_agents)
    model.get_env().close()  # type: ignore[union-attr]
    return model


def evaluate(options: argparse.Namespace, model: Any) -> EvaluationResult:
    """Return the team returns of new games, the same for every model."""
    env = make_env(options, min(options.episodes, 20), EVALUATION_SEED + options.seed)
    result = evaluate_team(model, env, options.episodes, deterministic=False)
    env.close()
    return result


def main(arguments: list[str] | None = None) -> None:
    """Train, evaluate, compare."""
    options = parse(arguments)
    th.set_num_threads(options.threads)
    start, cpu_start = time.perf_counter(), time.process_time()
    model = train(options)
    seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
    if options.output is not None:
        model.save(options.output)
    trained = evaluate(options, model)
    random = evaluate(options, RandomPolicy(model.action_space, seed=options.seed))
    print(f"{options.env}, {options.algo}{' on the state' if options.state else ''}, seed {options.seed}")
    print(
        f"{options.game_steps:,} game steps in {seconds:.0f} s ({cpu_seconds:.0f} s of CPU time, "
        f"{options.threads} thread(s))"
    )
    print("team return (sum over agents and steps), actions sampled")
    print(f"  trained  {trained}")
    print(f"  random   {random}")


if __name__ == "__main__":
    main()
