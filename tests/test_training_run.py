"""``train``: the one way from settings to a trained model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_saf.training.run import CHECKPOINTS, RunOptions, Training, load_parameters, train
from sb3_saf.training.settings import Settings, load_settings
from tests.test_training_commands import equal, weights

ENV = "TeamTogether-v0"


@pytest.fixture(scope="module")
def settings() -> Settings:
    return load_settings("saf", ENV, "smoke")


@pytest.fixture(scope="module")
def by_hand(settings: Settings) -> dict[str, th.Tensor]:
    model = settings.make_model(settings.make_env(3), 3)
    model.learn(settings.total_timesteps)
    return weights(model)


class Interrupt(BaseCallback):
    """Raise an error after so many agents' steps."""

    def __init__(self, after: int, error: type[BaseException]) -> None:
        super().__init__()
        self.after, self.error = after, error

    def _on_step(self) -> bool:
        if self.num_timesteps >= self.after:
            raise self.error
        return True


def test_options_do_not_change_what_is_learned(
    settings: Settings, by_hand: dict[str, th.Tensor], tmp_path: Path
) -> None:
    assert equal(by_hand, weights(train(settings, 3)))
    options = RunOptions(
        eval_freq=60, eval_episodes=4, save_freq=100, inspect_freq=200, checkpoint_freq=None, tensorboard_log=tmp_path
    )
    folder = tmp_path / "run"
    assert equal(by_hand, weights(train(settings, 3, folder, options)))
    assert {"model.zip", "best_model.zip", "evaluations.npz", "monitor.csv", "rl_model_400_steps.zip"} <= {
        path.name for path in folder.iterdir()
    }
    assert not (folder / CHECKPOINTS).exists()


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_interrupted_run_goes_on(
    error: type[BaseException], settings: Settings, by_hand: dict[str, th.Tensor], tmp_path: Path
) -> None:
    options = RunOptions(checkpoint_freq=1)
    with pytest.raises(error):
        train(settings, 3, tmp_path, options, [Interrupt(900, error)])
    assert (tmp_path / "model.zip").is_file() == (error is KeyboardInterrupt)
    assert equal(by_hand, weights(train(settings, 3, tmp_path, options, [Interrupt(10**9, error)])))


def test_a_model_is_trained_on_from_its_weights_alone(settings: Settings, tmp_path: Path) -> None:
    first = train(settings, 3, tmp_path)
    slow = load_settings("saf", ENV, "smoke", overrides={"learning_rate": 1e-30})
    second = train(slow, 3, None, RunOptions(initial_model=tmp_path / "model.zip"))
    assert all(
        np.allclose(a, b, atol=1e-5) for a, b in zip(weights(first).values(), weights(second).values(), strict=True)
    )
    other = load_settings("mappo", ENV, "smoke")
    with Training(other, 3) as training, pytest.raises(ValueError, match="do not fit MAPPOPolicy"):
        load_parameters(training.model, tmp_path / "model.zip")


def test_evaluation_needs_the_agents_of_training(settings: Settings) -> None:
    others = load_settings("saf", ENV, "smoke", {"n_agents": 3})
    with pytest.raises(ValueError, match="evaluation needs the 4 agents of training, got n_agents=3"):
        train(settings, 0, None, RunOptions(eval_freq=None, eval_settings=others))
