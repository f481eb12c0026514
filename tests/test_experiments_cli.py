"""Listing, planning, and one-line error messages."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sb3_saf.experiments import cli
from sb3_saf.experiments.definitions import EXPERIMENTS, RunConfig, Selection, find_experiment
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.run import run
from tests.experiments_jobs import InlineEngine
from tests.test_training_commands import failed


def output(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert cli.main(words) == 0
    return capsys.readouterr().out


def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    printed = output(capsys, "list")
    for experiment in EXPERIMENTS.values():
        assert re.search(rf"^{experiment.name} +{re.escape(experiment.question)}$", printed, re.MULTILINE)
    assert "saf, mappo, ippo on TeamTogether, TeamSupport\n" in printed
    assert "trained at c=2, h=1, tested at c=1, h=1; c=2, h=1; c=3, h=1" in printed


@pytest.mark.parametrize("command", ["run", "report"])
def test_parameters(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    printed = output(capsys, command, "parameters")
    for number in ("1,233,056", "1,740,016", "2,477,296", "2,556,486"):
        assert number in printed


def test_plan_lists_cells_and_totals(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["plan", "ood-coordination", "--size", "paper", "-f", str(tmp_path / "new")]
    tested = "tested at c=1, h=1; c=2, h=1; c=3, h=1"
    assert output(capsys, *words).splitlines() == [
        "ood-coordination, size paper: robustness to unseen coordination",
        f"            TeamTogether, c=2, h=1, {tested}: saf mappo ippo, seeds 0 1 2",
        f"            TeamSupport, c=2, h=1, {tested}: saf mappo ippo, seeds 0 1 2",
        "cells       18 to train (3 methods x 2 settings x 3 seeds), 0 of them finished",
        "tests       72 to play, of 512 team episodes each, random teams included",
        "game steps  180,000,000 left of 180,000,000 (10,000,000 a cell)",
    ]
    assert not (tmp_path / "new").exists()
    # It takes what `run` takes.
    part = output(capsys, *words, "--shard", "2/3", "--workers", "2", "--device", "cpu")
    assert "cells       6 to train" in part and "60,000,000 left of 60,000,000" in part


def test_plan_counts_what_is_finished_and_names_what_is_left_out(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    config = RunConfig("smoke", {"env_kwargs": {"n_agents": 3}}, 16, 200, 2)
    run(find_experiment("joint"), Selection((0,), ("ippo",)), config, Results(tmp_path), InlineEngine())
    capsys.readouterr()
    words = ["plan", "joint", "-f", str(tmp_path), "--env-kwargs", "n_agents:3", "--methods", "ippo", "--seeds", "0"]
    printed = output(capsys, *words, "1")
    assert "cells       4 to train (1 methods x 2 settings x 2 seeds), 2 of them finished" in printed
    assert "game steps  800 left of 1,600 (400 a cell)" in printed
    assert re.search(
        r"rate +[\d,]+ game steps/s of one worker in the finished cells\ntime +about 0:\d\d:\d\d \(h:mm:ss\) of one",
        printed,
    )
    assert (
        "left out    TeamSupport: training at c=4, h=4 is left out: coordination must be an integer from 1" in printed
    )
    assert "game steps  0 left of 800" in output(capsys, *words)


BAD = {
    ("run", "coordinaton"): "unknown experiment 'coordinaton' (did you mean 'coordination'?)",
    ("run",): "name an experiment: ",
    ("run", "--env", "TeamSupport-v0", "a.b"): "several environments need a name before --env",
    ("run", "joint", "--env", "TeamSupport-v0"): "an experiment of your own needs a name",
    ("run", "joint", "--vary", "a:[1]"): "--vary is for a grid of your own: give its environments with --env",
    ("plan", "joint", "--methods", "safe"): "unknown method 'safe' (did you mean 'saf'?)",
    ("run", "joint", "--tasks", "TeamSuport"): "unknown environment 'TeamSuport' (did you mean 'TeamSupport'",
    ("run", "joint", "--seeds", "-1"): "seed must be a whole number from 0 to 4294967295, got -1",
    ("run", "joint", "--shard", "9/8"): "expected a part such as 3/8 (the third of eight), got '9/8'",
    ("run", "joint", "--workers", "0"): "argument --workers: must be at least 1, got 0",
    ("run", "joint", "--game-steps", "0"): "argument -n/--game-steps: must be at least 1, got 0",
    ("run", "joint", "--retries", "-1"): "argument --retries: must be at least 0, got -1",
    ("run", "joint", "--env-kwargs", "coordination:2"): "coordination is what the experiment varies; leave it out of",
    ("run", "joint", "--env-kwargs", "n_agent:2"): "unknown parameter 'n_agent' (did you mean 'n_agents'?)",
    ("run", "joint", "--hyperparams", "learning_rat:2"): "unknown setting of PPO 'learning_rat' (did you mean",
    ("report", "joint", "-f", "nowhere"): "there is no folder nowhere; name another with -f, or run it first: ",
    ("report", "joint", "-f", "empty"): "empty has no results of 'joint'; run it first: ",
    ("run", "joint", "--size", "huge"): "argument --size: invalid choice",
    ("run", "joint", "-params", "policy_kwargs:{n_slots: 4}"): "unknown argument of MAPPOPolicy 'n_slots'",
    ("fly",): "argument COMMAND: invalid choice",
    ("check",): "the following arguments are required: FOLDER/CELL",
    ("check", "empty"): "expected RESULTS/cells/TASK-LEVEL/METHOD/seed-N",
}


@pytest.mark.parametrize(("words", "message"), BAD.items(), ids=lambda value: " ".join(value)[:40])
def test_one_line_errors(
    words: tuple[str, ...],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    assert message in failed(words, capsys, cli.main)
    assert [*Path().iterdir()] == [Path("empty")]  # nothing that would refuse the corrected command
