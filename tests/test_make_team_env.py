from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.envs.supersuit_vec_env import SuperSuitVecEnv
from sb3_saf.evaluation import RandomPolicy, evaluate_team
from sb3_saf.make import make_team_env
from tests.team_venv import TeamVenv
from tests.toy_envs import CounterEnv

SMALL: dict[str, Any] = {"n_agents": 3, "grid_size": 10, "n_treasures": 12, "max_cycles": 6, "view_size": 5}


def test_stock_ppo_trains_on_it_and_logs_team_returns(tmp_path: Path) -> None:
    env = make_team_env("TeamTogether", n_envs=4, seed=0, monitor_dir=str(tmp_path / "run"), **SMALL)
    model = PPO("MultiInputPolicy", env, n_steps=12, batch_size=72, n_epochs=1, device="cpu", seed=0).learn(12 * 12)
    assert model.ep_info_buffer is not None
    assert [entry["l"] for entry in model.ep_info_buffer] == [6] * 8
    collected = sum(entry["r"] for entry in model.ep_info_buffer)
    assert collected > 0
    assert collected == pytest.approx(model.rollout_buffer.rewards.sum())
    env.close()
    lines = (tmp_path / "run" / "monitor.csv").read_text().splitlines()
    assert [float(row["r"]) for row in csv.DictReader(lines[1:])] == [entry["r"] for entry in model.ep_info_buffer]


def test_a_factory_with_parameters() -> None:
    env = make_team_env(CounterEnv, n_envs=2, seed=0, n_agents=3, max_cycles=2)
    assert isinstance(env.unwrapped, SuperSuitVecEnv)
    env.reset()
    obs, rewards, dones, _ = env.step(np.arange(6) % 3)
    assert isinstance(obs, dict)
    assert obs["team"][4, :, :2].tolist() == [[1, 0], [1, 1], [1, 2]]
    assert rewards.tolist() == [10, 12, 14] * 2
    assert not dones.any()
    *_, dones, infos = env.step(np.zeros(6, dtype=int))
    assert dones.all()
    assert infos[5]["terminal_observation"]["team"][:, :2].tolist() == [[2, 0], [2, 1], [2, 2]]
    assert [info.get("episode", {}).get("r") for info in infos] == [36 + 63, None, None, 36 + 63, None, None]
    assert [info["TimeLimit.truncated"] for info in infos] == [False] * 6


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: make_team_env("TeamTogether", n_envs=0), "n_envs .*got 0"),
        (lambda: make_team_env("TeamTogether", n_envs=2.0), "n_envs .*got 2.0"),  # type: ignore[arg-type]
        (lambda: make_team_env(CounterEnv, n_cpus=0), "n_cpus .*got 0"),
        (lambda: make_team_env("TeamTogether", seed=-1), "seed .*got -1"),
        (lambda: make_team_env("TeamTogether", n_envs=2, n_cpus=2), "n_cpus=2 .*backend='supersuit'"),
        (lambda: make_team_env("TeamTogether", backend="gpu"), "backend .*'native', 'supersuit', got 'gpu'"),  # type: ignore[arg-type]
        (lambda: make_team_env(CounterEnv, backend="native"), "backend='native' .*CounterEnv"),
        (lambda: make_team_env("TeamTogether", time_limit="never", **SMALL), "time_limit .*'bootstrap', got 'never'"),  # type: ignore[arg-type]
        (lambda: make_team_env("TeamTogether", active=True), "active=True; .*backend='supersuit'"),
        (lambda: make_team_env("TeamTogether", state=True), "state=True .*backend='supersuit'"),
        (lambda: make_team_env("TeamTogether-v1"), "'TeamTogether-v1'"),
        (lambda: make_team_env("TeamTogether", n_agent=5), "'n_agent' .*'n_agents'"),
        (lambda: make_team_env(CounterEnv(), n_agents=3), r"\['n_agents'\] .*factory"),
        (lambda: make_team_env(TeamVenv()), r"TeamVenv; .*CentralizedValueWrapper\("),
        (lambda: make_team_env(3), "ParallelEnv"),
        (lambda: make_team_env("TeamSupport", stagger=True, backend="supersuit"), "stagger=True .*TeamSupport-v0"),
        (lambda: make_team_env(CounterEnv, stagger=True), "stagger=True .*CounterEnv"),
        (lambda: make_team_env(CounterEnv, curriculum=[(10, {})]), r"curriculum .*Stage.*got \(10, \{\}\)"),  # type: ignore[list-item]
        (lambda: make_team_env(CounterEnv, monitor_dir=__file__), f"monitor_dir .*{__file__} is a file"),
    ],
)
def test_wrong_calls(make: Callable[[], VecEnv], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        make()


def test_hecogrid_through_supersuit_has_the_games_state_and_signals() -> None:
    env = make_team_env("TeamTogether", 2, backend="supersuit", state=True, active=True, **SMALL)
    assert env.team_spaces.state is not None and env.team_spaces.has_active
    assert env.reset()["state"].shape[0] == env.num_envs
    env.close()


def test_short_first_episodes_of_staggered_games_do_not_count() -> None:
    level = {"n_agents": 2, "grid_size": 8, "n_treasures": 2, "max_cycles": 10}
    env = make_team_env("TeamSupport", n_envs=5, seed=0, stagger=True, **level)
    assert evaluate_team(RandomPolicy(env.action_space, seed=0), env, 7).lengths == [10] * 7
