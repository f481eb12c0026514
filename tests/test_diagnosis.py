"""The diagnosis of trained teams reads an experiment's folder."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import diagnosis
from hecogrid_envs.constants import Command
from sb3_saf.experiments.definitions import Cell, Level, RunConfig
from sb3_saf.experiments.results import Results
from sb3_saf.training.folders import write_run
from sb3_saf.training.settings import load_settings

#: A network shape other than the zoo's: the diagnosis must read the trained shape from the folder.
OVERRIDES = {"policy_kwargs": {"features_extractor_class": "LightEncoder", "net_arch": [32]}}


def save_team(folder: Path, method: str, seed: int) -> None:
    level = {"coordination": 2, "heterogeneity": 3}
    settings = load_settings(method, "TeamSupport-v0", "small", overrides={**OVERRIDES, "env_kwargs": level})
    model = settings.make_model(settings.make_env(seed), seed, device="cpu")
    cell = folder / "cells" / "TeamSupport-c2-h3" / method / f"seed-{seed}"
    cell.mkdir(parents=True)
    model.save(cell / "model.zip")
    description = RunConfig("small", OVERRIDES).describe(Cell(method, "TeamSupport-v0", Level.of(**level), seed))
    write_run(cell, **description, command="")


def test_it_looks_into_every_trained_team(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for method, seed in (("saf", 0), ("saf", 1), ("ippo", 0)):
        save_team(tmp_path, method, seed)
    results = Results(tmp_path)
    results.save_config(RunConfig("small", OVERRIDES))
    assert [str(cell) for cell in diagnosis.cells(results)] == [
        "ippo TeamSupport c=2, h=3 seed 0",
        "saf TeamSupport c=2, h=3 seed 0",
        "saf TeamSupport c=2, h=3 seed 1",
    ]
    assert not list(diagnosis.cells(results, "TeamTogether-*"))
    kept = tmp_path / "numbers.json"
    monkeypatch.setattr(sys, "argv", ["diagnosis", str(tmp_path), "--episodes", "2", "--json", str(kept)])
    diagnosis.main()
    numbers = json.loads(kept.read_text())
    ippo, saf = numbers["TeamSupport c2-h3 ippo"], numbers["TeamSupport c2-h3 saf"]
    assert saf["knowledge_source/read_entropy"] > 0.9  # untrained: attention is nearly uniform
    assert 0 <= saf["pool/zone_dependence"] < 0.1
    assert not any(name.startswith(("pool", "message")) for name in ippo)
    assert 0 <= ippo["greedy"] <= 25
    for zone in range(3):  # untrained: three of seven commands do nothing
        assert 0.3 < ippo[f"useless/zone_{zone}"] < 0.55
    header, _, first, second = capsys.readouterr().out.strip().splitlines()
    assert header.startswith("| task | level | method | critic/bias |")
    assert first.startswith("| TeamSupport | c2-h3 | ippo |")
    assert second.count("|") == header.count("|")


def test_useless_commands_are_counted_by_zone() -> None:
    commands = np.array([Command.FORWARD, Command.TOGGLE, Command.DONE, Command.DROP, Command.PICKUP], dtype=np.uint8)
    zones = np.array([0, 0, 2, 2, 2])
    counted = diagnosis.useless_commands("TeamSupport", commands, zones)
    assert counted == {"useless/zone_0": 0.5, "useless/zone_2": pytest.approx(2 / 3)}
    with_keys = diagnosis.useless_commands("KeyForTreasure", commands, zones)
    assert with_keys == {"useless/zone_0": 0.5, "useless/zone_2": pytest.approx(1 / 3)}
