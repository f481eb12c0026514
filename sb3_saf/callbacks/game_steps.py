"""Game steps in the logs: SB3 counts rows, that is, every agent of every game."""

from __future__ import annotations

import sys
import time

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_saf.callbacks.checks import check_training
from sb3_saf.envs.teams import find_n_agents

GAME_STEPS_TAG = "time/game_steps"
GAME_STEPS_PER_SECOND_TAG = "time/game_steps_per_second"


def game_steps(model: BaseAlgorithm) -> int | None:
    """
    Return the steps of games that a model was trained for: its ``num_timesteps`` (agents' steps) divided by N.

    :param model: an algorithm with or without an environment
    :return: None if its environment is not made of teams
    """
    venv = model.get_env()
    n_agents = None if venv is None else find_n_agents(venv)
    return None if n_agents is None else model.num_timesteps // n_agents


class GameStepsCallback(BaseCallback):
    """
    Log ``time/game_steps`` and ``time/game_steps_per_second`` beside SB3's ``time/total_timesteps`` and ``time/fps``,
    which count agents' steps. On environments that are not made of teams it logs nothing.

    Before training it checks policy, buffer and batch size (:func:`~sb3_saf.callbacks.checks.check_training`).

    ``sb3_saf.train`` and ``resumable_learn`` use it by themselves; pass it to any other ``learn``.
    """

    def __init__(self) -> None:
        super().__init__()
        self._n_agents: int | None = None
        self._first_step = 0
        self._started = 0.0

    def _init_callback(self) -> None:
        check_training(self.model)

    def _on_training_start(self) -> None:
        self._n_agents = find_n_agents(self.training_env)
        self._first_step, self._started = self.num_timesteps, time.monotonic()

    def _on_step(self) -> bool:
        if self._n_agents is not None:
            seconds = max(time.monotonic() - self._started, sys.float_info.epsilon)
            rate = (self.num_timesteps - self._first_step) / self._n_agents / seconds
            self.logger.record(GAME_STEPS_TAG, self.num_timesteps // self._n_agents)
            self.logger.record(GAME_STEPS_PER_SECOND_TAG, round(rate, 1))
        return True
