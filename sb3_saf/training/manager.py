"""
RL-Zoo3's ``ExperimentManager`` for teams.

What it repairs, each where it sits: parameters of the level reach evaluation and cannot differ unnoticed; evaluation,
checkpoints and trials count game steps; evaluation games have seeds of their own; settings are objects before RL-Zoo3
sees them, so that it evaluates no strings; policy arguments that are tuned join the others; no trial completes without
a finite value; runs are called by their algorithm in TensorBoard.
"""

from __future__ import annotations

import argparse
import math
import shutil
from functools import cached_property
from pathlib import Path
from typing import Any

import optuna
import rl_zoo3.exp_manager
import yaml
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS as ZOO_ALGOS
from rl_zoo3.utils import get_latest_run_id
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import configure_logger
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.inspection.callback import InspectionCallback
from sb3_saf.training.algorithms import ALGOS
from sb3_saf.training.callbacks import (
    CheckpointInGameSteps,
    GameStepsProgressBar,
    SeededEvalCallback,
    TrialCallback,
)
from sb3_saf.training.commands import CommandError, replaced, user_errors
from sb3_saf.training.inspection import inspection
from sb3_saf.training.request import Request
from sb3_saf.training.resuming import checkpoint_interval, forget_checkpoints, learn_with_checkpoints
from sb3_saf.training.sampling import sample_overrides, to_overrides
from sb3_saf.training.settings import Settings
from sb3_saf.training.storage import open_storage
from sb3_saf.training.versions import software_versions


class TeamExperimentManager(ExperimentManager):
    """
    One run, or one study, of the zoo.

    :param args: RL-Zoo3's arguments
    :param algo: name in ``ALGOS``
    :param env_id: the environment
    :param log_folder: where the folders of algorithms are
    :param rest: RL-Zoo3's further arguments
    :param request: what the user asked for
    :param kwargs: RL-Zoo3's further arguments
    """

    settings: Settings

    def __init__(
        self,
        args: argparse.Namespace,
        algo: str,
        env_id: str,
        log_folder: str,
        *rest: Any,
        request: Request,
        **kwargs: Any,
    ):
        super().__init__(args, algo, env_id, log_folder, *rest, **kwargs)
        self.request = request
        self.deterministic_eval = request.deterministic_eval or not ALGOS[algo].draws_actions
        # RL-Zoo3 would divide these by the number of games.
        self.eval_freq = self.save_freq = -1
        if request.resume is not None:
            self.save_path = str(request.resume)
        self._envs: list[VecEnv] = []
        self._has_folder = False
        HYPERPARAMS_SAMPLER[algo] = self._sample
        HYPERPARAMS_CONVERTER[algo] = to_overrides  # type: ignore[assignment]  # their dict is typed by its first entry

    # --- settings ---------------------------------------------------------------------------------------------------

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        Settings in place of RL-Zoo3's YAML.

        :return: arguments as objects for RL-Zoo3, and plain data for ``config.yml``
        """
        self.settings = self.request.settings(self._trial_overrides())
        self._eval_settings = self.request.settings(self._trial_overrides(), evaluation=True)
        if self._eval_settings.n_agents != self.settings.n_agents:
            raise ValueError(
                f"evaluation needs the {self.settings.n_agents} agents of training, got "
                f"n_agents={self._eval_settings.n_agents}; leave n_agents out of --eval-env-kwargs"
            )
        print(yaml.safe_dump(self.settings.as_dict(), sort_keys=False), end="")
        return self._arguments(self.settings), {**self.settings.as_dict(), "seed": self.seed}

    @staticmethod
    def _arguments(settings: Settings) -> dict[str, Any]:
        run = {"n_envs": settings.n_envs, "n_timesteps": settings.total_timesteps}
        return {"policy": settings.spec.policy, **settings.hyperparams, **run}

    @cached_property
    def _trial_parameters(self) -> dict[str, Any]:
        assert self.storage is not None and self.study_name is not None
        number = None if self.request.trial == "best" else self.request.trial
        assert not isinstance(number, str)
        try:
            open_storage(self.storage, must_exist=True)
            return dict(self.load_trial(self.storage, self.study_name, number))
        except IndexError:
            raise CommandError(
                f"the study {self.study_name!r} has no trial {number}; take a smaller --trial-id"
            ) from None
        except KeyError:
            raise CommandError(
                f"there is no study {self.study_name!r} in {self.storage}, or none of its trials is complete; give the "
                "--study-name and --storage of the tuning"
            ) from None

    def _trial_overrides(self) -> dict[str, Any]:
        return {} if self.request.trial is None else self._trial_parameters

    @staticmethod
    def _preprocess_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
        """Schedules are objects already."""
        return hyperparams

    # --- one run ----------------------------------------------------------------------------------------------------

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """Make folder, environments, callbacks and model; if that fails, nothing is left."""
        try:
            # SB3's checks of what it is given, and folders that cannot be written
            with user_errors(AssertionError, TypeError, OSError):
                prepared = super().setup_experiment()
                if prepared is not None and self.request.resume is None:  # which brings its logs along
                    model, _ = prepared
                    # SB3 would call every run PPO.
                    model.set_logger(configure_logger(self.verbose, self.tensorboard_log, self.algo, True))
        except CommandError:
            self._close_envs()
            if self._has_folder:
                shutil.rmtree(self.save_path)  # it would pass for the latest run
            raise
        return prepared

    def learn(self, model: BaseAlgorithm) -> None:
        """
        Train.

        :param model: from :meth:`setup_experiment`
        """
        try:
            if checkpoint_interval(self.request):
                self._learn_with_checkpoints(model)
            else:
                super().learn(model)
        finally:
            self._close_envs()

    def _learn_with_checkpoints(self, model: BaseAlgorithm) -> None:
        """As RL-Zoo3 does; a run that is interrupted leaves its model, too, and a checkpoint to go on from."""
        # -1 is for the algorithm's own, anything below for none.
        log_interval = {} if self.log_interval == -1 else {"log_interval": max(self.log_interval, 0) or None}
        folder = Path(self.save_path)
        try:
            learn_with_checkpoints(model, self.n_timesteps, folder, self.callbacks, self.request, **log_interval)
        except (KeyboardInterrupt, SystemExit):
            super().save_trained_model(model)
            raise
        finally:
            for callback in self.callbacks:
                if isinstance(callback, GameStepsProgressBar):
                    callback.close()

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """
        Save the model of a finished run, which needs its checkpoints no longer.

        :param model: the model
        """
        super().save_trained_model(model)
        forget_checkpoints(Path(self.save_path))

    def _close_envs(self) -> None:
        """Close those of training again, which does no harm, and those of evaluation, which RL-Zoo3 leaves open."""
        while self._envs:
            self._envs.pop().close()

    def create_log_folder(self) -> None:
        """Take a folder of our own; tuning leaves none, which would pass for the latest run."""
        if self.optimize_hyperparameters:
            return
        while self.request.resume is None:
            try:
                Path(self.save_path).mkdir(parents=True)
                self._has_folder = True
                break
            except FileExistsError:  # another process was faster
                number = get_latest_run_id(self.log_path, self.env_name) + 1
                self.save_path = str(Path(self.log_path) / f"{self.env_name}_{number}")
        self.params_path = f"{self.save_path}/{self.env_name}"
        super().create_log_folder()

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """
        Make games.

        :param n_envs: how many
        :param eval_env: for evaluation, with its level and seeds of its own
        :param no_log: without ``monitor.csv``
        """
        settings = self._eval_settings if eval_env else self.settings
        quiet = eval_env or no_log or self.optimize_hyperparameters
        env = settings.make_env(
            self.seed, evaluation=eval_env, monitor_dir=None if quiet else self.save_path, n_envs=n_envs
        )
        if not self.optimize_hyperparameters:  # a trial closes its own
            self._envs.append(env)
        return env

    def create_callbacks(self) -> None:
        """Add the progress bar, checkpoints, evaluation, and a look into the policy."""
        if self.optimize_hyperparameters:
            return  # trials have callbacks of their own
        if self.show_progress:
            self.callbacks.append(GameStepsProgressBar())
        if self.request.save_freq > 0:
            self.callbacks.append(CheckpointInGameSteps(self.request.save_freq, self.save_path, self.verbose))
        eval_freq = self.request.eval_freq
        if eval_freq is None:
            eval_freq = max(1, self.settings.game_steps // 20)
        if eval_freq > 0:
            self.callbacks.append(self._evaluation(eval_freq))
        inspect_freq = self.request.inspect_freq
        if self.tensorboard_log is not None and (inspect_freq is None or inspect_freq > 0):
            self.callbacks.append(self._inspection(inspect_freq))

    def _evaluation(self, eval_freq: int) -> SeededEvalCallback:
        return SeededEvalCallback(
            self.create_envs(self.n_eval_envs, eval_env=True),
            seed=self.seed,
            best_model_save_path=self.save_path,
            log_path=self.save_path,
            n_eval_episodes=self.n_eval_episodes,
            eval_freq=eval_freq,
            deterministic=self.deterministic_eval,
            verbose=self.verbose,
        )

    def _inspection(self, inspect_freq: int | None) -> InspectionCallback:
        callback = inspection(self.settings, self.seed, inspect_freq)
        self._envs.append(callback.eval_env)
        return callback

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        """Keep what was used and asked for; RL-Zoo3's ``args.yml`` and command would be those it was called with."""
        if self.request.resume is not None:
            return  # it is there
        super()._save_config(saved_hyperparams)
        folder = Path(self.params_path)
        for name, content in {"args.yml": dict(self.request.options), "versions.yml": software_versions()}.items():
            (folder / name).write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
        (folder / "command.txt").write_text(self.request.command + "\n", encoding="utf-8")

    # --- tuning -----------------------------------------------------------------------------------------------------

    def hyperparameters_optimization(self) -> None:
        """Run trials; several processes may share one storage."""
        if self.storage is not None:
            with user_errors():
                open_storage(self.storage)
        # The ValueError is Optuna's, of a study without a complete trial.
        with replaced(rl_zoo3.exp_manager, "TrialEvalCallback", self._trial_callback), user_errors():
            super().hyperparameters_optimization()

    def _create_sampler(self, sampler_method: str) -> optuna.samplers.BaseSampler:
        sampler = super()._create_sampler(sampler_method)
        if self.storage is not None:
            sampler.reseed_rng()  # workers with one seed would all propose the same
        return sampler

    def _sample(self, trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: object) -> dict[str, Any]:
        """What RL-Zoo3 lays over its arguments: complete, so nothing of ``policy_kwargs`` is lost."""
        overrides = sample_overrides(trial, ALGOS[self.algo], self.request.overrides)
        return dict(self.request.settings(overrides).hyperparams)

    def _trial_callback(self, eval_env: VecEnv, trial: optuna.Trial, **kwargs: Any) -> TrialCallback:
        kwargs["eval_freq"] = max(1, self.settings.game_steps // self.n_evaluations)
        return TrialCallback(eval_env, trial=trial, seed=self.seed, verbose=0, **kwargs)

    def objective(self, trial: optuna.Trial) -> float:
        """
        Train and evaluate a trial.

        :raises optuna.TrialPruned: also if there is no finite value, which would pass for a result
        """
        value = float(super().objective(trial))
        if not math.isfinite(value):
            raise optuna.TrialPruned(f"the trial ended without a finite team return: {value}")
        return value


def install_algorithm(algo: str) -> None:
    """
    Let RL-Zoo3 know an algorithm.

    :param algo: name in ``ALGOS``
    """
    ZOO_ALGOS[algo] = ALGOS[algo].algorithm
