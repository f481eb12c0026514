"""
Connect Four by self-play, then 100 games against an opponent that plays uniformly among its legal moves.

``python examples/connect_four.py`` trains both players as one team for 40,960 moves; needs ``pettingzoo[classic]``.
"""

from __future__ import annotations

import argparse

import numpy as np
from pettingzoo.classic import connect_four_v3
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm

import sb3_saf


def play(model: BaseAlgorithm, side: int, seed: int, deterministic: bool = False) -> float:
    """Return the reward of the model's player, 1, 0 or -1, in one game; ``side`` 0 moves first."""
    game, rng, reward = connect_four_v3.env(), np.random.default_rng(seed), 0.0
    game.reset(seed=seed)
    for agent in game.agent_iter():
        observation, _, over, _, _ = game.last()
        if over:
            reward = game.rewards[game.possible_agents[side]]
            break
        if agent == game.possible_agents[side]:
            action = int(model.predict(observation, deterministic=deterministic)[0])
        else:
            action = int(rng.choice(np.flatnonzero(observation["action_mask"])))
        game.step(action)
    return float(reward)


def main(arguments: list[str] | None = None) -> float:
    """Train, play, print; return the mean reward with drawn actions."""
    parser = argparse.ArgumentParser(prog="python examples/connect_four.py", description="self-play of Connect Four")
    parser.add_argument("--moves", type=int, default=40_960, help="of the training, by both players together")
    parser.add_argument("--games", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    env = sb3_saf.make_team_env(lambda: sb3_saf.TurnsInParallel(connect_four_v3.env()), n_envs=16, seed=options.seed)
    model = PPO("IPPOPolicy", env, seed=options.seed, **sb3_saf.ppo_settings(env, "ippo"))
    model.learn(options.moves * env.n_agents)  # a move is one game step, in which the other player waits
    for deterministic in (True, False):
        rewards = np.array([play(model, game % 2, game, deterministic) for game in range(options.games)])
        won = rewards > 0
        print(
            f"{'most likely' if deterministic else 'drawn'} actions, {options.games} games: won {won.mean():.0%} "
            f"({won[::2].mean():.0%} moving first, {won[1::2].mean():.0%} second), mean reward {rewards.mean():.2f}"
        )
    return float(rewards.mean())


if __name__ == "__main__":
    main()
