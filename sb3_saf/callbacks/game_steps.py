"""Game steps in the logs (SB3 counts agent steps), and the check of a model before training."""

from __future__ import annotations

import sys
import time
import warnings
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat
from stable_baselines3.common.torch_layers import CombinedExtractor

from sb3_saf.policies.rows import TeamRowsPolicy
from sb3_saf.teams.rows import TEAM_KEY, TEAM_KEYS
from sb3_saf.teams.vec_env import agent_names, find_n_agents

GAME_STEPS_TAG = "time/game_steps"
GAME_STEPS_PER_SECOND_TAG = "time/game_steps_per_second"


def game_steps(model: BaseAlgorithm) -> int | None:
    """
    Return the game steps that a model was trained for: its ``num_timesteps`` (agent steps) divided by N.

    :param model: an algorithm with or without an environment
    :return: None if its environment has no teams
    """
    venv = model.get_env()
    n_agents = None if venv is None else find_n_agents(venv)
    return None if n_agents is None else model.num_timesteps // n_agents


def team_steps(model: BaseAlgorithm) -> int:
    """Return :func:`game_steps` of a model whose environment is known to have teams."""
    steps = game_steps(model)
    assert steps is not None
    return steps


def check_training(model: BaseAlgorithm) -> None:
    """
    Check a model before training; the callbacks of this package call it.

    Warns about SB3's own ``"MultiInputPolicy"``: it reads all entries of a row, the joint observation included, so that
    execution is not decentralised. It is allowed as a centralised policy.
    """
    entries = getattr(model.observation_space, "spaces", {})
    extractor = getattr(model.policy, "features_extractor", None)
    if set(TEAM_KEYS) <= set(entries) and isinstance(extractor, CombinedExtractor):
        own = sorted(
            name
            for name, policy in model.policy_aliases.items()
            if issubclass(policy, TeamRowsPolicy) and name == policy.__name__
        )
        warnings.warn(
            f"{type(model.policy).__name__} reads whole rows of teams: its actor sees {TEAM_KEY!r}, what all agents "
            "see, so that agents cannot act on their own observations. Use a policy whose critic alone reads the team: "
            f"{', '.join(own)}, as in {type(model).__name__}({own[-1]!r}, env)",
            UserWarning,
            stacklevel=3,
        )


class GameStepsBoard(TensorBoardOutputFormat):
    """A run's TensorBoard file with game steps on the x-axis instead of SB3's agent steps."""

    def __init__(self, board: TensorBoardOutputFormat, n_agents: int) -> None:
        # Not the base class's constructor, which would open a second file.
        self.board, self.n_agents, self.writer = board, n_agents, board.writer

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """See the base class; ``step`` counts agent steps."""
        self.board.write(key_values, key_excluded, step // self.n_agents)

    def close(self) -> None:
        """Close the file."""
        self.board.close()


def show_game_steps(model: BaseAlgorithm) -> None:
    """
    Make TensorBoard count game steps from now on; callbacks of this package do so when training starts.

    :param model: a model in ``learn``; nothing changes if its environment has no teams
    """
    venv = model.get_env()
    n_agents = None if venv is None else find_n_agents(venv)
    if n_agents is None:
        return
    model.logger.output_formats = [
        GameStepsBoard(each, n_agents)
        if isinstance(each, TensorBoardOutputFormat) and not isinstance(each, GameStepsBoard)
        else each
        for each in model.logger.output_formats
    ]


class GameStepsCallback(BaseCallback):
    """
    Log ``time/game_steps`` and ``time/game_steps_per_second`` beside SB3's ``time/total_timesteps`` and ``time/fps``,
    which count agent steps, and make TensorBoard's x-axis count game steps; log each agent's own return beside the
    team's, ``rollout/ep_rew_mean/AGENT``, but not on the screen. Without teams it does nothing.

    Before training it checks policy, buffer and batch size (:func:`check_training`).

    ``sb3_saf.train`` and ``resumable_learn`` add it automatically; pass it to any other ``learn``.
    """

    only_shows = True  # has no state in checkpoints

    def __init__(self) -> None:
        super().__init__()
        self._n_agents: int | None = None
        self._first_step = 0
        self._started = 0.0

    def _init_callback(self) -> None:
        check_training(self.model)

    def _on_training_start(self) -> None:
        show_game_steps(self.model)
        self._n_agents = find_n_agents(self.training_env)
        self._first_step, self._started = self.num_timesteps, time.monotonic()

    def _on_step(self) -> bool:
        if self._n_agents is not None:
            seconds = max(time.monotonic() - self._started, sys.float_info.epsilon)
            rate = (self.num_timesteps - self._first_step) / self._n_agents / seconds
            self.logger.record(GAME_STEPS_TAG, self.num_timesteps // self._n_agents)
            self.logger.record(GAME_STEPS_PER_SECOND_TAG, round(rate, 1))
        return True

    def _on_rollout_end(self) -> None:
        """Log the agents' own mean returns over the episodes of SB3's ``rollout/ep_rew_mean``."""
        episodes = [episode["agents"] for episode in self.model.ep_info_buffer or () if "agents" in episode]
        if self._n_agents is not None and episodes:
            for name, mean in zip(agent_names(self.training_env), np.mean(episodes, axis=0).tolist(), strict=True):
                self.logger.record(f"rollout/ep_rew_mean/{name}", mean, exclude="stdout")
