"""Gathering rows has gradients that repeat on any number of threads, and so do trainings."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch as th
from stable_baselines3 import PPO

from sb3_saf import QPLEX, LightEncoder, TeamRolloutBuffer, make_team_env
from sb3_saf.networks.layers import gather, gather_agents


@pytest.fixture
def two_threads() -> Iterator[None]:
    """Set torch to two threads for one test."""
    before = th.get_num_threads()
    th.set_num_threads(2)
    yield
    th.set_num_threads(before)


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)], ids=str)
def test_gather_is_indexing(shape: tuple[int, ...]) -> None:
    x = th.randn(4, *shape, dtype=th.float64, requires_grad=True)
    rows = th.tensor([[0, 3, 3], [1, 0, 3]])
    assert th.equal(gather(x, rows), x[rows])
    assert th.autograd.gradcheck(lambda x: gather(x, rows), (x,))
    of_agents = th.randn(3, 4, *shape, dtype=th.float64)
    teams, agent = th.tensor([2, 0, 2]), th.tensor([3, 1, 3])
    assert th.equal(gather_agents(of_agents, teams, agent), of_agents[teams, agent])


def _trained(algorithm: type[Any], policy: str, memory: str | None = None, **kwargs: Any) -> th.Tensor:
    env = make_team_env("TeamSupport", n_envs=32, seed=0, n_agents=5, grid_size=12, n_treasures=20)
    policy_kwargs: dict[str, Any] = {"features_extractor_class": LightEncoder}
    policy_kwargs |= {} if memory is None else {"memory": memory}
    model = algorithm(policy, env, seed=0, policy_kwargs=policy_kwargs, device="cpu", **kwargs)
    parameters = list(model.policy.parameters())
    before = th.nn.utils.parameters_to_vector(parameters).detach().clone()
    model.learn(4_000)
    after = th.nn.utils.parameters_to_vector(parameters).detach()
    assert not th.equal(before, after)
    return after


_PPO = {"n_steps": 25, "batch_size": 4_000, "n_epochs": 1, "rollout_buffer_class": TeamRolloutBuffer}
_QPLEX: dict[str, Any] = {"batch_size": 128, "learning_starts": 600}


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize(
    ("algorithm", "policy", "kwargs"),
    [
        (PPO, "SAFPolicy", _PPO),
        (PPO, "SAFPolicy", _PPO | {"memory": "gru"}),
        (QPLEX, "QPLEXPolicy", _QPLEX),
    ],
)
def test_a_training_repeats_on_two_threads(algorithm: type[Any], policy: str, kwargs: dict[str, Any]) -> None:
    assert th.equal(_trained(algorithm, policy, **kwargs), _trained(algorithm, policy, **kwargs))
