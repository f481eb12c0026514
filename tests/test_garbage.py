"""Invalid training data is detected: NaN and infinity, rows in another order, training games in evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

import sb3_saf
from sb3_saf import QPLEX, FiniteCallback, NonFiniteError, TeamEvalCallback, resumable_learn
from tests.weights import weights_of

N_AGENTS, N_GAMES, N_STEPS = 2, 3, 4
ROLLOUT = N_AGENTS * N_GAMES * N_STEPS
TASK: dict[str, Any] = {"n_agents": N_AGENTS, "grid_size": 7, "n_treasures": 3, "coordination": 1, "max_cycles": 10}
LIGHT: dict[str, Any] = {"features_extractor_class": sb3_saf.LightEncoder, "net_arch": [8]}


class Spoiled(VecEnvWrapper):
    """Games whose observations (numbers, not bytes) or rewards have an invalid value from a given step on."""

    def __init__(self, venv: VecEnv, what: str, value: float, step: int) -> None:
        shape = venv.observation_space.shape
        super().__init__(venv, observation_space=spaces.Box(-np.inf, np.inf, shape, np.float32))
        self.what, self.value, self.steps_left = what, value, step

    def reset(self) -> Any:
        return np.asarray(self.venv.reset(), dtype=np.float32)

    def step_wait(self) -> Any:
        obs, rewards, dones, infos = self.venv.step_wait()
        obs = np.asarray(obs, dtype=np.float32)
        self.steps_left -= 1
        if self.steps_left <= 0:
            (obs if self.what == "observations" else rewards)[3:4] = self.value
        return obs, rewards, dones, infos

    def checkpoint_state(self) -> dict[str, Any]:
        return {}

    def load_checkpoint_state(self, state: object) -> None:
        pass


def games(seed: int = 0, **spoiled: Any) -> sb3_saf.CentralizedValueWrapper:
    native = sb3_saf.make_team_env("TeamTogether", N_GAMES, seed=seed, **TASK).venv
    return sb3_saf.CentralizedValueWrapper(Spoiled(native, **spoiled) if spoiled else native)


def ppo(env: VecEnv | None = None, **settings: Any) -> PPO:
    policy = LIGHT if env is None else {"net_arch": [8]}
    defaults = {"n_steps": N_STEPS, "batch_size": ROLLOUT // 2, "n_epochs": 1, "seed": 0, "policy_kwargs": policy}
    buffer = sb3_saf.TeamRolloutBuffer
    return PPO("SAFPolicy", env or games(), rollout_buffer_class=buffer, **{**defaults, **settings})


CAUSES: dict[str, tuple[Any, str]] = {
    "loss": (lambda: ppo(ent_coef=float("nan")), r"the gradient of \S+ must be finite, got nan at game step 12, .*"),
    "reward": (
        lambda: ppo(games(what="rewards", value=float("nan"), step=6)),
        "rewards must be finite, got nan at step 6 for agent 1 of game 1.*",
    ),
    "observation": (
        lambda: ppo(games(what="observations", value=float("-inf"), step=7)),
        "observations must be finite, got -inf at step 7 for agent 1 of game 1.*",
    ),
    "returns": (
        lambda: ppo(games(what="rewards", value=3e38, step=2)),
        "returns of the rollout must be finite, got inf at game step 12, after 0 steps of the optimizer.*",
    ),
    "values of QPLEX": (
        lambda: QPLEX(
            "QPLEXPolicy", games(), gamma=float("nan"), learning_starts=6, batch_size=4, train_freq=6, seed=0
        ),
        r"the gradient of \S+ must be finite, got nan at game step 12.*",
    ),
}


@pytest.mark.filterwarnings("ignore:overflow encountered")
@pytest.mark.parametrize("name", CAUSES)
def test_training_stops_with_step_name_and_last_good_checkpoint_and_good_weights(name: str, tmp_path: Path) -> None:
    make, words = CAUSES[name]
    model = make()
    with pytest.raises(NonFiniteError, match=rf"{words}last good checkpoint is .*checkpoint-\d+\.ckpt"):
        resumable_learn(model, 10 * ROLLOUT, tmp_path, every_game_steps=1)
    assert all(bool(tensor.isfinite().all()) for tensor in model.policy.state_dict().values())


def test_nothing_is_learned_from_bad_losses_and_those_of_before_are_named() -> None:
    model = ppo().learn(ROLLOUT)
    before = weights_of(model)
    model.ent_coef = float("nan")
    with pytest.raises(NonFiniteError, match=r"the gradient of \S+ must be finite, got nan at game step \d+, after 0"):
        model.learn(ROLLOUT, FiniteCallback())
    assert weights_of(model) == before
    with pytest.raises(NonFiniteError, match=r"\(the update before had .*train/value_loss \d.*train/loss -?\d.*\)"):
        ppo().learn(3 * ROLLOUT, [FiniteCallback(), SpoiledLater()])


class SpoiledLater(BaseCallback):
    """Makes the loss NaN after the first update."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        if self.num_timesteps > ROLLOUT:
            vars(self.model)["ent_coef"] = float("nan")


def test_one_bad_gradient_is_named_before_clipping_spreads_it() -> None:
    model = ppo()
    assert isinstance(model.policy, sb3_saf.SAFPolicy)
    names = [name for name, _ in model.policy.named_parameters()]
    spoiled = names[len(names) // 2]
    dict(model.policy.named_parameters())[spoiled].register_hook(lambda grad: grad * float("inf"))
    with pytest.raises(NonFiniteError, match=rf"the gradient of {spoiled} must be finite"):
        model.learn(ROLLOUT, FiniteCallback())


def test_weights_and_losses_are_looked_at_after_updates() -> None:
    with pytest.raises(NonFiniteError, match="must be finite"):
        ppo(learning_rate=1e38, max_grad_norm=1e30, policy_kwargs={**LIGHT, "optimizer_class": th.optim.SGD}).learn(
            2 * ROLLOUT, FiniteCallback()
        )
    model = ppo()
    callback = FiniteCallback()
    model.learn(ROLLOUT)
    callback.init_callback(model)
    model.logger.record("train/value_loss", float("inf"))
    with pytest.raises(NonFiniteError, match=r"train/value_loss must be finite, got inf at game step 12"):
        callback.on_rollout_start()


def test_looking_changes_nothing_and_leaves_nothing() -> None:
    model, plain = ppo().learn(3 * ROLLOUT, FiniteCallback()), ppo().learn(3 * ROLLOUT)
    assert weights_of(model) == weights_of(plain)
    assert not model.policy.optimizer._optimizer_step_pre_hooks
    assert not any(parameter._post_accumulate_grad_hooks for parameter in model.policy.parameters())


# --- seeds ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["native", "supersuit"])
def test_evaluation_on_the_games_of_training_is_refused(backend: Any) -> None:
    evaluations = [
        TeamEvalCallback(sb3_saf.make_team_env("TeamTogether", 2, 5, backend, **TASK), warn=False) for _ in range(2)
    ]
    with pytest.raises(ValueError, match=r"got 2 with seeds of training games.*another one"):
        ppo(games(seed=7), seed=5).learn(ROLLOUT, evaluations[0])
    ppo(games(seed=5), seed=7).learn(ROLLOUT, evaluations[1])
