"""Threads share the games of a batch: games do not depend on the thread, also after a fork."""

from __future__ import annotations

import math
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest

from hecogrid_envs import GameBatch, HECOGridParams
from sb3_saf import game_seeds

PARAMS = HECOGridParams(n_agents=5, grid_size=12, n_treasures=30, observation="tiles")


def batch_of(n_threads: int, n_games: int = 6) -> GameBatch:
    """Create a batch of seeded games."""
    batch = GameBatch("TeamSupport", PARAMS, n_games, n_threads)
    batch.reset(seeds=game_seeds(0, n_games))
    return batch


def test_threads_end_with_their_batch() -> None:
    before = set(threading.enumerate())
    batch = batch_of(3)
    batch.step(np.zeros((6, 5), dtype=np.uint8))
    threads = set(threading.enumerate()) - before
    assert threads
    del batch
    end = time.monotonic() + 30
    while any(thread.is_alive() for thread in threads):
        assert time.monotonic() < end, "a thread outlives its batch"
        time.sleep(0.01)


@pytest.mark.skipif(not hasattr(__import__("os"), "fork"), reason="no fork here")
def test_a_forked_process_plays_on() -> None:
    script = """
        import os, numpy as np
        from tests.test_threads import batch_of

        batch, alone = batch_of(2), batch_of(1)
        step = np.ones((6, 5), dtype=np.uint8)
        batch.step(step)
        child = os.fork()
        batch.step(step)
        if child == 0:
            alone.step(step)
            alone.step(step)
            os._exit(0 if (batch.observe() == alone.observe()).all() else 1)
        raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    """
    command = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", textwrap.dedent(script)]
    subprocess.run(command, check=True, timeout=120)


@pytest.mark.parametrize(("view_size", "tile"), [(1, 1), (3, 5), (7, 4), (7, 12), (9, 2), (9, 6)])
def test_drawing_stays_inside_its_array(view_size: int, tile: int) -> None:
    params = HECOGridParams(
        n_agents=5, grid_size=12, n_treasures=30, view_size=view_size, view_offset=0, view_tile_size=tile
    )
    drawn = []
    for n_threads in (1, 3):
        batch = GameBatch("TeamSupport", params, 6, n_threads)
        batch.reset(seeds=game_seeds(0, 6))
        shape = (6, 5, params.view_pixels, params.view_pixels, 3)
        memory = np.full(math.prod(shape) + 64, 77, dtype=np.uint8)
        batch.observe(memory[:-64].reshape(shape))
        assert (memory[-64:] == 77).all()
        drawn.append(memory)
        alone = [batch.observe_game(game) for game in range(6)]
        np.testing.assert_array_equal(memory[:-64].reshape(shape), alone)
    np.testing.assert_array_equal(drawn[0], drawn[1])
