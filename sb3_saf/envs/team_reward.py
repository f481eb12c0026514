"""Rewards for learning: each agent's own, or the team's."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_saf.teams.vec_env import TeamVecEnvWrapper

#: Each agent its own reward; each the sum, or the mean, over the agents of its team.
TeamReward = Literal["given", "sum", "mean"]


class SharedReward(TeamVecEnvWrapper):
    """
    Give every agent the sum or the mean of its team's rewards. Wrap it around a TeamMonitor, which logs unchanged
    returns.

    :param venv: rows of flattened teams
    :param team_reward: ``"sum"`` or ``"mean"`` over the agents of a team
    """

    shares_reward: ClassVar[bool] = True

    def __init__(self, venv: VecEnv, team_reward: Literal["sum", "mean"]) -> None:
        super().__init__(venv)
        self.team_reward = team_reward

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for the step of all games; rewards (B,) are equal within a team."""
        obs, rewards, dones, infos = self.venv.step_wait()
        by_game = np.asarray(rewards).reshape(self.n_games, self.n_agents)
        shared = by_game.sum(axis=1) if self.team_reward == "sum" else by_game.mean(axis=1)
        return obs, np.repeat(shared, self.n_agents), dones, infos
