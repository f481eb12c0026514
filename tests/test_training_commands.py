"""``python -m sb3_saf.train``: RL-Zoo3 underneath, and its traps for teams repaired."""

from __future__ import annotations

import random
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_saf import QPLEX, SAFPolicy, evaluate_team
from sb3_saf.randomness import own_randomness
from sb3_saf.training import train as zoo_train
from sb3_saf.training.algorithms import ALGOS
from sb3_saf.training.callbacks import GameStepsProgressBar
from sb3_saf.training.settings import ENV_IDS, load_settings

rl_zoo_train = pytest.importorskip("rl_zoo3.train")

ENV = "TeamTogether-v0"


def train(folder: Path, *options: str, algo: str = "saf") -> Path:
    """Train at smoke size with seed 3; returns the run's folder."""
    before = {path.parent for path in folder.glob("*/*/monitor.csv")}
    given = ("--size", "smoke", "--seed", "3", "--eval-episodes", "4", "--env", ENV, "-f", str(folder))
    zoo_train.main(["--algo", algo, *given, *options])
    (run,) = {path.parent for path in folder.glob("*/*/monitor.csv")} - before
    return run


def weights(model: Any) -> dict[str, th.Tensor]:
    return {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}


def equal(one: dict[str, th.Tensor], other: dict[str, th.Tensor]) -> bool:
    return one.keys() == other.keys() and all(one[name].equal(other[name]) for name in one)


@pytest.fixture(scope="module")
def by_hand() -> dict[str, th.Tensor]:
    settings = load_settings("saf", ENV, "smoke")
    model = settings.make_model(settings.make_env(3), 3)
    model.learn(settings.total_timesteps)
    return weights(model)


@pytest.mark.parametrize("evaluation", [("--eval-freq", "-1"), ("--eval-freq", "60"), ("--save-freq", "100")])
def test_the_command_trains_what_settings_train_with_and_without_evaluation(
    evaluation: tuple[str, ...], by_hand: dict[str, th.Tensor], tmp_path: Path
) -> None:
    run = train(tmp_path, *evaluation)
    assert equal(by_hand, weights(PPO.load(run / f"{ENV}.zip")))


def test_another_seed_trains_something_else(by_hand: dict[str, th.Tensor], tmp_path: Path) -> None:
    run = train(tmp_path, "--eval-freq", "-1", "--seed", "4")
    assert not equal(by_hand, weights(PPO.load(run / f"{ENV}.zip")))


@pytest.mark.parametrize("algo", ["saf", "qplex"])
def test_tensorboard_has_the_inside_of_the_policy_and_training_does_not_notice(algo: str, tmp_path: Path) -> None:
    quick = ("--eval-freq", "-1", "-n", "80")
    plain = train(tmp_path, *quick, algo=algo)
    watched = train(tmp_path, *quick, "-tb", str(tmp_path / "tb"), "--inspect-freq", "40", algo=algo)
    load = ALGOS[algo].algorithm.load
    assert equal(weights(load(plain / f"{ENV}.zip")), weights(load(watched / f"{ENV}.zip")))
    (file,) = (tmp_path / "tb").rglob("events.*")
    found = EventAccumulator(str(file)).Reload()
    assert [event.step for event in found.Scalars("team/return")] == [0, 160, 320]
    assert {"episode/strip", "critic/calibration"} <= set(found.Tags()["images"])
    assert b"TeamTogether" in found.PluginTagToContent("hparams")["_hparams_/session_start_info"]


def test_no_look_into_the_policy(tmp_path: Path) -> None:
    train(tmp_path, "--eval-freq", "-1", "-n", "40", "-tb", str(tmp_path / "tb"), "--inspect-freq", "-1")
    (file,) = (tmp_path / "tb").rglob("events.*")
    assert "team/return" not in EventAccumulator(str(file)).Reload().Tags()["scalars"]


def test_value_based_algorithms_are_evaluated_without_exploring(tmp_path: Path) -> None:
    """QPLEX explores with every second action at this point; SAF's drawn actions are what it learns."""
    run = train(tmp_path, "--eval-freq", "40", "-n", "40", "-params", "exploration_final_eps:0.5", algo="qplex")
    games = load_settings("qplex", ENV, "smoke").make_env(3, evaluation=True, n_envs=4)
    expected = evaluate_team(QPLEX.load(run / "best_model.zip"), games, 4, deterministic=True)
    with np.load(run / "evaluations.npz") as arrays:
        assert arrays["results"].tolist() == [expected.returns]


def test_generators_are_put_back() -> None:
    def draws() -> tuple[float, float, float]:
        return random.random(), float(np.random.random()), float(th.rand(()))  # noqa: NPY002

    states = random.getstate(), np.random.get_state(), th.get_rng_state()  # noqa: NPY002
    expected = draws()
    random.setstate(states[0])
    np.random.set_state(states[1])  # noqa: NPY002
    th.set_rng_state(states[2])
    with own_randomness(5, th.device("cpu")):
        inside = draws()
    assert draws() == expected
    with own_randomness(5, th.device("cpu")):
        assert draws() == inside


def test_frequencies_count_game_steps(tmp_path: Path) -> None:
    run = train(tmp_path, "--eval-freq", "150", "--save-freq", "200", "-n", "400")
    with np.load(run / "evaluations.npz") as arrays:
        # Four games play 4 steps at a time; the final policy is always evaluated.
        assert arrays["game_steps"].tolist() == [152, 300, 400]
        assert arrays["results"].shape == (3, 4)
    assert sorted(path.name for path in run.glob("rl_model_*")) == ["rl_model_200_steps.zip", "rl_model_400_steps.zip"]
    assert PPO.load(run / "rl_model_200_steps.zip").num_timesteps == 200 * 4
    assert PPO.load(run / f"{ENV}.zip").num_timesteps == 400 * 4


def test_the_level_reaches_evaluation(tmp_path: Path) -> None:
    run = train(tmp_path, "--env-kwargs", "max_cycles:6", "coordination:2", "--eval-freq", "400")
    with np.load(run / "evaluations.npz") as arrays:
        assert set(arrays["ep_lengths"].ravel()) == {6}
    assert {line.split(",")[1] for line in (run / "monitor.csv").read_text().splitlines()[2:]} == {"6"}


def test_evaluation_may_have_a_level_of_its_own(tmp_path: Path) -> None:
    run = train(tmp_path, "--env-kwargs", "max_cycles:6", "--eval-env-kwargs", "max_cycles:5", "--eval-freq", "400")
    with np.load(run / "evaluations.npz") as arrays:
        assert set(arrays["ep_lengths"].ravel()) == {5}


def test_a_run_keeps_what_it_was(tmp_path: Path) -> None:
    logs = ("-tb", str(tmp_path / "tb"), "--inspect-freq", "-1")
    run = train(tmp_path, *logs, "-params", "gamma:0.9", "policy_kwargs:{n_slots: 3}", algo="saf-no-pool")
    assert run == tmp_path / "saf-no-pool" / f"{ENV}_1"
    config, given, versions = (
        yaml.safe_load((run / ENV / f"{name}.yml").read_text()) for name in ("config", "args", "versions")
    )
    expected = load_settings(
        "saf-no-pool", ENV, "smoke", overrides={"gamma": 0.9, "policy_kwargs": {"n_slots": 3}}
    ).as_dict()
    assert config == {**expected, "seed": 3}
    assert given["hyperparams"] == {"gamma": 0.9, "policy_kwargs": {"n_slots": 3}}
    assert versions["stable-baselines3"] and versions["sb3-saf"]
    command = (run / ENV / "command.txt").read_text()
    assert command.startswith("python -m sb3_saf.train --algo saf-no-pool --size smoke")
    assert "'policy_kwargs:{n_slots: 3}'" in command
    assert list((tmp_path / "tb" / ENV / "saf-no-pool_1").glob("events.*"))
    policy = PPO.load(run / f"{ENV}.zip").policy
    assert isinstance(policy, SAFPolicy)
    assert asdict(policy.parts)["n_slots"] == 3


def test_runs_are_numbered_and_never_shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert train(tmp_path, "--eval-freq", "-1").name == f"{ENV}_1"
    # As if another process had made its folder between our look and our own.
    monkeypatch.setattr("rl_zoo3.exp_manager.get_latest_run_id", lambda *_: 0)
    assert train(tmp_path, "--eval-freq", "-1").name == f"{ENV}_2"


def test_a_model_is_trained_on(tmp_path: Path) -> None:
    first = train(tmp_path, "--eval-freq", "-1") / f"{ENV}.zip"
    second = train(tmp_path, "--eval-freq", "-1", "-i", str(first), "-params", "learning_rate:1e-30")
    difference = [
        float((a.float() - b.float()).abs().max())
        for a, b in zip(
            weights(PPO.load(first)).values(), weights(PPO.load(second / f"{ENV}.zip")).values(), strict=True
        )
    ]
    assert max(difference) < 1e-5


def test_rl_zoo_is_left_as_it_was(tmp_path: Path) -> None:
    manager, argv = rl_zoo_train.ExperimentManager, sys.argv
    train(tmp_path, "--eval-freq", "-1")
    assert rl_zoo_train.ExperimentManager is manager
    assert sys.argv is argv


@pytest.mark.parametrize("terminal", [True, False])
def test_a_progress_bar_is_for_terminals(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal)
    options = zoo_train.make_parser().parse_args([])
    zoo_train._complete(options)
    assert (options.progress, options.verbose) == (terminal, int(not terminal))
    options = zoo_train.make_parser().parse_args(["--no-progress"])
    zoo_train._complete(options)
    assert not options.progress


def test_the_progress_bar_counts_game_steps() -> None:
    settings = load_settings("ippo", ENV, "smoke", overrides={"game_steps": 80})
    bar = GameStepsProgressBar()
    settings.make_model(settings.make_env(0), 0).learn(settings.total_timesteps, callback=bar)
    assert (bar.pbar.n, bar.pbar.total) == (80, 80)
    GameStepsProgressBar().on_training_end()  # of a training that never began


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_carriers_hold_the_game_and_refuse_to_be_stepped(env_id: str) -> None:
    from sb3_saf.training.carriers import register_carriers

    register_carriers()
    register_carriers()
    env = gym.make(env_id, n_agents=3)
    game = env.get_wrapper_attr("parallel_env")
    assert isinstance(game, ParallelEnv)
    assert len(game.possible_agents) == 3
    assert env.action_space == game.action_space("agent_0")
    with pytest.raises(ValueError, match="make_team_env"):
        env.reset()
    with pytest.raises(ValueError, match="make_team_env"):
        env.unwrapped.step(0)
    env.close()


def failed(options: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line on stderr with which a command ended."""
    with pytest.raises(SystemExit) as exit_:
        zoo_train.main(options)
    assert exit_.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("python -m sb3_saf.train: error: ")
    return line


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--algo", "safe"], ("unknown algorithm 'safe'", "did you mean 'saf'")),
        (["--env", "TeamTogehter-v0"], ("unknown environment", "did you mean 'TeamTogether-v0'")),
        (["--size", "large"], ("unknown size 'large'", "paper, small, smoke")),
        (["--env-kwargs", "coordination:9"], ("coordination must be an integer from 1 to 4", "got 9")),
        (["--env-kwargs", "coordination"], ("expects key:value", "coordination:2")),
        (["--env-kwargs", "coordination:{"], ("not valid YAML",)),
        (["--eval-env-kwargs", "n_agents:5"], ("evaluation needs the 4 agents of training",)),
        (["-params", "learning_rat:1"], ("did you mean 'learning_rate'",)),
        (["-params", "policy_kwargs:dict(n_slots=8)"], ("policy_kwargs must be a mapping",)),
        (["-params", "clip_range_vf:-1"], ("clip_range_vf", "positive")),
        (["-params", "policy_kwargs:{n_slots: 0}"], ("n_slots must be a whole number of at least 1",)),
        (["-params", "batch_size:7"], ("batch_size", "multiple")),
        (["-conf", "nowhere.yml"], ("cannot read the settings in nowhere.yml",)),
        (["--seed", "-5"], ("seed must be a whole number from 0",)),
        (["--eval-episodes", "0"], ("--eval-episodes must be at least 1",)),
        (["-i", "nowhere.zip"], ("--trained-agent must be a .zip",)),
        (["--trial-id", "1"], ("--trial-id needs the --storage and --study-name",)),
        (["--trial-id", "x", "--storage", "s.log", "--study-name", "s"], ("a trial's number or 'best'",)),
        (["--trial-id", "1", "--storage", "s.log", "--study-name", "s"], ("there is no study file s.log",)),
        (["-optimize", "--storage", "study"], ("--storage must be",)),
        (["--sampler", "grid"], ("invalid choice", "--help")),
        (["-f", "/dev/null/logs"], ("Not a directory", "/dev/null/logs")),
        (["-tb", "/dev/null/tb"], ("Not a directory", "/dev/null/tb")),
        (["--game-step", "5"], ("unrecognized arguments", "--help")),
    ],
)
def test_mistakes_are_one_line(
    options: list[str],
    words: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    line = failed(["--size", "smoke", *options], capsys)
    assert all(word in line for word in words), line
    assert not list(Path("logs").rglob("*.yml"))  # it would pass for the latest run


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("default: [", "bad.yml is not valid YAML"),
        ("- 1", "bad.yml must map 'default' and environment ids to settings, got [1]"),
        ("default: {learning_rat: 1}", "bad.yml: unknown setting 'learning_rat' (did you mean 'learning_rate'?)"),
        ("default: {gamma: 0.9, gamma: 0.8}", "the key 'gamma' is there twice"),
        ("default: {gamma: high}", "gamma must be a number, got 'high'"),
        ("default: {sizes: {tiny: {gamma: 0.9}}}", "unknown size 'tiny'"),
        ("TeamTogehter-v0: {}", "unknown environment 'TeamTogehter-v0' (did you mean 'TeamTogether-v0'?)"),
        ("default: !!python/object/apply:os.system ['touch evaluated']", "bad.yml is not valid YAML"),
    ],
)
def test_bad_files_are_one_line(
    text: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bad.yml").write_text(text)
    assert words in failed(["--size", "smoke", "-conf", "bad.yml"], capsys)
    assert not Path("evaluated").exists()


def test_help_tells_defaults_where_there_are_any(capsys: pytest.CaptureFixture[str]) -> None:
    text = zoo_train.make_parser().format_help()
    assert "(default: saf)" in text
    assert not any(f"(default: {empty})" in text for empty in ("None", "{}", "", "False"))


def test_strings_are_not_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code = "__import__('pathlib').Path('evaluated').touch()"
    for option in ("-params", "--env-kwargs"):
        for key in ("policy_kwargs", "n_agents", "learning_rate"):
            failed(["--size", "smoke", option, f"{key}:{code}"], capsys)
    assert not (tmp_path / "evaluated").exists()


def test_from_a_shell(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sb3_saf.train", "--algo", "saf", "--env-kwargs", "coordination:99"]
    result = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True)
    assert result.returncode == 2
    assert result.stderr.splitlines() == [
        "python -m sb3_saf.train: error: coordination must be an integer from 1 to 10 (1 <= coordination <= n_agents), "
        "got 99"
    ]
