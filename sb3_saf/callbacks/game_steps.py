"""Game steps in the logs: SB3 counts rows, that is, every agent of every game."""

from __future__ import annotations

import sys
import time

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_saf.callbacks.wrapping import AlgorithmClass, do_before
from sb3_saf.envs.teams import find_n_agents

GAME_STEPS_TAG = "time/game_steps"
GAME_STEPS_PER_SECOND_TAG = "time/game_steps_per_second"


def game_steps(model: BaseAlgorithm) -> int | None:
    """
    Steps of games that a model was trained for: its ``num_timesteps`` (agents' steps) divided by N.

    :param model: an algorithm with or without an environment
    :return: None if its environment is not made of teams
    """
    venv = model.get_env()
    n_agents = None if venv is None else find_n_agents(venv)
    return None if n_agents is None else model.num_timesteps // n_agents


def game_steps_per_second(model: BaseAlgorithm) -> float | None:
    """
    Steps of games per second since ``learn`` was called; SB3's ``time/fps`` is the same in agents' steps.

    :param model: an algorithm in or after ``learn``
    :return: None if its environment is not made of teams, or it has not begun to learn
    """
    venv = model.get_env()
    n_agents = None if venv is None else find_n_agents(venv)
    if n_agents is None or not model.start_time:
        return None
    seconds = max((time.time_ns() - model.start_time) / 1e9, sys.float_info.epsilon)
    return (model.num_timesteps - model._num_timesteps_at_start) / n_agents / seconds


def log_game_steps(algorithm_class: AlgorithmClass) -> AlgorithmClass:
    """
    Let an algorithm log ``time/game_steps`` and ``time/game_steps_per_second`` whenever it trains on teams. SB3's
    ``time/total_timesteps`` and ``time/fps`` beside them count agents' steps.

    SB3 has no door for this: callbacks end before the logs are written, and must be passed to every ``learn``. So
    ``dump_logs`` of the class is wrapped; models on other environments log what they always did. Calling it again, for
    the class or a subclass that inherits the wrapped method, changes nothing.

    :param algorithm_class: for instance PPO; its base classes are left alone
    :return: the same class
    """
    return do_before(algorithm_class, "dump_logs", _record_game_steps)


def _record_game_steps(model: BaseAlgorithm) -> None:
    steps, per_second = game_steps(model), game_steps_per_second(model)
    if steps is not None:
        model.logger.record(GAME_STEPS_TAG, steps)
    if per_second is not None:
        model.logger.record(GAME_STEPS_PER_SECOND_TAG, round(per_second, 1))
