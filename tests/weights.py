"""
Hashes of the weights of short trainings: ``python -m tests.weights [NAME ...]``.

A change that moves code without changing what is learned prints the same lines before and after it, on one machine
(other processors round otherwise). Only names of the packages' roots are used, so that any version can run it.
"""

from __future__ import annotations

import hashlib
import sys
import warnings
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

import sb3_saf

HECOGRID: Final[dict[str, Any]] = {"n_agents": 3, "grid_size": 9, "n_treasures": 6, "max_cycles": 10}
BUFFER: Final[dict[str, Any]] = {"rollout_buffer_class": sb3_saf.TeamRolloutBuffer}
STEPS: Final[dict[str, Any]] = {"n_steps": 16, "n_epochs": 2, "seed": 0, "device": "cpu"}


class DyingGame(ParallelEnv[str, Any, Any]):
    """Three agents with masks in infos; agent ``a`` dies in step 3, ``c`` joins in step 2, all end in step 7."""

    metadata = {"name": "dying"}
    possible_agents = ["a", "b", "c"]

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Box(-1, 1, (3,), np.float32)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Discrete(4)

    def _seen(self) -> tuple[dict[str, Any], dict[str, Any]]:
        masks = {agent: np.arange(4) != (self.time + i) % 4 for i, agent in enumerate(self.agents)}
        observations = {agent: self.rng.uniform(-1, 1, 3).astype(np.float32) for agent in self.agents}
        return observations, {agent: {"action_mask": mask.astype(np.int8)} for agent, mask in masks.items()}

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if seed is not None or not hasattr(self, "rng"):
            self.rng = np.random.default_rng(seed)
        self.agents, self.time = ["a", "b"], 0
        return self._seen()

    def step(self, actions: dict[str, Any]) -> Any:
        self.time += 1
        if self.time == 2:
            self.agents = ["a", "b", "c"]
        rewards = {agent: float(actions.get(agent, 0)) - self.time / 8 for agent in self.agents}
        observations, infos = self._seen()
        over = self.time == 7
        ends = {agent: agent == "a" and self.time == 3 for agent in self.agents}
        cuts = dict.fromkeys(self.agents, over)
        self.agents = [] if over else [agent for agent in self.agents if not ends[agent]]
        return observations, rewards, ends, cuts, infos


def hecogrid(n_envs: int = 4, **kwargs: Any) -> Any:
    return sb3_saf.make_team_env("TeamSupport", n_envs, seed=0, **{**HECOGRID, **kwargs})


def trained(algorithm: Any, policy: str, env: Any, steps: int = 32, **kwargs: Any) -> Any:
    rows = env.num_envs
    model = algorithm(policy, env, **{**STEPS, "batch_size": 4 * rows, **kwargs})
    return model.learn(steps * rows)


def of_method(method: str) -> Any:
    env = hecogrid()
    return PPO(f"{method.upper()}Policy", env, **{**sb3_saf.ppo_settings(env, method), **STEPS}).learn(64 * 12)


TRAININGS: Final[dict[str, Callable[[], Any]]] = {
    "saf": lambda: of_method("saf"),
    "mappo": lambda: of_method("mappo"),
    "ippo": lambda: of_method("ippo"),
    "saf, SB3's buffer": lambda: trained(PPO, "SAFPolicy", hecogrid()),
    "saf, pixels, gumbel, heads": lambda: trained(
        PPO,
        "SAFPolicy",
        hecogrid(observation="rgb"),
        policy_kwargs={"selection": "gumbel", "heads": "per_agent"},
        **BUFFER,
    ),
    "supersuit": lambda: trained(PPO, "SAFPolicy", hecogrid(2, backend="supersuit", time_limit="bootstrap"), **BUFFER),
    "lstm": lambda: trained(PPO, "MAPPOPolicy", hecogrid(2), policy_kwargs={"memory": "lstm"}, **BUFFER),
    "gru, dying": lambda: trained(
        PPO, "SAFPolicy", sb3_saf.make_team_env(DyingGame, 3, seed=0), policy_kwargs={"memory": "gru"}, **BUFFER
    ),
    "qplex": lambda: sb3_saf.QPLEX("QPLEXPoolPolicy", hecogrid(2), learning_starts=60, buffer_size=600, seed=0).learn(
        600
    ),
    "curriculum": lambda: trained(
        PPO, "MAPPOPolicy", hecogrid(coordination=2, curriculum=[sb3_saf.Stage(100, {"coordination": 1})]), **BUFFER
    ),
    "dying": lambda: trained(PPO, "MAPPOPolicy", sb3_saf.make_team_env(DyingGame, 3, seed=0), **BUFFER),
    "dying, team rewards": lambda: trained(
        PPO,
        "SAFPolicy",
        sb3_saf.make_team_env(DyingGame, 3, seed=0, team_reward="sum"),
        rollout_buffer_kwargs={"ends": "team"},
        policy_kwargs={"normalize_values": True},
        **BUFFER,
    ),
    "maskable": lambda: trained(MaskablePPO, "MAPPOMaskablePolicy", sb3_saf.make_team_env(DyingGame, 3, seed=0)),
    "normalised": lambda: trained(
        PPO,
        "IPPOPolicy",
        sb3_saf.CentralizedValueWrapper(
            VecNormalize(sb3_saf.make_team_env(DyingGame, 3, seed=0).venv, norm_obs_keys=["obs"])
        ),
        **BUFFER,
    ),
    "smax": lambda: trained(PPO, "SAFPolicy", sb3_saf.make_team_env("smax/3m", 2, seed=0), **BUFFER),
}


def weights_of(model: Any) -> dict[str, bytes]:
    """Return the weights of a model's policy, to compare them to the last bit."""
    return {name: value.cpu().numpy().tobytes() for name, value in model.policy.state_dict().items()}


def digest(model: Any) -> str:
    """Return the first digits of a hash of all weights."""
    weights = hashlib.sha256()
    for name, value in sorted(weights_of(model).items()):
        weights.update(name.encode() + value)
    return weights.hexdigest()[:16]


def main(names: list[str]) -> None:
    """Print one line for each training."""
    th.set_num_threads(1)
    warnings.simplefilter("ignore")
    for name, train in TRAININGS.items():
        if names and not any(part in name for part in names):
            continue
        try:
            print(f"{name:28} {digest(train())}", flush=True)
        except Exception as error:
            print(f"{name:28} {type(error).__name__}: {str(error)[:200]}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
