"""Several vector environments and models in threads, processes and copies do not affect each other."""

from __future__ import annotations

import copy
import gc
import multiprocessing
import pickle
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from typing import Any, Final

import numba
import numpy as np
import psutil
import pytest
import torch as th

import sb3_saf
from sb3_saf import make_vec_env
from tests.test_game_copies import played
from tests.toy_envs import LazyEnv

LEVEL: Final[dict[str, Any]] = {
    "n_agents": 2,
    "grid_size": 9,
    "n_treasures": 4,
    "max_cycles": 7,
    "observation": "tiles",
}


def native(seed: int) -> Any:
    return make_vec_env("TeamTogether", 6, seed=seed, n_threads=2, **LEVEL)


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
    venvs = [begun(make) for make in makers]  # their threads, if any, are running
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


@MAKERS
def test_numbers_of_threads_that_change_in_between(make: Callable[[int], Any]) -> None:
    expected = play_alone(make, 0)
    before = th.get_num_threads(), numba.get_num_threads()
    venv = begun(make)
    try:
        th.set_num_threads(2)
        numba.set_num_threads(1)
        assert played(venv) == expected
    finally:
        th.set_num_threads(before[0])
        numba.set_num_threads(before[1])
        venv.close()
