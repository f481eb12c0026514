"""Callbacks of a run: all count game steps and leave the random generators of training unchanged."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any, Final

from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from tqdm import TqdmExperimentalWarning
from tqdm.rich import tqdm

from sb3_saf.callbacks.evaluation import TeamEvalCallback
from sb3_saf.callbacks.game_steps import team_steps
from sb3_saf.teams.checks import evaluation_seed
from sb3_saf.teams.randomness import own_randomness
from sb3_saf.teams.vec_env import require_n_agents

#: Minimum seconds over which the rate of training is measured, from the end of the first rollout.
_MEASURED_SECONDS: Final = 20.0
_MEASURED_ROLLOUTS: Final = 2


class SeededEvalCallback(TeamEvalCallback):
    """Evaluate with a separate seed, so that training is unchanged; also evaluates the final policy."""

    def __init__(self, *args: Any, seed: int, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._seed = evaluation_seed(seed)
        self._n_evaluations = 0
        self._evaluated_at = -1

    def _evaluate(self) -> bool:
        self._n_evaluations += 1
        self._evaluated_at = self._game_steps()
        with own_randomness(self._seed + self._n_evaluations, self.model.device):
            return super()._evaluate()

    def checkpoint_state(self) -> dict[str, int]:
        """Return the counters, for exact resume."""
        return {"n_evaluations": self._n_evaluations, "evaluated_at": self._evaluated_at}

    def load_checkpoint_state(self, state: Mapping[str, int]) -> None:
        """Restore the counters."""
        self._n_evaluations, self._evaluated_at = state["n_evaluations"], state["evaluated_at"]

    def _on_training_end(self) -> None:
        if self.eval_freq > 0 and self._evaluated_at != self._game_steps():
            self._evaluate()


class GameStepsProgressBar(ProgressBarCallback):
    """SB3's progress bar in game steps instead of agent steps."""

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
        """Close the bar, also if training never began, or ended by an error."""
        if hasattr(self, "pbar"):
            self.pbar.close()


class RemainingTime(BaseCallback):
    """Print once the estimated remaining time, measured on the first rollouts."""

    def __init__(self, verbose: int = 1) -> None:
        super().__init__(verbose)
        self._n_rollouts = 0
        self._started = 0.0, 0
        self._told = verbose == 0

    def _on_rollout_start(self) -> None:
        self._n_rollouts += 1
        now, steps = time.perf_counter(), team_steps(self.model)
        if self._n_rollouts == 2:  # the first one compiles and fills caches
            self._started = now, steps
        seconds = now - self._started[0]
        if self._told or self._n_rollouts < 2 + _MEASURED_ROLLOUTS or seconds < _MEASURED_SECONDS:
            return
        self._told = True
        rate = (steps - self._started[1]) / seconds
        total = self.locals["total_timesteps"] // require_n_agents(self.training_env)
        left = timedelta(seconds=round(max(0, total - steps) / rate))
        print(f"{rate:,.0f} game steps per second: about {left} (h:mm:ss) to go", flush=True)

    def _on_step(self) -> bool:
        return True


class CheckpointInGameSteps(BaseCallback):
    """Save the model every ``save_freq`` game steps, of all games together, as ``rl_model_<game steps>_steps.zip``."""

    def __init__(self, save_freq: int, folder: str | Path, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.save_freq = save_freq
        self.folder = Path(folder)
        self._next = 0

    def _on_training_start(self) -> None:
        self._next = (team_steps(self.model) // self.save_freq + 1) * self.save_freq

    def _on_step(self) -> bool:
        steps = team_steps(self.model)
        if steps >= self._next:
            self._next = (steps // self.save_freq + 1) * self.save_freq
            path = self.folder / f"rl_model_{steps}_steps.zip"
            self.model.save(path)
            if self.verbose > 0:
                print(f"Saved {path}")
        return True
