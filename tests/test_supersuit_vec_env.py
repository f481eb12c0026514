"""The SuperSuit backend: that games are played as they are where the original classes are wrong."""

from __future__ import annotations

import functools
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from gymnasium import spaces
from gymnasium.utils import EzPickle
from pettingzoo.utils import parallel_to_aec

from sb3_saf import game_seeds
from sb3_saf.envs.supersuit_vec_env import SuperSuitVecEnv
from tests.toy_envs import (
    BareEnv,
    CounterEnv,
    DictEnv,
    EagerEnv,
    FaultyEnv,
    OuterWrapper,
    ReusingEnv,
    TracingEnv,
    UnpicklableEnv,
    late_env,
)

Bridge = Callable[..., SuperSuitVecEnv]
one_and_two_cpus = pytest.mark.parametrize("n_cpus", [1, 2])


@pytest.fixture
def bridge() -> Iterator[Bridge]:
    """Create vector environments that are closed after the test."""
    made: list[SuperSuitVecEnv] = []

    def make(*args: Any, **kwargs: Any) -> SuperSuitVecEnv:
        made.append(SuperSuitVecEnv(*args, **kwargs))
        return made[-1]

    yield make
    for venv in made:
        venv.close()


def zeros(venv: Any) -> npt.NDArray[Any]:
    """Actions 0 for all rows."""
    space = venv.action_space
    return np.zeros((venv.num_envs, *space.shape), space.dtype)


def draws(observations: Any) -> npt.NDArray[Any]:
    """Return the draws of the games' generators, per row."""
    return np.asarray(observations)[:, 2]


# ---- trap: seeds and options


@one_and_two_cpus
@pytest.mark.parametrize("n_games", [1, 3, 5])
def test_games_play_as_if_each_was_alone(bridge: Bridge, n_cpus: int, n_games: int) -> None:
    """Game i is the ParallelEnv reset with game_seeds(seed, E)[i], and continues with its own random stream."""
    venv = bridge(lambda: CounterEnv(2, max_cycles=3), n_games, seed=11, n_cpus=n_cpus)
    alone = [CounterEnv(2, max_cycles=3) for _ in range(n_games)]
    expected = [env.reset(seed=seed)[0] for env, seed in zip(alone, game_seeds(11, n_games), strict=True)]
    observations = venv.reset()
    rng = np.random.default_rng(0)
    for _ in range(8):
        assert np.asarray(observations).dtype == np.float32
        assert np.array_equal(np.asarray(observations), [game[agent] for game in expected for agent in game])
        actions = rng.integers(0, 4, venv.num_envs)
        observations, rewards, dones, _ = venv.step(actions)
        assert (rewards.dtype.name, dones.dtype.name) == ("float32", "bool")
        rows = iter(range(venv.num_envs))
        for game, env in enumerate(alone):
            stepped, reward, _, truncations, _ = env.step({a: actions[next(rows)] for a in env.agents})
            assert rewards[2 * game : 2 * game + 2].tolist() == list(reward.values())
            assert dones[2 * game : 2 * game + 2].tolist() == list(truncations.values())
            expected[game] = stepped if env.agents else env.reset()[0]


@one_and_two_cpus
@pytest.mark.parametrize("seed", [None, 0])
@pytest.mark.parametrize("make", [EagerEnv, EagerEnv()], ids=["factory", "environment"])
def test_copies_play_different_games(bridge: Bridge, n_cpus: int, seed: int | None, make: Any) -> None:
    first, second = (draws(bridge(make, 3, seed=seed, n_cpus=n_cpus).reset()) for _ in range(2))
    assert len(set(first.tolist())) == 6
    assert np.array_equal(first, second) == (seed == 0)


# ---- trap: truncation, terminal step


@one_and_two_cpus
@pytest.mark.parametrize(
    ("ends", "truncated"),
    [
        ({}, [True, True]),
        ({"deaths": {0: 3, 1: 3}}, [False, False]),
        ({"deaths": {0: 3}}, [False, True]),
        ({"deaths": {0: 2, 1: 2}}, [False, False]),
        ({"cuts": {0: 1}}, [False, True]),  # must not be bootstrapped at the end of the team
    ],
    ids=["time limit", "both at once", "one terminated, one not", "true end", "its own time limit"],
)
def test_truncation_is_told(bridge: Bridge, n_cpus: int, ends: dict[str, Any], truncated: list[bool]) -> None:
    """In the second case the agents are terminated at the time limit: both flags are set, and termination counts."""
    venv = bridge(lambda: CounterEnv(2, max_cycles=3, **ends), n_games=2, n_cpus=n_cpus)
    venv.reset()
    for _ in range(3):
        _, _, dones, infos = venv.step(zeros(venv))
        if dones.any():
            break
        assert not any(info.get("TimeLimit.truncated") for info in infos) or "cuts" in ends
    assert dones.all()
    assert [info["TimeLimit.truncated"] for info in infos] == truncated * 2
    assert all(type(info["TimeLimit.truncated"]) is bool for info in infos)


@one_and_two_cpus
def test_last_step_keeps_its_infos(bridge: Bridge, n_cpus: int) -> None:
    venv = bridge(lambda: CounterEnv(2, max_cycles=2), n_games=2, n_cpus=n_cpus)
    venv.reset()
    assert venv.reset_infos == [{"episode": 1, "options": None}] * 4
    assert venv.step(zeros(venv))[3] == [{"step": 1}] * 4
    assert venv.reset_infos == [{"episode": 1, "options": None}] * 4
    observations, _, dones, infos = venv.step(zeros(venv))
    assert dones.all()
    assert [sorted(info) for info in infos] == [["TimeLimit.truncated", "step", "terminal_observation"]] * 4
    assert [info["step"] for info in infos] == [2] * 4
    assert venv.reset_infos == [{"episode": 2, "options": None}] * 4
    assert isinstance(observations, np.ndarray)
    assert observations[:, 0].tolist() == [0] * 4
    assert [info["terminal_observation"][:2].tolist() for info in infos] == [[2, 0], [2, 1]] * 2


@one_and_two_cpus
def test_games_may_reuse_their_arrays_and_infos(bridge: Bridge, n_cpus: int) -> None:
    """Terminal observations and earlier infos do not change afterwards, and no two rows share an info."""
    venv = bridge(lambda: ReusingEnv(max_cycles=2), n_games=2, n_cpus=n_cpus)
    first = np.copy(np.asarray(kept := venv.reset()))
    infos_of_step_1 = venv.step(zeros(venv))[3]
    _, _, dones, infos = venv.step(zeros(venv))
    assert np.array_equal(np.asarray(kept), first)
    assert dones.all()
    assert [info["terminal_observation"][:2].tolist() for info in infos] == [[2, 0], [2, 1]] * 2
    assert [info["steps"] for info in infos_of_step_1] == [[1]] * 4
    assert [info["steps"] for info in infos] == [[2]] * 4
    assert [info["steps"] for info in venv.reset_infos] == [[]] * 4
    nested = [id(info["steps"]) for info in infos] + [id(info["steps"]) for info in venv.reset_infos]
    assert len(set(nested)) == 8


# ---- trap: attributes and methods


@one_and_two_cpus
def test_attributes_by_row(bridge: Bridge, n_cpus: int) -> None:
    venv = bridge(CounterEnv, n_games=3, seed=0, n_cpus=n_cpus)
    assert venv.get_attr("level") == [1] * 6  # before the first reset
    venv.reset()
    assert venv.get_attr("last_seed", indices=[5, 0]) == [game_seeds(0, 3)[2], game_seeds(0, 3)[0]]
    venv.set_attr("level", 7, indices=[2])
    assert venv.get_attr("level") == [1, 1, 7, 7, 1, 1]
    assert venv.get_attr("level", indices=2) == venv.get_attr("level", np.int64(-3)) == [7]  # type: ignore[arg-type]
    assert venv.get_attr("level", indices=[]) == []
    assert venv.has_attr("level")
    assert not venv.has_attr("depth")
    assert venv.has_attr("action_masks")
    with pytest.raises(AttributeError, match="depth"):
        venv.get_attr("depth")
    with pytest.raises(ValueError, match="there is no row 6: expected 0 to 5"):
        venv.get_attr("level", indices=6)


@one_and_two_cpus
def test_methods_by_row_and_by_game(bridge: Bridge, n_cpus: int) -> None:
    venv = bridge(CounterEnv, n_games=3, n_cpus=n_cpus)
    assert venv.env_method("poke", 10, indices=[2, 0, 3]) == [10, 10, 20]  # rows 2 and 3 are one game
    assert venv.env_method("poke", amount=1) == [11, 12, 21, 22, 1, 2]
    assert venv.game_method("poke", 100) == [112, 122, 102]
    assert venv.game_method("poke", amount=1, games=[2, 0]) == [103, 113]
    assert venv.game_method("poke", 0, games=-1) == [103]
    assert venv.env_method("apply", lambda level: level + 1, indices=0) == [2]
    with pytest.raises(ValueError, match="there is no game 3: expected 0 to 2"):
        venv.game_method("poke", games=3)


@one_and_two_cpus
def test_wrappers_are_seen(bridge: Bridge, n_cpus: int) -> None:
    venv = bridge(lambda: OuterWrapper(CounterEnv()), n_games=2, n_cpus=n_cpus)
    assert venv.env_is_wrapped(OuterWrapper) == [True] * 4
    assert venv.env_is_wrapped(OuterWrapper, indices=[1]) == [True]
    assert venv.env_is_wrapped(TracingEnv) == [False] * 4
    assert venv.get_attr("colour", 0) == ["red"]
    venv.set_attr("colour", "blue")
    venv.set_attr("level", 5)  # an attribute of the game, which its own methods must see
    venv.set_attr("fresh", 6)
    assert venv.get_attr("colour", 0) == ["blue"]
    assert venv.env_method("apply", int, indices=0) == [5]
    assert venv.get_attr("fresh", 0) == [6]
    assert venv.get_attr("unwrapped", 0)[0].fresh == 6
    assert venv.get_attr("_rng", 0) == [None]  # private, so PettingZoo's wrapper does not forward it


@one_and_two_cpus
def test_errors_come_back(bridge: Bridge, n_cpus: int) -> None:
    venv = bridge(CounterEnv, n_games=3, n_cpus=n_cpus)
    venv.reset()
    with pytest.raises(LookupError, match="this method always fails") as caught:
        venv.env_method("fail", indices=5)
    if n_cpus == 2:
        assert "in the worker process of game 2" in str(caught.value.__cause__)
        assert "in fail" in str(caught.value.__cause__)
    assert venv.step(zeros(venv))[1].tolist() == [10, 11] * 3


def test_what_cannot_leave_a_worker(bridge: Bridge) -> None:
    venv = bridge(UnpicklableEnv, n_games=2, n_cpus=2)
    with pytest.raises(TypeError, match=r"this reply cannot leave its worker process .* use n_cpus=1"):
        venv.get_attr("lock")
    assert venv.get_attr("level") == [1] * 4
    assert isinstance(bridge(UnpicklableEnv, n_games=1).get_attr("lock")[0], type(threading.Lock()))


@one_and_two_cpus
def test_masks_by_row(bridge: Bridge, n_cpus: int) -> None:
    venv = bridge(lambda: CounterEnv(3, deaths={1: 1}), n_games=2, n_cpus=n_cpus)
    venv.reset()
    assert np.array_equal(np.stack(venv.env_method("action_masks")), np.tile(np.eye(3, 4, dtype=bool), (2, 1)))
    venv.step(zeros(venv))
    masks = venv.env_method("action_masks", indices=[3, 4])
    assert [mask.tolist() for mask in masks] == [[True, False, False, False], [True] * 4]  # agent 1 has ended


def test_no_pictures(bridge: Bridge) -> None:
    venv = bridge(CounterEnv, n_games=2)
    assert venv.get_images() == [None] * 4
    with pytest.warns(UserWarning, match="render_mode"):
        assert venv.render() is None


# ---- trap: agents that die


@one_and_two_cpus
def test_death_of_an_agent(bridge: Bridge, n_cpus: int) -> None:
    venv = bridge(lambda: CounterEnv(3, max_cycles=3, deaths={1: 1}), n_games=2, n_cpus=n_cpus)
    for episode in (1, 2):
        if episode == 1:
            venv.reset()
        assert venv.reset_infos == [{"episode": episode, "options": None}] * 6
        observations, rewards, dones, infos = venv.step(zeros(venv))
        assert np.asarray(observations)[:3, :2].tolist() == [[1, 0], [0, 0], [1, 2]]
        assert rewards[:3].tolist() == [10, 11, 12]
        assert not dones.any()
        assert infos[0] == infos[2] == {"step": 1}
        assert sorted(infos[1]) == ["TimeLimit.truncated", "step", "terminal_observation"]
        assert infos[1]["terminal_observation"][:2].tolist() == [1, 1]
        observations, rewards, dones, infos = venv.step(zeros(venv))
        assert np.asarray(observations)[:3, :2].tolist() == [[2, 0], [0, 0], [2, 2]]
        assert rewards[:3].tolist() == [20, 0, 22]
        assert not dones.any()
        assert infos[:3] == [{"step": 2}, {"active": False}, {"step": 2}]
        observations, rewards, dones, infos = venv.step(zeros(venv))
        assert np.asarray(observations)[:3, :2].tolist() == [[0, 0], [0, 1], [0, 2]]  # the next episode
        assert rewards[:3].tolist() == [30, 0, 32]
        assert dones.all()
        assert [info["terminal_observation"][:2].tolist() for info in infos[:3]] == [[3, 0], [0, 0], [3, 2]]
        assert [info["TimeLimit.truncated"] for info in infos[:3]] == [True, False, True]
        assert [info.get("active") for info in infos[:3]] == [None, False, None]


@one_and_two_cpus
def test_bare_game(bridge: Bridge, n_cpus: int) -> None:
    """No metadata, no render_mode, no infos, ended agents stay in ``agents``: still a team episode."""
    venv = bridge(BareEnv, n_games=2, n_cpus=n_cpus)
    assert np.asarray(venv.reset()).tolist() == [0] * 4
    assert np.asarray(venv.step(zeros(venv))[0]).tolist() == [1] * 4
    observations, rewards, dones, infos = venv.step(zeros(venv))
    assert np.asarray(observations).tolist() == [0, 2] * 2
    assert not dones.any()
    assert [info.get("terminal_observation") for info in infos] == [2, None] * 2
    observations, rewards, dones, infos = venv.step(zeros(venv))
    assert dones.all()
    assert rewards.tolist() == [1, 1] * 2, "the game pays the one that has ended, too"
    assert [info["terminal_observation"] for info in infos] == [0, 3] * 2


# ---- one process or two, dict or box, real games


def rollout(venv: SuperSuitVecEnv, n_steps: int) -> list[Any]:
    """Return all results of a vector environment with fixed actions."""
    record: list[Any] = [venv.reset(), venv.reset_infos.copy()]
    venv.action_space.seed(0)
    for _ in range(n_steps):
        actions = np.stack([venv.action_space.sample() for _ in range(venv.num_envs)])
        record.extend([*venv.step(actions), venv.reset_infos.copy()])
    return record


def kaz() -> Any:
    """Knights, archers, zombies: agents die, and its surfaces cannot be pickled."""
    from pettingzoo.butterfly.knights_archers_zombies import knights_archers_zombies

    return knights_archers_zombies.parallel_env(spawn_delay=2, max_zombies=60, max_cycles=140)


def rps() -> Any:
    """Rock, paper, scissors: an AEC game in PettingZoo's converter."""
    from pettingzoo.classic.rps import rps as rock_paper_scissors

    return rock_paper_scissors.parallel_env(max_cycles=5)


@pytest.mark.parametrize("make", [lambda: CounterEnv(3, deaths={2: 2}), DictEnv, late_env, BareEnv, rps, kaz])
def test_processes_make_no_difference(bridge: Bridge, make: Callable[[], Any]) -> None:
    if make in (kaz, rps):
        pytest.importorskip("pygame")
    n_steps = 150 if make is kaz else 12
    one, two = (rollout(bridge(make, n_games=3, seed=1, n_cpus=n_cpus), n_steps) for n_cpus in (1, 2))
    np.testing.assert_equal(one, two)
    if make is kaz:
        assert any(info.get("active") is False for part in one[5::5] for info in part)


# ---- bad input


MADE: list[CounterEnv] = []


def recorded_env() -> CounterEnv:
    """Record what was created."""
    MADE.append(CounterEnv())
    return MADE[-1]


def same_env_again() -> CounterEnv:
    """Return the last one again."""
    return MADE[-1] if MADE else recorded_env()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: parallel_to_aec(CounterEnv()), "got a function that returned the AECEnv counter_v0; convert it with "
         "pettingzoo.utils.conversions.aec_to_parallel"),
        (parallel_to_aec(CounterEnv()), "expected a PettingZoo ParallelEnv, got the AECEnv counter_v0; convert it"),
        (dict, "got a function that returned an object of type dict"),
        ("counter", "got an object of type str"),
        (SimpleNamespace(__name__="games.tag", parallel_env=CounterEnv), "pass games.tag.parallel_env(...)"),
        (UnpicklableEnv(), "pass a function that makes the environment instead"),
        (same_env_again, "got one that returned the same object for 3 games"),
    ],
)  # fmt: skip
def test_wrong_environment(bridge: Bridge, make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        bridge(make, n_games=3)


def test_what_cannot_be_pickled_stays_in_this_process(bridge: Bridge) -> None:
    """Caches on methods cannot be pickled, nor can a local class that has one."""

    class CachedEnv(CounterEnv):
        @functools.lru_cache  # noqa: B019 - as PettingZoo's own tutorial writes it
        def observation_space(self, agent: str) -> spaces.Space[Any]:
            return super().observation_space(agent)

    for make in (CachedEnv, lambda: CachedEnv(), CachedEnv()):
        venv = bridge(make, n_games=3, seed=0)
        draws = np.asarray(venv.reset())[::2, 2]
        assert len(set(draws.tolist())) == 3, "each game has its own generator"
        assert venv.step(zeros(venv))[1].tolist() == [10, 11] * 3
        venv.close()
        with pytest.raises(ValueError, match=r"n_cpus=2 .* pickling it failed .* use n_cpus=1"):
            bridge(make, n_games=2, n_cpus=2)


class Remade(CounterEnv, EzPickle):
    """Pickles and copies of it have the arguments of its constructor only."""

    def __init__(self) -> None:
        EzPickle.__init__(self)
        super().__init__()

    def process_id(self) -> int:
        return os.getpid()


@one_and_two_cpus
def test_what_was_set_after_the_construction_is_copied(bridge: Bridge, n_cpus: int) -> None:
    for wrap in (lambda env: env, OuterWrapper):
        game = Remade()
        game.max_cycles = 2
        venv = bridge(wrap(game), n_games=2, n_cpus=n_cpus)
        venv.reset()
        assert [venv.step(zeros(venv))[2].all() for _ in range(4)] == [False, True] * 2


def test_workers_leave_signals_to_their_owner(bridge: Bridge) -> None:
    """Ctrl-C in a terminal is sent to all processes: the owner may need the games for a last checkpoint."""
    venv = bridge(Remade, n_games=2, n_cpus=2)
    venv.reset()
    for pid in venv.env_method("process_id"):
        os.kill(pid, signal.SIGINT)
        os.kill(pid, signal.SIGTERM)
    assert venv.step(zeros(venv))[1].tolist() == [10, 11] * 2


class OddSpacesEnv(CounterEnv):
    """Has given spaces."""

    def __init__(self, observation_space: Any = None, action_space: Any = None):
        super().__init__()
        self._observation_space = observation_space or self._observation_space
        self._action_space = action_space or self._action_space


box = spaces.Box(-1.0, np.array([1.0, 0.7], np.float32), (2,), np.float32)


@pytest.mark.parametrize(
    ("space", "actions", "message"),
    [
        (spaces.Discrete(4), [0, 1, 2], "expected actions from Discrete(4) for 4 rows, int64 of shape (4,), "
         "got int64 of shape (3,)"),
        (spaces.Discrete(4), [0.0, 1.0, 2.0, 3.0], "got float64 of shape (4,)"),
        (spaces.Discrete(4), [0, 0, 4, 0], "expected actions from Discrete(4), got 4 in row 2 (game 1, agent_0)"),
        (spaces.Discrete(2, start=5), [0, 1, 5, 0], "expected actions from Discrete(2), got 5 in row 2"),
        (spaces.MultiDiscrete([2, 3]), [[0, 0], [0, 3], [0, 0], [0, 0]], "got [0 3] in row 1 (game 0, agent_1)"),
        (box, np.zeros((4, 3)), "float32 of shape (4, 2), got float64 of shape (4, 3)"),
        (box, [[0, 0], [np.nan, 0], [0, 0], [0, 0]], "in row 1"),
        (box, np.full((4, 2), "a"), "got <U1 of shape (4, 2)"),
        (spaces.Box(0, 9, (1,), np.uint8), [[0], [256], [0], [0]], "got [256] in row 1"),
    ],
)  # fmt: skip
def test_wrong_actions(bridge: Bridge, space: spaces.Space[Any], actions: Any, message: str) -> None:
    venv = bridge(lambda: OddSpacesEnv(action_space=space), n_games=2)
    venv.reset()
    with pytest.raises(ValueError, match=re.escape(message)):
        venv.step(actions)
    assert venv.get_attr("steps") == [0] * 4


@one_and_two_cpus
@pytest.mark.parametrize(
    ("space", "actions", "expected"),
    [
        (spaces.Discrete(2, start=5), [0, 1, 0, 1], [5, 6]),  # SB3 counts from 0
        (spaces.MultiDiscrete([2, 3], start=[4, -1]), [[1, 2], [0, 0], [0, 0], [0, 0]], [[5, 1], [4, -1]]),
        (spaces.MultiBinary(2), np.ones((4, 2), bool), [[1, 1], [1, 1]]),
        (spaces.MultiBinary(2), np.eye(4, 2, dtype=np.float32), [[1, 0], [0, 1]]),  # as SB3's policies give them
        (spaces.Box(0, 9, (1,), np.uint8), [[0], [9], [1], [2]], [[0], [9]]),
        (spaces.Box(-9, 9, (1,), np.int64), [[-0.6], [8.7], [0], [0]], [[-1], [9]]),
        # 0.7 is above the bound before it is rounded like the bound
        (box, [[1, 0.7], [-1, -1], [0, 0], [0, 0]], [[1, 0.7], [-1, -1]]),
    ],
)
def test_right_actions(bridge: Bridge, n_cpus: int, space: spaces.Space[Any], actions: Any, expected: Any) -> None:
    venv = bridge(lambda: OddSpacesEnv(action_space=space), n_games=2, n_cpus=n_cpus)
    venv.reset()
    venv.step(actions)
    arrived = venv.get_attr("last_actions", indices=0)[0]
    assert np.array_equal(np.stack(list(arrived.values())), np.asarray(expected, space.dtype))
    assert all(np.asarray(action).dtype == space.dtype for action in arrived.values())


@one_and_two_cpus
def test_order_of_calls(bridge: Bridge, n_cpus: int) -> None:
    venv = bridge(CounterEnv, n_games=2, n_cpus=n_cpus)
    with pytest.raises(ValueError, match=r"no episode has begun .* call reset\(\) before step\(\)"):
        venv.step(zeros(venv))
    venv.reset()
    with pytest.raises(RuntimeError, match="no step has been started"):
        venv.step_wait()
    venv.step_async(zeros(venv))
    assert venv.get_attr("level") == [1] * 4
    observations = np.asarray(venv.reset())  # cancels the step
    assert observations[:, 0].tolist() == [0] * 4
    with pytest.raises(RuntimeError, match="no step has been started"):
        venv.step_wait()
    assert venv.step(zeros(venv))[1].tolist() == [10, 11] * 2
    venv.close()
    for closed_call in (lambda: venv.step_async(zeros(venv)), lambda: venv.get_attr("level"), venv.reset):
        with pytest.raises(RuntimeError, match=r"the vector environment is closed \(it was closed\)"):
            closed_call()


# ---- games that fail


@one_and_two_cpus
@pytest.mark.parametrize(("how", "error"), [("raise", ArithmeticError), ("exit", SystemExit)])
def test_game_that_breaks(bridge: Bridge, n_cpus: int, how: str, error: type[BaseException]) -> None:
    """Its exception is raised, and a reset starts again."""
    unlucky = game_seeds(0, 3)[1]
    venv = bridge(lambda: FaultyEnv(how, unlucky), n_games=3, seed=0, n_cpus=n_cpus)
    venv.reset()
    venv.step(zeros(venv))
    with pytest.raises(error):
        venv.step(zeros(venv))
    assert venv.get_attr("steps", indices=2) == [2]
    with pytest.raises(ValueError, match=r"stopped by an error\): call reset\(\)"):
        venv.step(zeros(venv))
    venv.seed(1)
    venv.reset()
    for _ in range(3):
        dones = venv.step(zeros(venv))[2]
    assert dones.all()


class LocalError(Exception):
    """Cannot be recreated from its args."""

    def __init__(self, one: int, two: int):
        super().__init__(f"{one} {two}")


def test_exception_that_cannot_be_pickled(bridge: Bridge) -> None:
    class Game(CounterEnv):
        def step(self, actions: dict[str, Any]) -> Any:
            raise LocalError(1, 2)

    venv = bridge(Game, n_games=2, n_cpus=2)
    venv.reset()
    with pytest.raises(RuntimeError, match="LocalError: 1 2"):
        venv.step(zeros(venv))
    assert venv.get_attr("level") == [1] * 4
    alone = bridge(Game, n_games=1)
    alone.reset()
    with pytest.raises(LocalError):
        alone.step(zeros(alone))


# ---- worker processes


def workers(venv: SuperSuitVecEnv) -> list[int]:
    return sorted(set(venv.get_attr("pid")))


def kill(pid: int) -> None:
    """Kill a worker process, and wait until it is gone."""
    process = next(child for child in multiprocessing.active_children() if child.pid == pid)
    process.kill()
    process.join()


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.timeout(60)
@pytest.mark.parametrize("when", ["asleep", "at work"])
def test_worker_that_dies(bridge: Bridge, when: str) -> None:
    venv = bridge(lambda: FaultyEnv("die" if when == "at work" else "none", game_seeds(0, 4)[2]), 4, seed=0, n_cpus=2)
    venv.reset()
    first, second = venv.get_attr("pid", indices=[0, 4])
    venv.step(zeros(venv))
    if when == "asleep":
        kill(second)
    code = -9 if when == "asleep" else 7
    expected = rf"worker process 1 \(games 2 to 3, pid {second}\) ended with exit code {code}; .* make a new one"
    start = time.monotonic()
    with pytest.raises(RuntimeError, match=expected):
        venv.step(zeros(venv))
    assert time.monotonic() - start < 5
    assert not is_running(first)
    with pytest.raises(RuntimeError, match=r"is closed \(worker process 1 .* ended with exit code"):
        venv.reset()
    venv.close()


@one_and_two_cpus
def test_close(bridge: Bridge, n_cpus: int, tmp_path: Path) -> None:
    trace = tmp_path / "closed"
    venv = bridge(lambda: TracingEnv(str(trace)), n_games=3, n_cpus=n_cpus)
    venv.reset()
    pids = [pid for pid in workers(venv) if pid != os.getpid()]
    assert len(pids) == (0 if n_cpus == 1 else 2)
    start = time.monotonic()
    venv.close()
    assert time.monotonic() - start < 5
    assert not any(is_running(pid) for pid in pids)
    assert trace.read_text() == "closed\n" * 3
    venv.close()
    assert trace.read_text() == "closed\n" * 3


@one_and_two_cpus
@pytest.mark.parametrize("stepping", [False, True])
def test_close_that_breaks(bridge: Bridge, n_cpus: int, stepping: bool, tmp_path: Path) -> None:
    trace = tmp_path / "closed"

    class Game(TracingEnv):
        def close(self) -> None:
            super().close()
            if self.last_seed == game_seeds(0, 2)[0]:
                raise LookupError("window is gone")

    venv = bridge(lambda: Game(str(trace)), n_games=2, seed=0, n_cpus=n_cpus)
    venv.reset()
    pids = [pid for pid in workers(venv) if pid != os.getpid()]
    if stepping:
        venv.step_async(zeros(venv))
    with pytest.raises(LookupError, match="window is gone"):
        venv.close()
    assert trace.read_text() == "closed\n" * 2
    assert not any(is_running(pid) for pid in pids)


@pytest.mark.timeout(60)
def test_close_when_a_worker_is_gone(bridge: Bridge, tmp_path: Path) -> None:
    trace = tmp_path / "closed"
    venv = bridge(lambda: TracingEnv(str(trace)), n_games=2, n_cpus=2)
    venv.reset()
    first, second = venv.get_attr("pid", indices=[0, 2])
    kill(first)
    start = time.monotonic()
    venv.close()
    assert time.monotonic() - start < 5
    assert not is_running(second)


@one_and_two_cpus
def test_game_that_can_only_be_closed_after_a_reset(bridge: Bridge, n_cpus: int) -> None:
    class Game(CounterEnv):
        def close(self) -> None:
            assert self.episode

    bridge(Game, n_games=2, n_cpus=n_cpus).reset()


def test_every_game_that_was_made_is_closed(bridge: Bridge) -> None:
    """SuperSuit makes spare copies and drops them; none of them may keep a game open."""
    MADE.clear()
    bridge(recorded_env, n_games=3).close()
    assert [env.closed for env in MADE] == [True] * 4  # one was made for the spaces


SCRIPT = """
import sys
sys.path.insert(0, {root!r})
from sb3_saf.envs.supersuit_vec_env import SuperSuitVecEnv
from tests.toy_envs import TracingEnv

if __name__ == "__main__":
    venv = SuperSuitVecEnv(lambda: TracingEnv({trace!r}), 2, n_cpus=2)
    venv.reset()
    keep = [venv]
    keep.append(keep)
    print("end of script", flush=True)
"""


@pytest.mark.timeout(120)
def test_script_that_forgets_to_close(tmp_path: Path) -> None:
    """The original classes hang at the interpreter's exit, waiting for workers that were not told to end."""
    trace = tmp_path / "closed"
    root = str(Path(__file__).parents[1])
    (tmp_path / "script.py").write_text(SCRIPT.format(root=root, trace=str(trace)))
    process = subprocess.Popen([sys.executable, str(tmp_path / "script.py")], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "end of script\n"
    try:
        assert process.wait(30) == 0
        assert trace.read_text() == "closed\n" * 2
    finally:
        process.kill()
        process.communicate()
