"""A game is the same for any batch size, other games in the batch, and after a snapshot."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

import hecogrid_envs
from hecogrid_envs import TASK_NAMES, GameBatch, HECOGridParams
from hecogrid_envs.constants import Rules
from sb3_saf import game_seeds, make_vec_env

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


@pytest.mark.parametrize(("density", "size", "walls"), [(0.12, 17, 26), (0.29, 12, 29), (0.1, 30, 78)])
def test_clutter_is_rounded_as_in_the_rule_book(density: float, size: int, walls: int) -> None:
    assert HECOGridParams(clutter_density=density, grid_size=size).n_clutter == walls


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
        "other games": (lambda: batch.reset(np.ones(3, dtype=bool)), "which must be 4 booleans, one per game"),
        "indices": (lambda: batch.reset([0, 1, 0, 1]), r"which must be 4 booleans, .* got \[0, 1, 0, 1\]"),  # type: ignore[arg-type]
        "other seeds": (lambda: batch.reset(seeds=[1, 2, 3]), "seeds must be 4, one per game, got 3"),
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


# --- snapshots --------------------------------------------------------------------------------------------------------


N_GAMES = 4
#: Crowded, so that several agents share a cell.
LEVEL: dict[str, Any] = {
    "n_agents": 6,
    "grid_size": 9,
    "n_treasures": 12,
    "coordination": 2,
    "heterogeneity": 3,
    "max_cycles": 25,
    "observation": "tiles",
}


def played(task: str = "TeamTogether", rules: Rules = "paper", n_steps: int = 60) -> GameBatch:
    batch = GameBatch(task, HECOGridParams(**LEVEL, rules=rules), N_GAMES)
    batch.reset(seeds=game_seeds(0, N_GAMES))
    actions = np.random.default_rng(0).choice(7, size=(n_steps, N_GAMES, 6), p=[0.1, 0.1, 0.4, 0.2, 0.2, 0, 0])
    for step in actions:
        batch.advance(step)
    return batch


@pytest.mark.parametrize("rules", ["paper", "released"])
@pytest.mark.parametrize("task", ["TeamTogether", "TeamSupport", "KeyForTreasure"])
def test_games_of_a_snapshot_are_those_that_were_played(task: str, rules: Rules) -> None:
    batch = played(task, rules)
    fresh = GameBatch(task, batch.params, N_GAMES)
    fresh.restore(batch.snapshot())
    rng = np.random.default_rng(1)
    for _ in range(40):
        actions = rng.integers(7, size=(N_GAMES, 6))
        for one, other in zip(batch.advance(actions), fresh.advance(actions), strict=True):
            np.testing.assert_array_equal(one, other)


def test_pickles_have_the_games_without_what_follows_from_their_settings() -> None:
    """The tables of a level, whose form changes between versions, are made anew."""
    batch = played()
    content = pickle.dumps(batch)
    assert b"World" not in content
    copy, actions = pickle.loads(content), np.full((N_GAMES, 6), 2)
    for one, other in zip(batch.advance(actions), copy.advance(actions), strict=True):
        np.testing.assert_array_equal(one, other)


def _set(name: str, value: Any) -> Callable[[dict[str, Any]], object]:
    def change(snapshot: dict[str, Any]) -> None:
        snapshot[name].reshape(-1)[0] = value

    return change


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (_set("x", 0), "agent 0 .*wall"),
        (_set("terrain", 0), "outer ring"),
        (_set("has_key", 2), "`has_key`"),
        (_set("colour", 200), "`colour` .*got 200"),
        (_set("order", 77), "`order` is not a permutation"),
        (lambda snapshot: snapshot.pop("rng"), "`rng`"),
        (lambda snapshot: snapshot.update(x=snapshot["x"][:, :5]), r"`x` as int32 \(4, 6\)"),
        (lambda snapshot: snapshot.update(x=snapshot["x"].astype(float)), "`x` .*got float64"),
    ],
)
def test_what_kernels_cannot_index_is_refused_and_changes_nothing(change: Callable[..., object], named: str) -> None:
    batch = played(n_steps=5)
    before, snapshot = batch.snapshot(), batch.snapshot()
    change(snapshot)
    with pytest.raises(ValueError, match=named):
        batch.restore(snapshot)
    np.testing.assert_equal(batch.snapshot(), before)


# --- one call for step, reset and observations ------------------------------------------------------------------------


N_BEGUN = 7
SMALL: dict[str, Any] = {"n_agents": 5, "grid_size": 12, "n_treasures": 40, "max_cycles": 9}


def apart_in_time(**params: Any) -> GameBatch:
    """Create games that end at different steps: they begin one after the other, the last from a given state."""
    batch = GameBatch("TeamTogether", HECOGridParams(**{**SMALL, **params}), N_BEGUN)
    batch.reset(seeds=game_seeds(0, N_BEGUN))
    for game in range(N_BEGUN - 1):
        batch.step(np.full((N_BEGUN, 5), 2))
        batch.reset(np.arange(N_BEGUN) == game)
    batch.set_state(batch.get_state(0), N_BEGUN - 1)
    return batch


@pytest.mark.parametrize("rules", ["paper", "released"])
@pytest.mark.parametrize("observation", ["rgb", "tiles"])
def test_one_call_does_what_three_do(observation: str, rules: str) -> None:
    params: dict[str, Any] = {"observation": observation, "rules": rules, "coordination": 1}
    apart, at_once = apart_in_time(**params), apart_in_time(**params)
    out, last = apart.observe(), np.full_like(apart.observe(), 77)
    n_over: list[int] = []
    paid = 0.0
    for actions in np.random.default_rng(0).choice(7, size=(40, N_BEGUN, 5), p=[0.1, 0.1, 0.4, 0.3, 0.1, 0, 0]):
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
    batch = apart_in_time()
    kept = batch.advance(np.full((N_BEGUN, 5), 1))
    copies = [array.copy() for array in kept]
    for _ in range(9):
        batch.advance(np.full((N_BEGUN, 5), 1))
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
    state = apart_in_time().get_state()
    batch = GameBatch("TeamTogether", HECOGridParams(**SMALL), 2)
    for game in range(2):
        batch.set_state(state, game)
    for _ in range(SMALL["max_cycles"]):
        _, over = batch.advance(np.full((2, 5), 6))
    assert over.all()
    assert not np.array_equal(batch.get_state(0)["walls"], batch.get_state(1)["walls"])


def test_rows_are_the_games_of_parallel_env_also_where_they_end_at_different_steps() -> None:
    params = {**SMALL, "observation": "tiles"}
    venv: Any = make_vec_env("TeamSupport", 3, seed=4, **params)
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
