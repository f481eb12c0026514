"""Training on several levels in order: sb3_saf.Curriculum, make_team_env(curriculum=), and the settings key."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
import pytest
from stable_baselines3.common.vec_env import VecEnv

import sb3_saf
from sb3_saf import Stage, make_team_env
from sb3_saf.suites.registry import find_environment
from sb3_saf.training.settings import load_settings
from tests.toy_envs import ZEROS, CounterEnv, Game

SMALL: Final[dict[str, Any]] = {"n_agents": 3, "grid_size": 8, "n_treasures": 6}


def _staged(**kwargs: Any) -> sb3_saf.CentralizedValueWrapper:
    stages = [Stage(20, {"coordination": 1}), Stage(12, {"coordination": 2})]
    return make_team_env("TeamSupport", 2, seed=0, coordination=3, max_cycles=5, curriculum=stages, **SMALL, **kwargs)


class Played(NamedTuple):
    """Result of a step of the vector environment, and the coordination after it."""

    coordination: int
    obs: dict[str, np.ndarray]
    rewards: np.ndarray
    dones: np.ndarray
    infos: list[dict[str, Any]]


def _play(env: VecEnv, steps: int, seed: int = 0) -> list[Played]:
    rng, seen = np.random.default_rng(seed), []
    for _ in range(steps):
        obs, rewards, dones, infos = env.step(rng.integers(5, size=env.num_envs))
        assert isinstance(obs, dict)
        coordination = env.get_attr("params", 0)[0].coordination if env.has_attr("params") else 0
        seen.append(Played(coordination, obs, rewards, dones, infos))
    return seen


def test_levels_follow_each_other_after_their_game_steps() -> None:
    env = _staged()
    env.reset()
    seen = _play(env, 20)
    # 2 games: 20 game steps are 10 steps of the vector environment, then 12 are 6.
    assert [played.coordination for played in seen] == [1] * 9 + [2] * 6 + [3] * 5
    env.close()


def test_the_end_of_a_stage_truncates_what_is_not_over() -> None:
    env = _staged(time_limit="bootstrap")
    env.reset()
    seen = _play(env, 20)
    # Episodes of 5 steps: the first stage ends with two whole episodes, the second, of 6 steps, in the first step of
    # one.
    assert [step for step, played in enumerate(seen) if played.dones.all()] == [4, 9, 14, 15]
    infos = seen[15].infos
    assert all(info["TimeLimit.truncated"] for info in infos)
    assert [info["episode"]["l"] for info in infos if "episode" in info] == [1, 1]
    env.close()


def test_an_agent_that_dies_as_its_stage_ends_is_not_cut() -> None:
    env = make_team_env(CounterEnv(max_cycles=9, deaths={1: 4}), time_limit="bootstrap", curriculum=[Stage(4, {})])
    env.reset()
    for _ in range(4):
        *_, infos = env.step(np.zeros(2, np.int64))
    assert [info["TimeLimit.truncated"] for info in infos] == [True, False]


def test_an_agent_that_a_limit_stops_as_its_stage_ends_keeps_its_last_observation() -> None:
    env = make_team_env(CounterEnv(max_cycles=9, cuts={1: 4}), time_limit="bootstrap", curriculum=[Stage(4, {})])
    env.reset()
    for _ in range(4):
        *_, infos = env.step(np.zeros(2, np.int64))
    last = infos[1]["terminal_observation"]
    assert last["obs"][:2].tolist() == [4, 1] and last["active"].tolist() == [1, 1]


def test_an_agent_that_is_back_as_its_stage_ends_is_cut() -> None:
    class Waiting(Game):
        def change(self, out: list[Any]) -> None:
            out[0]["b"] = ZEROS
            self.agents = ["a"] if self.t == 1 else ["a", "b"]

    env = make_team_env(Waiting, 1, time_limit="bootstrap", curriculum=[Stage(2, {})])
    env.reset()
    for _ in range(2):
        *_, infos = env.step(np.zeros(2, np.int64))
    assert [info["TimeLimit.truncated"] for info in infos] == [True, True]


def test_games_are_not_blamed_for_what_a_cut_episode_lacks() -> None:
    class Won(Game):
        def info(self, agent: Any) -> dict[str, Any]:
            return {"is_success": True} if self.t == self.length else {}

    env = make_team_env(Won, 1, curriculum=[Stage(5, {})])
    env.reset()
    for _ in range(9):
        env.step(np.zeros(2, np.int64))  # warnings are errors


def test_new_seeds_begin_with_the_first_stage() -> None:
    """A model that is made on used games trains on all stages."""
    env = _staged()
    env.reset()
    assert _play(env, 20)[-1].coordination == 3
    env.seed(1)
    env.reset()
    assert [played.coordination for played in _play(env, 10)] == [1] * 9 + [2]


def test_evaluations_do_not_count_what_the_end_of_a_stage_cuts() -> None:
    env = _staged()
    result = sb3_saf.evaluate_team(sb3_saf.RandomPolicy(env, seed=0), env, 8)
    assert result.lengths == [5] * 8


def test_the_last_stage_plays_the_games_of_an_environment_of_that_level() -> None:
    stages = [Stage(2, {"coordination": 1})]
    staged = make_team_env("TeamSupport", 2, seed=0, coordination=3, curriculum=stages, **SMALL)
    staged.reset()
    assert _play(staged, 1)[0].coordination == 3
    plain = make_team_env("TeamSupport", 2, coordination=3, **SMALL)
    plain.seed(int(np.random.SeedSequence(0, spawn_key=(1,)).generate_state(1)[0]))
    plain.reset()
    for ours, theirs in zip(_play(staged, 60), _play(plain, 60), strict=True):
        np.testing.assert_array_equal(ours.obs["obs"], theirs.obs["obs"])
        np.testing.assert_array_equal(ours.rewards, theirs.rewards)


def test_any_environment_has_stages() -> None:
    pytest.importorskip("mpe2")
    make = find_environment("mpe2.simple_spread_v3").make
    assert make is not None
    env = make_team_env(make, 2, max_cycles=6, local_ratio=0.0, curriculum=[Stage(8, {"local_ratio": 1.0})])
    env.reset()
    assert [step for step, played in enumerate(_play(env, 12)) if played.dones.all()] == [3, 9]
    env.close()


def test_stages_with_other_spaces_are_refused() -> None:
    with pytest.raises(ValueError, match=r"need the same observation_space: stage 0 .* such as coordination"):
        make_team_env("TeamSupport", 2, view_size=7, curriculum=[Stage(10, {"view_size": 5})], **SMALL)


def test_settings_give_shares_of_the_run() -> None:
    stages = [{"share": 0.25, "coordination": 1}, {"share": 0.5, "coordination": 2}]
    settings = load_settings("saf", "TeamTogether-v0", "smoke", {"coordination": 3}, {"curriculum": stages})
    env = settings.make_env(0)
    assert env.get_attr("params", 0)[0].coordination == 1
    assert env.ends == (round(settings.game_steps / 4), round(settings.game_steps * 0.75))
    evaluation = settings.make_env(0, evaluation=True)
    assert evaluation.get_attr("params", 0)[0].coordination == 3


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ([{"coordination": 1}], "share, between 0 and 1"),
        ([{"share": 0.6, "coordination": 1}, {"share": 0.4, "coordination": 2}], "must leave game steps"),
        ([{"share": 0.5, "coordination": 9}], "coordination"),
        ([{"share": 0.5, "cordination": 1}], "cordination"),
    ],
)
def test_bad_curricula_are_refused(stages: list[dict[str, object]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_settings("saf", "TeamTogether-v0", "smoke", {"coordination": 3}, {"curriculum": stages})
