"""Evaluation, checkpoints and tuning while training: all in game steps, none touching the generators of training."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import optuna
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from tqdm import TqdmExperimentalWarning
from tqdm.rich import tqdm

from sb3_saf.callbacks.evaluation import TeamEvalCallback
from sb3_saf.callbacks.game_steps import game_steps
from sb3_saf.envs.teams import require_n_agents
from sb3_saf.evaluation import EvaluationResult
from sb3_saf.randomness import own_randomness
from sb3_saf.training.seeds import evaluation_seed


class SeededEvalCallback(TeamEvalCallback):
    """
    ``TeamEvalCallback`` that leaves training as it would be without it, and evaluates the final policy too.

    :param args: as ``TeamEvalCallback``
    :param seed: the run's seed
    :param kwargs: as ``TeamEvalCallback``
    """

    def __init__(self, *args: Any, seed: int, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._seed = evaluation_seed(seed)
        self._n_evaluations = 0
        self._evaluated_at = -1
        self._has_started = False

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._has_started = True

    def _evaluate(self) -> bool:
        self._n_evaluations += 1
        self._evaluated_at = self._game_steps()
        with own_randomness(self._seed + self._n_evaluations, self.model.device):
            return super()._evaluate()

    def checkpoint_state(self) -> dict[str, int]:
        """Counters, for exact resume."""
        return {"n_evaluations": self._n_evaluations, "evaluated_at": self._evaluated_at}

    def load_checkpoint_state(self, state: Mapping[str, int]) -> None:
        """
        Go on from there.

        :param state: what :meth:`checkpoint_state` gave
        """
        self._n_evaluations, self._evaluated_at = state["n_evaluations"], state["evaluated_at"]

    def _on_training_end(self) -> None:
        # RL-Zoo3 ends its first callback once more, and ends it even if training never began.
        if self._has_started and self.eval_freq > 0 and self._evaluated_at != self._game_steps():
            self._evaluate()


class TrialCallback(SeededEvalCallback):
    """
    Evaluation of an Optuna trial: reports every evaluation, and stops what the pruner gives up.

    :param args: as ``SeededEvalCallback``
    :param trial: the trial
    :param kwargs: as ``SeededEvalCallback``
    """

    def __init__(self, *args: Any, trial: optuna.Trial, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.trial = trial
        self.is_pruned = False

    def _react(self, result: EvaluationResult) -> bool:
        go_on = super()._react(result)
        self.trial.report(result.mean, self._n_evaluations)
        self.is_pruned = self.trial.should_prune()
        return go_on and not self.is_pruned

    def _on_training_end(self) -> None:
        if not self.is_pruned:
            super()._on_training_end()


class GameStepsProgressBar(ProgressBarCallback):
    """SB3's progress bar, which counts the steps of every agent, in game steps."""

    def _on_training_start(self) -> None:
        n_agents = require_n_agents(self.training_env)
        total = self.locals["total_timesteps"] - self.model.num_timesteps
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TqdmExperimentalWarning)
            self.pbar = tqdm(total=total // n_agents, unit="game steps")

    def _on_step(self) -> bool:
        self.pbar.update(self.training_env.num_envs // require_n_agents(self.training_env))
        return True

    def _on_training_end(self) -> None:
        self.close()

    def close(self) -> None:
        """Leave the bar as it is; also if training never began, or has ended by an error."""
        if hasattr(self, "pbar"):
            self.pbar.close()


class CheckpointInGameSteps(BaseCallback):
    """
    Save the model every so many game steps, as ``rl_model_<game steps>_steps.zip``.

    :param save_freq: game steps between checkpoints, summed over all parallel games
    :param folder: where to
    :param verbose: 1 to say so
    """

    def __init__(self, save_freq: int, folder: str | Path, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.save_freq = save_freq
        self.folder = Path(folder)
        self._next = 0

    def _game_steps(self) -> int:
        steps = game_steps(self.model)
        assert steps is not None, "the zoo trains on teams only"
        return steps

    def _on_training_start(self) -> None:
        self._next = (self._game_steps() // self.save_freq + 1) * self.save_freq

    def _on_step(self) -> bool:
        steps = self._game_steps()
        if steps >= self._next:
            self._next = (steps // self.save_freq + 1) * self.save_freq
            path = self.folder / f"rl_model_{steps}_steps.zip"
            self.model.save(path)
            if self.verbose > 0:
                print(f"Saved {path}")
        return True
