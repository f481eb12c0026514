"""Copies of games continue like the originals; environments in threads and processes do not affect each other."""

from __future__ import annotations

import copy
import gc
import multiprocessing
import pickle
import random
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import psutil
import pytest
from gymnasium import spaces

import sb3_saf
from hecogrid_envs.tasks import TASKS
from sb3_saf import CheckpointError, make_vec_env
from sb3_saf.envs import game_copies
from sb3_saf.envs.supersuit_vec_env import SuperSuitVecEnv
from tests.toy_envs import CounterEnv, Game, GlobalEnv, LazyEnv, OuterWrapper, StateEnv, UnpicklableEnv


class MaskedChoicesEnv(CounterEnv):
    """Each agent makes two choices, of which masks in infos allow some."""

    def _make_action_space(self) -> spaces.Space[Any]:
        return spaces.MultiDiscrete([3, 2])

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        observations, infos = super().reset(seed, options)
        return observations, self._masked(infos)

    def step(self, actions: dict[str, Any]) -> Any:
        *results, infos = super().step(actions)
        return *results, self._masked(infos)

    def _masked(self, infos: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        return {agent: {**info, "action_mask": np.array([1, 0, 1, 1, 1], np.int8)} for agent, info in infos.items()}


GAMES: dict[str, Any] = {
    "a lazily made generator": LazyEnv,
    "global generators": GlobalEnv,
    "a lock": UnpicklableEnv,
    "agents that die": partial(CounterEnv, deaths={0: 2}, max_cycles=7),
    "masks of several choices": MaskedChoicesEnv,
    "a wrapper": lambda: OuterWrapper(LazyEnv()),
    "HECOGrid": partial(TASKS["TeamTogether"], n_agents=2, grid_size=9, n_treasures=4, max_cycles=9),
    "its own methods": StateEnv,
    "own methods that forget": partial(StateEnv, forgets=True),
}
BY_METHODS = {"its own methods"}


def played(venv: Any, n_steps: int = 20) -> list[bytes]:
    """Return observations, rewards and dones of fixed actions."""
    rng = np.random.default_rng(0)
    n_choices, shape = getattr(venv.action_space, "n", 2), (venv.num_envs, *(venv.action_space.shape or ()))
    steps = [venv.step(rng.integers(0, n_choices, shape)) for _ in range(n_steps)]
    return [serialised(part) for step in steps for part in step[:3]]


def serialised(part: Any) -> bytes:
    arrays = part.values() if isinstance(part, dict) else [part]
    return b"".join(np.asarray(array).tobytes() for array in arrays)


@pytest.mark.parametrize("n_cpus", [1, 2])
@pytest.mark.parametrize("name", GAMES)
def test_copies_play_on_as_the_games(name: str, n_cpus: int) -> None:
    venv, other = (SuperSuitVecEnv(GAMES[name], 3, seed, n_cpus) for seed in (0, 1))
    try:
        venv.reset()
        played(venv, 4)
        state = venv.checkpoint_state()
        other.load_checkpoint_state(state)
        assert all(("state" in game) == (name in BY_METHODS) for game in state["games"])
        if name == "global generators" and n_cpus == 1:
            before = random.getstate(), np.random.get_state()  # noqa: NPY002
            expected = played(venv, 20)
            random.setstate(before[0])
            np.random.set_state(before[1])  # noqa: NPY002
        else:
            expected = played(venv, 20)
        assert played(other, 20) == expected
    finally:
        venv.close()
        other.close()


class LateEnv(LazyEnv):
    """Makes a lock after the trial of copies."""

    n_seen, lock = 0, None

    def _observe(self) -> dict[str, Any]:
        self.n_seen += 1
        if self.n_seen == 70:
            self.lock = threading.Lock()
        return super()._observe()


def test_what_a_game_makes_late_does_not_spoil_its_copies() -> None:
    venv, other = (SuperSuitVecEnv(LateEnv, 1, seed) for seed in (0, 1))
    venv.reset()
    played(venv, 72)
    with pytest.warns(UserWarning, match="the game's lock was made after its reset and cannot be pickled"):
        other.load_checkpoint_state(venv.checkpoint_state())
    assert played(other, 20) == played(venv, 20)


class SharingEnv(CounterEnv):
    """Draws from a generator of all games of its class."""

    levels = np.random.default_rng(0)

    def __init__(self) -> None:
        super().__init__()
        self.generator = self.levels

    def _observation(self, index: int, draw: np.float32) -> Any:
        return super()._observation(index, np.float32(self.generator.random()))


def test_games_that_share_what_changes_are_not_copied_one_by_one() -> None:
    venv = SuperSuitVecEnv(SharingEnv, 2, seed=0)
    venv.reset()
    with pytest.raises(CheckpointError, match="games share an object that changes"):
        venv.checkpoint_state()


class ResetEnv(Game):
    """Has a state from its first reset on, as PettingZoo's games."""

    def get_state(self) -> dict[str, Any]:
        return {"t": self.t}

    def set_state(self, state: dict[str, Any]) -> None:
        self.reset()
        self.t = state["t"]


@pytest.mark.parametrize("n_cpus", [1, 2])
def test_games_before_their_first_reset_have_no_state(n_cpus: int) -> None:
    venv = SuperSuitVecEnv(ResetEnv, 2, n_cpus=n_cpus, seed=0)
    assert venv.checkpoint_state()["games"] == []
    venv.reset()
    assert [game["state"] for game in venv.checkpoint_state()["games"]] == [{"t": 0}] * 2
    venv.close()


def test_a_slow_game_is_tried_for_fewer_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(10**6))
    monkeypatch.setattr("sb3_saf.envs.game_copies.time.monotonic", lambda: next(clock) ** 2 / 40)  # slower and slower
    venv = SuperSuitVecEnv(LazyEnv, 1, seed=0)
    venv.reset()
    assert "pickled" in venv.checkpoint_state()["games"][0]


def test_taking_a_state_draws_no_global_numbers() -> None:
    venv = SuperSuitVecEnv(GlobalEnv, 1, seed=0)
    venv.reset()
    before = repr(np.random.get_state())  # noqa: NPY002
    venv.checkpoint_state()
    assert repr(np.random.get_state()) == before  # noqa: NPY002


@pytest.mark.parametrize(("part", "value"), [("pickled", b"other"), ("pickled", None), ("signature", "0" * 64)])
def test_games_without_this_users_signature_are_refused(part: str, value: Any) -> None:
    venv = SuperSuitVecEnv(LazyEnv, 2, seed=0)
    venv.reset()
    state = venv.checkpoint_state()
    state["games"][1][part] = np.frombuffer(value, dtype=np.uint8) if isinstance(value, bytes) else value
    with pytest.raises(CheckpointError, match="not signed with this user's key"):
        venv.load_checkpoint_state(state)


def test_a_key_is_made_once_and_is_the_users_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    data = np.arange(9, dtype=np.uint8)
    signed = game_copies.signature(data)
    game_copies._key.cache_clear()
    assert game_copies.signature(data) == signed
    assert game_copies.key_file().stat().st_mode & 0o777 == 0o600
    assert [path.name for path in game_copies.key_file().parent.iterdir()] == ["key"]
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))  # no folder can be created there
    assert game_copies.signature(data) == game_copies.signature(data) != signed


# --- threads, processes and copies ------------------------------------------------------------------------------------


LEVEL: Final[dict[str, Any]] = {
    "n_agents": 2,
    "grid_size": 9,
    "n_treasures": 4,
    "max_cycles": 7,
    "observation": "tiles",
}


def native(seed: int) -> Any:
    return make_vec_env("TeamTogether", 6, seed=seed, **LEVEL)


def supersuit(seed: int) -> Any:
    return sb3_saf.make_team_env(LazyEnv, 3, seed=seed)


MAKERS: Final = pytest.mark.parametrize("make", [native, supersuit])


def begun(make: Callable[[int], Any], seed: int = 0) -> Any:
    venv = make(seed)
    venv.reset()
    return venv


def play_alone(make: Callable[[int], Any], seed: int) -> list[bytes]:
    venv = begun(make, seed)
    try:
        return played(venv)
    finally:
        venv.close()


@MAKERS
def test_two_threads_at_once(make: Callable[[int], Any]) -> None:
    expected = [play_alone(make, seed) for seed in (0, 1)]
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(partial(play_alone, make), (0, 1))) == expected


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_processes_that_are_started_in_the_middle_of_an_episode(method: str) -> None:
    makers: list[Callable[[int], Any]] = [native, supersuit]
    expected = [play_alone(make, 0) for make in makers]
    venvs = [begun(make) for make in makers]
    for venv in venvs:
        played(venv, 3)
    with ProcessPoolExecutor(1, multiprocessing.get_context(method)) as pool:
        assert [pool.submit(play_alone, make, 0).result() for make in makers] == expected
    for venv in venvs:
        venv.close()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda venv: pickle.loads(pickle.dumps(venv))])
def test_copies_in_the_middle_of_an_episode_share_nothing(copied: Callable[[Any], Any]) -> None:
    venv = begun(native)
    played(venv, 3)
    other = copied(venv)
    expected = played(venv)
    assert played(other) == expected


@pytest.mark.parametrize("copied", [copy.deepcopy, pickle.dumps])
def test_games_in_worker_processes_refuse_copies_and_play_on(copied: Callable[[Any], Any]) -> None:
    venv = sb3_saf.make_team_env(LazyEnv, 2, seed=0, n_cpus=2)
    venv.reset()
    with pytest.raises(TypeError, match="n_cpus=1"):
        copied(venv)
    gc.collect()
    venv.step(np.zeros(venv.num_envs, dtype=np.int64))
    venv.close()


def test_games_in_worker_processes_end_with_a_killed_owner() -> None:
    def own(pids: Any) -> None:
        envs = [sb3_saf.make_team_env(LazyEnv, 2, seed=seed, n_cpus=2) for seed in (0, 1)]
        pids.put([child.pid for child in multiprocessing.active_children()])
        time.sleep(600)
        del envs

    context = multiprocessing.get_context("fork")
    pids = context.SimpleQueue()
    owner = context.Process(target=own, args=(pids,))
    owner.start()
    workers = [psutil.Process(pid) for pid in pids.get()]
    owner.kill()
    owner.join()
    _, left = psutil.wait_procs(workers, timeout=10)
    for worker in left:
        worker.kill()
    assert len(workers) == 4 and not left
