"""Watching and plotting trained teams: ``python -m sb3_saf.enjoy`` and ``python -m sb3_saf.plot``."""

from __future__ import annotations

import argparse
import json
import os
import runpy
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import imageio_ffmpeg
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.utils import set_random_seed

from sb3_saf import EvaluationResult, evaluate_team
from sb3_saf.teams.checks import evaluation_seed
from sb3_saf.training import enjoy as zoo_enjoy
from sb3_saf.training import plot as zoo_plot
from sb3_saf.training import train as zoo_train
from sb3_saf.training.folders import Run, finish_run, training_curve, write_run
from sb3_saf.training.plot import describe, find_runs
from sb3_saf.training.settings import load_settings
from sb3_saf.training.yaml_files import Size
from tests.test_training_commands import failed
from tests.toy_envs import CounterEnv

ENV = "TeamTogether-v0"


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create logs of SAF and MAPPO at two levels, SAF with two seeds, and a team with memory."""
    folder = tmp_path_factory.mktemp("logs")

    def train(algo: str, *options: str) -> None:
        given = ("--size", "smoke", "-n", "80", "--eval-freq", "40", "--eval-episodes", "4", "--verbose", "0")
        zoo_train.main(["--algo", algo, "--env", ENV, "-f", str(folder), *given, *options])

    for coordination in (1, 2):
        train("saf", "--seed", "0", "--env-kwargs", f"coordination:{coordination}", "--save-freq", "40")
        train("saf", "--seed", "1", "--env-kwargs", f"coordination:{coordination}")
        train("mappo", "--seed", "0", "--env-kwargs", f"coordination:{coordination}")
    train("saf-gru", "--seed", "0")
    return folder


def enjoy(logs: Path, *options: str) -> EvaluationResult:
    return zoo_enjoy.enjoy(["-f", str(logs), "--env", ENV, "--episodes", "6", *options])


# --- enjoy ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("deterministic", [True, False])
def test_returns_are_those_of_the_saved_model_over_games_of_its_level(logs: Path, deterministic: bool) -> None:
    options = ["--deterministic"] if deterministic else []
    result = enjoy(logs, "--exp-id", "1", "--no-render", "--seed", "5", *options)
    run = Run(logs / "saf" / f"{ENV}_1")
    assert run.settings.env_kwargs["coordination"] == 1
    model = PPO.load(run.folder / f"{ENV}.zip", device="cpu")
    games = run.settings.make_env(5, evaluation=True, n_envs=6)
    set_random_seed(5)
    of_evaluation = evaluate_team(model, games, 6, deterministic=deterministic)
    games.seed(evaluation_seed(5, test=0))
    set_random_seed(5)
    assert result == evaluate_team(model, games, 6, deterministic=deterministic)
    assert result != of_evaluation


def test_latest_run_by_default_and_other_models_on_demand(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    enjoy(logs, "--no-render")
    assert f"{ENV}_4/{ENV}.zip" in capsys.readouterr().out
    for option, name in (
        (["--load-best"], "best_model.zip"),
        (["--load-checkpoint", "40"], "rl_model_40_steps.zip"),
    ):
        result = enjoy(logs, "--exp-id", "1", "--no-render", *option)
        printed = capsys.readouterr().out
        assert f"{ENV}_1/{name}" in printed
        assert f"team return {result.mean:.2f} [" in printed
        assert "6 team episodes" in printed


def test_other_levels_sizes_and_teams_with_memory(logs: Path, tmp_path: Path) -> None:
    assert set(enjoy(logs, "--no-render", "--env-kwargs", "max_cycles:7", "heterogeneity:2").lengths) == {7}
    assert len(enjoy(logs, "--algo", "saf-gru", "--gif", str(tmp_path / "g.gif")).returns) == 6
    assert len(enjoy(logs, "--no-render", "--env-kwargs", "n_agents:5").agent_means) == 5


def test_gif_mp4_and_text_show_every_step_of_the_first_game(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    enjoy(logs, "--gif", str(tmp_path / "new" / "game.gif"))
    gif = imageio.imread(tmp_path / "new" / "game.gif")
    assert 5 < len(gif) <= 10  # equal pictures are joined
    assert len(np.unique(gif.reshape(len(gif), -1), axis=0)) > 5  # it moves
    enjoy(logs, "--mp4", str(tmp_path / "game.mp4"))
    assert imageio_ffmpeg.count_frames_and_secs(tmp_path / "game.mp4")[0] == 10
    capsys.readouterr()
    (tmp_path / "folder.gif").mkdir()
    with pytest.raises(IsADirectoryError):
        enjoy(logs, "--gif", str(tmp_path / "folder.gif"))
    assert "team return" in capsys.readouterr().out  # what was measured is not lost
    enjoy(logs, "--text", "--seed", "9", "--exp-id", "3")
    pages = capsys.readouterr().out.split("team return")[0]
    assert [step for step in range(12) if f"step {step} " in pages] == list(range(10))
    games = Run(logs / "saf" / f"{ENV}_3").settings.make_env(9, evaluation=True, n_envs=1, render_mode="ansi")
    games.seed(evaluation_seed(9, test=0))
    games.reset()
    assert pages.startswith(games.env_method("render", indices=[0])[0])
    with zoo_enjoy.open_screen(argparse.Namespace(no_render=False, text=True), games) as show:
        assert show is not None
        with pytest.raises(ValueError, match=r"expected text from render.* got ndarray; leave out --text"):
            show(np.zeros((4, 4, 3), np.uint8))


def test_a_window_needs_a_display(
    logs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    enjoy(logs)  # SDL's dummy driver
    capsys.readouterr()
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    line = failed(["-f", str(logs), "--env", ENV], capsys, zoo_enjoy.main)
    assert "there is no display" in line
    assert "--gif FILE" in line


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--algo", "safe"], "did you mean 'saf'"),
        (["--algo", "ippo"], "python -m sb3_saf.train --algo ippo"),
        (["-f", "nowhere"], "there is no folder nowhere/saf; train first"),
        (["--env", "TeamSupport-v0"], "there is no run of TeamSupport-v0"),
        (["--load-checkpoint", "41"], "has no rl_model_41_steps.zip"),
        (["--team", "saf"], "unknown team 'saf'; there is"),
        (["--gif", "film.mp4"], "a file that ends with .gif"),
        (["--gif", "a.gif", "--text"], "not allowed with"),
    ],
)
def test_mistakes_in_enjoy_are_one_line(
    options: list[str], words: str, logs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quiet = [] if "--gif" in options else ["--no-render"]
    assert words in failed(["-f", str(logs), *quiet, *options], capsys, zoo_enjoy.main)


def test_another_games_run_is_not_watched_by_this_name(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(logs / "saf" / f"{ENV}_1", tmp_path / "saf" / "TeamSupport-v0_1")
    (tmp_path / "saf" / "TeamSupport-v0_1" / f"{ENV}.zip").rename(tmp_path / "saf/TeamSupport-v0_1/TeamSupport-v0.zip")
    line = failed(["-f", str(tmp_path), "--env", "TeamSupport-v0", "--no-render"], capsys, zoo_enjoy.main)
    assert f"has a run of {ENV}, not of TeamSupport-v0" in line


def test_the_error_without_a_run_prints_a_command_that_trains(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = failed(["--no-render", "-f", str(tmp_path)], capsys, zoo_enjoy.main)
    options = zoo_train.make_parser().parse_args(shlex.split(line.partition("-m sb3_saf.train ")[2]))
    assert options.log_folder == tmp_path


def test_a_reader_may_leave(logs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Like ``| head -1``: neither the command nor closing its output complains."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as output, monkeypatch.context() as context:
        context.setattr(sys, "stdout", output)
        with pytest.raises(SystemExit, match="1"):
            zoo_enjoy.main(["-f", str(logs), "--env", ENV, "--episodes", "2", "--text"])
    assert capsys.readouterr().err == ""


def test_a_damaged_model_is_one_line(logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "saf" / f"{ENV}_1"
    run.mkdir(parents=True)
    (run / f"{ENV}.zip").write_bytes(b"no zip")
    assert "run.json cannot be read" in failed(["-f", str(tmp_path), "--no-render"], capsys, zoo_enjoy.main)
    shutil.copy(logs / "saf" / f"{ENV}_1" / "run.json", run)
    assert "does not hold the tensors" in failed(["-f", str(tmp_path), "--no-render"], capsys, zoo_enjoy.main)


# --- runs and plot ----------------------------------------------------------------------------------------------------


def test_runs_are_found_and_described(logs: Path) -> None:
    found = [(one.method, one.run.seed, one.setting) for one in describe(find_runs(logs, ["saf", "mappo"]))]
    levels = "TeamTogether, coordination 1", "TeamTogether, coordination 2"
    expected = [(method, seed, level) for method, seed in (("saf", 0), ("saf", 1), ("mappo", 0)) for level in levels]
    assert sorted(found) == sorted(expected)


def test_results_of_a_run(logs: Path) -> None:
    run = find_runs(logs, ["saf"])[0]
    with np.load(run.folder / "evaluations.npz") as arrays:
        means = arrays["results"].mean(axis=1)
    curve = run.curve("evaluation")
    assert curve["game_steps"].tolist() == [40, 80]
    assert curve["score"].tolist() == means.tolist()
    training = run.curve("training")
    returns = np.genfromtxt(run.folder / "monitor.csv", delimiter=",", skip_header=2)[:, 0]
    assert training["game_steps"].tolist() == [40, 80]  # 8 episodes in 4 games
    assert training["score"].tolist() == [part.mean() for part in np.split(returns, 2)]
    columns = ["game_steps", "score", "episodes"]
    of_monitor = training_curve(run.folder, 2)[columns].astype(float)
    pd.testing.assert_frame_equal(of_monitor, training[columns])


def test_hyperparameters_that_differ_are_in_the_method_and_repeated_runs_count_once(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["--size", "smoke", "-n", "40", "--eval-freq", "-1", "--seed", "0", "--verbose", "0", "-f", str(tmp_path)]
    zoo_train.main(["--algo", "saf", *given])
    zoo_train.main(["--algo", "saf", *given, "-params", "gamma:0.9"])
    shutil.copytree(tmp_path / "saf" / f"{ENV}_2", tmp_path / "saf" / f"{ENV}_3")
    named = describe(find_runs(tmp_path))
    assert [(one.run.number, one.method) for one in named] == [(1, "saf"), (3, "saf gamma=0.9")]
    with pytest.raises(ValueError, match="has no evaluations"):
        named[0].run.curve("evaluation")
    fake_run(tmp_path, 4, seed=1)
    figure = str(tmp_path / "curves.png")
    zoo_plot.main(["-f", str(tmp_path), "--source", "training", "-o", figure])
    told = capsys.readouterr().err
    assert told.count("left out: ") == 1 and "4" in told  # the run without episodes
    fake_run(tmp_path, 6, seed=3)
    (tmp_path / "saf" / f"{ENV}_6" / "curve.csv").write_text("game_steps,processor_seconds,score,episodes\n")
    zoo_plot.main(["-f", str(tmp_path), "--source", "training", "-o", figure])
    assert f"left out: no episode has ended in {tmp_path}/saf/{ENV}_6" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "saf" / f"{ENV}_6")
    (tmp_path / "saf" / f"{ENV}_1" / "finished.json").rename(tmp_path / "kept")
    shutil.copytree(tmp_path / "saf" / f"{ENV}_1", tmp_path / "saf" / f"{ENV}_5")
    (tmp_path / "kept").rename(tmp_path / "saf" / f"{ENV}_1" / "finished.json")
    ours = json.loads((tmp_path / "saf" / f"{ENV}_5" / "run.json").read_text())
    (tmp_path / "saf" / f"{ENV}_5" / "run.json").write_text(json.dumps({**ours, "seed": 2}))
    zoo_plot.main(["-f", str(tmp_path), "--source", "training", "-o", figure])
    assert f"{ENV}_5 is not finished, others of its method are" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "saf" / f"{ENV}_5")
    fake_run(tmp_path, 5, game_steps=40)  # as run 1, not finished
    assert [one.run.number for one in describe(find_runs(tmp_path))] == [1, 3, 4]
    assert "has no evaluations" in failed(["-f", str(tmp_path), "-o", figure], capsys, zoo_plot.main)


def fake_run(folder: Path, number: int, seed: int = 0, options: dict[str, Any] | None = None, **overrides: Any) -> None:
    """Write a run's settings, as training does."""
    settings = load_settings("saf", ENV, "smoke", overrides=overrides)
    write_run(folder / "saf" / f"{ENV}_{number}", settings.as_dict(), seed, "", options)


def test_a_folder_that_is_used_again_has_nothing_of_the_run_before(tmp_path: Path) -> None:
    fake_run(tmp_path, 1)
    (folder,) = (tmp_path / "saf").iterdir()
    (folder / "curve.csv").write_text("game_steps,processor_seconds,score,episodes\n40,1,2,1\n")
    finish_run(folder, wall_seconds=1.0)
    fake_run(tmp_path, 1, seed=1)  # stopped before its first game was over
    assert [path.name for path in folder.iterdir()] == ["run.json"]


def test_names_of_methods_say_what_differs_from_the_zoo(tmp_path: Path) -> None:
    fake_run(tmp_path, 1)
    fake_run(tmp_path, 2, game_steps=80, batch_size=80)
    many: dict[str, Any] = {"gamma": 0.9123456, "ent_coef": 0.02, "policy_kwargs": {"n_slots": 3, "n_policies": 2}}
    fake_run(tmp_path, 3, **many)
    fake_run(tmp_path, 4, seed=1, **many)
    fake_run(tmp_path, 5, **{**many, "gamma": 0.8})
    fake_run(tmp_path, 6, time_limit="bootstrap")
    named = describe(find_runs(tmp_path))
    assert [one.method for one in named] == [
        "saf",
        "saf batch_size=80 game_steps=80",
        *["saf, variant 1"] * 2,
        "saf, variant 2",
        "saf time_limit=bootstrap",
    ]
    assert named[2].changes == "ent_coef=0.02 gamma=0.9123456 n_policies=2 n_slots=3"
    for number in (1, 2):
        fake_run(tmp_path / "shared", number, seed=number, game_steps=80)
    assert methods_in(tmp_path / "shared") == ["saf", "saf"]  # what all share is not named


def methods_in(folder: Path) -> list[str]:
    return [one.method for one in describe(find_runs(folder))]


def test_games_that_state_a_parameter_and_games_that_do_not_are_apart(tmp_path: Path) -> None:
    for number, stated in ((1, {}), (2, {"max_cycles": 7})):
        settings = load_settings("saf", "tests.toy_envs:CounterEnv", "smoke", {**stated, "deaths": {}})
        write_run(tmp_path / "saf" / f"Counter_{number}", settings.as_dict(), 0, "")
    settings_of_games = [one.setting.partition(", ")[2] for one in describe(find_runs(tmp_path))]
    assert settings_of_games == ["max_cycles default", "max_cycles 7"]


def test_runs_that_began_or_were_evaluated_otherwise_have_other_names(tmp_path: Path) -> None:
    fake_run(tmp_path, 1, options={"deterministic_eval": False, "eval_env_kwargs": {}})
    fake_run(tmp_path, 2, options={"deterministic_eval": True, "eval_env_kwargs": {"coordination": 3}})
    fake_run(tmp_path, 3, options={"initial_model": {"path": "old.zip", "sha256": "1"}})
    expected = ["saf", "saf deterministic_eval=True eval_env_kwargs=coordination:3", "saf trained_agent=old.zip"]
    assert methods_in(tmp_path) == expected
    shutil.rmtree(tmp_path / "saf" / f"{ENV}_1")
    shutil.rmtree(tmp_path / "saf" / f"{ENV}_3")
    settings = load_settings("mappo", ENV, "smoke")
    write_run(tmp_path / "mappo" / f"{ENV}_1", settings.as_dict(), 0, "")
    assert set(methods_in(tmp_path)) == {"mappo", expected[1]}  # beside another method, too


def sized_game(size: int, method: str = "") -> CounterEnv:
    """Make a game of parameters that are named as properties of runs."""
    return CounterEnv(max_cycles=size)


def test_a_parameter_of_a_game_may_be_named_as_a_property_of_runs(tmp_path: Path) -> None:
    sizes: list[Size] = ["small", "smoke"]
    for number, size in enumerate(sizes, start=1):
        settings = load_settings("saf", f"{__name__}:sized_game", size, {"size": 8, "method": str(number)})
        write_run(tmp_path / "saf" / f"Sized_{number}", settings.as_dict(), 0, "")
    named = [(one.method, one.setting.partition(", ")[2]) for one in describe(find_runs(tmp_path))]
    assert named == [("saf", "size small, method 1"), ("saf", "size smoke, method 2")]


def test_runs_of_games_that_are_not_registered_are_found_by_others_names(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(logs, tmp_path / "logs")
    settings = {**load_settings("saf", ENV, "smoke").as_dict(), "env": "Elsewhere-v0"}
    write_run(folder / "saf" / "Elsewhere-v0_1", settings, 0, "")
    assert len(find_runs(folder, env_ids=[ENV])) == len(find_runs(logs, env_ids=[ENV]))
    words = ["-f", str(folder), "-o", "a.png", "--gym-packages", "nowhere"]
    assert "cannot import 'nowhere'" in failed(words, capsys, zoo_plot.main)


def test_a_figure_from_a_folder(logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "new" / "figure.png"
    zoo_plot.main(["-f", str(logs), "--algos", "saf", "mappo", "-o", str(output.with_suffix(""))])
    assert capsys.readouterr().out.splitlines()[-1] == str(output)
    picture = imageio.imread(output)
    assert picture.shape[0] > 300
    assert len(np.unique(picture.reshape(-1, picture.shape[-1]), axis=0)) > 50


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("monitor.csv", "is not what sb3_saf.train writes"),
        ("curve.csv", "is no learning curve"),
        ("evaluations.npz", "is not what sb3_saf.train writes"),
    ],
)
def test_damaged_results_are_one_line(
    name: str, words: str, logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "saf" / f"{ENV}_1"
    shutil.copytree(logs / "saf" / f"{ENV}_1", run)
    (run / name).write_text("" if name == "evaluations.npz" else "a,b\nsome,text\n")
    if name == "monitor.csv":  # of a run that is not finished
        (run / "curve.csv").unlink()
    source = "evaluation" if name == "evaluations.npz" else "training"
    options = ["-f", str(tmp_path), "--source", source, "-o", str(tmp_path / "a.png")]
    assert f"{name} {words}" in failed(options, capsys, zoo_plot.main)


@pytest.mark.filterwarnings("ignore")  # of other projects
def test_plots_of_rl_zoo3_read_the_folders(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("seaborn")
    pytest.importorskip("rl_zoo3.plots")
    with matplotlib.rc_context():  # which seaborn changes
        for words in (
            f"plot_train -a saf -e {ENV} -f {logs} -w 1",
            f"all_plots -a saf mappo -e {ENV} -f {logs} --no-display -o {tmp_path / 'all'}",
        ):
            monkeypatch.setattr(sys, "argv", words.split())
            runpy.run_module(f"rl_zoo3.plots.{sys.argv[0]}", run_name="__main__")
        plt.close("all")
    printed = capsys.readouterr().out
    assert "No data" not in printed and "not found" not in printed
    assert "SAF" in printed and ENV in printed


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["-f", "nowhere", "-o", "a.png"], "there is no folder nowhere"),
        (["-o", "a.txt"], "Format 'txt' is not supported (supported formats: "),
    ],
)
def test_mistakes_in_plot_are_one_line(
    options: list[str], words: str, logs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert words in failed(["-f", str(logs), *options], capsys, zoo_plot.main)
