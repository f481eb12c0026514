"""Common mistakes in custom environments, and their error messages."""

from __future__ import annotations

import warnings
from typing import Any, cast

import numpy as np
import pytest
from sb3_contrib import TRPO, MaskablePPO
from stable_baselines3 import A2C, DQN, PPO

from sb3_saf import (
    QPLEX,
    GameStepsCallback,
    RandomPolicy,
    TeamRolloutBuffer,
    make_team_env,
    ppo_settings,
)
from sb3_saf.training.settings import load_settings
from tests.toy_envs import CounterEnv, TellingEnv


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


def test_a_random_policy_of_an_environment() -> None:
    env = make_team_env(CounterEnv, n_envs=2, seed=0)
    of_space, of_env, of_game = (RandomPolicy(source, seed=3) for source in (env.action_space, env, CounterEnv()))
    rows = env.reset()
    assert isinstance(rows, dict)
    drawn = [of_space.predict(rows)[0].tolist() for _ in range(20)]
    assert len({tuple(actions) for actions in drawn}) > 1
    assert [of_env.predict(rows)[0].tolist() for _ in range(20)] == drawn
    assert [of_game.predict(rows)[0].tolist() for _ in range(20)] == drawn
    for wrong in (None, 4, "Discrete(4)"):
        with pytest.raises(ValueError, match=r"expected one agent's action space, or an environment that has it, got"):
            RandomPolicy(cast(Any, wrong))
