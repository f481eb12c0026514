from __future__ import annotations

import csv
import json
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy as evaluate_rows
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from sb3_saf.callbacks import GameStepsCallback, game_steps
from sb3_saf.envs.joint_observation import CentralizedValueWrapper
from sb3_saf.envs.monitor import TeamMonitor
from sb3_saf.evaluation import RandomPolicy, evaluate_team
from tests.team_venv import TeamVenv, still

#: Team return of an episode of n steps of game e: agents 0, 1, 2 get 100 e + 10 i + step.
RETURN_OF_GAME_0 = 3 * 30 + 3 * (1 + 2 + 3)
RETURN_OF_GAME_1 = 2 * 330 + 3 * (1 + 2)


def play(env: Any, n_steps: int) -> list[list[dict[str, Any]]]:
    env.reset()
    return [env.step(still(env))[3] for _ in range(n_steps)]


def test_each_team_episode_is_counted_once_with_the_return_of_the_team() -> None:
    env = TeamMonitor(TeamVenv(lengths=(3, 2), n_agents=3))
    infos = play(env, 6)
    episodes = {
        (step, row): (info["episode"]["r"], info["episode"]["l"])
        for step, rows in enumerate(infos, start=1)
        for row, info in enumerate(rows)
        if "episode" in info
    }
    assert episodes == {
        (2, 3): (RETURN_OF_GAME_1, 2),
        (3, 0): (RETURN_OF_GAME_0, 3),
        (4, 3): (RETURN_OF_GAME_1, 2),
        (6, 0): (RETURN_OF_GAME_0, 3),
        (6, 3): (RETURN_OF_GAME_1, 2),
    }
    assert env.episode_count == 5
    times = [rows[3]["episode"]["t"] for rows in (infos[1], infos[3], infos[5])]
    assert 0 <= times[0] <= times[1] <= times[2] < 60


def test_an_unfinished_episode_is_forgotten_at_reset() -> None:
    env = TeamMonitor(TeamVenv(lengths=(3, 3)))
    play(env, 2)
    infos = play(env, 3)
    assert infos[2][0]["episode"]["r"] == RETURN_OF_GAME_0
    assert infos[2][0]["episode"]["l"] == 3


def test_small_rewards_beside_large_ones_are_not_lost() -> None:
    # float32 cannot tell 2**24 from 2**24 + 1.
    venv = TeamVenv(lengths=(101,), n_agents=2, reward=lambda game, agent, step: 2.0**24 if step + agent == 1 else 1.0)
    infos = play(TeamMonitor(venv), 101)
    assert infos[100][0]["episode"]["r"] == 2.0**24 + 201


def test_monitor_file_is_one_that_sb3_reads(tmp_path: Path) -> None:
    env = TeamMonitor(TeamVenv(lengths=(3, 2)), str(tmp_path / "run"), info_keywords=("episode_number",))
    play(env, 6)
    env.close()
    results = load_results(str(tmp_path))
    assert results["r"].tolist() == [RETURN_OF_GAME_1, RETURN_OF_GAME_0] * 2 + [RETURN_OF_GAME_1]
    assert results["l"].tolist() == [2, 3, 2, 3, 2]
    assert results["episode_number"].tolist() == [0, 0, 1, 1, 2]
    lines = (tmp_path / "run.monitor.csv").read_text().splitlines()
    assert json.loads(lines[0][1:])["t_start"] == env.t_start
    assert lines[1] == "r,l,t,episode_number" and len(lines) == 2 + 5
    assert env.venv.closed  # type: ignore[attr-defined]


def returns_in(path: Path) -> list[float]:
    return [float(line.split(",")[0]) for line in path.read_text().splitlines()[2:]]


Monitors = Callable[..., TeamMonitor]


@pytest.fixture
def monitors(tmp_path: Path) -> Iterator[Monitors]:
    """Create monitors of one game that write to one folder; their files are closed after the test."""
    made: list[TeamMonitor] = []

    def make(length: int, **kwargs: Any) -> TeamMonitor:
        made.append(TeamMonitor(TeamVenv(lengths=(length,)), str(tmp_path), **kwargs))
        return made[-1]

    yield make
    for monitor in made:
        monitor.close()


def test_the_file_of_an_earlier_run_is_set_aside_and_a_reset_touches_none(monitors: Monitors, tmp_path: Path) -> None:
    path = tmp_path / "monitor.csv"
    earlier = monitors(2)
    earlier.reset()
    assert not path.exists(), "a run that only resets, and is refused then, leaves no trace"
    play(earlier, 4)
    lines = path.read_text()
    monitors(3).reset()
    assert path.read_text() == lines
    play(monitors(3), 3)
    assert (tmp_path / "monitor.csv.1").read_text() == lines
    assert returns_in(path) == [RETURN_OF_GAME_0]


def test_a_resumed_run_cuts_what_it_wrote_after_the_checkpoint(monitors: Monitors, tmp_path: Path) -> None:
    env = monitors(2)
    begin = env.checkpoint_state()
    play(env, 2)
    state = env.checkpoint_state()
    for _ in range(2):
        env.step(still(env))
    assert returns_in(tmp_path / "monitor.csv") == [69, 69]
    resumed = monitors(2)
    resumed.reset()
    resumed.load_checkpoint_state(state)
    path = tmp_path / "monitor.csv"
    assert returns_in(path) == [69]
    anew = monitors(2)
    anew.reset()
    anew.load_checkpoint_state(begin)
    play(anew, 2)
    assert returns_in(path) == [69] and not list(tmp_path.glob("*.1")), "its own file is no other run's"
    path.unlink()
    for _ in range(2):
        resumed = monitors(2)
        resumed.reset()
        with pytest.warns(UserWarning, match="no episodes are written to .* lacks those before"):
            resumed.load_checkpoint_state(state)
        resumed.step(still(resumed))
        state = resumed.checkpoint_state()
    assert not path.exists()


def test_keywords_that_are_columns_are_refused() -> None:
    with pytest.raises(ValueError, match=r"other than the monitor's own columns \['l', 'r', 't'\], got \['l'\]"):
        TeamMonitor(TeamVenv(), info_keywords=("score", "l"))


def test_missing_info_keyword_is_named_once(tmp_path: Path) -> None:
    env = TeamMonitor(TeamVenv(lengths=(2,)), str(tmp_path / "monitor.csv"), ("score", "episode_number"))
    with pytest.warns(UserWarning, match=r"one without \['score'\], of game 0") as told:
        infos = play(env, 4)
    assert len(told) == 1
    assert [infos[step][0]["episode"]["score"] for step in (1, 3)] == [None, None]
    assert [infos[step][0]["episode"]["episode_number"] for step in (1, 3)] == [0, 1]


def test_what_an_agent_says_before_the_last_step_belongs_to_the_episode() -> None:
    class Early(TeamVenv):
        def step_wait(self) -> Any:
            obs, rewards, dones, infos = super().step_wait()
            if not dones.any():
                infos[1] = {**infos[1], "score": 7}
            return obs, rewards, dones, infos

    infos = play(TeamMonitor(Early(lengths=(3,)), info_keywords=("score",)), 3)
    assert infos[2][0]["episode"]["score"] == 7 and "score" not in infos[2][1]


def test_team_size_can_be_told() -> None:
    venv = TeamVenv(lengths=(2, 2), n_agents=3, tell_size=False)
    assert TeamMonitor(venv, n_agents=2).n_games == 3
    with pytest.raises(ValueError, match="expected a VecEnv of flattened teams that states its team size"):
        TeamMonitor(venv)


OURS = r"take each of these 6 rows .* team of 3: .* sb3_saf.evaluate_policy .*TeamEvalCallback, and sb3_saf.TeamMonitor"


def test_sb3s_own_evaluation_returns_though_it_counts_agents() -> None:
    """SB3's own evaluation warns and counts agents as episodes, but does not loop endlessly."""
    env = CentralizedValueWrapper(TeamMonitor(TeamVenv(lengths=(2, 2))))
    with pytest.warns(UserWarning, match=OURS):
        returns, lengths = evaluate_rows(
            RandomPolicy(env.action_space, 0), env, 6, return_episode_rewards=True, warn=False
        )
    assert isinstance(returns, list)
    assert sorted(returns) == [3, 23, 43, 203, 223, 243]
    assert lengths == [2] * 6
    evaluate_rows(RandomPolicy(env.action_space, 0), env, 6, warn=False)  # not a second time


def test_sb3s_own_monitor_around_teams_or_below_is_warned_of() -> None:
    with pytest.warns(UserWarning, match=OURS) as told:
        VecMonitor(VecNormalize(CentralizedValueWrapper(TeamMonitor(TeamVenv(lengths=(2, 2)))), norm_obs=False))
    assert len(told) == 1
    with pytest.warns(UserWarning, match=OURS) as told:
        CentralizedValueWrapper(TeamMonitor(VecMonitor(TeamVenv(lengths=(2, 2)))))
    assert len(told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alone = VecMonitor(CentralizedValueWrapper(TeamMonitor(TeamVenv(lengths=(2, 2), n_agents=1))))
    assert evaluate_team(RandomPolicy(alone.action_space, 0), alone, 2).agent_returns == ((3,), (203,))
    with pytest.warns(UserWarning, match=OURS):
        team = VecMonitor(TeamMonitor(TeamVenv(lengths=(2, 2))))
    with pytest.raises(ValueError, match="those of a VecMonitor around it"):
        evaluate_team(RandomPolicy(team.action_space, 0), team, 2)


def logged(model: BaseAlgorithm, folder: Path, n_steps: int) -> list[dict[str, str]]:
    model.set_logger(configure(str(folder), ["csv"]))
    model.learn(n_steps, GameStepsCallback(), log_interval=1)
    model.logger.close()
    with open(folder / "progress.csv") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(("learner", "settings"), [(PPO, {"batch_size": 24, "n_epochs": 1}), (A2C, {})])
def test_game_steps_are_logged_beside_rows(learner: Any, settings: dict[str, Any], tmp_path: Path) -> None:
    env = VecNormalize(CentralizedValueWrapper(TeamMonitor(TeamVenv(lengths=(3, 2)))), norm_obs=False)
    model = learner("IPPOPolicy", env, n_steps=4, device="cpu", **settings)
    rows = logged(model, tmp_path, 48)
    assert [int(row["time/total_timesteps"]) for row in rows] == [24, 48]
    assert [int(row["time/game_steps"]) for row in rows] == [8, 16]
    assert all(float(row["time/game_steps_per_second"]) > 0 for row in rows)
    assert game_steps(model) == 16


def test_environments_without_teams_log_what_they_did(tmp_path: Path) -> None:
    venv = TeamVenv(lengths=(3, 2), tell_size=False)
    model = PPO("MlpPolicy", VecMonitor(venv), n_steps=4, batch_size=24, n_epochs=1, device="cpu")
    rows = logged(model, tmp_path, 24)
    assert int(rows[0]["time/total_timesteps"]) == 24
    assert "time/game_steps" not in rows[0]
    assert game_steps(model) is None
