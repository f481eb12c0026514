"""The benchmark of team sizes trains what is missing, and compares methods seed by seed."""

from __future__ import annotations

import sys
from pathlib import Path

import pandas as pd
import pytest

from benchmarks import team_size
from sb3_saf.experiments import cli
from tests.experiments_jobs import InlineEngine


def test_it_trains_what_is_missing_then_draws(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["-f", str(tmp_path), "--agents", "2", "--methods", "ippo", "--seeds", "0", "-n", "800", "--episodes", "2"]
    monkeypatch.setattr(cli, "_engine", lambda options: InlineEngine())
    monkeypatch.setattr(sys, "argv", ["team_size", *words, "--figure", str(tmp_path / "size.png")])
    team_size.main()
    header, _, ippo, random, _, script = capsys.readouterr().out.partition("| agents")[2].strip().splitlines()
    assert ippo.startswith("| 2 | ippo | 1 | ") and ippo.count("|") == header.count("|") + 1
    assert random.startswith("| 2 | random | 1 | ")
    assert script.startswith("scripted, 7 x 7 views, 2 agents: ")
    assert (tmp_path / "2" / "cells" / "TeamSupport-c2-h1" / "ippo" / "seed-0" / "model.zip").exists()
    assert (tmp_path / "size.png").stat().st_size > 1_000


def test_differences_are_taken_seed_by_seed() -> None:
    rows = [("mappo", 1, 44.0, 39.0), ("saf", 0, 30.0, 20.0), ("saf", 1, 50.0, 40.0), ("mappo", 0, 26.0, 18.0)]
    table = pd.DataFrame(rows, columns=["method", "seed", "score", "learning"]).assign(
        n_agents=5, explained=0.5, cost=100.0
    )
    assert list(team_size.lines(table, ["saf", "mappo"]))[2:] == [
        "| 5 | saf | 2 | 40.0 [-87.1, 167.1] | 30.0 [-97.1, 157.1] | 0.50 | 100 |",
        "| 5 | mappo | 2 | 35.0 [-79.4, 149.4] | 28.5 [-104.9, 161.9] | 0.50 | 100 |",
        "| 5 | saf minus mappo | 2 | 5.0 [-7.7, 17.7] | 1.5 [-4.9, 7.9] | | |",
    ]
