"""The example programs run on installed environments."""

from __future__ import annotations

import re

import pytest

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
