from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import DictRolloutBuffer
from stable_baselines3.common.type_aliases import DictRolloutBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_saf.buffers.rollout import TeamRolloutBuffer
from sb3_saf.envs.joint_observation import CentralizedValueWrapper
from sb3_saf.envs.monitor import TeamMonitor
from tests.team_venv import VECTOR, Array, TeamVenv

N_STEPS, N_GAMES, N_AGENTS = 5, 4, 3
SPACES: dict[str, tuple[spaces.Space[Any], Callable[..., Any]]] = {
    "vector": (VECTOR, lambda e, i, k, t: np.array([e, i, k, t], dtype=np.float32)),
    "tiles": (
        spaces.Box(0, 99, (2, 2), np.uint8),
        lambda e, i, k, t: np.array([[e, i], [k, t]], dtype=np.uint8),
    ),
    "discrete": (spaces.Discrete(400), lambda e, i, k, t: 100 * e + 30 * i + 10 * k + t),
    "multi_discrete": (spaces.MultiDiscrete([9, 9, 9, 9]), lambda e, i, k, t: np.array([e, i, k, t])),
}


def make_env(name: str = "vector", lengths: tuple[int, ...] = (3, 2, 4, 7), **kwargs: Any) -> CentralizedValueWrapper:
    own_space, see = SPACES[name]
    return CentralizedValueWrapper(TeamMonitor(TeamVenv(lengths, N_AGENTS, own_space, see, **kwargs)))


def fill(buffers: list[Any], env: CentralizedValueWrapper, seed: int = 0, n_steps: int = N_STEPS) -> None:
    """Play, and put the same data with arbitrary values into all buffers."""
    rng = np.random.default_rng(seed)
    obs = env.reset()
    starts = np.ones(env.num_envs, dtype=bool)
    for _ in range(n_steps):
        actions = rng.integers(0, 5, size=env.num_envs)
        values, log_probs = th.tensor(rng.normal(size=(2, env.num_envs)), dtype=th.float32)
        new_obs, rewards, dones, _ = env.step(actions)
        for buffer in buffers:
            buffer.add(dict(obs), actions.reshape(-1, 1), rewards, starts, values.unsqueeze(1), log_probs)
        assert isinstance(new_obs, dict)
        obs, starts = new_obs, dones
    last_values = th.tensor(rng.normal(size=(env.num_envs, 1)), dtype=th.float32)
    for buffer in buffers:
        buffer.compute_returns_and_advantage(last_values, starts)


def make_buffer(env: CentralizedValueWrapper, kind: type[DictRolloutBuffer] = TeamRolloutBuffer, **kwargs: Any) -> Any:
    settings = {"device": "cpu", "gae_lambda": 0.9, "gamma": 0.97, "n_envs": env.num_envs, **kwargs}
    assert isinstance(env.observation_space, spaces.Dict)
    return kind(N_STEPS, env.observation_space, env.action_space, **settings)


def make_both(name: str) -> tuple[Any, Any]:
    env = make_env(name)
    team, stock = make_buffer(env), make_buffer(env, DictRolloutBuffer)
    fill([team, stock], env)
    return team, stock


def rows_of(samples: list[DictRolloutBufferSamples]) -> list[tuple[Any, ...]]:
    """Return all rows, in a canonical order."""
    rows = []
    for sample in samples:
        parts = [*(sample.observations[key] for key in ("obs", "team", "agent")), *sample[1:]]
        rows += list(zip(*(part.tolist() for part in parts), strict=True))
    return sorted(rows)


@pytest.mark.parametrize("name", SPACES)
def test_rows_and_advantages_are_those_of_sb3s_buffer_to_the_last_bit(name: str) -> None:
    team, stock = make_both(name)
    for part in ("advantages", "returns", "values", "log_probs", "rewards", "episode_starts"):
        np.testing.assert_array_equal(getattr(team, part), getattr(stock, part))
    samples, stock_samples = list(team.get(6)), list(stock.get(6))
    assert rows_of(samples) == rows_of(stock_samples)
    for part, stock_part in zip(samples[0][1:], stock_samples[0][1:], strict=True):
        assert (part.shape, part.dtype) == (stock_part.shape, stock_part.dtype)
    for key, stock_value in stock_samples[0].observations.items():
        value = samples[0].observations[key]
        assert (value.shape, value.dtype) == (stock_value.shape, stock_value.dtype), key


@pytest.mark.parametrize(
    ("batch_size", "sizes"),
    [(1, [3] * 20), (5, [3] * 20), (12, [12] * 5), (23, [21, 21, 18]), (None, [60]), (90, [60])],
)
def test_minibatches_hold_whole_teams(batch_size: int | None, sizes: list[int]) -> None:
    team, _ = make_both("vector")
    samples = list(team.get(batch_size))
    assert [len(sample.actions) for sample in samples] == sizes
    for sample in samples:
        obs = {key: value.numpy() for key, value in sample.observations.items()}
        own = obs["obs"].reshape(-1, N_AGENTS, 4)
        assert obs["agent"].reshape(-1, N_AGENTS).tolist() == [[0, 1, 2]] * len(own)
        assert own[:, :, 1].tolist() == [[0, 1, 2]] * len(own)
        for column in (0, 2, 3):
            assert (own[:, :, column] == own[:, :1, column]).all(), "agents of one game at one step"
        np.testing.assert_array_equal(
            obs["team"].reshape(-1, N_AGENTS, N_AGENTS, 4), np.repeat(own[:, None], N_AGENTS, 1)
        )
    with pytest.raises(KeyError, match="other"):
        samples[0].observations["other"]


def test_order_is_drawn_anew_from_the_generator_that_sb3_seeds() -> None:
    team, _ = make_both("vector")

    def order() -> list[list[float]]:
        return [sample.old_values.tolist() for sample in team.get(6)]

    np.random.seed(3)  # noqa: NPY002
    first, second = order(), order()
    assert first != second
    assert sorted(map(tuple, first)) != sorted(map(tuple, second))
    np.random.seed(3)  # noqa: NPY002
    assert [order(), order()] == [first, second]
    np.random.seed(4)  # noqa: NPY002
    assert order() != first


def test_memory_is_one_observation_per_row_and_33_bytes() -> None:
    own = spaces.Box(0, 99, (7, 7), np.uint8)
    parts = CentralizedValueWrapper(TeamVenv((9,) * 4, 10, own, lambda *_: np.zeros((7, 7)))).observation_space
    team = TeamRolloutBuffer(50, parts, spaces.Discrete(7), "cpu", n_envs=40)  # type: ignore[arg-type]
    assert team.nbytes == 50 * 40 * (49 + 33)
    assert list(team.observations) == ["obs"]
    stock = DictRolloutBuffer(50, parts, spaces.Discrete(7), "cpu", n_envs=40)  # type: ignore[arg-type]
    stock_bytes = sum(value.nbytes for value in stock.observations.values()) + 50 * 40 * 32
    assert stock_bytes == 50 * 40 * 587


def a_step(env: CentralizedValueWrapper) -> tuple[dict[str, Array], tuple[Any, ...]]:
    rest = (np.zeros((env.num_envs, 1)), np.zeros(env.num_envs), np.zeros(env.num_envs), th.zeros(env.num_envs))
    return env.reset(), (*rest, th.zeros(env.num_envs))


def swap_rows(obs: dict[str, Array]) -> None:
    for value in obs.values():
        value[[0, 1]] = value[[1, 0]]


def swap_games(obs: dict[str, Array]) -> None:
    obs["team"][:3], obs["team"][3:6] = obs["team"][3:6].copy(), obs["team"][:3].copy()


def larger_team(obs: dict[str, Array]) -> None:
    obs["team"] = np.concatenate([obs["team"], obs["team"][:, :1]], axis=1)


def fewer_rows(obs: dict[str, Array]) -> None:
    for key in obs:
        obs[key] = obs[key][:-1]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (swap_rows, r"'agent' 0 to 2 in each team, got \[1, 0, 2, 0, 1, 2\] .*CentralizedValueWrapper"),
        (swap_games, "'team' to hold the 'obs' .* below CentralizedValueWrapper only"),
        (larger_team, r"'team' to hold the 'obs' .* got another one of shape \(12, 4, 4\)"),
        (fewer_rows, r"expected 'obs' of shape \(12, 4\) and dtype float32, got \(11, 4\) and float32"),
    ],
)
def test_rows_that_are_no_whole_teams_are_refused(spoil: Callable[[dict[str, Array]], None], message: str) -> None:
    env = make_env()
    obs, rest = a_step(env)
    spoil(obs)
    with pytest.raises(ValueError, match=message):
        make_buffer(env).add(obs, *rest)


def test_what_cannot_be_buffered() -> None:
    env = make_env()
    with pytest.raises(ValueError, match="whole teams, a multiple of n_agents=3, got 11 rows"):
        make_buffer(env, n_envs=11)
    with pytest.raises(ValueError, match="expected the Dict observation space of CentralizedValueWrapper"):
        TeamRolloutBuffer(5, VECTOR, env.action_space)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="expected a full rollout of 5 steps, got 0; add the rest first"):
        next(make_buffer(env).get())


def test_observations_normalised_above_the_wrapper_are_refused() -> None:
    settings: dict[str, Any] = {"n_steps": N_STEPS, "batch_size": 30, "rollout_buffer_class": TeamRolloutBuffer}
    model = PPO("MultiInputPolicy", VecNormalize(make_env(), norm_obs_keys=["obs", "team"]), **settings)
    with pytest.raises(ValueError, match="change or normalise observations below CentralizedValueWrapper"):
        model.learn(60)
    PPO("MultiInputPolicy", CentralizedValueWrapper(VecNormalize(make_env().venv)), **settings).learn(60)
