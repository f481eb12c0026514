"""The example programs run on installed environments."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from examples import warehouse
from examples.train_pettingzoo import ENVIRONMENTS, main

NEEDS = {"multiwalker": "Box2D", "pursuit": "pettingzoo.sisl.pursuit_v5", "hanabi": "pyspiel"}


@pytest.mark.filterwarnings("ignore")  # warnings of other projects
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_environments_of_others_train(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(NEEDS.get(name, "mpe2"), exc_type=ImportError)
    example = ENVIRONMENTS[name]
    short = {**example.params, "max_cycles": 20} if "max_cycles" in example.params else example.params
    monkeypatch.setitem(ENVIRONMENTS, name, example._replace(n_games=2, n_steps=20, params=short))
    main(["--env", name, "--game-steps", "40", "--episodes", "2"])
    printed = capsys.readouterr().out
    assert re.search(r"trained  -?\d+\.\d\d \[.*2 team episodes\)\n  random   -?\d+\.\d\d \[", printed), printed


def test_two_kinds_of_agents_from_rules_to_replay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    warehouse.main(["--game-steps", "64", "--episodes", "2", "--output", str(tmp_path)])
    printed = capsys.readouterr().out
    assert re.search(
        r"trained  .* 2 team episodes\)\nrandom   .*\nby itself: \d orders left after \d+ steps\n", printed
    )
    assert "exported actor of packer_0: calls" in printed
    assert (tmp_path / "actor" / "actor.onnx").exists() and (tmp_path / "replay.html").exists()


def test_connect_four_is_trained_and_played_on_both_sides(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pygame")
    from examples import connect_four

    assert -1 <= connect_four.main(["--moves", "64", "--games", "4"]) <= 1
    of_games = r"4 games: won (\d+)% \(\d+% moving first, \d+% second\), mean reward -?\d\.\d\d\n"
    assert re.fullmatch(f"most likely actions, {of_games}drawn actions, {of_games}", capsys.readouterr().out)
