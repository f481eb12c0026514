from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure

from sb3_saf import QPLEX, CentralizedValueWrapper, EntropySchedule, TeamReplayBuffer
from tests.team_venv import TeamVenv

ROLLOUT = 24  # agent steps


class Seen(BaseCallback):
    """Record the coefficients of updates, and those between them, with which a model would be saved."""

    def __init__(self) -> None:
        super().__init__()
        self.coefficients: list[float] = []
        self.saved: set[float] = set()

    def _on_step(self) -> bool:
        self.saved.add(vars(self.model)["ent_coef"])
        return True

    def _on_rollout_end(self) -> None:
        self.coefficients.append(vars(self.model)["ent_coef"])


def learner(algorithm: Any, **settings: Any) -> Any:
    env = CentralizedValueWrapper(TeamVenv(lengths=(3, 2)))
    return algorithm("IPPOPolicy", env, n_steps=4, device="cpu", seed=0, **settings)


@pytest.mark.parametrize(("algorithm", "settings"), [(PPO, {"batch_size": ROLLOUT, "n_epochs": 1}), (A2C, {})])
def test_updates_use_a_coefficient_that_changes_linearly(
    algorithm: Any, settings: dict[str, Any], tmp_path: Path
) -> None:
    model, seen = learner(algorithm, ent_coef=0.08, **settings), Seen()
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(4 * ROLLOUT, [EntropySchedule(end=0.04), seen], log_interval=1)
    assert seen.coefficients == pytest.approx([0.07, 0.06, 0.05, 0.04])
    assert model.ent_coef == 0.08
    assert seen.saved == {0.08}  # a model that is saved during a rollout has its own value
    model.logger.close()
    with (tmp_path / "progress.csv").open() as file:
        logged = [float(row["train/ent_coef"]) for row in csv.DictReader(file)]
    assert logged == pytest.approx([0.08, 0.07, 0.06, 0.05])  # beside the losses of the update before


def test_the_bonus_is_gone_at_the_end_also_of_a_training_that_goes_on() -> None:
    model, seen = learner(PPO, ent_coef=0.01, batch_size=ROLLOUT, n_epochs=1), Seen()
    model.learn(ROLLOUT, [EntropySchedule(), seen])
    model.learn(ROLLOUT, [EntropySchedule(), seen], reset_num_timesteps=False)
    assert seen.coefficients == pytest.approx([0.0, 0.0])
    model.learn(2 * ROLLOUT, [EntropySchedule(), seen])
    assert seen.coefficients[2:] == pytest.approx([0.005, 0.0])


def test_what_has_no_entropy_coefficient_is_refused() -> None:
    env = CentralizedValueWrapper(TeamVenv(lengths=(3, 2)))
    model = QPLEX("QPLEXPolicy", env, replay_buffer_class=TeamReplayBuffer, buffer_size=100, device="cpu")
    with pytest.raises(ValueError, match="of PPO and A2C; QPLEX has none; leave the callback out"):
        model.learn(ROLLOUT, EntropySchedule())
    with pytest.raises(ValueError, match=r"ent_coef is 0\.0 from the start, as end; give the algorithm another"):
        learner(PPO, ent_coef=0.0, batch_size=ROLLOUT).learn(ROLLOUT, EntropySchedule())


@pytest.mark.parametrize("end", [-1, float("nan"), float("inf"), "x", None, True])
def test_the_end_is_a_number(end: Any) -> None:
    with pytest.raises(ValueError, match=f"end must be a number of at least 0, got {end!r}"):
        EntropySchedule(end=end)
