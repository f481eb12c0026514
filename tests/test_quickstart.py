"""``make train`` with small numbers: all its outputs exist, and its model can be replayed."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as imageio
import pytest
from stable_baselines3 import PPO

from sb3_saf import quickstart
from sb3_saf.training import replay
from tests.test_replay import data_of


def test_it_leaves_a_model_that_can_be_replayed_a_curve_a_video_and_logs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(quickstart, "N_EPISODES", 8)
    monkeypatch.setattr(quickstart, "N_INSPECTIONS", 1)
    output = tmp_path / "run"
    quickstart.main(["--game-steps", "1600", "--output", str(output), "--no-progress-bar", "--coordination", "1"])
    printed = capsys.readouterr().out
    assert "Training SAF on TeamSupport" in printed
    assert all(f"  {name}" in printed for name in ("SAF", "random"))
    model = PPO.load(output / "model.zip")
    assert model.num_timesteps == 1600 * 5
    assert imageio.imread(output / "learning_curve.png").shape[0] > 400
    assert 20 < len(imageio.imread(output / "episode.gif")) <= 50
    assert list((output / "tb" / "saf_1").glob("events.out.tfevents.*"))
    assert "</html>" in (output / "replay.html").read_text()
    for name in ("model.zip", "learning_curve.png", "episode.gif", "replay.html", "tb"):
        assert str(output / name) in printed
    page, model_file = tmp_path / "page.html", str(output / "model.zip")
    replay.main(["--model", model_file, model_file, "-o", str(page), "--env-kwargs", "max_cycles:9"])
    assert capsys.readouterr().out.strip() == str(page)
    assert [run["steps"] for run in data_of(page)["runs"]] == [9, 9]


def test_wrong_levels_are_one_line_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        quickstart.main(["--coordination", "6", "--output", str(tmp_path)])
    assert exit_.value.code == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.endswith("coordination must be an integer from 1 to 5 (1 <= coordination <= n_agents), got 6")
