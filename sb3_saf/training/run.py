"""
Training from settings: make the games, make the model, learn, save; and the callbacks of a run, which count game steps
and leave the random generators of training unchanged.

Commands, tuning, experiments and scripts call :func:`train`. :class:`Training` has the same function in two steps, for
callers that distinguish errors of preparation from errors of training.
"""

from __future__ import annotations

import shutil
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from tqdm import TqdmExperimentalWarning
from tqdm.rich import tqdm

from sb3_saf.callbacks import FiniteCallback, GameStepsCallback, TeamEvalCallback, team_steps
from sb3_saf.checkpoints.learning import resumable_learn
from sb3_saf.checkpoints.states import settings_restored_on_error
from sb3_saf.envs.joint_observation import CentralizedValueWrapper
from sb3_saf.evaluation import EvaluationResult
from sb3_saf.export.writer import load_weights, read_weights
from sb3_saf.inspection.callback import InspectionCallback
from sb3_saf.suites.registry import Standing
from sb3_saf.teams.checks import evaluation_seed
from sb3_saf.teams.files import atomic_file, remove_leftovers
from sb3_saf.teams.randomness import own_randomness
from sb3_saf.teams.vec_env import require_n_agents
from sb3_saf.training.folders import CHECKPOINTS, CURVE_POINTS, FINISHED, MONITOR, finish_run, write_curve
from sb3_saf.training.settings import Settings
from sb3_saf.training.wrappers import load_normalization, make_callbacks, save_normalization


class SeededEvalCallback(TeamEvalCallback):
    """
    Evaluate with a separate seed, so that training is unchanged.

    The last evaluation is of the final policy: at the last game step it waits for the update that follows.

    :param seed: of the run
    :param settings: of the games of evaluation, to log ``eval/share_of_published``, see ``sb3_saf.suites.registry``
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
        best = self.best_mean_reward
        with own_randomness(self._seed + self.n_evaluations, self.model.device):
            go_on = super()._evaluate()
        if self.best_mean_reward > best and self.best_model_save_path is not None:
            save_normalization(self.training_env, Path(self.best_model_save_path, "best_model.zip"))
        return go_on

    def _log(self, result: EvaluationResult) -> None:
        self.standing = self._settings.standing(result.scores, team_steps(self.model))
        if self.standing is not None and self.standing.share is not None:
            self.logger.record("eval/share_of_published", self.standing.share)
        super()._log(result)

    def checkpoint_state(self) -> dict[str, Any]:
        """Return the counters and the time, for exact resume."""
        return {"n_evaluations": self.n_evaluations, "evaluated_at": self._evaluated_at, "seconds": self.seconds}

    def load_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Restore the counters and the time."""
        self.n_evaluations, self._evaluated_at = state["n_evaluations"], state["evaluated_at"]
        self.seconds = state.get("seconds", 0.0)

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

    def close(self) -> None:
        """Close the bar, also if training never began, or ended by an error."""
        if hasattr(self, "pbar"):
            self.pbar.close()


class ProgressLines(BaseCallback):
    """Print a line for every tenth of the training, for log files and terminals without a progress bar."""

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
            save_normalization(self.training_env, path)
            if self.verbose > 0:
                print(f"Saved {path}")
        return True


#: Evaluations, inspections and checkpoints of a run, unless a frequency is given.
EVALUATIONS_PER_RUN: Final = 20
INSPECTIONS_PER_RUN: Final = 10
CHECKPOINTS_PER_RUN: Final = 10
#: Team episodes of an inspection, each in a separate game.
INSPECTED_EPISODES: Final = 16


@dataclass(frozen=True)
class RunOptions:
    """
    Options of a run. They do not change the learned model, except ``device``, ``num_threads`` (by rounding) and
    ``initial_model``.

    Frequencies are intervals in game steps, summed over all parallel games: 0 or less for never, None for the default
    number of times per run.

    :param eval_freq: game steps between evaluations (None: 20 per run), and one after the last step
    :param eval_episodes: team episodes per evaluation
    :param n_eval_envs: parallel games for evaluation
    :param eval_settings: settings of the evaluation games; None for those of training
    :param after_evaluation: called after every evaluation; training ends if it returns False
    :param deterministic_eval: whether evaluation takes the most likely actions; value-based algorithms always do
    :param save_freq: game steps between saved models
    :param inspect_freq: game steps between inspections of the policy, only with ``tensorboard_log`` (None: 10 per run)
    :param checkpoint_freq: game steps between checkpoints in ``FOLDER/checkpoints``, from which a run of the same
        settings continues (None: 10 per run); they are removed at the end of the run
    :param tensorboard_log: folder of TensorBoard logs, named by algorithm; None for none
    :param model_name: the trained model is saved as ``FOLDER/MODEL_NAME.zip``
    :param initial_model: a saved model with the initial weights and optimiser state; None for new ones
    :param log_interval: rollouts between log entries; None for SB3's default, 0 for no log
    :param n_cpus: processes for the training games; HECOGrid's compiled games need one
    :param num_threads: threads of torch; None for its default
    :param progress: whether to draw a progress bar in game steps
    :param verbose: 0 or 1, as in SB3
    :param resume_hint: advice in the message after Ctrl-C or SIGTERM
    """

    eval_freq: int | None = 0
    eval_episodes: int = 32
    n_eval_envs: int = 32
    eval_settings: Settings | None = None
    after_evaluation: BaseCallback | None = None
    deterministic_eval: bool = False
    save_freq: int = 0
    inspect_freq: int | None = None
    checkpoint_freq: int | None = 0
    tensorboard_log: Path | None = None
    model_name: str = "model"
    initial_model: Path | None = None
    log_interval: int | None = None
    device: str = "auto"
    n_cpus: int = 1
    num_threads: int | None = None
    progress: bool = False
    verbose: int = 0
    resume_hint: str = "start the same command again to go on from there"


def train(
    settings: Settings,
    seed: int,
    folder: Path | None = None,
    options: RunOptions | None = None,
    callbacks: Sequence[BaseCallback] = (),
) -> BaseAlgorithm:
    """
    Train a model; continue from the newest checkpoint if the folder has checkpoints of the same run.

    :param settings: everything that determines the result except the seed
    :param folder: folder for ``monitor.csv``, models, evaluations and checkpoints; None writes none of them
    :param callbacks: further callbacks, called before those of the options
    :return: the trained model; its games are closed
    :raises ValueError: if the games or the model cannot be made, or the folder has a finished run
    :raises CheckpointError: if a checkpoint cannot be written or read
    :raises NonFiniteError: at NaN or infinity
    """
    with closing(Training(settings, seed, folder, options, callbacks)) as training:
        return training.learn()


class Training:
    """Games, model and callbacks of one run, to be closed at the end; arguments as in :func:`train`."""

    def __init__(
        self,
        settings: Settings,
        seed: int,
        folder: Path | None = None,
        options: RunOptions | None = None,
        callbacks: Sequence[BaseCallback] = (),
    ) -> None:
        self.settings = settings
        self.seed = seed
        self.folder = folder
        self.options = options or RunOptions()
        if folder is not None and (folder / FINISHED).exists() and not any((folder / CHECKPOINTS).glob("*.ckpt")):
            raise ValueError(f"{folder} has a finished run: give this one a folder of its own")
        if self.options.num_threads is not None:
            th.set_num_threads(self.options.num_threads)
        with ExitStack() as self._open:  # closes the parts already made if a later one fails
            self.games = self._games(settings, monitor_dir=folder, n_cpus=self.options.n_cpus)
            if (log := self.options.tensorboard_log) is not None:
                log.mkdir(parents=True, exist_ok=True)
            self.model = settings.make_model(
                self.games,
                seed,
                device=self.options.device,
                tensorboard_log=None if log is None else str(log),
                verbose=self.options.verbose,
            )
            if (initial := self.options.initial_model) is not None:
                load_parameters(self.model, initial)
                load_normalization(self.games, initial)
            self.clock = TrainingClock(settings.game_steps / (2 * CURVE_POINTS))
            self.evaluation: SeededEvalCallback | None = None
            self.callbacks = [self.clock, *callbacks, *self._make_callbacks()]
            self._open = self._open.pop_all()

    def close(self) -> None:
        """Close all games."""
        self._open.close()

    def learn(self) -> BaseAlgorithm:
        """
        Train, save, and return the model. It is also saved if Ctrl-C or SIGTERM ends training.

        Checkpoints are removed when everything else is on disk.
        """
        options, total = self.options, self.settings.total_timesteps
        arguments: dict[str, Any] = {"tb_log_name": self.settings.algo}
        if options.log_interval is not None:
            arguments["log_interval"] = options.log_interval or None
        checkpoint_freq = self._every(options.checkpoint_freq, CHECKPOINTS_PER_RUN)
        try:
            if self.folder is None or (checkpoint_freq == 0 and not any((self.folder / CHECKPOINTS).glob("*.ckpt"))):
                with settings_restored_on_error(self.model):
                    self.model.learn(total, [FiniteCallback(), GameStepsCallback(), *self.callbacks], **arguments)
            else:
                resumable_learn(
                    self.model,
                    total,
                    self.folder / CHECKPOINTS,
                    self.callbacks,
                    every_game_steps=checkpoint_freq or self.settings.game_steps,
                    keep=2,
                    again=options.resume_hint,
                    **arguments,
                )
        except (KeyboardInterrupt, SystemExit):
            self._save()
            raise
        self._save()
        if self.folder is not None:
            if (self.folder / MONITOR).is_file():  # users may have moved or compressed it
                write_curve(self.folder, self.clock.points, self.settings.n_envs)
            remove_leftovers(self.folder)
            finish_run(self.folder, **self.clock.cost())
            shutil.rmtree(self.folder / CHECKPOINTS, ignore_errors=True)
        return self.model

    def _save(self) -> None:
        if self.folder is not None:
            path = self.folder / f"{self.options.model_name}.zip"
            with atomic_file(path) as file:
                self.model.save(file)
            save_normalization(self.games, path)

    def _games(self, settings: Settings, **kwargs: Any) -> CentralizedValueWrapper:
        """Make games that are closed with the training."""
        games = settings.make_env(self.seed, **kwargs)
        self._open.callback(games.close)
        return games

    def _make_callbacks(self) -> list[BaseCallback]:
        options, settings = self.options, self.settings
        callbacks = make_callbacks(settings.wrapping)
        if options.progress:
            bar = GameStepsProgressBar()
            self._open.callback(bar.close)
            callbacks.append(bar)
        if self.folder is not None and options.save_freq > 0:
            callbacks.append(CheckpointInGameSteps(options.save_freq, self.folder, options.verbose))
        if eval_freq := self._every(options.eval_freq, EVALUATIONS_PER_RUN):
            of_evaluation, folder = options.eval_settings or settings, None if self.folder is None else str(self.folder)
            if of_evaluation.n_agents != settings.n_agents:
                raise ValueError(
                    f"evaluation needs the {settings.n_agents} agents of training, got "
                    f"n_agents={of_evaluation.n_agents}"
                )
            n_games = min(options.n_eval_envs, options.eval_episodes)
            self.evaluation = SeededEvalCallback(
                self._games(of_evaluation, evaluation=True, n_envs=n_games),
                seed=self.seed,
                settings=of_evaluation,
                callback_after_eval=options.after_evaluation,
                best_model_save_path=folder,
                log_path=folder,
                n_eval_episodes=options.eval_episodes,
                eval_freq=eval_freq,
                deterministic=options.deterministic_eval or not of_evaluation.spec.draws_actions,
                verbose=options.verbose,
            )
            callbacks.append(self.evaluation)
        inspect_freq = self._every(options.inspect_freq, INSPECTIONS_PER_RUN)
        if options.tensorboard_log is not None and inspect_freq and "normalize" not in settings.wrapping:
            callbacks.append(self._inspection(inspect_freq))
        return callbacks

    def _inspection(self, every_game_steps: int) -> InspectionCallback:
        """Make the callback that inspects the policy for TensorBoard, on games not used in training."""
        settings = self.settings
        suite = settings.environment.suite
        # Other games may not support pictures.
        render_mode = "rgb_array" if suite is not None and suite.is_drawn_from_state else None
        games = self._games(settings, evaluation=True, n_envs=INSPECTED_EPISODES, render_mode=render_mode)
        of_level = (() if suite is None else suite.level_params) or tuple(settings.env_kwargs)
        hparams = {
            "task": settings.env_id,
            "level": ", ".join(f"{name} {settings.env_kwargs[name]}" for name in of_level),
            "seed": self.seed,
            "method": settings.algo,
            "size": settings.size,
        }
        seed = evaluation_seed(self.seed)
        return InspectionCallback(games, every_game_steps, INSPECTED_EPISODES, seed=seed, hparams=hparams)

    def _every(self, frequency: int | None, times_per_run: int) -> int:
        """Return the game steps between two events; 0 for never."""
        if frequency is None:
            return max(1, self.settings.game_steps // times_per_run)
        return max(0, frequency)


def load_parameters(model: BaseAlgorithm, path: Path) -> None:
    """
    Load weights and optimiser state of a saved model, a ``.zip``. Only tensors are read: no code of the file is run.
    The optimiser's settings, such as its weight decay, stay those of ``model``.

    :param model: model with the policy and the ``policy_kwargs`` of the saved one
    :raises ValueError: if the file is damaged or does not fit
    """
    read_weights(path)  # a damaged file is named as such
    optimizer = model.policy.optimizer
    settings = [{name: value for name, value in group.items() if name != "params"} for group in optimizer.param_groups]
    try:
        load_weights(model, path)  # compares types, too
        model.set_parameters(str(path), device=model.device)
        if missing := set(settings[0]) - set(optimizer.param_groups[0]):
            raise ValueError(f"its optimizer has no {', '.join(sorted(missing))}: another algorithm's")
        for parameter, state in optimizer.state.items():
            if any(isinstance(one, th.Tensor) and one.ndim and one.shape != parameter.shape for one in state.values()):
                raise ValueError("its optimizer's averages have other shapes than the weights")
        for group, own in zip(optimizer.param_groups, settings, strict=True):
            group.update(own)
    except Exception as error:  # errors of zipfile, the unpickler and torch have no common class
        reason = " ".join(str(error).split())[:300]
        raise ValueError(
            f"the parameters in {path} do not fit {model.policy.__class__.__name__} with these settings; give the "
            f"algorithm and the policy_kwargs that it was trained with ({reason})"
        ) from error
