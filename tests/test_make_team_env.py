"""Environments by make_team_env, and common mistakes in custom ones with their error messages."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib import TRPO, MaskablePPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.vec_env import VecEnv, VecExtractDictObs, VecFrameStack
from supersuit import agent_indicator_v0, clip_reward_v0, dtype_v0, frame_stack_v1, normalize_obs_v0
from torch import nn

import hecogrid_envs
from hecogrid_envs.state import STATE_PLANES
from sb3_saf import (
    QPLEX,
    CentralizedValueWrapper,
    GameStepsCallback,
    RandomPolicy,
    TeamMonitor,
    TeamRolloutBuffer,
    make_team_env,
    ppo_settings,
)
from sb3_saf.envs.supersuit_vec_env import SuperSuitVecEnv
from sb3_saf.evaluation import evaluate_team
from sb3_saf.training.settings import load_settings
from tests.team_venv import TeamVenv
from tests.toy_envs import CounterEnv, Game, TellingEnv

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
        (lambda: make_team_env(CounterEnv, active="no"), "active must be one of None, True, False, got 'no'"),  # type: ignore[arg-type]
        (lambda: make_team_env(CounterEnv, action_masks="yes"), "action_masks must be one of .*got 'yes'"),  # type: ignore[arg-type]
        (lambda: ppo_settings(CounterEnv()), "expected a VecEnv of flattened teams, got .*make_team_env"),
        (lambda: CentralizedValueWrapper(CounterEnv), "expected a VecEnv of flattened teams"),  # type: ignore[arg-type]
        (lambda: TeamMonitor(CounterEnv()), "expected a VecEnv of flattened teams"),
        (lambda: TeamMonitor(TeamVenv(), team_return="max"), "team_return must be one of 'sum', 'mean', got 'max'"),  # type: ignore[arg-type]
        (lambda: make_team_env(CounterEnv, monitor_dir=__file__), f"monitor_dir .*{__file__} is a file"),
    ],
)
def test_wrong_calls(make: Callable[[], VecEnv], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        make()


def test_hecogrid_through_supersuit_has_the_games_state_and_signals() -> None:
    env = make_team_env("TeamTogether", 2, backend="supersuit", state=True, active=True, **SMALL)
    assert env.team_spaces.state is not None and env.team_spaces.has_active
    rows: Any = env.reset()
    assert rows["state"].shape == (env.num_envs, SMALL["grid_size"], SMALL["grid_size"], len(STATE_PLANES))
    model = PPO("MAPPOPolicy", env, policy_kwargs={"critic_input": "state"}, device="cpu")
    read: list[Any] = []
    first = next(layer for layer in model.policy.value_net.modules() if isinstance(layer, nn.Linear))
    first.register_forward_pre_hook(lambda _, inputs: read.append(inputs[0]))
    model.policy.predict_values(model.policy.obs_to_tensor(rows)[0])
    assert read[0].max() == rows["state"].max() >= 1, "planes are numbers, not pixels of 0 to 255"
    env.close()


def test_wrappers_that_make_tile_codes_plain_numbers_are_refused() -> None:
    def game(**params: Any) -> Any:
        return hecogrid_envs.parallel_env("TeamSupport", **SMALL, **params)

    for wrap in (lambda env: frame_stack_v1(env, 2), agent_indicator_v0):
        with pytest.raises(ValueError, match=r"leave tile codes as they are, .* give the game observation='rgb'"):
            make_team_env(lambda wrap=wrap: wrap(game(observation="tiles")))
        make_team_env(lambda wrap=wrap: wrap(game())).close()
    with pytest.raises(ValueError, match="leave tile codes as they are"):
        make_team_env(lambda: normalize_obs_v0(dtype_v0(game(observation="tiles"), np.float32)))
    make_team_env(lambda: clip_reward_v0(game(observation="tiles"))).close()
    rows = make_team_env("TeamSupport", 2, **SMALL).venv
    with pytest.raises(ValueError, match="leave tile codes as they are"):
        CentralizedValueWrapper(VecFrameStack(rows, 2))
    renamed = TeamVenv(n_agents=2)
    renamed.observation_space = spaces.Dict({"seen": renamed.observation_space})
    CentralizedValueWrapper(VecExtractDictObs(renamed, "seen"), n_agents=2)


def test_short_first_episodes_of_staggered_games_do_not_count() -> None:
    level: dict[str, Any] = {"n_agents": 2, "grid_size": 8, "n_treasures": 2, "max_cycles": 10}
    env = make_team_env("TeamSupport", n_envs=5, seed=0, stagger=True, **level)
    assert evaluate_team(RandomPolicy(env.action_space, seed=0), env, 7).lengths == [10] * 7


# --- policies and settings on one's own environment -------------------------------------------------------------------


def test_sb3s_own_policy_warns_that_it_sees_the_team() -> None:
    env = make_team_env(CounterEnv, n_envs=2, seed=0)
    with pytest.raises(ValueError, match="You must use `MultiInputPolicy`"):  # SB3's advice, which users then follow:
        PPO("MlpPolicy", env)
    settings: dict[str, Any] = {"n_steps": 2, "batch_size": 8, "n_epochs": 1, "device": "cpu"}
    model = PPO("MultiInputPolicy", env, **settings)
    with pytest.warns(UserWarning, match=r"actor sees 'team', .*SAFPolicy, as in PPO\('SAFPolicy'"):
        model.learn(8, GameStepsCallback())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        settings |= {"rollout_buffer_class": TeamRolloutBuffer}
        PPO("SAFPolicy", env, **settings).learn(8, GameStepsCallback())
        del settings["rollout_buffer_class"]
        PPO("MlpPolicy", "CartPole-v1", **settings | {"n_steps": 8}).learn(8, GameStepsCallback())


def test_sb3s_own_buffer_warns_when_the_model_is_made_and_names_the_remedy() -> None:
    env = make_team_env(CounterEnv, n_envs=2, seed=0)
    with pytest.warns(UserWarning, match=r"SAFPolicy is trained on .*ppo_settings\(env\)") as told:
        model = PPO("SAFPolicy", env, n_steps=4, batch_size=8, device="cpu")
    assert sum("ppo_settings" in str(warning.message) for warning in told) == 1
    assert str(told[0].filename) == __file__, "the warning points at the line that made the model"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for algorithm in (PPO, A2C, TRPO):
            algorithm("SAFPolicy", env, rollout_buffer_class=TeamRolloutBuffer, n_steps=32, device="cpu")
        type(model.policy)(env.observation_space, env.action_space, lambda _: 0.0)
    with pytest.warns(UserWarning, match="is trained on"):  # again, on the same environment
        A2C("SAFPolicy", env, n_steps=4, device="cpu")


@pytest.mark.parametrize(("method", "algorithm"), [("saf", PPO), ("mappo", A2C), ("ippo", TRPO), ("saf", MaskablePPO)])
def test_settings_fit_the_algorithm(method: str, algorithm: Any) -> None:
    env = make_team_env("TeamSupport", 2, seed=0, n_agents=2, grid_size=7, n_treasures=2, max_cycles=10)
    settings = ppo_settings(env, method, algorithm, n_steps=8)
    has_own_buffer = algorithm in (PPO, A2C, TRPO)
    assert ("rollout_buffer_class" in settings) == has_own_buffer
    assert ("normalize_values" in settings["policy_kwargs"]) == has_own_buffer
    model = algorithm(method, env, **settings, device="cpu")
    with pytest.raises(ValueError, match=r"algorithm that trains .* 'DQN'"):
        ppo_settings(env, method, DQN)  # type: ignore[arg-type]
    if algorithm is not MaskablePPO:  # which needs masks
        model.learn(8 * 4)


def test_settings_of_another_method_are_named() -> None:
    env = make_team_env(CounterEnv, seed=0)
    with pytest.raises(TypeError, match=r"MAPPOPolicy has no argument 'n_policies'.*ppo_settings\(env, 'mappo'\)"):
        PPO("MAPPOPolicy", env, **ppo_settings(env, "saf"))


def test_settings_are_those_of_the_method() -> None:
    env = make_team_env("TeamSupport", n_envs=2, seed=0, observation="tiles")
    saf, no_pool = (ppo_settings(env, algo)["policy_kwargs"] for algo in ("saf", "saf-no-pool"))
    of_commands = load_settings("saf", "TeamSupport-v0", "small").hyperparams["policy_kwargs"]
    assert {**saf, "projection_arch": tuple(saf["projection_arch"])} == of_commands
    assert no_pool == {**saf, "n_policies": 1}
    with pytest.raises(ValueError, match=r"unknown method of PPO 'qplex'; there is saf, "):
        ppo_settings(env, "qplex")


@pytest.mark.parametrize("memory", [None, "gru"])
@pytest.mark.parametrize("deterministic", [False, True])
def test_qplex_acts_by_agent(memory: str | None, deterministic: bool) -> None:
    env = make_team_env(CounterEnv, n_envs=2, seed=0)
    model: Any = QPLEX("QPLEXPolicy", env, buffer_size=100, device="cpu", seed=0, policy_kwargs={"memory": memory})
    observations, _ = CounterEnv().reset(seed=0)
    model.set_random_seed(1)
    actions, _ = model.predict(observations, deterministic=deterministic)
    model.set_random_seed(1)
    rows = {"obs": np.stack(list(observations.values())), "agent": np.arange(2)}
    assert list(actions.values()) == model.predict(rows, deterministic=deterministic)[0].tolist()
    assert list(actions) == list(observations)


def test_a_mask_is_refused_by_a_model_without_masks() -> None:
    model = PPO("MAPPOPolicy", make_team_env(CounterEnv, seed=0), device="cpu")
    (given, _) = TellingEnv(n_agents=2).reset(seed=0)[0].values()
    with pytest.raises(ValueError, match="'action_mask'"):
        model.predict(given)


class Bounded(Game):
    def action_space(self, agent: Any) -> spaces.Space[Any]:
        return (
            spaces.Box(-1, 1, (1,))
            if agent == "a"
            else spaces.Box(np.array([0, 10]), np.array([10, 20]), dtype=np.float32)
        )


@pytest.mark.filterwarnings("ignore:expected Box actions around 0")
def test_a_random_policy_of_an_environment() -> None:
    env = make_team_env(CounterEnv, n_envs=2, seed=0)
    of_space, of_env, of_game = (RandomPolicy(source, seed=3) for source in (env.action_space, env, CounterEnv()))
    rows = env.reset()
    assert isinstance(rows, dict)
    drawn = [of_space.predict(rows)[0].tolist() for _ in range(20)]
    assert len({tuple(actions) for actions in drawn}) > 1
    assert [of_env.predict(rows)[0].tolist() for _ in range(20)] == drawn
    assert [of_game.predict(rows)[0].tolist() for _ in range(20)] == drawn
    env = make_team_env(Bounded, n_envs=500, seed=0)
    acted = RandomPolicy(env, seed=0).predict(env.reset())[0].reshape(500, 2, 2)
    assert acted.mean(axis=0) == pytest.approx(np.array([[0, 0], [5, 15]]), abs=0.5), "each between its own bounds"
    assert abs(acted[:, 0, 0]).max() < 1 and acted[:, 1].max() > 19
    for wrong in (None, 4, "Discrete(4)"):
        with pytest.raises(ValueError, match=r"expected one agent's action space, or an environment that has it, got"):
            RandomPolicy(cast(Any, wrong))
