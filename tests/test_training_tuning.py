"""``-optimize``: search space, finite values, one storage for several processes, and retraining of trials."""

from __future__ import annotations

import math
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import optuna
import pytest
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from sb3_saf import LightEncoder
from sb3_saf.training import train as zoo_train
from sb3_saf.training.folders import Run
from sb3_saf.training.run import RunOptions, SeededEvalCallback
from sb3_saf.training.settings import ALGOS, load_settings
from sb3_saf.training.tune import Tuning, run_trial, sample_overrides, to_overrides
from tests.test_training_commands import failed

ENV = "TeamTogether-v0"
SMOKE = ("--algo", "saf", "--env", ENV, "--size", "smoke", "--seed", "3", "--eval-episodes", "4")


def tune(folder: Path, *options: str) -> optuna.Study:
    """Tune in a journal file; by default one trial of 80 game steps."""
    zoo_train.main(given(folder, *options))
    return load_study(str(folder / "study.log"))


def given(folder: Path, *options: str) -> list[str]:
    study = ("-optimize", "--storage", str(folder / "study.log"), "--study-name", "s", "-f", str(folder / "logs"))
    return [*SMOKE, *study, "--n-trials", "1", "-n", "80", *options]


def load_study(storage: str) -> optuna.Study:
    if storage.endswith(".log"):
        journal = JournalFileBackend(storage)
        return optuna.load_study(study_name="s", storage=optuna.storages.JournalStorage(journal))
    return optuna.load_study(study_name="s", storage=storage)


@pytest.fixture(scope="module")
def tuned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a study with one trial, read-only."""
    folder = tmp_path_factory.mktemp("tuned")
    tune(folder)
    return folder


def test_two_processes_share_a_storage_and_the_best_trial_trains_again(tmp_path: Path) -> None:
    storage = f"sqlite:///{tmp_path}/study.db"
    words = given(tmp_path, "--storage", storage, "--n-evaluations", "1", "-params", "n_epochs:1")
    optuna.storages.RDBStorage(f"sqlite:///{tmp_path}/other.db")  # whose modules the processes inherit
    with ProcessPoolExecutor(2, multiprocessing.get_context("fork")) as pool:
        for worker in [pool.submit(zoo_train.main, words) for _ in range(2)]:
            worker.result()
    study = load_study(storage)
    complete = study.get_trials(states=[TrialState.COMPLETE])
    assert len(study.trials) == 2
    assert complete and all(trial.value is not None and math.isfinite(trial.value) for trial in complete)
    assert len({trial.params["learning_rate"] for trial in study.trials}) == 2  # equal seeds, different proposals

    trial_options = ["--storage", storage, "--study-name", "s", "--trial-id", str(study.best_trial.number)]
    zoo_train.main([*SMOKE, *trial_options, "-n", "80", "-f", str(tmp_path / "again")])
    saved = Run(tmp_path / "again" / "saf" / f"{ENV}_1").description["settings"]
    expected = load_settings("saf", ENV, "smoke", overrides={**to_overrides(study.best_params), "game_steps": 80})
    assert saved == expected.as_dict()


def test_trials_are_evaluated_n_times_in_game_steps(tmp_path: Path) -> None:
    study = tune(tmp_path, "--n-evaluations", "4", "--pruner", "none", "-n", "160")
    (trial,) = study.trials
    assert trial.state is TrialState.COMPLETE and trial.user_attrs == {"seed": 3}
    assert sorted(trial.intermediate_values) == [1, 2, 3, 4]
    assert trial.value == trial.intermediate_values[4]
    assert not list((tmp_path / "logs").glob(f"saf/{ENV}_*"))  # no run folder is left
    assert list((tmp_path / "logs").glob("saf/report_*.csv"))


@pytest.mark.parametrize("failure", ["unevaluated", "diverged"])
def test_a_failed_trial_is_never_complete(
    failure: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def evaluate(self: SeededEvalCallback) -> bool:
        if failure == "diverged":
            raise ValueError("NaN in the logits")
        return True  # and last_mean_reward stays -inf

    monkeypatch.setattr(SeededEvalCallback, "_evaluate", evaluate)
    line = failed(given(tmp_path), capsys)
    why = "; the last error: NaN in the logits" if failure == "diverged" else ""
    assert f"none of 1 trials was completed{why}" in line
    (trial,) = load_study(str(tmp_path / "study.log")).trials
    assert (trial.state, trial.value) == (TrialState.PRUNED, None)


def test_the_pruner_ends_a_trial() -> None:
    """At its first evaluation, whose return is what the trial has."""
    study = optuna.create_study(pruner=optuna.pruners.ThresholdPruner(lower=1e9))
    settings = load_settings("mappo", ENV, "smoke", overrides={"game_steps": 160})
    tuning = Tuning(seed=0, options=RunOptions(eval_episodes=2), n_evaluations=2)
    study.optimize(lambda trial: run_trial(trial, settings, tuning), n_trials=1)
    (trial,) = study.trials
    assert trial.state is TrialState.PRUNED and list(trial.intermediate_values) == [1]
    assert trial.value == trial.intermediate_values[1] >= 0


def test_trial_zero_is_a_trial_and_what_the_user_gives_wins_over_it(tuned: Path, tmp_path: Path) -> None:
    storage = str(tuned / "study.log")
    sampled = to_overrides(load_study(storage).trials[0].params)
    study = ("--storage", storage, "--study-name", "s")
    options = (*study, "-n", "40", "--eval-freq", "-1", "-f", str(tmp_path / "logs"))
    for number, trial in enumerate(("0", "best"), start=1):
        zoo_train.main([*SMOKE, *options, "--trial-id", trial])
        saved = Run(tmp_path / "logs" / "saf" / f"{ENV}_{number}").settings.plain
        assert saved["learning_rate"] == sampled["learning_rate"]
    zoo_train.main([*SMOKE, *options, "--trial-id", "0", "-params", "learning_rate:0.5"])
    assert Run(tmp_path / "logs" / "saf" / f"{ENV}_3").settings.plain["learning_rate"] == 0.5


def test_ctrl_c_reports_the_trials_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    evaluate, begun = SeededEvalCallback._evaluate, []

    def interrupted(callback: SeededEvalCallback) -> bool:
        begun.append(callback)
        if len(begun) == 2:
            raise KeyboardInterrupt
        return evaluate(callback)

    monkeypatch.setattr(SeededEvalCallback, "_evaluate", interrupted)
    with pytest.raises(SystemExit, match="130"):
        tune(tmp_path, "--n-trials", "3", "--n-evaluations", "1")
    assert "Best: trial 0" in capsys.readouterr().out and len(load_study(str(tmp_path / "study.log")).trials) == 2
    assert list((tmp_path / "logs").glob("saf/report_*.csv"))
    trial = ["--storage", str(tmp_path / "study.log"), "--study-name", "s", "--trial-id", "1", "-f", str(tmp_path)]
    assert "trial 1 of 's' failed or is not finished" in failed([*SMOKE, *trial], capsys)


def test_unknown_studies_and_trials_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    storage = str(tmp_path / "study.log")
    optuna.create_study(study_name="s", storage=optuna.storages.JournalStorage(JournalFileBackend(storage)))
    for study, trial, words in (("other", "0", "there is no study 'other'"), ("s", "7", "has no trial 7")):
        options = ["--storage", storage, "--study-name", study, "--trial-id", trial, "-f", str(tmp_path)]
        assert words in failed([*SMOKE, *options], capsys)


def test_a_study_is_of_one_goal(tuned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "model.zip").touch()
    for other, words in (
        (("--algo", "mappo"), "algo was 'saf', now 'mappo'"),
        (("--env-kwargs", "coordination:2"), "coordination was 1, now 2"),
        (("--eval-env-kwargs", "coordination:2"), "eval_env_kwargs"),
        (("--eval-episodes", "2"), "eval_episodes was 4, now 2"),
        (("--n-evaluations", "3"), "n_evaluations was 5, now 3"),
        (("-params", "gamma:0.5"), "gamma"),
        (("-i", str(tmp_path / "model.zip")), "initial_model"),
    ):
        line = failed(given(tuned, *other), capsys)
        assert "the trials of the study 's' cannot be compared with these" in line and words in line


def _sampled(algo: str, fixed: dict[str, Any] | None = None) -> dict[str, Any]:
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    return sample_overrides(study.ask(), ALGOS[algo], fixed or {})


def test_trials_of_a_model_keep_its_shapes(tmp_path: Path) -> None:
    zoo_train.main([*SMOKE, "-n", "40", "--eval-freq", "-1", "-f", str(tmp_path / "first")])
    study = tune(tmp_path, "-i", str(tmp_path / "first" / "saf" / f"{ENV}_1" / f"{ENV}.zip"))
    (trial,) = study.trials
    assert trial.state is TrialState.COMPLETE and "n_policies" not in trial.params


@pytest.mark.parametrize("algo", ALGOS)
def test_what_is_sampled_joins_the_other_settings(algo: str) -> None:
    settings = load_settings(algo, ENV, "small", overrides=_sampled(algo))
    policy_kwargs = settings.hyperparams["policy_kwargs"]
    assert policy_kwargs["features_extractor_class"] is LightEncoder
    assert policy_kwargs.items() >= dict(ALGOS[algo].policy_kwargs).items()
    assert settings.hyperparams["learning_rate"] != 7e-4


@pytest.mark.parametrize("algo", ALGOS)
def test_sizes_of_parts_that_a_method_lacks_are_not_searched(algo: str) -> None:
    """A pool would make VDN another method, and PQN refuses one."""
    sampled = _sampled(algo).get("policy_kwargs", {})
    is_saf = algo.startswith("saf")
    assert ("n_policies" in sampled) == ((is_saf or "pool" in algo) and "no-pool" not in algo)
    assert ("n_slots" in sampled) == (is_saf and "no-ks" not in algo)


def test_what_is_given_is_not_searched() -> None:
    sampled = _sampled("saf", {"learning_rate": 1e-3, "batch_size": 100, "policy_kwargs": {"n_policies": 2}})
    assert {"learning_rate", "n_minibatches"}.isdisjoint(sampled)
    assert list(sampled["policy_kwargs"]) == ["n_slots"]
    assert "policy_kwargs" not in _sampled("mappo")
    assert list(_sampled("saf-no-ks")["policy_kwargs"]) == ["n_policies"]


def test_a_learning_rate_is_constant_or_decreases_to_zero() -> None:
    assert to_overrides({"learning_rate": 1e-3, "lr_schedule": "linear"}) == {"learning_rate": "lin_0.001"}
    assert to_overrides({"learning_rate": 1e-3, "lr_schedule": "constant"}) == {"learning_rate": 1e-3}
    assert to_overrides({"learning_rate": 1e-3}) == {"learning_rate": 1e-3}  # of an older study
    with pytest.raises(ValueError, match="unknown parameter of a trial 'env_wrapper'"):
        to_overrides({"learning_rate": 1e-3, "env_wrapper": "os.system"})
