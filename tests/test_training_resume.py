"""``python -m sb3_saf.train --resume``: interrupted runs end like uninterrupted ones."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch as th

from sb3_saf.checkpoints.learning import CheckpointFolder
from sb3_saf.training import train as zoo_train
from sb3_saf.training.commands import check_device
from sb3_saf.training.folders import Run, python_command
from sb3_saf.training.run import SeededEvalCallback, Training
from tests.kill_harness import results_of
from tests.test_training_commands import failed

ENV = "TeamTogether-v0"
OPTIONS = (
    *("--env", ENV, "--size", "smoke", "-n", "120"),
    *("--eval-freq", "10", "--eval-episodes", "2", "--checkpoint-freq", "1", "--inspect-freq", "-1"),
)


def train(folder: Path, algo: str, *options: str) -> None:
    zoo_train.main(["--algo", algo, *OPTIONS, "-f", str(folder), "-tb", str(folder / "tb"), *options])


def struck(folder: Path, algo: str, *options: str, error: type[BaseException] = RuntimeError, at: int = 2) -> None:
    """Train until an evaluation ends the run in the middle of a rollout."""
    evaluate = SeededEvalCallback._evaluate

    def strike(self: SeededEvalCallback) -> bool:
        if self.n_evaluations == at:
            raise error
        return evaluate(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SeededEvalCallback, "_evaluate", strike)
        with pytest.raises(SystemExit if error is KeyboardInterrupt else error) as ended:
            train(folder, algo, "--seed", "3", *options)
    assert error is not KeyboardInterrupt or ended.value.args == (130,)


@pytest.mark.parametrize(
    ("algo", "strikes", "more"),
    [("saf", (1, 2), ("-params", "callback:sb3_saf.EntropySchedule")), ("qplex", (2,), ("--inspect-freq", "100000"))],
)
def test_a_run_that_was_struck_ends_as_the_undisturbed_one(
    algo: str, strikes: tuple[int, ...], more: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--resume", *more)
    train(tmp_path / "undisturbed", algo, "--seed", "3", *options)
    assert "unfinished: a new one begins" in capsys.readouterr().out
    for evaluation in strikes:
        struck(tmp_path / "run", algo, *options, at=evaluation)
    (tmp_path / "run" / algo / f"{ENV}_1" / ".writing-0-best_model.zip").touch()  # as left by SIGKILL
    train(tmp_path / "run", algo, *options, "--checkpoint-freq", "-1")  # writes no more; the seed is the run's
    assert f"Going on with {tmp_path}" in capsys.readouterr().out
    one, other = (tmp_path / name / algo / f"{ENV}_1" for name in ("undisturbed", "run"))
    assert results_of(one) == results_of(other) != {}
    assert {path.name for path in one.iterdir()} == {path.name for path in other.iterdir()} >= {"finished.json"}
    assert not (other / "checkpoints").exists()
    assert [path.name for path in (tmp_path / "run" / algo).iterdir()] == [f"{ENV}_1"]
    assert [path.name for path in (tmp_path / "run" / "tb" / ENV).iterdir()] == [f"{algo}_1"]


def test_the_time_of_evaluations_is_that_of_all_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    struck(tmp_path, "saf", "--resume")
    load = SeededEvalCallback.load_checkpoint_state

    def load_more(callback: SeededEvalCallback, state: dict[str, Any]) -> None:
        assert state["seconds"] > 0
        load(callback, {**state, "seconds": state["seconds"] + 1e6})

    monkeypatch.setattr(SeededEvalCallback, "load_checkpoint_state", load_more)
    train(tmp_path, "saf", "--resume")
    assert re.search(r"^Evaluation took \d{5,}%", capsys.readouterr().out, re.MULTILINE)


def test_ctrl_c_leaves_model_and_checkpoint_and_says_how_to_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    struck(tmp_path, "saf", error=KeyboardInterrupt)
    run = tmp_path / "saf" / f"{ENV}_1"
    assert (run / f"{ENV}.zip").is_file()
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("Stopped."))
    command = line.partition("go on from there with: ")[2]
    assert command.startswith(python_command("sb3_saf.train"))
    zoo_train.main(shlex.split(command)[3:])
    train(tmp_path / "undisturbed", "saf", "--seed", "3")
    assert results_of(run) == results_of(tmp_path / "undisturbed" / "saf" / f"{ENV}_1") != {}


def test_other_settings_begin_another_run(tmp_path: Path) -> None:
    struck(tmp_path, "saf", "-n", "80")
    for number, options in enumerate((["--seed", "4"], ["--env-kwargs", "coordination:2"], ["--eval-freq", "50"]), 2):
        train(tmp_path, "saf", "--resume", "-n", "80", *options)
        run = tmp_path / "saf" / f"{ENV}_{number}"
        assert (run / f"{ENV}.zip").is_file()
    assert Run(run).seed is not None


def test_another_initial_model_and_a_folder_in_use_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in ("1", "2"):
        train(tmp_path / "models", "saf", "--seed", seed, "-n", "40")
    a, b = (str(tmp_path / "models" / "saf" / f"{ENV}_{number}" / f"{ENV}.zip") for number in (1, 2))
    struck(tmp_path, "saf", "-i", a)
    for other in (["-i", b], []):
        given = ["--algo", "saf", *OPTIONS, "-f", str(tmp_path), "-tb", str(tmp_path / "tb"), "--resume", *other]
        assert f"began with the model {a}, got " in failed(given, capsys)
    run = tmp_path / "saf" / f"{ENV}_1"
    used = CheckpointFolder(run / "checkpoints")
    used.acquire()
    assert "another run writes checkpoints" in failed([*given, "-i", a], capsys)
    used.release()
    copy = shutil.copy(a, tmp_path / "copy.zip")
    train(tmp_path, "saf", "--seed", "3", "-i", str(copy), "--resume")
    assert "Going on with" in capsys.readouterr().out
    with pytest.raises(ValueError, match="has a finished run"):
        Training(Run(run).settings, 0, run)


def test_nan_stops_the_command_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = failed([*OPTIONS, "-f", str(tmp_path), "--hyperparams", "learning_rate:1.0e30"], capsys)
    # Where the difference first shows depends on the seed.
    assert "must be finite, got nan at game step" in line or "invalid values" in line
    assert "the last good checkpoint is" in line and "checkpoint-0" in line


def test_resume_is_for_training(capsys: pytest.CaptureFixture[str]) -> None:
    assert "--resume is for training with settings" in failed(["--resume", "-optimize"], capsys)


@pytest.mark.skipif(th.cuda.is_available(), reason="there is a GPU")
def test_a_device_that_is_not_there_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    for device in ("cuda", "cuda:1", "meat"):
        line = failed(["--device", device], capsys)
        assert f"got '{device}'" in line and "sees no CUDA devices" in line
    assert check_device("cpu") == "cpu"
