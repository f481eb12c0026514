"""A game is the same for any batch size, other games in the batch and number of threads."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from hecogrid_envs import TASK_NAMES, GameBatch, HECOGridParams
from sb3_saf import game_seeds

PARAMS = HECOGridParams(n_agents=5, grid_size=12, coordination=2, heterogeneity=3, n_treasures=30, n_keys=10)


def play(batch: GameBatch, seeds: list[int], actions: np.ndarray[Any, Any]) -> list[np.ndarray[Any, Any]]:
    """Play a little over two episodes with resets at the time limit; return observations, rewards, directions."""
    batch.reset(seeds=seeds)
    frames = []
    for row in actions:
        batch.step(row)
        frames.append(np.concatenate([batch.observe().reshape(batch.n_games, -1), batch.rewards[:, None]], axis=1))
        if batch.truncated.any():
            batch.reset(batch.truncated)
    return frames


@pytest.mark.parametrize("rules", ["paper", "released"])
@pytest.mark.parametrize("task", TASK_NAMES)
def test_a_game_does_not_depend_on_its_neighbours(task: str, rules: Any) -> None:
    params = HECOGridParams(**{**PARAMS.__dict__, "rules": rules, "observation": "tiles"})
    actions = np.random.default_rng(0).integers(0, 7, size=(120, 7, 5))
    seeds = game_seeds(5, 7)
    together = play(GameBatch(task, params, 7), seeds, actions)
    for game in (0, 6):
        alone = play(GameBatch(task, params, 1), [seeds[game]], actions[:, [game]])
        np.testing.assert_array_equal([frame[0] for frame in alone], [frame[game] for frame in together])
    strangers = [1000 + i for i in range(7)]
    strangers[4] = seeds[4]
    among_strangers = play(GameBatch(task, params, 7), strangers, actions)
    np.testing.assert_array_equal([f[4] for f in among_strangers], [f[4] for f in together])


def test_game_seeds_do_not_depend_on_their_number_and_never_repeat() -> None:
    assert game_seeds(3, 10)[:4] == game_seeds(3, 4)
    assert game_seeds(3, 4, first=2) == game_seeds(3, 6)[2:]
    seeds = [seed for run in range(200) for seed in game_seeds(run, 50)]
    assert len(set(seeds)) == len(seeds)
    assert len(set(game_seeds(0, 100_000))) == 100_000
    assert all(0 <= seed < 2**32 for seed in seeds), "np.random.seed and RandomState take 32 bits"


@pytest.mark.parametrize("task", TASK_NAMES)
def test_levels_have_what_the_parameters_say(task: str) -> None:
    batch = GameBatch(task, PARAMS, 50)
    batch.reset(seeds=game_seeds(0, 50))
    for game in range(50):
        state = batch.get_state(game)
        assert state["treasures"].sum() == PARAMS.n_treasures
        assert state["keys"].sum() == (PARAMS.n_keys if task == "KeyForTreasure" else 0)
        assert state["walls"].sum() == 4 * 11 + PARAMS.n_clutter
        assert not (state["walls"] & (state["keys"] | (state["treasures"] > 0))).any()
        assert not state["agent_has_key"].any()


def test_levels_are_uniform() -> None:
    """Treasures are uniform over cells, and agents over directions: chi-square within its 99.9 % bound."""
    params = HECOGridParams(n_agents=3, grid_size=7, n_treasures=5, clutter_density=0.2)
    batch = GameBatch("TeamSupport", params, 4000)
    batch.reset(seeds=game_seeds(1, 4000))
    treasures = np.zeros((7, 7))
    directions = np.zeros(4)
    for game in range(4000):
        state = batch.get_state(game)
        treasures += state["treasures"] > 0
        directions += np.bincount(state["agent_dir"], minlength=4)
    inside = treasures[1:-1, 1:-1].ravel()
    assert ((inside - inside.mean()) ** 2 / inside.mean()).sum() < 51.2  # 24 degrees of freedom
    assert ((directions - directions.mean()) ** 2 / directions.mean()).sum() < 16.3  # 3 degrees of freedom


def test_acting_orders_are_uniform_and_new_each_step() -> None:
    params = HECOGridParams(n_agents=3, grid_size=7, n_treasures=5)
    batch = GameBatch("TeamSupport", params, 2000)
    batch.reset(seeds=game_seeds(1, 2000))
    counts: dict[tuple[int, ...], int] = {}
    for _ in range(3):
        batch.step(np.full((2000, 3), 6))
        for order in batch.order.tolist():
            counts[tuple(order)] = counts.get(tuple(order), 0) + 1
    assert len(counts) == 6
    expected = 3 * 2000 / 6
    assert sum((count - expected) ** 2 / expected for count in counts.values()) < 20.5  # 99.9 %, 5 degrees of freedom


def test_released_rules_keep_directions_until_a_seed() -> None:
    params = HECOGridParams(**{**PARAMS.__dict__, "rules": "released"})
    batch = GameBatch("TeamSupport", params)
    batch.reset(seeds=[0])
    assert batch.get_state()["agent_dir"].tolist() == [0] * 5
    batch.step(np.array([[1, 0, 1, 0, 1]]))
    turned = batch.get_state()["agent_dir"].tolist()
    batch.reset()
    assert batch.get_state()["agent_dir"].tolist() == turned != [0] * 5
    batch.reset(seeds=[0])
    assert batch.get_state()["agent_dir"].tolist() == [0] * 5


def wrong_calls(batch: GameBatch) -> dict[str, tuple[Callable[[], object], str]]:
    """Return calls that would access an array out of bounds, and their error messages."""
    read_only = batch.observe()
    read_only.flags.writeable = False
    actions: Any = np.zeros((4, 5), dtype=int)
    number = "an integer from 0 to 3"
    integers = "actions must be integers, got"
    values = "actions must be from 0 to 6, got"
    return {
        "set_state beyond": (lambda: batch.set_state(batch.get_state(), 4), f"game must be {number}, got 4"),
        "get_state": (lambda: batch.get_state(-1), f"game must be {number}, got -1"),
        "observe_game": (lambda: batch.observe_game(10_000_000), f"game must be {number}, got 10000000"),
        "fields_of_view": (lambda: batch.fields_of_view(1_000_000), f"game must be {number}, got 1000000"),
        "read-only out": (lambda: batch.observe(read_only), "out .*writeable=False"),
        "turned out": (lambda: batch.observe(read_only.copy(order="F")), "out .*contiguous=False"),
        "flat last": (lambda: batch.advance(actions, last=read_only.reshape(-1)), "last .*got uint8"),
        "fractions": (lambda: batch.step(actions + 2.7), f"{integers} float64"),
        "flat actions": (lambda: batch.step(actions.reshape(-1)), r"actions must have shape \(4, 5\), .* got \(20,\)"),
        "other games": (lambda: batch.reset(np.ones(3, dtype=bool)), r"which must have shape \(4,\), one per game"),
        **{
            f"{value} as {dtype}": (
                partial(batch.step, (actions + value).astype(dtype)),
                f"{values} {value} for agent 0 of game 0",
            )
            for value, dtype in ((-1, "int8"), (7, "uint8"), (200, "uint8"), (258, "int64"))
        },
    }


@pytest.mark.parametrize("name", wrong_calls(GameBatch("TeamSupport", PARAMS, 4)))
def test_nothing_reads_or_writes_outside_of_its_arrays(name: str) -> None:
    batch = GameBatch("TeamSupport", PARAMS, 4)
    batch.reset(seeds=game_seeds(0, 4))
    call, message = wrong_calls(batch)[name]
    before = batch.snapshot()
    with pytest.raises(ValueError, match=message):
        call()
    np.testing.assert_equal(batch.snapshot(), before)
