"""
A ladder for memory: a cue in the first step of an episode is answered in the last.

    python -m benchmarks.memory [--cues own joint] [--lengths 3 6 9] [--methods saf mappo ippo qplex]
        [--memories none gru lstm] [--episodes 8000] [--seeds 0]

Prints the share of right answers, by length, method and memory, one for each seed; chance is a half.
"""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any, Literal, get_args

import numpy as np
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO

import sb3_saf

#: Who answers: every agent its own cue, or agent b that of agent a, whose first action it sees.
Cue = Literal["own", "joint"]


class CueGame(ParallelEnv[str, Any, Any]):
    """
    Two agents, of which ``b`` may leave before the end (not with a joint cue).

    Observations are [cue is 0, cue is 1, this is the last step, a did 0, a did 1]: the cue in the first step only, and
    a's first action in b's second. Actions are the answers 0 and 1, and waiting, the only legal one between the first
    and the last step. With a joint cue, only ``a`` sees the cue, which b answers.

    :param length: steps of an episode, at least 3
    :param cue: who answers
    """

    metadata = {"name": "cue"}
    possible_agents = ["a", "b"]

    def __init__(self, length: int = 3, cue: Cue = "own"):
        self.length, self.cue = length, cue

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """See PettingZoo."""
        return spaces.Box(0, 1, (5,), np.float32)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """See PettingZoo."""
        return spaces.Discrete(3)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Show new cues."""
        if seed is not None or not hasattr(self, "rng"):
            self.rng = np.random.default_rng(seed)
        self.agents, self.time, self.first = list(self.possible_agents), 0, 2
        self.cues = dict(zip(self.agents, self.rng.integers(2, size=2).tolist(), strict=True))
        if self.cue == "joint":
            self.cues["b"] = self.cues["a"]
        self.leaves = int(self.rng.integers(1, 2 * self.length)) if self.cue == "own" else self.length
        return self._seen()

    def _seen(self) -> tuple[dict[str, Any], dict[str, Any]]:
        is_first, is_last = self.time == 0, self.time == self.length - 1
        observations, infos = {}, {}
        for agent in self.agents:
            view = np.zeros(5, np.float32)
            if is_first and (agent == "a" or self.cue == "own"):
                view[self.cues[agent]] = 1
            view[2] = is_last
            if agent == "b" and self.cue == "joint" and self.time == 1 and self.first < 2:
                view[3 + self.first] = 1
            answers = is_last or (is_first and agent == "a" and self.cue == "joint")
            infos[agent] = {"action_mask": np.array([answers, answers, not answers], np.int8)}
            observations[agent] = view
        return observations, infos

    def step(self, actions: dict[str, Any]) -> Any:
        """Wait, or answer in the last step."""
        if self.time == 0:
            self.first = int(actions["a"])
        self.time += 1
        over = self.time == self.length
        right = {agent: float(over and actions[agent] == self.cues[agent]) for agent in self.agents}
        if self.cue == "joint":
            right = dict.fromkeys(self.agents, right["b"])
        ends = {agent: over or (agent == "b" and self.time >= self.leaves) for agent in self.agents}
        observations, infos = self._seen()
        cuts = dict.fromkeys(self.agents, False)
        self.agents = [agent for agent in self.agents if not ends[agent]]
        return observations, right, ends, cuts, infos


def trained(
    method: str, memory: str | None, length: int, cue: Cue = "own", n_episodes: int = 8_000, seed: int = 0
) -> Any:
    """Train a method on the game, with a small network."""
    env = sb3_saf.make_team_env(partial(CueGame, length, cue), 32, seed=seed)
    kwargs: dict[str, Any] = {"net_arch": [32], "memory": memory, "memory_size": 32}
    common: dict[str, Any] = {"seed": seed, "device": "cpu", "gamma": 1.0}
    if method == "qplex":
        kwargs |= {"sequence_length": length, "burn_in": 0} if memory is not None else {}
        model: Any = sb3_saf.QPLEX(
            "QPLEXPolicy", env, policy_kwargs=kwargs, learning_rate=2e-3, learning_starts=1_000, batch_size=64 * length,
            train_freq=64, target_update_interval=500, exploration_fraction=0.5, buffer_size=20_000, **common,
        )  # fmt: skip
    else:
        if method == "saf":
            kwargs |= {"n_policies": 2, "latent_dim": 16, "projection_arch": (32,)}
        model = PPO(
            f"{method.upper()}Policy", env, policy_kwargs=kwargs, n_steps=4 * length, batch_size=64 * length,
            n_epochs=4, learning_rate=lambda left: 2e-3 * left, ent_coef=0.01, gae_lambda=1.0,
            rollout_buffer_class=sb3_saf.TeamRolloutBuffer, **common,
        )  # fmt: skip
    return model.learn(n_episodes * length * 2)


def share_right(model: Any, length: int, cue: Cue = "own") -> float:
    """Return the share of right answers (of agent a, or with a joint cue of b) in 200 new episodes."""
    env = sb3_saf.make_team_env(partial(CueGame, length, cue), 40, seed=1_000)
    result = sb3_saf.evaluate_team(model, env, 200)
    return float(np.mean([returns["ab".index("a" if cue == "own" else "b")] for returns in result.agent_returns]))


def main() -> None:
    """Print the ladder."""
    parser = argparse.ArgumentParser(description="share of right answers to a cue in the first step")
    parser.add_argument("--cues", nargs="+", choices=get_args(Cue), default=list(get_args(Cue)))
    parser.add_argument("--lengths", type=int, nargs="+", default=[3, 6, 9])
    parser.add_argument("--methods", nargs="+", default=["saf", "mappo", "ippo", "qplex"])
    parser.add_argument("--memories", nargs="+", default=["none", "gru", "lstm"])
    parser.add_argument("--episodes", type=int, default=8_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    options = parser.parse_args()
    th.set_num_threads(1)
    for cue in options.cues:
        for length in options.lengths:
            for method in options.methods:
                for memory in options.memories:
                    print(f"{cue:6}{length:3} {method:6}{memory:5}", end="", flush=True)
                    for seed in options.seeds:
                        kind = None if memory == "none" else memory
                        model = trained(method, kind, length, cue, options.episodes, seed)
                        print(f"{share_right(model, length, cue):6.2f}", end="", flush=True)
                    print()


if __name__ == "__main__":
    main()
