"""The benchmark of team sizes trains what is missing, and compares methods seed by seed."""

from __future__ import annotations

import sys
from pathlib import Path

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
