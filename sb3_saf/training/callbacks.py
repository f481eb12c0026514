"""Callbacks of a run: all count game steps and leave the random generators of training unchanged."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from tqdm import TqdmExperimentalWarning
from tqdm.rich import tqdm

from sb3_saf.callbacks.evaluation import TeamEvalCallback
from sb3_saf.callbacks.game_steps import team_steps
from sb3_saf.evaluation import EvaluationResult
from sb3_saf.suites.references import Standing, standing
from sb3_saf.teams.checks import evaluation_seed
from sb3_saf.teams.files import atomic_file
from sb3_saf.teams.randomness import own_randomness
from sb3_saf.teams.vec_env import require_n_agents
from sb3_saf.training.settings import Settings


class SeededEvalCallback(TeamEvalCallback):
    """
    Evaluate with a separate seed, so that training is unchanged.

    The last evaluation is of the final policy: at the last game step it waits for the update that follows.

    :param seed: of the run
    :param settings: of the games of evaluation, to log ``eval/share_of_published``, see ``sb3_saf.suites.references``
    """

    def __init__(self, *args: Any, seed: int, settings: Settings, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._seed = evaluation_seed(seed)
        self._settings = settings
        self.standing: Standing | None = None
        #: Evaluations of the run so far.
        self.n_evaluations = 0
        self._evaluated_at = -1

    def _on_step(self) -> bool:
        return self.num_timesteps >= self.locals["total_timesteps"] or super()._on_step()

    def _evaluate(self) -> bool:
        self.n_evaluations += 1
        self._evaluated_at = team_steps(self.model)
        with own_randomness(self._seed + self.n_evaluations, self.model.device):
            return super()._evaluate()

    def _log(self, result: EvaluationResult) -> None:
        settings = self._settings
        self.standing = standing(settings.environment, settings.env_kwargs, result.scores, team_steps(self.model))
        if self.standing is not None and self.standing.share is not None:
            self.logger.record("eval/share_of_published", self.standing.share)
        super()._log(result)

    def checkpoint_state(self) -> dict[str, int]:
        """Return the counters, for exact resume."""
        return {"n_evaluations": self.n_evaluations, "evaluated_at": self._evaluated_at}

    def load_checkpoint_state(self, state: Mapping[str, int]) -> None:
        """Restore the counters."""
        self.n_evaluations, self._evaluated_at = state["n_evaluations"], state["evaluated_at"]

    def _on_training_end(self) -> None:
        if self.eval_freq > 0 and self._evaluated_at != team_steps(self.model):
            self._evaluate()


class TrainingClock(BaseCallback):
    """
    Record processor time and wall time against game steps, also over resumed trainings.

    :param every_game_steps: minimum game steps between two points
    """

    def __init__(self, every_game_steps: float) -> None:
        super().__init__()
        self.every_game_steps = every_game_steps
        self._points: list[tuple[float, float]] = []
        self._started_at = time.strftime("%Y-%m-%dT%H:%M:%S%z")
        #: Processor and wall seconds of earlier parts of the training, and both clocks at the begin of this part.
        self._spent = np.zeros(2)
        self._begin: npt.NDArray[np.float64] | None = None

    @property
    def points(self) -> npt.NDArray[np.float64]:
        """Game steps, and processor seconds of this process until then, (K, 2)."""
        return np.array(self._points, dtype=np.float64).reshape(-1, 2)

    def cost(self) -> dict[str, Any]:
        """Return the cost of the training."""
        processor, wall = self._seconds()
        return {
            "started": self._started_at,
            "wall_seconds": float(wall),
            "processor_seconds": float(processor),
            "threads": th.get_num_threads(),
            "device": str(self.model.device),
        }

    def _seconds(self) -> npt.NDArray[np.float64]:
        return self._spent if self._begin is None else self._spent + _clocks() - self._begin

    def _add_point(self) -> None:
        self._points.append((team_steps(self.model), float(self._seconds()[0])))

    def _on_training_start(self) -> None:
        self._begin = _clocks()

    def _on_rollout_start(self) -> None:
        # Rollouts of off-policy algorithms are a few steps each.
        if not self._points or team_steps(self.model) >= self._points[-1][0] + self.every_game_steps:
            self._add_point()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self._spent, self._begin = self._seconds(), None
        self._add_point()

    def checkpoint_state(self) -> dict[str, Any]:
        """Return the points, the time until now, and when training began, as plain data."""
        return {"points": self.points, "seconds": self._seconds(), "started_at": self._started_at}

    def load_checkpoint_state(self, state: dict[str, Any]) -> None:
        """Restore a state of :meth:`checkpoint_state`."""
        self._points = [(float(steps), float(seconds)) for steps, seconds in state["points"]]
        self._spent, self._started_at = state["seconds"], state["started_at"]


def _clocks() -> npt.NDArray[np.float64]:
    return np.array([time.process_time(), time.perf_counter()])


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


class ProgressLines(BaseCallback):
    """Print a line for every tenth of the training, for log files and terminals without a progress bar."""

    def __init__(self, verbose: int = 1) -> None:
        super().__init__(verbose)

    def _on_training_start(self) -> None:
        self._total = self.locals["total_timesteps"] // require_n_agents(self.training_env)
        self._begun = time.perf_counter(), team_steps(self.model)
        self._tenths = 10 * self._begun[1] // self._total

    def _on_step(self) -> bool:
        steps = team_steps(self.model)
        if self.verbose == 0 or 10 * steps // self._total <= self._tenths:
            return True
        self._tenths = 10 * steps // self._total
        rate = (steps - self._begun[1]) / max(time.perf_counter() - self._begun[0], 1e-9)
        left = timedelta(seconds=round(max(0, self._total - steps) / rate))
        episodes = [episode["r"] for episode in self.model.ep_info_buffer or ()]
        mean = f", team return {np.mean(episodes):.2f} in training" if episodes else ""
        print(
            f"{10 * self._tenths:3} % of {self._total:,} game steps{mean}; {rate:,.0f} game steps per second, about "
            f"{left} (h:mm:ss) to go",
            flush=True,
        )
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
            with atomic_file(path) as file:
                self.model.save(file)
            if self.verbose > 0:
                print(f"Saved {path}")
        return True
