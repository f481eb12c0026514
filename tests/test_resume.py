"""Interrupted and resumed runs equal the uninterrupted run, bit for bit."""

from __future__ import annotations

import functools
import itertools
import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from sb3_contrib import TRPO, MaskablePPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import sb3_saf
from sb3_saf import (
    PQN,
    QPLEX,
    CheckpointError,
    TeamCheckpointCallback,
    TeamEvalCallback,
    TeamMonitor,
    resumable_learn,
    resume,
)
from sb3_saf.checkpoints.learning import CheckpointFolder
from sb3_saf.envs.curriculum import Curriculum
from sb3_saf.teams.vec_env import layers
from tests.toy_envs import CounterEnv, LazyEnv, StateEnv, StreamEnv, TellingEnv
from tests.weights import weights_of

N_AGENTS, N_GAMES, N_STEPS = 2, 3, 8
ROLLOUT = N_AGENTS * N_GAMES * N_STEPS
#: Rollouts of a run; two interruptions fit into it.
ROLLOUTS = 4
WHOLE = ROLLOUTS * ROLLOUT
TASK: dict[str, Any] = {"n_agents": N_AGENTS, "grid_size": 7, "n_treasures": 3, "coordination": 1, "max_cycles": 10}
LIGHT = {"features_extractor_class": sb3_saf.LightEncoder, "net_arch": [8]}


MADE: list[BaseAlgorithm] = []


@pytest.fixture(autouse=True)
def _close_what_was_made() -> Iterator[None]:
    yield
    for model in MADE:
        assert model.env is not None
        model.env.close()
    MADE.clear()


class Lightning(BaseCallback):
    """Ends training in the middle of a rollout, as a crash or a signal would."""

    def __init__(self, after_calls: int, error: type[BaseException] | signal.Signals = RuntimeError) -> None:
        super().__init__()
        self.strikes_in, self.strike = after_calls, error

    def _on_step(self) -> bool:
        self.strikes_in -= 1
        if self.strikes_in == 0:
            if isinstance(self.strike, signal.Signals):
                signal.raise_signal(self.strike)
            else:
                raise self.strike
        return True


def make(
    folder: Path | None = None,
    algorithm: Any = PPO,
    policy: str = "SAFPolicy",
    env: Any = None,
    games_seed: int = 3,
    coordination: int = 1,
    **arguments: Any,
) -> Any:
    """Create a model as a user's script does at every start."""
    monitor_dir, logs = (None, None) if folder is None else (str(folder), str(folder / "tb"))
    level = TASK | {"coordination": coordination}
    env = env or sb3_saf.make_team_env("TeamTogether", N_GAMES, seed=games_seed, monitor_dir=monitor_dir, **level)
    settings: dict[str, Any] = {} if issubclass(algorithm, QPLEX) else {"n_steps": N_STEPS}
    if algorithm is PPO:
        settings |= {"batch_size": ROLLOUT // 2, "n_epochs": 2, "rollout_buffer_class": sb3_saf.TeamRolloutBuffer}
    settings |= {"seed": 3, "policy_kwargs": dict(LIGHT)} | arguments  # A2C adds its optimiser to them
    MADE.append(algorithm(policy, env, tensorboard_log=logs, **settings))
    return MADE[-1]


def evaluation(folder: Path | None = None, seed: int = 50, **arguments: Any) -> TeamEvalCallback:
    env = sb3_saf.make_team_env("TeamTogether", 2, seed=seed, **TASK)
    path = None if folder is None else str(folder)
    settings: dict[str, Any] = {"n_eval_episodes": 2, "eval_freq": 24, "deterministic": False} | arguments
    return TeamEvalCallback(env, verbose=0, log_path=path, **settings)


def learn(folder: Path, model: Any, *callbacks: BaseCallback, rollouts: int = ROLLOUTS, **arguments: Any) -> Any:
    """Learn with a checkpoint at every rollout."""
    every_rollout: dict[str, Any] = {"every_game_steps": 1}
    return resumable_learn(model, rollouts * ROLLOUT, folder, callbacks, tb_log_name="run", **every_rollout | arguments)


def struck(folder: Path, model: Any, after_calls: int, *others: BaseCallback) -> None:
    """Run until it is interrupted in the middle of a rollout."""
    with pytest.raises(RuntimeError):
        learn(folder, model, *others, Lightning(after_calls))


def go_on(folder: Path, model: Any, *others: BaseCallback) -> Any:
    return learn(folder, model, *others, Lightning(-1))


@functools.cache
def undisturbed() -> dict[str, bytes]:
    """Return the weights of a whole run of PPO without checkpoints."""
    return weights_of(make().learn(WHOLE))


def qplex(train_freq: int = 6, **parts: Any) -> Any:
    """Create QPLEX, whose replay buffer holds half of the run."""
    settings: dict[str, Any] = {"buffer_size": 48, "learning_starts": 12, "batch_size": 8, "train_freq": train_freq}
    settings |= {"exploration_fraction": 0.9, "target_update_interval": 30}
    return make(algorithm=QPLEX, policy="QPLEXPolicy", policy_kwargs=LIGHT | parts, **settings)


def normalised(**arguments: Any) -> Any:
    rows = sb3_saf.make_team_env("TeamTogether", N_GAMES, **TASK).venv
    return make(env=sb3_saf.CentralizedValueWrapper(VecNormalize(rows, norm_obs=False, **arguments), N_AGENTS))


def masked() -> Any:
    """Create a model whose legal actions change from step to step."""
    env = sb3_saf.make_team_env(TellingEnv, N_GAMES, seed=3)
    settings: dict[str, Any] = {"batch_size": ROLLOUT, "n_epochs": 1, "policy_kwargs": {"net_arch": [8]}}
    return make(algorithm=MaskablePPO, policy="SAFMaskablePolicy", env=env, **settings)


def native(**arguments: Any) -> Callable[[], Any]:
    return lambda: make(env=sb3_saf.make_team_env("TeamTogether", N_GAMES, seed=3, **TASK | arguments))


def staged(game_steps: int = 30, stagger: bool = False, **params: Any) -> Callable[[], Any]:
    stages = [sb3_saf.Stage(24, {"n_treasures": 1}), sb3_saf.Stage(game_steps, {"n_treasures": 2, **params})]
    return native(curriculum=stages, stagger=stagger)


MODELS: dict[str, Callable[[], Any]] = {
    "PPO": make,
    "schedules and normalised values": lambda: make(
        learning_rate=lambda progress: 1e-2 * progress,
        clip_range=lambda progress: 0.2 * progress,
        policy_kwargs=LIGHT | {"normalize_values": True},
    ),
    "A2C": lambda: make(algorithm=A2C, policy="MAPPOPolicy"),
    "TRPO": lambda: make(algorithm=TRPO, policy="IPPOPolicy", batch_size=ROLLOUT),
    "MaskablePPO": masked,
    "QPLEX with memory": lambda: qplex(memory="lstm", sequence_length=4, burn_in=2),
    "PQN": lambda: make(algorithm=PQN, policy="PQNPolicy", rollout_steps=8, batch_size=8),
    "VecNormalize": normalised,
    "PPO with memory": lambda: make(
        rollout_buffer_class=sb3_saf.TeamRolloutBuffer, policy_kwargs=LIGHT | {"memory": "lstm", "memory_size": 8}
    ),
    "stages, staggered": staged(60, stagger=True),
}
#: Those that are evaluated while they train.
EVALUATED = ("QPLEX with memory", "PPO with memory", "stages, staggered")


def test_callbacks_of_an_evaluation_are_counted_once(tmp_path: Path) -> None:
    def new_best() -> TeamEvalCallback:
        return evaluation(callback_on_new_best=Lightning(-1))

    struck(tmp_path, make(), 20, new_best())
    assert go_on(tmp_path, make(), new_best()).num_timesteps == WHOLE


@pytest.mark.parametrize("name", MODELS)
def test_a_run_that_was_struck_ends_as_the_undisturbed_one(name: str, tmp_path: Path) -> None:
    """First in its first step, when no part has a state yet; evaluations between do not touch a memory."""

    def evaluations() -> list[TeamEvalCallback]:
        return [evaluation()] if name in EVALUATED else []

    whole = go_on(tmp_path / "whole", MODELS[name](), *evaluations())
    for calls in (1, 2 * N_STEPS + 2):
        struck(tmp_path / "run", MODELS[name](), calls, *evaluations())
    np.random.seed(77)  # noqa: NPY002 - another process has other states
    th.manual_seed(77)
    model = go_on(tmp_path / "run", MODELS[name](), *evaluations())
    assert model.num_timesteps == WHOLE and model._n_updates == whole._n_updates > 0
    assert weights_of(model) == weights_of(whole)
    if name == "PPO":
        assert weights_of(model) == undisturbed()


def test_evaluations_monitor_and_tensorboard_go_on_without_gap_or_repetition(tmp_path: Path) -> None:
    for folder, strikes in ((tmp_path / "undisturbed", ()), (tmp_path / "run", (12, 13))):
        for calls in strikes:
            struck(folder / "checkpoints", make(folder), calls, evaluation(folder))
        go_on(folder / "checkpoints", make(folder), evaluation(folder))
    one, other = tmp_path / "undisturbed", tmp_path / "run"
    with np.load(one / "evaluations.npz") as a, np.load(other / "evaluations.npz") as b:
        assert len(a["results"]) == ROLLOUTS and all(np.array_equal(a[name], b[name]) for name in a.files)
    lines = [
        [line.rsplit(",", 1)[0] for line in (f / "monitor.csv").read_text().splitlines()[1:]] for f in (one, other)
    ]
    assert lines[0] == lines[1] and len(lines[0]) == 1 + N_GAMES * (ROLLOUTS * N_STEPS // TASK["max_cycles"])
    assert [path.name for path in (other / "tb").iterdir()] == ["run_1"]
    for tag in ("train/loss", "rollout/ep_rew_mean", "eval/mean_reward"):
        assert scalars(one, tag) == scalars(other, tag) != []


def scalars(folder: Path, tag: str) -> list[tuple[int, float]]:
    events = EventAccumulator(str(folder / "tb" / "run_1")).Reload()
    return [(event.step, event.value) for event in events.Scalars(tag)]


def test_tensorboard_may_begin_with_the_resumed_part(tmp_path: Path) -> None:
    struck(tmp_path / "checkpoints", make(), N_STEPS + 2)
    model = make()
    model.tensorboard_log = str(tmp_path / "tb")
    go_on(tmp_path / "checkpoints", model)
    struck(tmp_path / "other", make(), N_STEPS + 2)
    other = make()
    other.tensorboard_log = model.tensorboard_log
    go_on(tmp_path / "other", other)
    folders = sorted((tmp_path / "tb").iterdir())
    assert [folder.name for folder in folders] == ["resumed_1", "resumed_2"]
    assert "train/loss" in EventAccumulator(str(folders[0])).Reload().Tags()["scalars"]


def test_the_folder_is_locked_until_the_last_callback_has_ended(tmp_path: Path) -> None:
    class Late(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_training_end(self) -> None:
            with pytest.raises(CheckpointError, match="another run writes checkpoints"):
                CheckpointFolder(tmp_path).acquire()

    resumable_learn(make(), ROLLOUT, tmp_path, Late())
    CheckpointFolder(tmp_path).acquire()


def test_resume_alone(tmp_path: Path) -> None:
    checkpoints = TeamCheckpointCallback(tmp_path, every_game_steps=1)
    with pytest.raises(RuntimeError):
        make().learn(WHOLE, [checkpoints, Lightning(20)])
    checkpoints.store.release()  # as at the end of a process
    model = make()
    path = resume(tmp_path, model)
    assert path.name == f"checkpoint-{2 * N_STEPS * N_GAMES:012d}.ckpt"
    model.learn(WHOLE - model.num_timesteps, TeamCheckpointCallback(tmp_path), reset_num_timesteps=False)
    assert weights_of(model) == undisturbed()


def fingerprint(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != "lock"}


#: Arguments of the model, or of its evaluation, in the second start of a run, and what the error says.
DIFFERENCES: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "hyperparameter": ({"gamma": 0.5}, {}, "model.gamma was 0.99, now 0.5"),
    "schedule": ({"clip_range": lambda left: 0.2 * left}, {}, "model.clip_range was"),
    "network": ({"policy_kwargs": LIGHT | {"net_arch": [9]}}, {}, "policy_kwargs.net_arch"),
    "policy": ({"policy": "MAPPOPolicy"}, {}, "model.policy was 'SAFPolicy', now 'MAPPOPolicy'"),
    "seed": ({"seed": 4}, {}, "model.seed was 3, now 4"),
    "games' seeds": ({"seed": None, "games_seed": 4}, {}, "environment.seeds of the games was"),
    "game": ({"coordination": 2}, {}, "coordination was 1, now 2"),
    "episodes of evaluation": ({}, {"n_eval_episodes": 3}, "TeamEvalCallback.n_eval_episodes was 2, now 3"),
    "games of evaluation": ({}, {"seed": 51}, "TeamEvalCallback.environment.seeds of the games was"),
}


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int | None], Path]:
    """Return folders of finished runs, by the model's seed."""

    @functools.cache
    def folder_of(seed: int | None) -> Path:
        folder = tmp_path_factory.mktemp("run")
        resumable_learn(make(folder, seed=seed), ROLLOUT, folder / "ck", evaluation(folder), every_game_steps=1)
        return folder

    return folder_of


@pytest.mark.parametrize("name", DIFFERENCES)
def test_another_run_is_named_before_anything_is_touched(name: str, finished_run: Callable[[int | None], Path]) -> None:
    folder = finished_run(None if name == "games' seeds" else 3)  # a model's seed also seeds its games
    before = fingerprint(folder)
    of_model, of_evaluation, message = DIFFERENCES[name]
    with pytest.raises(CheckpointError, match=message):
        resumable_learn(make(folder, **of_model), 2 * ROLLOUT, folder / "ck", evaluation(folder, **of_evaluation))
    assert fingerprint(folder) == before


def counting(**arguments: Any) -> Callable[[], Any]:
    """Make a model of somebody else's game, whose arguments only a function knows."""
    game: Any = lambda: LazyEnv(**arguments)  # noqa: E731
    return lambda: make(env=sb3_saf.make_team_env(game, N_GAMES, seed=3), policy_kwargs={"net_arch": [8]})


CHANGES: dict[str, tuple[Callable[[], Any], Callable[[], Any], str]] = {
    "time limit": (native(), native(time_limit="bootstrap"), "CentralizedValueWrapper.time_limit was 'terminal'"),
    "reward": (native(team_reward="sum"), native(team_reward="mean"), "SharedReward.team_reward was 'sum', now 'mean'"),
    "game of others": (counting(max_cycles=5), counting(max_cycles=6), "max_cycles was 5, now 6"),
    "wrapper": (normalised, lambda: normalised(clip_reward=2.0), "VecNormalize.clip_reward was 10.0, now 2.0"),
    "later stage": (staged(), staged(coordination=2), "Curriculum.stage 1.*coordination was 1, now 2"),
    "length of a stage": (staged(), staged(60), r"Curriculum.ends was \[24, 54\], now \[24, 84\]"),
    "updates": (qplex, lambda: qplex(train_freq=12), r"model.train_freq was \[6, .*now \[12, "),
    "replay buffer": (qplex, lambda: make(algorithm=QPLEX, policy="QPLEXPolicy"), "buffer_size was 48, now"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_another_game_reward_wrapper_or_stage_is_named(name: str, tmp_path: Path) -> None:
    before, after, difference = CHANGES[name]
    resumable_learn(before(), ROLLOUT, tmp_path)
    with pytest.raises(CheckpointError, match=difference):
        resume(tmp_path, after())
    resume(tmp_path, before())


def test_another_argument_of_a_callback_is_named(tmp_path: Path) -> None:
    resumable_learn(make(ent_coef=0.01), ROLLOUT, tmp_path, sb3_saf.EntropySchedule())
    with pytest.raises(CheckpointError, match=r"EntropySchedule.end was 0.0, now 0.001"):
        resume(tmp_path, make(ent_coef=0.01), sb3_saf.EntropySchedule(0.001))
    with pytest.raises(CheckpointError, match=r"callbacks.order was \['EntropySchedule'\], now \['Lightning'\]"):
        resume(tmp_path, make(ent_coef=0.01), Lightning(-1))
    resume(tmp_path, make(ent_coef=0.01), sb3_saf.EntropySchedule())


def test_ctrl_c_in_an_update_leaves_the_models_settings(tmp_path: Path) -> None:
    """The same model goes on in the same process, as a cell of a notebook that is run again."""
    model, updates = make(ent_coef=0.01), itertools.count(1)

    def strike(*_: object) -> None:
        if next(updates) == 6:  # in the second update
            raise KeyboardInterrupt

    hook = model.policy.optimizer.register_step_post_hook(strike)
    with pytest.raises(KeyboardInterrupt):
        resumable_learn(model, WHOLE, tmp_path, sb3_saf.EntropySchedule())
    hook.remove()
    assert model.ent_coef == 0.01
    resumable_learn(model, WHOLE, tmp_path, sb3_saf.EntropySchedule())
    whole = resumable_learn(make(ent_coef=0.01), WHOLE, tmp_path / "whole", sb3_saf.EntropySchedule())
    assert weights_of(model) == weights_of(whole)


def test_folders_and_algorithms_that_cannot_be_resumed(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="found none"):
        resume(tmp_path / "elsewhere", make())
    (tmp_path / "file").touch()
    with pytest.raises(CheckpointError, match="cannot keep checkpoints in"):
        resumable_learn(make(), ROLLOUT, tmp_path / "file")
    resumable_learn(make(), ROLLOUT, tmp_path / "run")
    with pytest.raises(CheckpointError, match="has checkpoints of another run"):
        make().learn(ROLLOUT, TeamCheckpointCallback(tmp_path / "run"))
    with pytest.raises(CheckpointError, match=r"exact resume is for PPO.*QPLEX, got DQN"):
        resumable_learn(DQN("MlpPolicy", "CartPole-v1", buffer_size=100), 10, tmp_path / "dqn")


def test_other_conditions_are_told_and_the_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    resumable_learn(make(), ROLLOUT, tmp_path)
    monkeypatch.setattr("sb3_saf.checkpoints.states.package_version", lambda: "9.9")
    with pytest.warns(UserWarning, match=r"sb3_saf was .*, now '9\.9'"):
        model = resumable_learn(make(), WHOLE, tmp_path)
    assert weights_of(model) == undisturbed()


def test_ctrl_c_stops_qplex_at_the_next_step_and_the_second_one_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    class CtrlC(Lightning):
        def _on_step(self) -> bool:
            self.strikes_in -= 1
            for _ in range(times if self.strikes_in == 0 else 0):
                signal.raise_signal(signal.SIGINT)
            return True

    for times, saved_at in ((1, 4), (2, 0)):
        folder = tmp_path / str(times)
        with pytest.raises(KeyboardInterrupt):
            resumable_learn(qplex(), WHOLE, folder, CtrlC(4), every_game_steps=10**6)
        assert f"checkpoint-{saved_at * N_GAMES:012d}.ckpt is saved" in capsys.readouterr().out


def test_signals_at_the_end_of_qplex_are_heard(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    class AtTheEnd(Lightning):
        def _on_training_end(self) -> None:
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(SystemExit):
        resumable_learn(qplex(), WHOLE, tmp_path, AtTheEnd(-1))
    assert "is saved; start the same command again" in capsys.readouterr().out


def test_steps_are_counted_from_the_beginning_of_the_run(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="counts the whole run, which begins at 0 also with a trained model"):
        resumable_learn(make(), WHOLE, tmp_path, reset_num_timesteps=False)


def foreign(game: type[CounterEnv], n_cpus: int = 1, seed: int | None = 3) -> Any:
    env = sb3_saf.make_team_env(functools.partial(game, max_cycles=5), N_GAMES, seed=3, n_cpus=n_cpus)
    return make(env=env, seed=seed, policy_kwargs={"net_arch": [8]})


@functools.cache
def undisturbed_foreign(game: Any) -> dict[str, bytes]:
    return weights_of(foreign(game).learn(WHOLE))


@pytest.mark.parametrize(("game", "n_cpus"), [(LazyEnv, 2), (StateEnv, 1)])
def test_games_of_others_go_on_bit_for_bit(game: Any, n_cpus: int, tmp_path: Path) -> None:
    for calls in (1, 20):
        struck(tmp_path / "ck", foreign(game, n_cpus), calls)
    going_on = foreign(game, n_cpus)
    going_on.set_logger(configure(str(tmp_path / "log"), ["log"]))
    model = go_on(tmp_path / "ck", going_on)
    going_on.logger.close()
    is_pickled = "they were unpickled from it" in (tmp_path / "log" / "log.txt").read_text()
    assert is_pickled == (game is LazyEnv)
    assert weights_of(model) == undisturbed_foreign(game)
    assert model.num_timesteps == WHOLE


@pytest.mark.parametrize("seed", [3, None])
def test_games_that_cannot_be_copied_begin_new_episodes_and_say_so_at_the_start(
    seed: int | None, tmp_path: Path
) -> None:
    with pytest.raises(CheckpointError, match=r"SuperSuitVecEnv cannot give the state.*exact=False"):
        resumable_learn(foreign(StreamEnv, seed=seed), ROLLOUT, tmp_path / "exact", exact=True)
    told = r"SuperSuitVecEnv cannot give the state of its games.*by pickle: .* without stream.*begins new episodes"
    with pytest.warns(UserWarning, match=told), pytest.raises(RuntimeError):
        learn(tmp_path / "run", foreign(StreamEnv, seed=seed), Lightning(20))
    model = foreign(StreamEnv, seed=seed)
    model.set_logger(configure(str(tmp_path / "log"), ["log"]))
    with pytest.warns(UserWarning, match=told):
        go_on(tmp_path / "run", model)
    model.logger.close()
    assert model.num_timesteps == WHOLE
    log = (tmp_path / "log" / "log.txt").read_text()
    assert "new episodes begin" in log and "cannot give the state of its games" in log


@pytest.mark.filterwarnings("ignore:SuperSuitVecEnv cannot give")
@pytest.mark.parametrize("game", [StreamEnv, LazyEnv])
def test_nothing_but_the_games_begins_anew(game: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Games that cannot be copied, and another user's: stage, statistics, files and counters go on."""
    game_steps, folder = ROLLOUT // N_AGENTS, str(tmp_path)

    def start() -> tuple[Any, TeamEvalCallback]:
        stages = [sb3_saf.Stage(game_steps, {"max_cycles": 3})]
        env = sb3_saf.make_team_env(game, N_GAMES, seed=3, monitor_dir=folder, curriculum=stages, max_cycles=5)
        env = sb3_saf.CentralizedValueWrapper(VecNormalize(env.venv, norm_obs_keys=["obs"]))
        eval_env = sb3_saf.CentralizedValueWrapper(
            VecNormalize(sb3_saf.make_team_env(game, 2, seed=50, max_cycles=5).venv, norm_obs_keys=["obs"])
        )
        model = make(env=env, policy_kwargs={"net_arch": [8]})
        return model, TeamEvalCallback(eval_env, n_eval_episodes=2, eval_freq=game_steps, log_path=folder, verbose=0)

    model, evaluation = start()
    struck(tmp_path / "ck", model, 20, evaluation)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other user"))
    model, evaluation = start()
    message = "not signed with this user's key.*New episodes begin" if game is LazyEnv else None
    with pytest.warns(UserWarning, match=message) if message else nullcontext():
        go_on(tmp_path / "ck", model, evaluation)
    assert evaluation.evaluations_game_steps == [game_steps * n for n in (1, 2, 3, 4)]
    normalised, monitor, curriculum = (
        next(layer for layer in layers(model.env) if isinstance(layer, kind))
        for kind in (VecNormalize, TeamMonitor, Curriculum)
    )
    assert (curriculum.game_steps, curriculum.stage) == (4 * game_steps, 1)
    rows_and_resets = N_AGENTS * N_GAMES * (4 * N_STEPS + 2)
    assert normalised.obs_rms["obs"].count == pytest.approx(rows_and_resets, abs=1)
    lines = (tmp_path / "monitor.csv").read_text().splitlines()
    assert len(lines) == 2 + monitor.episode_count and not list(tmp_path.glob("monitor.csv.*"))


def test_pickled_games_of_strangers_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    struck(tmp_path / "ck", foreign(LazyEnv), 20)
    shutil.copytree(tmp_path / "ck", tmp_path / "trusted")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other user"))
    opened: list[object] = []
    monkeypatch.setattr("sb3_saf.envs.game_copies._Unpickler.load", lambda reader: opened.append(reader))
    with pytest.raises(CheckpointError, match="not signed with this user's key"):
        resume(tmp_path / "ck", foreign(LazyEnv), [Lightning(-1)], exact=True)
    with pytest.warns(UserWarning, match="not signed with this user's key.*New episodes begin"):
        resume(tmp_path / "ck", foreign(LazyEnv), [Lightning(-1)])
    assert not opened
    monkeypatch.undo()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other user"))
    model = resumable_learn(foreign(LazyEnv), WHOLE, tmp_path / "trusted", [Lightning(-1)], trust_games=True)
    assert weights_of(model) == undisturbed_foreign(LazyEnv)


@pytest.mark.parametrize(
    ("error", "ending"),
    [(KeyboardInterrupt, KeyboardInterrupt()), (signal.SIGTERM, SystemExit(128 + signal.SIGTERM))],
    ids=["Ctrl-C", "SIGTERM"],
)
def test_what_ends_it_saves_and_says_how_to_go_on(
    error: Any, ending: BaseException, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(type(ending)) as ended:
        resumable_learn(make(), WHOLE, tmp_path, Lightning(20, error), every_game_steps=10**9)
    assert ended.value.args == ending.args
    assert (
        f"checkpoint-{2 * N_STEPS * N_GAMES:012d}.ckpt is saved; start the same command again"
        in capsys.readouterr().out
    )
    assert weights_of(go_on(tmp_path, make())) == undisturbed()


#: One after another in one process, whose children have its imports and compiled code.
KILLS = """
import json
import torch.utils.tensorboard
from tests.kill_harness import Games, Moment, kill_in_a_row, make_run

moments = [Moment("rollout", 40), Moment("update", 6), Moment("writing", 5)]
make_run("qplex-gru", None).warm_up()
print(json.dumps(kill_in_a_row("qplex-gru", Games(), 4, moments)))
"""


def test_killed_runs_end_bit_equal() -> None:
    """PPO's runs are killed in test_experiments_ray.py."""
    command = [sys.executable, "-c", KILLS]
    out = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, timeout=240).stdout
    (*phases, writing), is_equal = json.loads(out)
    assert is_equal and phases == ["rollout", "update"] and writing in ("writing", "evaluation")
