"""Tuning with Optuna: search spaces, trials, and studies shared by several processes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Final

import optuna
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState
from stable_baselines3.common.callbacks import BaseCallback

from sb3_saf.policies.parts import AlgorithmSpec
from sb3_saf.teams.checks import MAX_SEED, unknown_name
from sb3_saf.teams.files import differences
from sb3_saf.training.run import RunOptions, SeededEvalCallback, Training
from sb3_saf.training.settings import Settings, algorithm_arguments

_SQLITE: Final = "sqlite:///"
_JOURNAL: Final = ".log"
_ATTEMPTS: Final = 10
#: Attribute of a trial: what ended it.
_ERROR: Final = "error"

# --- search spaces ----------------------------------------------------------------------------------------------------

_Suggest = Callable[[optuna.Trial, str], Any]


def _log(low: float, high: float) -> _Suggest:
    return lambda trial, name: trial.suggest_float(name, low, high, log=True)


def _choice(*values: Any) -> _Suggest:
    return lambda trial, name: trial.suggest_categorical(name, values)


def _count(low: int, high: int) -> _Suggest:
    return lambda trial, name: trial.suggest_int(name, low, high)


#: Arguments of algorithms; those that an algorithm lacks are skipped.
_SEARCH: Final[dict[str, _Suggest]] = {
    "learning_rate": _log(1e-4, 3e-3),
    "gamma": _choice(0.8, 0.9, 0.95, 0.98, 0.99, 0.995),
    "gae_lambda": _choice(0.9, 0.95, 0.98, 1.0),
    "ent_coef": _log(1e-4, 0.05),
    "vf_coef": _log(0.1, 1.0),
    "clip_range": _choice(0.1, 0.2, 0.3),
    "max_grad_norm": _log(0.5, 10.0),
    "n_epochs": _count(2, 10),
    "n_minibatches": _choice(1, 2, 4, 8),
}
#: Whether the learning rate decreases to 0, as RL-Zoo3's ``lin_``.
_LR_SCHEDULE: Final = "lr_schedule"
_LINEAR: Final = "linear"
#: Arguments of policies.
_POLICY_SEARCH: Final[dict[str, _Suggest]] = {
    "n_policies": _count(2, 8),
    "n_slots": _count(2, 8),
}


def sample_overrides(
    trial: optuna.Trial, spec: AlgorithmSpec, fixed: Mapping[str, Any], *, with_shapes: bool = True
) -> dict[str, Any]:
    """
    Sample settings of a trial, as overrides for ``load_settings``, except those that the user has ``fixed``.

    :param with_shapes: whether weights may have other shapes; False if the trials begin with those of a model
    """
    known = set(algorithm_arguments(spec.algorithm))
    if {"n_steps", "batch_size"} <= known and "batch_size" not in fixed:
        known.add("n_minibatches")
    for name, suggest in _SEARCH.items():
        if name in known and name not in fixed:
            suggest(trial, name)
    if "learning_rate" in trial.params:
        trial.suggest_categorical(_LR_SCHEDULE, ("constant", _LINEAR))
    settled = {**spec.policy_kwargs, **fixed.get("policy_kwargs", {})}
    parts = getattr(spec.policy_class, "parts_class", None)
    method = {**({field.name: field.default for field in fields(parts)} if is_dataclass(parts) else {}), **settled}
    searched = {"n_policies": method.get("n_policies", 1) > 1, "n_slots": method.get("knowledge_source", False)}
    for name, suggest in _POLICY_SEARCH.items():
        if with_shapes and searched[name] and name not in settled:  # of the parts that the method has
            suggest(trial, name)
    return to_overrides(trial.params)


def to_overrides(params: Mapping[str, Any]) -> dict[str, Any]:
    """Convert the parameters of a trial to overrides for ``load_settings``."""
    searched = {*_SEARCH, *_POLICY_SEARCH, _LR_SCHEDULE}
    for name in params.keys() - searched:  # of a study of others
        raise unknown_name("parameter of a trial", name, searched)
    of_policy = {name: value for name, value in params.items() if name in _POLICY_SEARCH}
    others = {name: value for name, value in params.items() if name not in _POLICY_SEARCH}
    if others.pop(_LR_SCHEDULE, None) == _LINEAR:
        others["learning_rate"] = f"lin_{others['learning_rate']}"
    return {**others, "policy_kwargs": of_policy} if of_policy else others


# --- trials -----------------------------------------------------------------------------------------------------------


class TrialReport(BaseCallback):
    """Report every evaluation to a trial, and end the trial if the pruner stops it."""

    def __init__(self, trial: optuna.Trial) -> None:
        super().__init__()
        self.trial = trial

    def _on_step(self) -> bool:
        evaluation = self.parent
        assert isinstance(evaluation, SeededEvalCallback)
        self.trial.report(float(evaluation.last_mean_reward), evaluation.n_evaluations)
        if self.trial.should_prune():
            raise optuna.TrialPruned(f"the trial ended with a team return of {evaluation.last_mean_reward}")
        return True


@dataclass(frozen=True)
class Tuning:
    """
    Options of a study, as those of the same names of ``sb3_saf.train``.

    :param seed: seed of the trials' games and models, and of the sampler unless the storage is shared
    :param options: options of the trials' runs: device, threads, evaluation
    :param storage: see :func:`open_storage`; None keeps the study in memory
    :param study_name: None for a name chosen by Optuna
    :param n_trials: trials of this process
    """

    seed: int
    options: RunOptions
    storage: str | None = None
    study_name: str | None = None
    n_trials: int = 100
    sampler: str = "tpe"
    pruner: str = "median"
    n_startup_trials: int = 10
    n_evaluations: int = 5


def open_study(tuning: Tuning, command: str, goal: Mapping[str, Any]) -> optuna.Study:
    """
    Make the study, or open that of the storage.

    :param goal: what is tuned on what, for how long; the trials of one study are of one goal
    :raises ValueError: if the study's trials are of another goal
    """
    pruner: optuna.pruners.BasePruner = optuna.pruners.NopPruner()
    if tuning.pruner == "halving":
        pruner = optuna.pruners.SuccessiveHalvingPruner(min_resource=1, reduction_factor=4, min_early_stopping_rate=0)
    elif tuning.pruner == "median":
        pruner = optuna.pruners.MedianPruner(tuning.n_startup_trials, n_warmup_steps=tuning.n_evaluations // 3)
    # Workers of one storage with equal seeds would all propose the same trials.
    seed = tuning.seed if tuning.storage is None else None
    sampler: optuna.samplers.BaseSampler = optuna.samplers.RandomSampler(seed=seed)
    if tuning.sampler == "tpe":
        sampler = optuna.samplers.TPESampler(n_startup_trials=tuning.n_startup_trials, seed=seed, multivariate=True)
    study = optuna.create_study(
        sampler=sampler,
        pruner=pruner,
        storage=None if tuning.storage is None else open_storage(tuning.storage),
        study_name=tuning.study_name,
        load_if_exists=True,
        direction="maximize",
    )
    if changed := differences(study.user_attrs.get("goal", goal), goal):
        raise ValueError(
            f"the trials of the study {tuning.study_name!r} cannot be compared with these: {changed}; choose another "
            "--study-name"
        )
    if "command" not in study.user_attrs:
        study.set_user_attr("command", command)
        study.set_user_attr("goal", goal)
    return study


def optimize(study: optuna.Study, settings_of: Callable[[optuna.Trial], Settings], tuning: Tuning) -> None:
    """Run trials; the ValueError if none of the study's was completed contains the last error."""
    study.optimize(
        lambda trial: run_trial(trial, settings_of(trial), tuning), n_trials=tuning.n_trials, gc_after_trial=True
    )
    if not is_any_complete(study):
        trials = study.get_trials(deepcopy=False)
        why = [trial.user_attrs[_ERROR] for trial in trials if _ERROR in trial.user_attrs]
        raise ValueError(f"none of {len(trials)} trials was completed{f'; the last error: {why[-1]}' if why else ''}")


def is_any_complete(study: optuna.Study) -> bool:
    """Return whether the study has a best trial."""
    return bool(study.get_trials(deepcopy=False, states=[TrialState.COMPLETE]))


def run_trial(trial: optuna.Trial, settings: Settings, tuning: Tuning) -> float:
    """
    Train and evaluate a trial with its own seed, and return the mean team return of the last evaluation.

    :raises optuna.TrialPruned: if the pruner stops it, training fails, or the value is not finite
    """
    seed = (tuning.seed + trial.number) % (MAX_SEED + 1)
    trial.set_user_attr("seed", seed)
    options = replace(
        tuning.options,
        eval_freq=max(1, settings.game_steps // tuning.n_evaluations),
        after_evaluation=TrialReport(trial),
        checkpoint_freq=0,
    )
    try:
        with closing(Training(settings, seed, options=options)) as training:
            training.learn()
    except (AssertionError, ValueError) as error:  # sampled settings may lead to NaN
        trial.set_user_attr(_ERROR, str(error))
        raise optuna.TrialPruned(str(error)) from error
    assert training.evaluation is not None
    value = float(training.evaluation.last_mean_reward)
    if not math.isfinite(value):
        raise optuna.TrialPruned(f"the trial ended with a team return of {value}")
    return value


# --- storages ---------------------------------------------------------------------------------------------------------


def open_storage(storage: str, *, must_exist: bool = False) -> BaseStorage:
    """
    Open a storage that several processes may share.

    :param storage: ``sqlite:///study.db``, a journal file ``study.log``, or a database's URL
    :param must_exist: whether a missing file is an error; otherwise it is created
    """
    if storage.startswith(_SQLITE) or storage.endswith(_JOURNAL):
        path = Path(storage.removeprefix(_SQLITE))
        if must_exist and not path.is_file():
            raise ValueError(f"there is no study file {path}; give the --storage of the tuning")
        path.parent.mkdir(parents=True, exist_ok=True)
    elif "://" not in storage:
        raise ValueError(
            f"--storage must be sqlite:///FILE.db, a journal FILE.log or a database's URL, got {storage!r}"
        )
    if storage.endswith(_JOURNAL):
        return JournalStorage(JournalFileBackend(storage))
    for attempt in range(_ATTEMPTS):
        try:
            return RDBStorage(storage)
        except Exception as error:  # SQLAlchemy's errors differ by database
            # Two processes create the tables at the same time: the next attempt finds them.
            if attempt == _ATTEMPTS - 1:
                raise ValueError(f"cannot open the storage {storage!r}: {error}") from error
            time.sleep(0.1 * (attempt + 1))
    raise AssertionError("the last attempt has raised")


def trial_overrides(storage: str, study_name: str, number: int | None) -> dict[str, Any]:
    """Read the settings of a trial, the best if ``number`` is None, as overrides for ``load_settings``."""
    opened = open_storage(storage, must_exist=True)
    try:
        study = optuna.load_study(study_name=study_name, storage=opened)
        trial = study.best_trial if number is None else study.trials[number]
    except IndexError:
        raise ValueError(f"the study {study_name!r} has no trial {number}; take a smaller --trial-id") from None
    except (KeyError, ValueError):
        raise ValueError(
            f"there is no study {study_name!r} in {storage}, or none of its trials is complete; give the "
            "--study-name and --storage of the tuning"
        ) from None
    if trial.state not in (TrialState.COMPLETE, TrialState.PRUNED):
        raise ValueError(f"trial {trial.number} of {study_name!r} failed or is not finished; take another --trial-id")
    return to_overrides(trial.params)
