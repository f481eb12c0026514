"""``python -m sb3_saf.train``: RL-Zoo3's options and folders, in game steps, on any environment."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pettingzoo
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from hecogrid_envs.play import main as play_main
from sb3_saf import QPLEX, SAFPolicy, evaluate_team, quickstart
from sb3_saf.experiments.cli import main as experiments_main
from sb3_saf.suites.registry import find_environment
from sb3_saf.training import enjoy as zoo_enjoy
from sb3_saf.training import folders
from sb3_saf.training import plot as zoo_plot
from sb3_saf.training import train as zoo_train
from sb3_saf.training.folders import Run
from sb3_saf.training.replay import main as replay_main
from sb3_saf.training.replay import write_page
from sb3_saf.training.run import GameStepsProgressBar, ProgressLines, RunOptions
from sb3_saf.training.run import train as train_settings
from sb3_saf.training.settings import Settings, load_settings
from tests.toy_envs import CounterEnv
from tests.weights import weights_of

ENV = "TeamTogether-v0"


def train(folder: Path, *options: str, algo: str = "saf") -> Path:
    """Train 80 game steps, by default, at smoke size with seed 3; return the run's folder."""
    before = {path.parent for path in folder.glob("*/*/monitor.csv")}
    given = ("--size", "smoke", "-n", "80", "--seed", "3", "--eval-episodes", "4", "--env", ENV, "-f", str(folder))
    zoo_train.main(["--algo", algo, *given, *options])
    (run,) = {path.parent for path in folder.glob("*/*/monitor.csv")} - before
    return run


@pytest.fixture(scope="module")
def settings() -> Settings:
    return load_settings("saf", ENV, "smoke", overrides={"game_steps": 80})


@pytest.fixture(scope="module")
def by_hand(settings: Settings) -> dict[str, bytes]:
    model = settings.make_model(settings.make_env(3), 3)
    model.learn(settings.total_timesteps)
    return weights_of(model)


def test_options_do_not_change_what_is_learned(settings: Settings, by_hand: dict[str, bytes], tmp_path: Path) -> None:
    assert by_hand == weights_of(train_settings(settings, 3))
    frequencies: dict[str, Any] = {"eval_freq": 12, "save_freq": 40, "inspect_freq": 100, "checkpoint_freq": None}
    options = RunOptions(eval_episodes=4, tensorboard_log=tmp_path, **frequencies)
    folder = tmp_path / "run"
    assert by_hand == weights_of(train_settings(settings, 3, folder, options))
    assert {"model.zip", "best_model.zip", "evaluations.npz", "monitor.csv", "rl_model_80_steps.zip"} <= {
        path.name for path in folder.iterdir()
    }
    assert not (folder / "checkpoints").exists()


def test_tensorboard_has_the_inside_of_the_policy_and_training_does_not_notice(tmp_path: Path) -> None:
    quick = ("--eval-freq", "-1", "-n", "40")
    plain = train(tmp_path, *quick, algo="qplex")
    watched = train(tmp_path, *quick, "-tb", str(tmp_path / "tb"), "--inspect-freq", "100", algo="qplex")
    assert weights_of(QPLEX.load(plain / f"{ENV}.zip")) == weights_of(QPLEX.load(watched / f"{ENV}.zip"))
    (file,) = (tmp_path / "tb").glob("*/*/events.*")
    found = EventAccumulator(str(file)).Reload()
    assert [event.step for event in found.Scalars("team/return")] == [0, 40]
    assert {"episode/film", "critic/calibration"} <= set(found.Tags()["images"])
    assert b"TeamTogether" in found.PluginTagToContent("hparams")["_hparams_/session_start_info"]


def test_value_based_algorithms_are_evaluated_without_exploring(tmp_path: Path) -> None:
    """QPLEX still explores with every second action here; SAF is evaluated with sampled actions."""
    run = train(tmp_path, "--eval-freq", "40", "-n", "40", "-params", "exploration_final_eps:0.5", algo="qplex")
    games = load_settings("qplex", ENV, "smoke").make_env(3, evaluation=True, n_envs=4)
    expected = evaluate_team(QPLEX.load(run / "best_model.zip"), games, 4, deterministic=True)
    with np.load(run / "evaluations.npz") as arrays:
        assert arrays["results"].tolist() == [expected.returns]


def test_the_command_trains_what_settings_train_and_frequencies_count_game_steps(
    by_hand: dict[str, bytes], tmp_path: Path
) -> None:
    run = train(tmp_path, "--eval-freq", "30", "--save-freq", "40")
    with np.load(run / "evaluations.npz") as arrays:
        # Four games play 4 steps at a time; the final policy is always evaluated.
        assert arrays["game_steps"].tolist() == [32, 60, 80]
        assert arrays["results"].shape == (3, 4)
    assert sorted(path.name for path in run.glob("rl_model_*")) == ["rl_model_40_steps.zip", "rl_model_80_steps.zip"]
    assert PPO.load(run / "rl_model_40_steps.zip").num_timesteps == 40 * 4
    model = PPO.load(run / f"{ENV}.zip")
    assert model.num_timesteps == 80 * 4 and weights_of(model) == by_hand


def test_short_runs_train_more_than_they_evaluate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """At most one evaluation for each of the three rollouts, at any frequency."""
    run = train(tmp_path, "--eval-freq", "1", "-n", "120")
    with np.load(run / "evaluations.npz") as arrays:
        steps = arrays["game_steps"]
    assert len(steps) == 4 and len(set((steps[:-1] - 1) // 40)) == 3 and steps[-1] == 120
    assert re.search(r"^Evaluation took \d+% of \d+ s", capsys.readouterr().out, re.MULTILINE)


def test_evaluation_plays_its_level(tmp_path: Path) -> None:
    levels = ("--env-kwargs", "max_cycles:6", "coordination:2", "--eval-env-kwargs", "max_cycles:5")
    run = train(tmp_path, *levels, "--eval-freq", "80")
    with np.load(run / "evaluations.npz") as arrays:
        assert set(arrays["ep_lengths"].ravel()) == {5}
    assert {line.split(",")[1] for line in (run / "monitor.csv").read_text().splitlines()[2:]} == {"6"}


def test_a_run_keeps_what_it_was(tmp_path: Path) -> None:
    logs = ("-tb", str(tmp_path / "tb"), "--inspect-freq", "-1")
    run = train(tmp_path, *logs, "-params", "gamma:0.9", "policy_kwargs:{n_slots: 3}", algo="saf-no-pool")
    assert run == tmp_path / "saf-no-pool" / f"{ENV}_1"
    description = Run(run).description
    overrides = {"gamma": 0.9, "policy_kwargs": {"n_slots": 3}}
    settings = load_settings("saf-no-pool", ENV, "smoke", overrides=overrides | {"game_steps": 80})
    assert description["settings"] == settings.as_dict()
    assert description["seed"] == 3 and description["options"]["eval_episodes"] == 4
    assert {"stable-baselines3", "sb3-saf", "commit"} <= set(description["versions"])
    assert description["command"].startswith("python -m sb3_saf.train --algo saf-no-pool --size smoke")
    assert "'policy_kwargs:{n_slots: 3}'" in description["command"]
    assert list((tmp_path / "tb" / ENV / "saf-no-pool_1").glob("events.*"))
    policy = PPO.load(run / f"{ENV}.zip").policy
    assert isinstance(policy, SAFPolicy)
    assert asdict(policy.parts)["n_slots"] == 3


def test_runs_are_numbered_and_never_shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert folders.make_run_folder(tmp_path, "saf", ENV).name == f"{ENV}_1"
    # As if another process had created the folder between check and use.
    found: list[Any] = [[], [(1, tmp_path)]]
    monkeypatch.setattr(folders, "runs_of", lambda *_: found.pop(0))
    assert folders.make_run_folder(tmp_path, "saf", ENV).name == f"{ENV}_2"
    monkeypatch.undo()
    assert [number for number, _ in folders.runs_of(tmp_path, "saf", ENV)] == [1, 2]


def test_a_model_is_trained_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = train(tmp_path, "--eval-freq", "-1", "-n", "40") / f"{ENV}.zip"
    optimizer = "policy_kwargs:{optimizer_kwargs: {betas: [0.5, 0.6]}}"
    again = ("-i", str(first), "-params", "learning_rate:1e-30", optimizer)
    second = train(tmp_path, "--eval-freq", "-1", "-n", "40", *again) / f"{ENV}.zip"
    assert PPO.load(second).policy.optimizer.param_groups[0]["betas"] == (0.5, 0.6)  # not those of the first
    assert f"the weights and the optimiser of {first}; no code is loaded" in capsys.readouterr().out
    other = ["--algo", "mappo", "--size", "smoke", "--env", ENV, "-f", str(tmp_path), "-i", str(first)]
    assert "do not fit MAPPOPolicy" in failed(other, capsys)
    damaged = tmp_path / "damaged.zip"
    damaged.write_bytes(first.read_bytes()[:-100])
    assert "damaged.zip does not hold the tensors of a saved model" in failed([*other, "-i", str(damaged)], capsys)
    other_types = PPO.load(first, device="cpu")
    other_types.policy.double()
    other_types.save(damaged)
    assert "and torch.float64" in failed([*other, "-i", str(damaged), "--algo", "saf"], capsys)
    other_shapes = PPO.load(first, device="cpu")
    state = next(iter(other_shapes.policy.optimizer.state.values()))
    state["exp_avg"] = state["exp_avg"][:1]
    other_shapes.save(damaged)
    assert "averages have other shapes" in failed([*other, "-i", str(damaged), "--algo", "saf"], capsys)
    assert "another algorithm's" in failed([*other, "--algo", "saf", "-params", "algorithm:A2C"], capsys)
    pairs = zip(*(PPO.load(path).policy.state_dict().values() for path in (first, second)), strict=True)
    assert all(th.allclose(a.float(), b.float(), atol=1e-5) for a, b in pairs)


def test_the_progress_bar_counts_game_steps() -> None:
    settings = load_settings("ippo", ENV, "smoke", overrides={"game_steps": 80})
    bar = GameStepsProgressBar()
    settings.make_model(settings.make_env(0), 0).learn(settings.total_timesteps, callback=bar)
    assert (bar.pbar.n, bar.pbar.total) == (80, 80)
    GameStepsProgressBar().close()  # of a training that never started


def test_a_line_for_every_tenth(capsys: pytest.CaptureFixture[str]) -> None:
    settings = load_settings("ippo", ENV, "smoke", overrides={"game_steps": 80})
    settings.make_model(settings.make_env(0), 0).learn(settings.total_timesteps, callback=ProgressLines(verbose=1))
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(" of ")[0].strip() for line in lines] == [f"{tenth} %" for tenth in range(10, 101, 10)]
    assert "team return" in lines[-1] and "about 0:00:00 (h:mm:ss) to go" in lines[-1]


# --- any environment --------------------------------------------------------------------------------------------------

COUNTER = "tests.toy_envs:CounterEnv"


def test_any_environment_is_trained_watched_drawn_and_tuned(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a folder whose name is a glob pattern, twice, because the second run must find the first."""
    logs = str(tmp_path / "runs [a]")
    short = ("--env", COUNTER, "--size", "smoke", "-n", "80", "-f", logs, "--eval-episodes", "2")
    for _ in range(2):
        zoo_train.main(["--seed", "0", "--env-kwargs", "max_cycles:5", "--eval-freq", "40", *short])
    name = COUNTER.replace(":", "-")
    run = Path(logs) / "saf" / f"{name}_2"
    assert {f"{name}.zip", "best_model.zip", "evaluations.npz", "monitor.csv"} <= {path.name for path in run.iterdir()}
    with np.load(run / "evaluations.npz") as arrays:
        assert set(arrays["ep_lengths"].ravel()) == {5}
    gif = tmp_path / "game.gif"
    monkeypatch.setitem(CounterEnv.metadata, "render_fps", None)
    result = zoo_enjoy.enjoy(["--env", COUNTER, "-f", logs, "--episodes", "2", "--gif", str(gif)])
    assert set(result.lengths) == {5} and gif.is_file()
    zoo_plot.main(["-f", logs, "-o", str(tmp_path / "curves.svg"), "--env", COUNTER])
    assert "<!-- team return -->" in (tmp_path / "curves.svg").read_text()  # not treasures
    zoo_train.main(["-optimize", "--n-trials", "1", *short])
    assert "Best: trial 0" in capsys.readouterr().out


@pytest.mark.parametrize("given", [({}, "human"), ({"render_mode": "rgb_array"},)])
def test_games_that_cannot_be_shown_say_what_they_lack(given: tuple[Any, ...]) -> None:
    with pytest.raises(ValueError, match=r"argument 'render_mode'; to show its games, give it .*--no-render"):
        find_environment("tests.toy_envs:BareEnv").make_game(*given)


def test_environments_by_other_names(tmp_path: Path) -> None:
    pettingzoo.register("parallel", "own/counter-v0", "tests.toy_envs:CounterEnv")
    try:
        assert load_settings("saf", "own/counter-v0", env_kwargs={"n_agents": 3}).n_agents == 3
        assert find_environment("own/counter-v0").folder_name == "own-counter-v0"
    finally:
        del pettingzoo.parallel_registry["own/counter-v0"]
    pettingzoo.register("aec", "own/missing-v0", "no_such_module:env")
    try:
        with pytest.raises(ValueError, match=r"own/missing-v0 cannot be made: .*'no_such_module'"):
            find_environment("own/missing-v0").make_game({})
    finally:
        del pettingzoo.aec_registry["own/missing-v0"]
    turns = find_environment("classic/tictactoe-v3").make_game({})
    turns.reset(seed=0)
    assert turns.step({"player_1": 4, "player_2": 0})[0]["player_2"]["action_mask"].tolist() == [1] * 4 + [0] + [1] * 4


def test_wrappers_of_rl_zoo3(tmp_path: Path) -> None:
    """Each changes what the policy sees, and ``enjoy`` uses all of them."""
    Path(tmp_path / "own.yml").write_text("""
default: {n_envs: 2, n_steps: 10, n_minibatches: 1, rollout_buffer_class: TeamRolloutBuffer}
"tests.toy_envs:CounterEnv":
  env_wrapper: [{supersuit.dtype_v0: {dtype: float64}}]
  vec_env_wrapper: [tests.team_venv.DoublingWrapper, stable_baselines3.common.vec_env.VecCheckNan]
  frame_stack: 2
  normalize: true
  callback: [{stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes: {max_episodes: 2}}]
""")
    given = f"-conf {tmp_path}/own.yml --env {COUNTER} --seed 0 --size smoke -f {tmp_path} --eval-freq -1 -n 400"
    with pytest.warns(UserWarning, match="DoublingWrapper cannot give the state of its games") as told:
        zoo_train.main(given.split())
    assert not any("VecCheckNan" in str(one.message) for one in told)
    run = tmp_path / "saf" / "tests.toy_envs-CounterEnv_1"
    model = PPO.load(run / "tests.toy_envs-CounterEnv.zip")
    assert isinstance(model.observation_space, spaces.Dict)
    own = model.observation_space["obs"]
    assert own.shape == (6,) and own.dtype == np.float32  # two frames of three numbers, converted
    assert model.num_timesteps < 400 * 2  # stopped by the callback
    with np.load(run / "tests.toy_envs-CounterEnv.vecnormalize.npz") as statistics:
        assert set(statistics) == {f"{name} {part}" for name in ("obs", "returns") for part in ("mean", "var", "count")}
        assert statistics["obs mean"].shape == (6,) and statistics["obs count"] > 10
    gif = str(tmp_path / "game.gif")
    zoo_enjoy.enjoy(["--env", COUNTER, "-f", str(tmp_path), "--episodes", "2", "--gif", gif])


def test_every_saved_model_has_its_own_statistics(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Also with stages, whose games have one layer more than those of evaluation; they are read by all commands."""
    given = f"--env {COUNTER} --seed 0 --size smoke -f {tmp_path} --eval-freq 40 --eval-episodes 2 -n 80 --save-freq 40"
    settings = ["normalize:True", "curriculum:[{share: 0.5, max_cycles: 4}]"]
    zoo_train.main([*given.split(), "--verbose", "0", "-params", *settings])
    run = tmp_path / "saf" / "tests.toy_envs-CounterEnv_1"
    counts = {}
    for path in run.glob("*.vecnormalize.npz"):
        with np.load(path) as statistics:
            counts[path.name.partition(".vecnormalize")[0]] = float(statistics["obs count"])
    assert counts["rl_model_40_steps"] < counts["tests.toy_envs-CounterEnv"]
    assert {path.stem for path in run.glob("*.zip")} == set(counts)
    watch = ["--env", COUNTER, "-f", str(tmp_path), "--episodes", "2", "--no-render"]
    zoo_enjoy.enjoy([*watch, "--load-checkpoint", "40"])
    model = run / "rl_model_40_steps.zip"
    write_page(["--model", str(model), "-o", str(tmp_path / "page.html")])
    other = [*given.split(), "-i", str(model)]
    assert "was trained with normalize; give it the same setting" in failed(other, capsys)
    words = "cannot read the statistics of normalize"
    model.with_suffix(".vecnormalize.npz").write_bytes(b"")
    assert words in failed([*watch, "--load-checkpoint", "40"], capsys, zoo_enjoy.main)
    model.with_suffix(".vecnormalize.npz").unlink()
    assert words in failed([*watch, "--load-checkpoint", "40"], capsys, zoo_enjoy.main)
    both = ["--model", str(model), str(run / "best_model.zip")]
    assert "a model with normalize is shown alone" in failed(both, capsys, replay_main)
    assert words in failed(both[:2], capsys, replay_main)
    assert "is a folder without weights.safetensors" in failed(["--model", str(run)], capsys, replay_main)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ("env_wrapper:os.system", "env_wrapper: .*(str|path)"),
        ("callback:os.system", "callback must name classes"),
        ("vec_env_wrapper:os.system", "vec_env_wrapper must be a class"),
        ("vec_env_wrapper:stable_baselines3.common.vec_env.VecFrameStack", "vec_env_wrapper: .*'n_stack'"),
        ("vec_env_wrapper:stable_baselines3.common.vec_env.VecNormalize", "vec_env_wrapper cannot be .* use normalize"),
        ("env_wrapper:nowhere.Wrapper", "cannot import 'nowhere'"),
        ("env_wrapper:supersuit.frame_stak_v1", "frame_stak_v1.*did you mean 'frame_stack_v"),
        ("env_wrapper:string.capwords", "env_wrapper: .*has no attribute 'split'"),
        ("frame_stack:0", "frame_stack=0"),
        ("ent_coef:0.0 callback:sb3_saf.EntropySchedule", "EntropySchedule has nothing to change"),
    ],
)
def test_wrappers_that_are_none(settings: str, words: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    line = failed(["--env", COUNTER, "--size", "smoke", "-f", str(tmp_path), "-params", *settings.split()], capsys)
    assert re.search(words, line), line


def test_weights_and_biases_follow_the_tensorboard_logs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert "pip install wandb" in failed(["--size", "smoke", "-n", "40", "--track"], capsys)
    assert not list(Path("logs").rglob("run.json"))
    given: dict[str, Any] = {}
    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=given.update))
    short = ["--size", "smoke", "-n", "40", "--eval-freq", "-1", "--inspect-freq", "-1", "--env", ENV]
    zoo_train.main([*short, "--track", "-tags", "one"])
    assert (given["project"], given["tags"], given["sync_tensorboard"]) == ("sb3", ["one"], True)
    assert list(Path("runs").rglob("events.*"))


# --- mistakes, and help -----------------------------------------------------------------------------------------------


def failed(
    options: Sequence[str], capsys: pytest.CaptureFixture[str], main: Callable[[Sequence[str]], object] = zoo_train.main
) -> str:
    """Return the one line on stderr with which a command ended."""
    with pytest.raises(SystemExit) as exit_:
        main(options)
    assert exit_.value.code == 2
    (line,) = (line for line in capsys.readouterr().err.splitlines() if "[I " not in line)  # Optuna's
    assert re.match(r"python -m sb3_saf\.\w+( \w+)?: error: ", line)
    return line


def test_mappings_that_are_given_in_parts_are_merged() -> None:
    parts = ("gamma:0.9", "policy_kwargs:{n_slots: 8, n_policies: 2}", "policy_kwargs:{n_policies: 3}", "gamma:0.8")
    options = zoo_train.make_parser().parse_args(["--algo", "saf", "-params", *parts])
    assert options.hyperparams == {"gamma": 0.8, "policy_kwargs": {"n_slots": 8, "n_policies": 3}}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--env-kwargs", "coordination"], ("expects key:value", "coordination:2")),
        (["-params", "policy_kwargs:{n_slots:2}"], ("write a space after the colon of 'n_slots:2'",)),
        (["--eval-env-kwargs", "n_agents:5"], ("evaluation needs the 4 agents of training",)),
        (["-params", "algorithm:MaskablePPO"], ("TeamTogether-v0 has no action masks",)),
        (["-i", "nowhere.zip"], ("--trained-agent must be a .zip",)),
        (["--trial-id", "1"], ("--trial-id needs the --storage and --study-name",)),
        (["--trial-id", "x", "--storage", "s.log", "--study-name", "s"], ("a trial's number or 'best'",)),
        (["--trial-id", "1", "--storage", "s.log", "--study-name", "s"], ("there is no study file s.log",)),
        (["-f", "/dev/null/logs"], ("Not a directory", "/dev/null/logs")),
        (["--game-step", "5"], ("unrecognized arguments", "--help")),
        (["--env", "tests.toy_envs:BareEnv", "--env-kwargs", "size:3"], ("cannot be made with {'size': 3}",)),
        (["--gym-packages", "nowhere"], ("--gym-packages: cannot import 'nowhere'",)),
        (["--vec-env", "subproc"], ("n_cpus=2", "TeamTogether-v0")),
        (["-n", "0"], ("--game-steps: must be at least 1, got 0",)),
        (["-optimize", "--track", "-tb", "logs"], ("leave out --track, -tb, which training takes",)),
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
    assert not list(Path("logs").rglob("run.json"))  # it would be mistaken for the latest run


@pytest.mark.parametrize(
    "command",
    [
        zoo_train.main,
        zoo_enjoy.main,
        zoo_plot.main,
        *(partial(experiments_main, [name]) for name in ("list", "plan", "run", "report", "check", "cell")),
        experiments_main,
        quickstart.main,
        play_main,
    ],
)
def test_every_command_has_help(command: Any, capsys: pytest.CaptureFixture[str]) -> None:
    before = list(command.args[0]) if isinstance(command, partial) else []
    main = command.func if isinstance(command, partial) else command
    with pytest.raises(SystemExit) as ended:
        main([*before, "--help"])
    assert ended.value.code in (0, None)
    assert "usage: " in capsys.readouterr().out


def test_wrong_levels_of_make_train_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        quickstart.main(["--coordination", "6", "--output", str(tmp_path)])
    assert "coordination must be an integer from 1 to 5" in capsys.readouterr().err.splitlines()[-1]
    with pytest.raises(SystemExit, match="2"):
        quickstart.main(["--seed", "-1", "--output", str(tmp_path)])
    assert "seed" in capsys.readouterr().err.splitlines()[-1] and not list(tmp_path.iterdir())
