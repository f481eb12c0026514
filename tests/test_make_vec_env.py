"""
Native and SuperSuit backends give the same numbers, row by row, bit for bit.

``test_batch`` compares the native backend with ``parallel_env``, including ends of episodes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import supersuit
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

import hecogrid_envs
from sb3_saf import game_seeds, make_vec_env

SMALL: dict[str, Any] = {
    "n_agents": 3,
    "grid_size": 9,
    "coordination": 2,
    "heterogeneity": 2,
    "n_treasures": 12,
    "n_keys": 5,
    "max_cycles": 7,
}
#: Crowded, so that treasures are collected within a few steps of random play.
CROWDED: dict[str, Any] = {**SMALL, "coordination": 1, "n_treasures": 20, "n_keys": 15, "clutter_density": 0.0}
#: Mostly forward and pickup in zone 0.
ACTION_WEIGHTS = [0.1, 0.1, 0.4, 0.25, 0.05, 0.05, 0.05]


def history(venv: Any, n_steps: int = 20) -> list[Any]:
    rng = np.random.default_rng(0)
    frames: list[Any] = [venv.reset(), venv.reset_infos]
    for _ in range(n_steps):
        observations, rewards, dones, infos = venv.step(rng.choice(7, size=venv.num_envs, p=ACTION_WEIGHTS))
        frames.append((observations.copy(), rewards.copy(), dones.copy(), infos, list(venv.reset_infos)))
    venv.close()
    return frames


def assert_same_frames(one: list[Any], other: list[Any]) -> None:
    np.testing.assert_equal(one, other)
    for a, b in zip(one[2:], other[2:], strict=True):
        assert [x.dtype for x in a[:3]] == [x.dtype for x in b[:3]]


@pytest.mark.parametrize(
    ("task", "observation", "rules", "n_cpus"),
    [
        ("TeamTogether", "rgb", "paper", 1),
        ("TeamSupport", "tiles", "paper", 1),
        ("TeamSupport", "rgb", "released", 1),
        ("KeyForTreasure", "tiles", "released", 1),
        ("KeyForTreasure", "rgb", "paper", 2),
    ],
)
def test_both_backends_give_the_same_numbers(task: str, observation: str, rules: str, n_cpus: int) -> None:
    params = {**CROWDED, "max_cycles": 20, "rules": rules, "observation": observation}
    native = history(make_vec_env(task, n_envs=4, seed=11, **params), 50)
    supersuit = history(make_vec_env(task, n_envs=4, seed=11, backend="supersuit", n_cpus=n_cpus, **params), 50)
    assert_same_frames(native, supersuit)
    assert sum(frame[1].sum() for frame in native[2:]) > 0, "some treasure must be collected for this to mean anything"


@pytest.mark.parametrize("backend", ["native", "supersuit"])
def test_seeds(backend: Any) -> None:
    def first(seed: int | None, **kwargs: Any) -> Any:
        return make_vec_env("TeamSupport", n_envs=6, seed=seed, backend=backend, **SMALL, **kwargs).reset()

    np.testing.assert_array_equal(first(1), first(1))
    per_game = first(1).reshape(6, -1)
    assert len({game.tobytes() for game in per_game}) == 6, "games of one environment must differ"
    assert not {game.tobytes() for game in per_game} & {game.tobytes() for game in first(2).reshape(6, -1)}
    assert not np.array_equal(first(None), first(None))
    venv: Any = make_vec_env("TeamSupport", n_envs=6, seed=1, backend=backend, **SMALL)
    assert not np.array_equal(venv.reset(), venv.reset()), "a second reset goes on with the games' own randomness"
    assert venv.seed(1) == [seed for seed in game_seeds(1, 6) for _ in range(3)]
    np.testing.assert_array_equal(venv.reset(), first(1))


@pytest.mark.parametrize("backend", ["native", "supersuit"])
def test_states_reach_single_games(backend: Any) -> None:
    level = hecogrid_envs.parallel_env("TeamSupport", **SMALL)
    level.reset(seed=99)
    state = level.get_state()
    venv: Any = make_vec_env("TeamSupport", n_envs=3, seed=0, backend=backend, **SMALL)
    venv.set_options([{"state": state} if row // 3 == 1 else {} for row in range(9)])
    observations = venv.reset()
    np.testing.assert_equal(venv.env_method("get_state", indices=3)[0], state)
    np.testing.assert_array_equal(observations[3:6], list(level.observations().values()))
    assert not np.array_equal(observations[:3], observations[3:6])
    again = venv.reset()
    assert not np.array_equal(again[3:6], observations[3:6]), "options hold for one reset"


@pytest.mark.parametrize("backend", ["native", "supersuit"])
def test_attributes_and_rendering_per_row(backend: Any) -> None:
    venv: Any = make_vec_env("TeamSupport", n_envs=2, seed=0, backend=backend, render_mode="rgb_array", **SMALL)
    venv.reset()
    assert (venv.n_games, venv.n_agents, venv.num_envs) == (2, 3, 6)
    assert venv.get_attr("task") == ["TeamSupport"] * 6
    assert venv.get_attr("n_steps", indices=[0, 5]) == [0, 0]
    assert venv.has_attr("params")
    assert not venv.has_attr("no_such_thing")
    assert venv.render_mode == "rgb_array"
    venv.set_attr("nickname", "b", indices=[3])
    assert venv.get_attr("nickname", indices=[4]) == ["b"]
    pictures = venv.get_images()
    assert len(pictures) == 6
    assert all(isinstance(picture, np.ndarray) and picture.ndim == 3 for picture in pictures)
    assert np.array_equal(pictures[0], pictures[2])
    assert not np.array_equal(pictures[0], pictures[3])
    height, width, _ = pictures[0].shape
    tiled = venv.render().shape
    assert tiled[0] * tiled[1] == 2 * height * width, "each game is drawn once"
    assert venv.env_is_wrapped(VecMonitor) == [False] * 6
    venv.close()


@pytest.mark.filterwarnings("ignore:The `render_mode` attribute is not defined")
@pytest.mark.parametrize("policy", ["MlpPolicy", "CnnPolicy"])
def test_the_game_trains_in_the_stock_stack(policy: str) -> None:
    """Only SuperSuit's own functions and SB3's own algorithm, with nothing of this repository but the game."""
    # NatureCNN needs images of at least 36 x 36.
    env = hecogrid_envs.parallel_env("TeamSupport", **{**SMALL, "view_tile_size": 6})
    flat = supersuit.pettingzoo_env_to_vec_env_v1(env)
    venv = VecMonitor(supersuit.concat_vec_envs_v1(flat, 2, num_cpus=1, base_class="stable_baselines3"))
    model = PPO(policy, venv, n_steps=8, batch_size=24, n_epochs=1, device="cpu").learn(96)
    assert model.num_timesteps == 96
    assert model.ep_info_buffer is not None
    assert {episode["l"] for episode in model.ep_info_buffer} == {7}


def test_actions_are_those_of_the_call_and_not_of_later() -> None:
    first, second = (make_vec_env("TeamSupport", 2, seed=0, n_agents=3) for _ in range(2))
    actions = np.full(6, 2)
    for venv in (first, second):
        venv.reset()
    first.step_async(actions)
    actions[:] = 200
    np.testing.assert_array_equal(first.step_wait()[0], second.step(np.full(6, 2))[0])
