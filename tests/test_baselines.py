"""Third-party gridworlds of the speed comparison: installed ones run, the others are left out."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import environments, workers
from benchmarks.baselines import BASELINES, N_AGENTS, N_GAMES
from benchmarks.rates import Row, table, take_turns
from benchmarks.workers import Worker, is_installed

#: Observations of one step: agents of all games first.
ROWS = {
    "pursuit": N_AGENTS,
    "minigrid": 1,
    "foraging": N_AGENTS,
    "pogema": N_AGENTS,
    "overcooked": 2 * N_GAMES,
    "overcooked_v2": 2 * N_GAMES,
    "trash_pickup": N_AGENTS * N_GAMES,
}


@pytest.mark.parametrize("name", BASELINES)
def test_an_installed_baseline_steps(name: str) -> None:
    if not is_installed(name):
        pytest.skip(f"{BASELINES[name].distribution} is not installed")
    with Worker(name) as worker:
        answers = [worker.measure(0.05) for _ in range(3)]
    assert all(answer["rate"] > 0 and answer["shape"][0] == ROWS[name] for answer in answers)
    assert len({answer["checksum"] for answer in answers}) > 1, "the agents see the same again and again"


def test_what_is_not_installed_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(workers, "INTERPRETERS", tmp_path)
    with pytest.raises(ImportError, match="pogema is not installed"):
        Worker("pogema")


def test_a_baseline_that_fails_keeps_the_other_rows(capsys: pytest.CaptureFixture[str]) -> None:
    calls = iter([1.0, 2.0])

    def dies_later(_: float) -> float:
        for value in calls:
            return value
        raise RuntimeError("gone")

    rows = take_turns({"dies": dies_later, "copy": lambda _: 4.0}, seconds=0.0, rounds=3)
    assert rows == [Row("copy", [4.0, 4.0, 4.0])]
    assert "left out: dies (RuntimeError: gone)" in capsys.readouterr().out


def test_baselines_that_are_not_installed_are_left_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def nothing(_: str) -> bool:
        return False

    monkeypatch.setattr(workers, "is_installed", nothing)
    monkeypatch.setattr(environments, "programs", lambda: {"copy of bytes": lambda: environments.copy_work()})
    found = environments.speed_table(seconds=0.001, rounds=1)
    assert found.count("\n| ") == 2 and "copy of bytes" in found and found.endswith("Others: none.")
    assert capsys.readouterr().out.count("left out: ") == len(BASELINES)


def test_the_table_has_medians_spread_and_ratios() -> None:
    lines = table([Row("batch", [1e6, 3e6, 2e6]), Row("copy of bytes", [8e6])], "copy").splitlines()
    assert lines[2:] == [
        "| batch | 2,000,000 | 1,000,000 - 3,000,000 | 0.25 |",
        "| copy of bytes | 8,000,000 | 8,000,000 - 8,000,000 | 1 |",
    ]
