"""Common mistakes in custom environments, and their error messages."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import supersuit
from gymnasium import spaces
from sb3_contrib import TRPO, MaskablePPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import StopTrainingOnRewardThreshold

from sb3_saf import (
    QPLEX,
    GameStepsCallback,
    RandomPolicy,
    TeamEvalCallback,
    TeamRolloutBuffer,
    make_team_env,
    ppo_settings,
)
from sb3_saf.training.settings import load_settings
from tests.toy_envs import CounterEnv, TellingEnv


class BrokenReset(CounterEnv):
    """Raises a TypeError in its reset."""

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return len(3)  # type: ignore[arg-type]


def test_a_type_error_of_the_game_itself_comes_out_as_it_is() -> None:
    with pytest.raises(TypeError, match="has no len"):
        _played(BrokenReset)


# --- policies ---------------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("algorithm", [PPO, A2C, TRPO, MaskablePPO])
@pytest.mark.parametrize("method", ["saf", "mappo", "ippo"])
def test_settings_fit_the_algorithm(algorithm: Any, method: str) -> None:
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


@pytest.mark.parametrize("policy", ["SAF", "MAPPO", "IPPO"])
@pytest.mark.parametrize("overrides", [{}, {"n_steps": 7, "n_epochs": 1, "policy_kwargs": {"net_arch": [8]}}])
def test_good_settings_train_any_team(policy: str, overrides: dict[str, Any]) -> None:
    env = make_team_env(CounterEnv, n_envs=3, seed=0)
    settings = ppo_settings(env, policy.lower(), device="cpu", **overrides)
    assert settings["batch_size"] % 2 == 0 and settings["rollout_buffer_class"] is TeamRolloutBuffer
    assert settings["policy_kwargs"].items() >= overrides.get("policy_kwargs", {}).items()
    assert all(settings[key] == value for key, value in overrides.items() if key != "policy_kwargs")
    model = PPO(policy, env, **settings)
    assert model.n_steps * model.n_envs == (42 if overrides else 2 * 3 * 268)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "the games have action_masks")
        model.learn(1 if overrides else 0, GameStepsCallback())


def test_settings_are_those_of_the_method() -> None:
    env = make_team_env("TeamSupport", n_envs=2, seed=0, observation="tiles")
    saf, no_pool = (ppo_settings(env, algo)["policy_kwargs"] for algo in ("saf", "saf-no-pool"))
    of_commands = load_settings("saf", "TeamSupport-v0", "small").hyperparams["policy_kwargs"]
    assert {**saf, "projection_arch": tuple(saf["projection_arch"])} == of_commands
    assert no_pool == {**saf, "n_policies": 1}
    with pytest.raises(ValueError, match=r"unknown method of PPO 'qplex'; there is saf, "):
        ppo_settings(env, "qplex")


def test_actors_that_read_who_acts_are_told_by_name_or_index() -> None:
    env = make_team_env(CounterEnv, n_envs=2, seed=0)
    model = PPO("IPPOPolicy", env, policy_kwargs={"actor_identity": True}, device="cpu")
    observations, _ = CounterEnv().reset(seed=0)
    actions, _ = model.predict(observations, deterministic=True)
    alone = {"obs": observations["agent_1"], "agent": 1}
    assert model.predict(alone, deterministic=True)[0] == actions["agent_1"]
    alone = {"agent_1": observations["agent_1"]}
    assert model.predict(alone, deterministic=True)[0] == {"agent_1": actions["agent_1"]}
    with pytest.raises(ValueError, match=r"expected observations of 'agent_0', 'agent_1', the agents .* got 'agent_9'"):
        model.predict({"agent_9": observations["agent_1"]})
    with pytest.raises(ValueError, match=r"expected the observation to have 'agent'"):
        model.predict(observations["agent_1"])
    with pytest.raises(ValueError, match=r"got 'team_view'$"):  # a row with a misspelt key is not a dict of agents
        model.predict({"obs": observations["agent_1"], "team_view": observations["agent_1"]})


@pytest.mark.parametrize("is_saved", [False, True])
def test_agents_are_found_by_their_names(is_saved: bool, tmp_path: Path) -> None:
    env = make_team_env(CounterEnv, n_envs=2, seed=0)
    model: Any = PPO("MAPPOPolicy", env, policy_kwargs={"heads": "per_agent"}, device="cpu", seed=0)
    for index, head in enumerate(model.policy.actor.head.heads):  # each agent prefers an action of its own
        head.net[-1].bias.data[index] = 5
    if is_saved:
        model.save(tmp_path / "model")
        model = PPO.load(tmp_path / "model", device="cpu")
    seen = next(iter(CounterEnv().reset(seed=0)[0].values()))
    by_index = [int(model.predict({"obs": seen, "agent": i}, deterministic=True)[0]) for i in range(2)]
    assert by_index == [0, 1]
    actions, _ = model.predict({"agent_1": seen, "agent_0": seen}, deterministic=True)
    assert actions == {"agent_1": by_index[1], "agent_0": by_index[0]}


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


def test_qplex_explores_legal_actions_by_agent() -> None:
    model: Any = QPLEX(
        "QPLEXPolicy", make_team_env(lambda: TellingEnv(n_agents=2), seed=0), buffer_size=100, device="cpu"
    )
    observations, _ = TellingEnv(n_agents=2).reset(seed=0)
    assert model.exploration_rate == 1.0
    for _ in range(20):
        actions, _ = model.predict(observations)
        assert all(observations[agent]["action_mask"][action] == 1 for agent, action in actions.items())


def test_masks_in_pettingzoos_form_are_understood() -> None:
    model, unmasked = (
        PPO("MAPPOPolicy", make_team_env(game(n_agents=2), seed=0), device="cpu", seed=0)
        for game in (TellingEnv, CounterEnv)
    )
    for given in TellingEnv(n_agents=2).reset(seed=0)[0].values():
        row = {"obs": given["observation"], "action_mask": given["action_mask"]}
        assert model.predict(given, None, None, True)[0] == model.predict(row, deterministic=True)[0]
        with pytest.raises(ValueError, match="expected no 'action_mask'"):
            unmasked.predict(given)


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


def _played(env: Any) -> None:
    venv = make_team_env(env, n_envs=2, seed=0)
    venv.reset()
    venv.step(np.zeros(venv.num_envs, dtype=int))


# --- large images -----------------------------------------------------------------------------------------------------


class Stripes(CounterEnv):
    """Two agents each see stripes in one of four directions in a large image, and are paid for naming it."""

    def __init__(self) -> None:
        super().__init__(n_agents=2, max_cycles=8)
        self.rng = np.random.default_rng(0)

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Box(0, 255, (120, 160, 3), np.uint8)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Discrete(4)

    def _pictures(self) -> dict[str, np.ndarray]:
        self.directions = {agent: int(self.rng.integers(4)) for agent in self.possible_agents}
        y, x = np.mgrid[:120, :160]
        return {
            agent: np.where(((y, x, y + x, y - x)[direction] + self.rng.integers(24)) // 12 % 2, 200, 100)
            .astype(np.uint8)[:, :, np.newaxis]
            .repeat(3, axis=2)
            for agent, direction in self.directions.items()
        }

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.rng = np.random.default_rng(seed)
        return self._pictures(), super().reset(seed, options)[1]

    def step(self, actions: dict[str, Any]) -> Any:
        rewards = {agent: float(actions[agent] == self.directions[agent]) for agent in actions}
        _, _, *rest = super().step(actions)
        return self._pictures(), rewards, *rest


def test_the_advice_for_large_images_learns() -> None:
    def game() -> Any:
        return supersuit.resize_v1(supersuit.color_reduction_v0(Stripes(), "B"), 84, 84)

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*render_mode", UserWarning, "pettingzoo")
        env, tests = (make_team_env(game, n_envs=4, seed=seed) for seed in (0, 1))
    solved = TeamEvalCallback(
        tests, callback_on_new_best=StopTrainingOnRewardThreshold(0.9 * 16), n_eval_episodes=8, eval_freq=128, verbose=0
    )
    model = PPO(
        "IPPOPolicy",
        env,
        8e-4,
        n_steps=16,
        batch_size=32,
        n_epochs=4,
        gamma=0.0,
        seed=0,
        device="cpu",
        rollout_buffer_class=TeamRolloutBuffer,
    )
    model.learn(4096, solved)
    assert solved.best_mean_reward > 0.9 * 16, "a random team gets a quarter of 16"
