"""Listing, planning, and one-line errors with a remedy."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sb3_saf.experiments import cli
from sb3_saf.experiments.cells import Choice, Protocol, Shard
from sb3_saf.experiments.definitions import EXPERIMENTS, find_experiment
from sb3_saf.experiments.measure import Burst, full_rate
from sb3_saf.experiments.plan import _duration
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.run import Machine, run
from sb3_saf.training.algorithms import ALGOS
from tests.experiments_jobs import InlineEngine


def output(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert cli.main(words) == 0
    return capsys.readouterr().out


def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    printed = output(capsys, "list")
    for experiment in EXPERIMENTS.values():
        assert re.search(rf"^{experiment.name} +{re.escape(experiment.question)}$", printed, re.MULTILINE)
    assert "trained at c=2, h=1, tested at c=1, h=1; c=2, h=1; c=3, h=1" in printed


@pytest.mark.parametrize("command", ["run", "report"])
def test_parameters(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    printed = output(capsys, command, "parameters")
    for number in ("1,233,056", "1,740,016", "2,477,296", "2,556,486"):
        assert number in printed


def test_plan_with_a_given_rate(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["plan", "coordination", "--size", "paper", "--rate", "1000", "--workers", "4", "-f", str(tmp_path / "new")]
    lines = output(capsys, *words).splitlines()
    assert lines == [
        "coordination, size paper: how hard is coordination?",
        "cells       81 to train (3 methods x 9 settings x 3 seeds); 0 of them are finished",
        "tests       108 to play, of 32 team episodes each, random teams included",
        "game steps  810,000,000 (10,000,000 a cell)",
        "rate        1,000 game steps/s for each worker, as given",
        "time        about 2 d 8 h with 4 workers of this speed, each with cores of its own (2 h 46 min a cell, "
        "9 d 9 h in all)",
    ]
    assert not (tmp_path / "new").exists()


def test_plan_counts_what_is_finished_and_names_what_is_left_out(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    protocol = Protocol("smoke", {"env_kwargs": {"n_agents": 3}})
    run(
        find_experiment("joint"),
        Choice((0,), ("ippo",)),
        protocol,
        Results(tmp_path),
        InlineEngine(),
        Machine(),
        Shard(),
    )
    capsys.readouterr()
    words = ["plan", "joint", "-f", str(tmp_path), "--env-kwargs", "n_agents:3", "--rate", "10"]
    printed = output(capsys, *words, "--methods", "ippo")
    assert "cells       4 to train (1 methods x 2 settings x 2 seeds); 2 of them are finished" in printed
    assert "game steps  800 (400 a cell)" in printed
    assert (
        "left out    TeamSupport: training at c=4, h=4 is left out: coordination must be an integer from 1" in printed
    )
    assert "nothing is left to train" in output(capsys, *words, "--methods", "ippo", "--seeds", "0")


def test_rates_are_extrapolated_to_all_games() -> None:
    """A rollout that costs 2 s and a tenth of a second more for every game."""
    few, many = (Burst(n, 50 * n, 2 + 0.1 * n, "cpu") for n in (2, 8))
    assert full_rate(few, many, 64) == pytest.approx(50 * 64 / (2 + 0.1 * 64))
    assert full_rate(few, many, 8) == pytest.approx(50 * 8 / 2.8)
    assert full_rate(few._replace(seconds=3.0), many, 16) == pytest.approx(50 * 16 / 2.8)  # noise, not negative costs


def test_plan_measures(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["plan", "joint", "--size", "smoke", "--methods", "ippo", "--workers", "1", "-f", str(tmp_path)]
    printed = output(capsys, *words)
    rate, steps, games = re.findall(
        r"measured +ippo: ([\d,]+) game steps/s \((\d+) game steps of (\d+) games at once in [\d.]+ s on cpu\)", printed
    )[0]
    assert int(rate.replace(",", "")) > 0
    assert int(steps) == 10 * int(games)
    memory = re.findall(r"memory +about ([\d.]+) GB, ([\d.]+) GB for each of 1 workers", printed)[0]
    assert 0.1 < float(memory[0]) == float(memory[1]) < 5


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.2, "1 s"), (59.6, "1 min"), (3_661, "1 h 1 min"), (3_605, "1 h"), (90_000, "1 d 1 h"), (86_460, "1 d")],
)
def test_durations(seconds: float, text: str) -> None:
    assert _duration(seconds) == text


BAD = {
    ("run", "coordinaton"): "unknown experiment 'coordinaton' (did you mean 'coordination'?)",
    ("plan", "joint", "--methods", "safe"): "unknown method 'safe' (did you mean 'saf'?)",
    ("run", "joint", "--tasks", "TeamSuport"): "unknown task 'TeamSuport' (did you mean 'TeamSupport'?)",
    ("run", "joint", "--seeds", "-1"): "seed must be a whole number from 0 to 4294967295, got -1",
    ("run", "joint", "--shard", "9/8"): "expected a part such as 3/8 (the third of eight), got '9/8'",
    ("run", "joint", "--workers", "0"): "--workers must be above 0, got 0",
    ("run", "joint", "--game-steps", "0"): "--game-steps must be above 0, got 0",
    ("run", "joint", "--retries", "-1"): "--retries must be 0 or more, got -1",
    ("run", "joint", "--env-kwargs", "coordination:2"): "coordination is what the experiment turns; leave it out of",
    ("run", "joint", "--env-kwargs", "n_agent:2"): "unknown parameter 'n_agent' (did you mean 'n_agents'?)",
    ("run", "joint", "--hyperparams", "learning_rat:2"): "unknown setting 'learning_rat' (did you mean",
    ("plan", "joint", "--rate", "-5"): "--rate must be above 0, got -5",
    (
        "report",
        "joint",
        "-f",
        "nowhere",
    ): "there is no folder nowhere; name another with -f, or run it first: python -m",
    ("report", "joint", "-f", "empty"): "empty has no results of 'joint'; run it first: python -m",
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
    assert cli.main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"python -m sb3_saf.experiments {words[0]}: error: ")
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("words", [("run", "joint", "--size", "medium"), ("fly",), ("run",)])
def test_usage_errors(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        cli.main(words)
    assert exit_.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_an_experiment_whose_algorithms_are_missing(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in find_experiment("qplex").methods:
        monkeypatch.delitem(ALGOS, name, raising=False)
    assert cli.main(["run", "qplex", "-f", str(tmp_path)]) == 2
    assert "the experiment 'qplex' needs the algorithms qplex, qplex-pool, which this installation does not" in (
        capsys.readouterr().err
    )


def test_report_before_anything_is_finished(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pytest.importorskip("rliable")
    protocol, results = Protocol("smoke"), Results(tmp_path)
    results.agree(protocol)
    results.add_request("joint", Choice((0,)))
    assert cli.main(["report", "joint", "-f", str(tmp_path)]) == 2
    assert "has no finished cell of 'joint'" in capsys.readouterr().err
