"""``GameBatch.advance`` equals step, reset of finished games and observe."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import hecogrid_envs
from hecogrid_envs import GameBatch, HECOGridParams
from sb3_saf import game_seeds, make_vec_env

N_GAMES = 7
SMALL: dict[str, Any] = {"n_agents": 5, "grid_size": 12, "n_treasures": 40, "max_cycles": 9}


def batch_of(n_threads: int = 1, **params: Any) -> GameBatch:
    """Create games that end at different steps: they begin one after the other, the last from a given state."""
    batch = GameBatch("TeamTogether", HECOGridParams(**{**SMALL, **params}), N_GAMES, n_threads)
    batch.reset(seeds=game_seeds(0, N_GAMES))
    for game in range(N_GAMES - 1):
        batch.step(np.full((N_GAMES, 5), 2))
        batch.reset(np.arange(N_GAMES) == game)
    batch.set_state(batch.get_state(0), N_GAMES - 1)
    return batch


@pytest.mark.parametrize("n_threads", [1, 3])
@pytest.mark.parametrize("rules", ["paper", "released"])
@pytest.mark.parametrize("observation", ["rgb", "tiles"])
def test_one_call_does_what_three_do(observation: str, rules: str, n_threads: int) -> None:
    params: dict[str, Any] = {"observation": observation, "rules": rules, "coordination": 1}
    apart, at_once = batch_of(1, **params), batch_of(n_threads, **params)
    out, last = apart.observe(), np.full_like(apart.observe(), 77)
    n_over: list[int] = []
    paid = 0.0
    for actions in np.random.default_rng(0).choice(7, size=(40, N_GAMES, 5), p=[0.1, 0.1, 0.4, 0.3, 0.1, 0, 0]):
        apart.step(actions)
        before, rewards, ended = apart.observe(), apart.rewards, apart.truncated
        apart.reset(ended)
        last[...] = 77
        views, over = at_once.advance(actions, out, last)
        assert views is out and over.dtype == bool
        np.testing.assert_array_equal(over, ended)
        np.testing.assert_array_equal(views, apart.observe())
        np.testing.assert_array_equal(at_once.rewards, rewards)
        np.testing.assert_array_equal(last[over], before[over])
        assert (last[~over] == 77).all()
        n_over.append(int(over.sum()))
        paid += rewards[over].sum()
    assert set(n_over) == {0, 1, 2} and paid > 0, "games must end at different steps, some with a reward"
    own, other = apart.snapshot(), at_once.snapshot()
    assert all(np.array_equal(own[name], other[name]) for name in own if name != "collected_now")


def test_results_stay_as_they_are_after_the_next_call() -> None:
    batch = batch_of()
    kept = batch.advance(np.full((N_GAMES, 5), 1))
    copies = [array.copy() for array in kept]
    for _ in range(9):
        batch.advance(np.full((N_GAMES, 5), 1))
        np.testing.assert_equal(list(kept), copies)


def test_games_that_have_not_begun_do_not_step() -> None:
    batch = GameBatch("TeamSupport", HECOGridParams(**SMALL), 2)
    nobody_began = batch.snapshot()
    batch.reset(np.array([True, False]))
    steps: list[Callable[..., object]] = [batch.step, batch.advance]
    for step in steps:
        with pytest.raises(ValueError, match=r"game 1 has not begun: call reset\(\) before a step"):
            step(np.zeros((2, 5), dtype=np.uint8))
    batch.reset()
    batch.step(np.zeros((2, 5), dtype=np.uint8))
    batch.restore(nobody_began)
    with pytest.raises(ValueError, match="game 0 has not begun"):
        batch.step(np.zeros((2, 5), dtype=np.uint8))


def test_games_begun_from_a_state_have_randomness_of_their_own() -> None:
    state = batch_of().get_state()
    batch = GameBatch("TeamTogether", HECOGridParams(**SMALL), 2)
    for game in range(2):
        batch.set_state(state, game)
    for _ in range(SMALL["max_cycles"]):
        _, over = batch.advance(np.full((2, 5), 6))
    assert over.all()
    assert not np.array_equal(batch.get_state(0)["walls"], batch.get_state(1)["walls"])


@pytest.mark.parametrize("n_threads", [1, 2])
def test_rows_are_the_games_of_parallel_env_also_where_they_end_at_different_steps(n_threads: int) -> None:
    params = {**SMALL, "observation": "tiles"}
    venv: Any = make_vec_env("TeamSupport", 3, seed=4, n_threads=n_threads, **params)
    twins = [hecogrid_envs.parallel_env("TeamSupport", **params) for _ in range(3)]
    venv.reset()
    for env, seed in zip(twins, game_seeds(4, 3), strict=True):
        env.reset(seed=seed)
    rng = np.random.default_rng(0)
    ends: list[tuple[int, int]] = []
    for step in range(30):
        if step == 4:
            venv.batch.objects[1].reset(seed=9)
            twins[1].reset(seed=9)
        actions = rng.integers(0, 7, size=(3, 5))
        observations, rewards, dones, infos = venv.step(actions.reshape(-1))
        assert dones.dtype == bool and len({id(info) for info in infos}) == 15
        for game, env in enumerate(twins):
            rows = slice(game * 5, game * 5 + 5)
            result = env.step(dict(zip(env.agents, actions[game].tolist(), strict=True)))
            now = list(result.observations.values())
            if not env.agents:
                ends.append((step, game))
                np.testing.assert_array_equal([info["terminal_observation"] for info in infos[rows]], now)
                assert all(info["TimeLimit.truncated"] is True for info in infos[rows])
                now = list(env.reset()[0].values())
            assert dones[rows].tolist() == list(result.truncations.values())
            np.testing.assert_array_equal(observations[rows], now)
            np.testing.assert_array_equal(rewards[rows], np.array(list(result.rewards.values()), dtype=np.float32))
    assert ends == [(8, 0), (8, 2), (12, 1), (17, 0), (17, 2), (21, 1), (26, 0), (26, 2)]
