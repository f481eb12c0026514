"""Values computed at the end of a rollout equal those computed at each step."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from sb3_saf import TeamRolloutBuffer, make_team_env
from sb3_saf.buffers.rollout import LaterValues, compute_together
from tests.toy_envs import LateEnv
from tests.toy_teams import VECTOR, CodeSpace, ToyTeams


class Eager(BaseCallback):
    """Computes the values at every step."""

    def __init__(self) -> None:
        super().__init__()
        self.values: list[np.ndarray] = []
        self.kinds: set[type] = set()

    def _on_step(self) -> bool:
        with th.no_grad():
            policy: Any = self.model.policy
            self.values.append(policy.predict_values(self.locals["obs_tensor"]).numpy()[:, 0])
        self.kinds.add(type(self.locals["values"]))
        return True


@pytest.mark.parametrize(
    ("policy", "game", "normalize_values"),
    [
        ("IPPOPolicy", "agents that join late", False),
        ("MAPPOPolicy", "agents that join late", True),
        ("MAPPOPolicy", "codes", False),
        ("SAFPolicy", "agents that join late", False),
        ("SAFPolicy", "vectors", True),
        ("SAFPolicy", "codes", True),
    ],
)
def test_values_of_many_steps_are_those_of_each(policy: str, game: str, normalize_values: bool) -> None:
    venv: Any = {
        "vectors": lambda: ToyTeams(VECTOR),
        "codes": lambda: ToyTeams(CodeSpace()),
        "agents that join late": lambda: make_team_env(LateEnv, n_envs=2, seed=0),
    }[game]()
    eager = Eager()
    model = PPO(
        policy,
        venv,
        n_steps=30,
        batch_size=30 * venv.num_envs,
        n_epochs=1,
        rollout_buffer_class=TeamRolloutBuffer,
        policy_kwargs={"normalize_values": normalize_values},
        seed=0,
        device="cpu",
    )
    model.learn(2 * 30 * venv.num_envs, eager)
    assert eager.kinds == {LaterValues}
    values, expected = model.rollout_buffer.values, np.stack(eager.values[-30:])
    active = expected != 0  # the buffer's values of other rows are those of the wait until the agent acts again
    np.testing.assert_allclose(values[active], expected[active], rtol=1e-5, atol=1e-5)
    assert np.ptp(values[active]) > 1e-3


def test_who_uses_them_has_them_computed_once() -> None:
    asked: list[int] = []

    def compute(steps: Any) -> list[th.Tensor]:
        asked.append(len(steps))
        return [th.full((3, 1), step) for step in steps]

    steps: Any = (1.0, 2.0, 3.0)
    one, other, third = (LaterValues.of(step, th.zeros(3), compute) for step in steps)
    assert one.shape == (3, 1) and asked in ([], [1])
    assert (one + one).tolist() == [[2.0]] * 3
    assert th.cat([one, one]).sum() == 6.0
    assert asked == [1]
    assert [float(values.mean()) for values in compute_together([one, other, third])] == [1.0, 2.0, 3.0]
    assert other.numpy().tolist() == [[2.0]] * 3
    assert asked == [1, 2]
