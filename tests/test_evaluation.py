from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_saf import QPLEX, inspect_team, load_weights, make_team_env, ppo_settings, replay
from sb3_saf.callbacks import TeamEvalCallback
from sb3_saf.envs.joint_observation import CentralizedValueWrapper
from sb3_saf.envs.monitor import TeamMonitor
from sb3_saf.envs.supersuit_vec_env import SuperSuitVecEnv
from sb3_saf.evaluation import (
    EvaluationResult,
    RandomPolicy,
    confidence_interval,
    evaluate_policy,
    evaluate_team,
)
from tests.contrib_teams import MaskedGame, choices_of
from tests.team_venv import Array, TeamVenv
from tests.toy_envs import CounterEnv, Game


def teams(**kwargs: Any) -> CentralizedValueWrapper:
    return CentralizedValueWrapper(TeamMonitor(TeamVenv(**kwargs)))


def constant(*per_game: float) -> Any:
    """Reward each agent of game e with ``per_game[e]`` per step."""
    return lambda game, agent, step: per_game[game]


class StillPolicy:
    """Does nothing, and records the arguments of its calls."""

    def __init__(self) -> None:
        self.starts: list[Array | None] = []
        self.states: list[Any] = []
        self.deterministic: set[bool] = set()

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> Any:
        self.starts.append(None if episode_start is None else episode_start.copy())
        self.states.append(state)
        self.deterministic.add(deterministic)
        n_rows = len(observation["agent"]) if isinstance(observation, dict) else len(observation)
        return np.zeros(n_rows, dtype=int), (np.full(1, len(self.states)),)


class TestEvaluatePolicy:
    def test_team_returns_and_game_steps(self) -> None:
        env = teams(lengths=(3, 2), n_agents=3, reward=constant(1, 10))
        returns, lengths = evaluate_policy(StillPolicy(), env, 4, return_episode_rewards=True)
        assert returns == [60, 9, 60, 9]
        assert lengths == [2, 3, 2, 3]
        assert evaluate_policy(StillPolicy(), env, 4) == (34.5, 25.5)
        by_agent = ((20.0,) * 3, (3.0,) * 3) * 2
        assert evaluate_team(StillPolicy(), env, 4) == EvaluationResult(
            [60, 9, 60, 9], [2, 3, 2, 3], (False, False, True, True), by_agent
        )

    @pytest.mark.parametrize(
        ("n_episodes", "per_game"), [(1, [0, 0, 1]), (2, [0, 1, 1]), (3, [1, 1, 1]), (7, [2, 2, 3])]
    )
    def test_episodes_are_divided_as_evenly_as_possible(self, n_episodes: int, per_game: list[int]) -> None:
        env = teams(lengths=(2, 2, 2), n_agents=2, reward=constant(1, 10, 100))
        result = evaluate_team(StillPolicy(), env, n_episodes)
        assert [result.returns.count(value) for value in (4, 40, 400)] == per_game

    @pytest.mark.parametrize("team_reward", ["given", "sum", "mean"])
    def test_callbacks_get_the_teams_reward(self, team_reward: Any) -> None:
        env, seen = make_team_env(CounterEnv, 2, seed=0, team_reward=team_reward), []
        result = evaluate_team(RandomPolicy(env, 0), env, 2, callback=lambda known, _: seen.append(known["reward"]))
        assert sum(seen) == pytest.approx(sum(result.returns)) != 0

    def test_rewards_are_those_before_normalisation(self) -> None:
        env = VecNormalize(teams(lengths=(3, 2), reward=constant(1, 10)), norm_obs=False, training=False)
        env.ret_rms.var = np.array(25.0)
        assert sorted(evaluate_team(StillPolicy(), env, 2).returns) == [9, 60]

    def test_without_a_monitor_the_outermost_rewards_count(self) -> None:
        env = VecNormalize(
            CentralizedValueWrapper(TeamVenv(lengths=(3, 2), reward=constant(1, 10))), norm_obs=False, training=False
        )
        env.ret_rms.var = np.array(25.0)
        with pytest.warns(UserWarning, match="no TeamMonitor"):
            result = evaluate_team(StillPolicy(), env, 2)
        assert sorted(result.returns) == pytest.approx([9 / 5, 60 / 5], rel=1e-5)
        assert evaluate_team(StillPolicy(), env, 2, warn=False).lengths == [2, 3]

    def test_recurrent_policies_are_told_the_starts_of_their_rows(self) -> None:
        policy = StillPolicy()
        evaluate_team(policy, teams(lengths=(3, 2), n_agents=3), 4, deterministic=False)
        assert [start.tolist() for start in policy.starts[:4] if start is not None] == [
            [True] * 6,
            [False] * 6,
            [False] * 3 + [True] * 3,
            [True] * 3 + [False] * 3,
        ]
        assert [state if state is None else int(state[0][0]) for state in policy.states[:3]] == [None, 1, 2]
        assert policy.deterministic == {False}

    def test_callback_sees_each_game_after_each_step(self) -> None:
        seen: list[tuple[int, float, bool]] = []

        def callback(local: dict[str, Any], _: dict[str, Any]) -> None:
            seen.append((local["i"], float(local["reward"]), bool(local["done"])))

        evaluate_policy(StillPolicy(), teams(lengths=(2, 2), reward=constant(1, 10)), 2, callback=callback)
        assert seen == [(0, 3, False), (1, 30, False), (0, 3, True), (1, 30, True)]

    def test_flat_rows_work_too(self) -> None:
        env = TeamMonitor(TeamVenv(lengths=(3, 2), reward=constant(1, 10)))
        assert evaluate_policy(RandomPolicy(env.action_space, seed=0), env, 2) == (34.5, 25.5)

    def test_threshold(self) -> None:
        env = teams(lengths=(2, 2), reward=constant(1, 1))
        assert evaluate_policy(StillPolicy(), env, 2, reward_threshold=5.9) == (6, 0)
        with pytest.raises(ValueError, match=r"expected a mean team return above 6, got 6.00 \[6.00, 6.00\]"):
            evaluate_policy(StillPolicy(), env, 2, reward_threshold=6)

    def test_single_agents_are_refused(self) -> None:
        for env, kind in ((DummyVecEnv([lambda: gym.make("CartPole-v1")]), "DummyVecEnv"), ("TeamTogether", "'Team")):
            with pytest.raises(ValueError, match=f"VecEnv of flattened teams.* got {kind}"):
                evaluate_policy(StillPolicy(), env, 2)  # type: ignore[arg-type]

    @pytest.mark.parametrize("n_episodes", [0, 2.5])
    def test_number_of_episodes(self, n_episodes: Any) -> None:
        with pytest.raises(ValueError, match=f"n_eval_episodes must be an integer of at least 1, got {n_episodes}"):
            evaluate_policy(StillPolicy(), teams(), n_episodes)


class Outcome(Game):
    """
    Agent b is paid 1 at each of four steps; every second game is won. Agent a dies in lost games.

    :param told: who is told the outcome: "acting" agents at the end, the agents at their own "end", all at "every" step
    """

    def __init__(self, told: str) -> None:
        self.told, self.n_games = told, 0

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.n_games += 1
        return super().reset(seed, options)

    def change(self, out: list[Any]) -> None:
        _, rewards, ends, _, infos = out
        rewards["a"] = 0.0
        won, team = self.n_games % 2 == 0, list(self.agents)
        ends |= {agent: self.t == 4 or (agent == "a" and self.t == 2 and not won) for agent in team}
        out[3] = dict.fromkeys(team, False)
        told = {"every": True, "acting": self.t == 4}
        for agent in team:
            if told.get(self.told, self.told == "a" == agent and ends["a"]):
                infos[agent] = {"is_success": won and self.t == 4, "score": 7 if won else 3}
        self.agents = [agent for agent in team if not ends[agent]]


@pytest.mark.parametrize("told", ["acting", "every", "a"])
def test_what_is_of_the_episode_is_found_wherever_the_game_puts_it(told: str, tmp_path: Path) -> None:
    venv = SuperSuitVecEnv(partial(Outcome, told), 2, seed=0, active=True, action_masks="auto")
    env = CentralizedValueWrapper(TeamMonitor(venv, str(tmp_path / "monitor.csv"), info_keywords=("score",)))
    result = evaluate_team(RandomPolicy(env, seed=0), env, 20)
    assert len(result.returns) == len(result.successes) == 20 and result.success_rate == 0.5
    assert result.agent_means == (0, 4) and result.agent_returns[0] == (0, 4)
    model = PPO("IPPOPolicy", env, **ppo_settings(env, n_steps=8), seed=0).learn(2 * 2 * 8 * 4)
    assert model.ep_info_buffer is not None and model.ep_success_buffer is not None
    assert len(model.ep_success_buffer) == len(model.ep_info_buffer) == 16
    assert np.mean(model.ep_success_buffer) == 0.5
    assert sorted(entry["score"] for entry in model.ep_info_buffer) == [3] * 8 + [7] * 8


GAME: dict[str, Any] = {"grid_size": 7, "n_treasures": 3, "max_cycles": 6}


class TestOtherGames:
    def make(self, n_agents: int = 3, n_envs: int = 2, **params: Any) -> Any:
        return make_team_env("TeamSupport", n_envs, seed=0, **{**GAME, "n_agents": n_agents, **params})

    @pytest.mark.parametrize("method", ["saf", "mappo", "ippo", "qplex"])
    def test_actors_play_in_teams_of_other_sizes(self, method: str) -> None:
        env = self.make()
        model: Any = (
            QPLEX("QPLEXPolicy", env, buffer_size=100, seed=0)
            if method == "qplex"
            else PPO(method, env, **ppo_settings(env, method), seed=0)
        )
        for n_agents in (2, 5):
            other = self.make(n_agents)
            assert len(evaluate_team(model, other, 2).agent_means) == n_agents
            rows: Any = other.reset()
            actions, _ = model.predict(rows, deterministic=True)
            alone = [model.predict(own, deterministic=True)[0] for own in rows["obs"]]
            assert actions.tolist() == [int(action) for action in alone]

    @pytest.mark.parametrize("kwargs", [{"actor_identity": True}, {"heads": "per_agent"}])
    def test_actors_that_depend_on_the_index_do_not(self, kwargs: dict[str, Any]) -> None:
        env = self.make()
        model = PPO("MAPPO", env, **ppo_settings(env, policy_kwargs=kwargs), seed=0)
        assert evaluate_team(model, env, 2).lengths == [6, 6]
        with pytest.raises(ValueError, match=r"and 3 agents, got .* and 5 agents; .* with 3 agents"):
            evaluate_team(model, self.make(5), 2)
        with pytest.raises(ValueError, match=r"'agent' must be in 0..2"):
            model.predict(self.make(5).reset())

    @pytest.mark.parametrize("kwargs", [{"actor_identity": True}, {}])
    def test_agents_in_another_order(self, kwargs: dict[str, Any]) -> None:
        """Actors that read who acts play only in the order of their training; others in any."""

        class Reordered(CounterEnv):
            def __init__(self, reverse: bool = False) -> None:
                super().__init__()
                self.possible_agents = sorted(self.possible_agents, reverse=reverse)

        env, other = (make_team_env(Reordered, 2, seed=0, reverse=reverse) for reverse in (False, True))
        model = PPO("MAPPO", env, **ppo_settings(env, policy_kwargs=kwargs), seed=0)
        if not kwargs:
            assert len(evaluate_team(model, other, 2).returns) == 2
            return
        with pytest.raises(
            ValueError, match=r"in the order of .*\['agent_0', 'agent_1'\], .*got \['agent_1', 'agent_0'\]"
        ):
            evaluate_team(model, other, 2)

    def test_weights_of_ippo_go_to_teams_of_other_sizes(self, tmp_path: Path) -> None:
        small, large = self.make(), self.make(5)
        model, other = (PPO("IPPO", env, **ppo_settings(env, "ippo"), seed=i) for i, env in enumerate((small, large)))
        model.save(tmp_path / "model")
        load_weights(other, tmp_path / "model")
        obs: Any = large.reset()
        assert other.predict(obs, deterministic=True)[0].tolist() == model.predict(obs, deterministic=True)[0].tolist()

    @pytest.mark.parametrize("other", [{"view_size": 5}, {"observation": "rgb"}])
    def test_models_of_other_games_are_refused(self, other: dict[str, Any], tmp_path: Path) -> None:
        env = self.make()
        model = PPO("MAPPO", env, **ppo_settings(env), seed=0)
        for play in (evaluate_team, inspect_team, replay):
            with pytest.raises(ValueError, match=r"was trained, with observations of shape \(7, 7\).*, got "):
                play(model, self.make(**other), *([tmp_path / "page.html"] if play is replay else [2]))
        with pytest.raises(ValueError, match=r"was trained, .* and 3 agents, got .* and 4 agents"):
            inspect_team(model, self.make(4), 2)


class TestIntervals:
    def test_interval_by_hand(self) -> None:
        # mean 3, sample standard deviation sqrt(2.5), 4 degrees of freedom: 3 -+ 2.776445 * sqrt(2.5 / 5).
        assert confidence_interval([1, 2, 3, 4, 5]) == pytest.approx((1.036757, 4.963243), rel=1e-6)
        assert EvaluationResult([1, 2, 3, 4, 5], [1] * 5).interval() == pytest.approx((1.036757, 4.963243), rel=1e-6)
        assert (
            str(EvaluationResult([1, 2, 3, 4, 5], [1] * 5)) == "3.00 [1.04, 4.96] (95 %, Student's t, 5 team episodes)"
        )

    def test_one_value_says_nothing_about_its_spread(self) -> None:
        assert confidence_interval([3]) == (-math.inf, math.inf)

    def test_what_has_no_interval(self) -> None:
        with pytest.raises(ValueError, match="an interval needs at least one value, got none"):
            confidence_interval([])
        with pytest.raises(ValueError, match="confidence must be above 0 and below 1, got 95"):
            confidence_interval([1, 2], 95)


def test_games_that_may_never_end_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_saf.evaluation._LONG", 3)
    env = make_team_env(partial(CounterEnv, max_cycles=5), 1, seed=0)
    with pytest.warns(UserWarning, match="a game has not ended in 3 steps; if it never ends, give it a time limit"):
        evaluate_team(RandomPolicy(env, seed=0), env, 1)


class TestRandomPolicy:
    @pytest.mark.parametrize(
        ("space", "sizes"),
        [
            (spaces.Discrete(7), [7]),
            (spaces.Discrete(3, start=2), [3]),
            (spaces.MultiDiscrete([2, 5]), [2, 5]),
            (spaces.MultiBinary(3), [2] * 3),
            (spaces.Box(-2, 3, (2,), np.float32), [10] * 2),
            (spaces.Box(0, 4, (2, 2), np.uint8), [5] * 4),
        ],
        ids=str,
    )
    def test_actions_are_uniform_over_the_space(self, space: spaces.Space[Any], sizes: list[int]) -> None:
        actions, state = RandomPolicy(space, seed=0).predict(np.zeros((20_000, 3)))
        assert state is None and actions.shape == (20_000, *(space.shape or ()))
        assert all(space.contains(action if space.shape else np.int64(action)) for action in actions[:200])
        other = RandomPolicy(space, seed=0).predict({"obs": np.zeros((20_000, 3)), "agent": np.zeros(20_000)})[0]
        np.testing.assert_array_equal(actions, other)
        assert not np.array_equal(actions, RandomPolicy(space, seed=1).predict(np.zeros((20_000, 3)))[0])
        for column, size in zip(actions.reshape(20_000, -1).T.astype(float), sizes, strict=True):
            np.testing.assert_allclose(np.histogram(column, size)[0], 20_000 / size, rtol=0.1)

    def test_masks_of_actions_with_two_axes(self) -> None:
        """Each mask allows one choice per dimension, of 2, 3, 4 and 2."""
        space, legal = spaces.MultiDiscrete(np.array([[2, 3], [4, 2]])), np.array([[1, 0, 3, 1], [0, 2, 1, 1]])
        masks = np.concatenate([legal[:, [i]] == np.arange(n) for i, n in enumerate((2, 3, 4, 2))], axis=1)
        actions, _ = RandomPolicy(space, seed=0).predict(np.zeros((2, 3)), action_masks=masks)
        np.testing.assert_array_equal(actions, legal.reshape(2, 2, 2))

    def test_spaces_without_a_uniform_distribution(self) -> None:
        with pytest.raises(ValueError, match="a uniform policy needs a bounded action space, got Box"):
            RandomPolicy(spaces.Box(-np.inf, np.inf, (2,)))
        with pytest.raises(ValueError, match=r"action space must be .*, got Text"):
            RandomPolicy(spaces.Text(3))


def turning(space: spaces.Space[Any], step: int) -> Array:
    """Return a mask of one legal action, another one at each step."""
    return np.concatenate([np.arange(n) == step % n for n in choices_of(space)]).astype(np.int8)


class Script:
    """A scripted team that takes the first legal action."""

    def predict(
        self, observation: Any, state: Any, episode_start: Any, deterministic: bool, action_masks: Any = None
    ) -> Any:
        masks = observation.get("action_mask") if action_masks is None else action_masks
        return np.asarray(masks).argmax(axis=1), state


SPACES = {"discrete": spaces.Discrete(3), "multi": spaces.MultiDiscrete([2, 3]), "binary": spaces.MultiBinary(2)}


def masked_game(space: spaces.Space[Any], where: str) -> Any:
    return partial(MaskedGame, where, actions=space, mask=partial(turning, space))


class TestMasks:
    """Whatever plays a model whose game has masks plays legally: an illegal action fails in the game."""

    def model(self, space: spaces.Space[Any], masks: str) -> Any:
        env = make_team_env(masked_game(space, masks), 2, seed=0)
        if masks == "method":
            return MaskablePPO("MAPPOMaskablePolicy", env, n_steps=8, batch_size=32, n_epochs=1, seed=0).learn(32)
        return PPO("MAPPOPolicy", env, **ppo_settings(env, n_steps=8, n_epochs=1), seed=0).learn(32)

    @pytest.mark.parametrize("space", SPACES)
    def test_masks_of_the_method(self, space: str, tmp_path: Path) -> None:
        model = self.model(SPACES[space], "method")
        self.play_all(model, tmp_path)

    @pytest.mark.parametrize("masks", ["info:action_mask", "action_mask"])
    def test_masks_in_rows(self, masks: str, tmp_path: Path) -> None:
        self.play_all(self.model(SPACES["discrete"], masks), tmp_path)

    def play_all(self, model: Any, folder: Path) -> None:
        env = model.get_env()
        env.render_mode = "rgb_array"
        players = [model, model.policy, RandomPolicy(env, seed=0)]
        if isinstance(env.action_space, spaces.Discrete):
            players.append(Script())
        for player in players:
            for deterministic in (True, False):
                assert evaluate_team(player, env, 3, deterministic).returns == [8, 8, 8]
        inspect_team(model, env, 2)
        replay(model, env, folder / "replay.html")

    def test_best_models_are_chosen_by_legal_play(self) -> None:
        env = make_team_env(masked_game(SPACES["multi"], "method"), 2, seed=9)
        callback = TeamEvalCallback(env, n_eval_episodes=3, eval_freq=8, verbose=0)
        self.model(SPACES["multi"], "method").learn(64, callback)
        assert callback.best_mean_reward == 8


class Lenient(MaskedGame):
    """A game that accepts illegal actions."""

    def step(self, actions: dict[str, Any]) -> Any:
        return Game.step(self, actions)


@pytest.mark.parametrize("space", SPACES)
def test_who_does_not_read_masks_is_warned_once(space: str) -> None:
    actions = SPACES[space]
    env = make_team_env(
        partial(Lenient, "info:action_mask", actions=actions, mask=partial(turning, actions)), 2, seed=0
    )
    env.reset()
    first = np.zeros((4, *(actions.shape or ())), np.int64)
    env.step(first)  # the first choices are legal in the first step only
    with pytest.warns(UserWarning, match=r"agent 0 of game 0 took an action that its 'action_mask' forbids, \[?0"):
        env.step(first)
    env.step(first)


@pytest.mark.parametrize("algorithm", [PPO, QPLEX])
def test_training_does_not_go_on_in_games_that_an_evaluation_has_played(algorithm: Any) -> None:
    env = make_team_env(CounterEnv, 2, seed=0)
    if algorithm is PPO:
        model: Any = PPO("IPPOPolicy", env, **ppo_settings(env, n_steps=8, n_epochs=1), seed=0)
    else:
        model = QPLEX("QPLEXPolicy", env, seed=0, batch_size=8)
    model.learn(8 * env.num_envs)
    evaluate_team(RandomPolicy(env, seed=0), env, 2)
    evaluate_team(model, env, 2)
    with pytest.raises(RuntimeError, match=r"Give evaluations games of their own.*model.set_env\(model.get_env"):
        model.learn(8 * env.num_envs, reset_num_timesteps=False)
    model.set_env(model.get_env())
    model.learn(8 * env.num_envs, reset_num_timesteps=False)
    assert model.num_timesteps >= 16 * env.num_envs
    with pytest.raises(ValueError, match="not trained on, got the games of training themselves"):
        model.learn(8 * env.num_envs, TeamEvalCallback(env, eval_freq=8))


class TestTeamEvalCallback:
    def learn(
        self, callback: TeamEvalCallback, n_game_steps: int, folder: Path, n_games: int = 2, normalise: bool = False
    ) -> PPO:
        env: Any = teams(lengths=(3, 2, 4)[:n_games])
        if normalise:
            env = VecNormalize(env, norm_obs=False)
        n_rows = 2 * env.num_envs
        model = PPO("MultiInputPolicy", env, n_steps=2, batch_size=n_rows, n_epochs=1, device="cpu", seed=0)
        model.set_logger(configure(str(folder), ["csv"]))
        model.learn(n_game_steps * 3, callback=callback)
        model.logger.close()
        return model

    def test_it_evaluates_every_so_many_game_steps(self, tmp_path: Path) -> None:
        # Three games a step: the multiples of 8 are passed at 9, 18 (16), 24, 33 (32).
        eval_env = teams(lengths=(3, 2), reward=constant(1, 10))
        callback = TeamEvalCallback(eval_env, n_eval_episodes=4, eval_freq=8, log_path=str(tmp_path), verbose=0)
        self.learn(callback, 36, tmp_path, n_games=3)
        saved = np.load(tmp_path / "evaluations.npz")
        assert sorted(saved) == ["agent_results", "ep_lengths", "game_steps", "results", "successes", "timesteps"]
        assert (
            saved["agent_results"].shape == (4, 4, 3) and (saved["agent_results"].sum(axis=2) == saved["results"]).all()
        )
        assert saved["game_steps"].tolist() == [9, 18, 24, 33]
        assert saved["timesteps"].tolist() == [27, 54, 72, 99]
        assert saved["results"].tolist() == [[60, 9, 60, 9]] * 4
        assert saved["ep_lengths"].tolist() == [[2, 3, 2, 3]] * 4
        assert saved["successes"].tolist() == [[False, False, True, True]] * 4

    def test_it_logs_and_prints_returns_against_game_steps(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        eval_env = teams(lengths=(3, 2), reward=constant(1, 10))
        self.learn(TeamEvalCallback(eval_env, n_eval_episodes=4, eval_freq=4), 8, tmp_path)
        printed = capsys.readouterr().out
        for words in ("Evaluation after 8 game steps: team return 34.50 [", "Success rate: 50"):
            assert words in printed
        log = _logged(tmp_path / "progress.csv", "eval/game_steps")
        assert [float(row["eval/game_steps"]) for row in log] == [4, 8]
        assert [float(row["time/game_steps"]) for row in log] == [4, 8]
        assert [float(row["time/total_timesteps"]) for row in log] == [12, 24]
        assert [float(row["eval/mean_reward"]) for row in log] == [34.5, 34.5]
        assert [float(row["eval/mean_ep_length"]) for row in log] == [2.5, 2.5]
        assert [float(row["eval/success_rate"]) for row in log] == [0.5, 0.5]
        assert [float(row["eval/mean_reward/2"]) for row in log] == [11.5, 11.5]

    def test_the_best_model_is_kept_and_callbacks_are_called(self, tmp_path: Path) -> None:
        rewards = iter([1.0, 3.0, 2.0, 4.0])
        now = [0.0]

        class Turn(TeamMonitor):
            def reset(self) -> Any:
                now[0] = next(rewards)
                return super().reset()

        eval_env = CentralizedValueWrapper(Turn(TeamVenv(lengths=(1,), reward=lambda game, agent, step: now[0])))
        best, after = Count(), Count()
        callback = TeamEvalCallback(
            eval_env, best, after, n_eval_episodes=1, eval_freq=2, best_model_save_path=str(tmp_path), verbose=0
        )
        self.learn(callback, 16, tmp_path)  # four rollouts, with one evaluation each
        assert (best.n_calls, after.n_calls) == (3, 4)
        assert (callback.best_mean_reward, callback.last_mean_reward) == (12, 12)
        assert PPO.load(tmp_path / "best_model").num_timesteps == 42
        assert best.model is after.model is callback.model

    def test_callbacks_can_stop_the_training(self, tmp_path: Path) -> None:
        eval_env = teams(lengths=(1,), reward=constant(1))
        stop = StopTrainingOnRewardThreshold(reward_threshold=2.5, verbose=0)
        model = self.learn(TeamEvalCallback(eval_env, stop, n_eval_episodes=1, eval_freq=4, verbose=0), 40, tmp_path)
        assert model.num_timesteps == 4 * 3

    def test_statistics_of_normalisation_are_those_of_training(self, tmp_path: Path) -> None:
        eval_env = VecNormalize(teams(), norm_obs=False, training=False)
        model = self.learn(TeamEvalCallback(eval_env, eval_freq=8, verbose=0), 8, tmp_path, normalise=True)
        training = model.get_vec_normalize_env()
        assert training is not None
        assert eval_env.ret_rms.count == training.ret_rms.count > 1
        assert eval_env.ret_rms.var == training.ret_rms.var

    def test_training_on_goes_on_counting(self, tmp_path: Path) -> None:
        callback = TeamEvalCallback(teams(), n_eval_episodes=2, eval_freq=6, log_path=str(tmp_path), verbose=0)
        model = self.learn(callback, 8, tmp_path)
        model.set_logger(configure(str(tmp_path), []))
        model.learn(8 * 3, callback=callback, reset_num_timesteps=False)
        assert callback.evaluations_game_steps == [6, 12]

    def test_no_evaluation_on_request(self, tmp_path: Path) -> None:
        callback = TeamEvalCallback(teams(), eval_freq=0, verbose=0)
        self.learn(callback, 8, tmp_path)
        assert callback.last_mean_reward == -np.inf

    def test_environments_without_teams_are_refused(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match="expected a VecEnv of flattened teams that states its team size"):
            TeamEvalCallback(TeamVenv(tell_size=False))
        model = PPO("MlpPolicy", TeamVenv(tell_size=False), n_steps=2, batch_size=12, device="cpu")
        with pytest.raises(ValueError, match="expected a VecEnv of flattened teams that states its team size"):
            model.learn(12, callback=TeamEvalCallback(teams()))


class Count(BaseCallback):
    def _on_step(self) -> bool:
        return True


def _logged(path: Path, column: str) -> list[dict[str, str]]:
    import csv

    with path.open() as file:
        return [row for row in csv.DictReader(file) if row.get(column)]
