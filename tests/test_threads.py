"""Helpers of a batch: they sleep and wake, leave with their batch, and are made anew after a fork."""

from __future__ import annotations

import math
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from hecogrid_envs import GameBatch, HECOGridParams, game_seeds
from hecogrid_envs.arrays import aligned
from hecogrid_envs.core.sharing import DESK_PART, END, FIRST, NEXT, STEP, lead, post
from hecogrid_envs.threads import NOTHING, Helpers

PARAMS = HECOGridParams(n_agents=5, grid_size=12, n_treasures=30, observation="tiles")


def batch_of(n_threads: int, n_games: int = 6) -> GameBatch:
    """A batch of seeded games."""
    batch = GameBatch("TeamSupport", PARAMS, n_games, n_threads)
    batch.reset(seeds=game_seeds(0, n_games))
    return batch


def helpers_of(batch: GameBatch) -> list[threading.Thread]:
    """The threads that a batch has started, told by the desk that they share."""
    helpers = batch._shares._helpers
    assert helpers is not None
    return helpers.threads


def wait_until(condition: Callable[[], bool], seconds: float = 30.0) -> None:
    """Wait for what another thread does."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


def test_helpers_fall_asleep_and_are_woken() -> None:
    alone, shared = batch_of(1), batch_of(3)
    for row in np.random.default_rng(0).integers(0, 7, size=(5, 6, 5)):
        alone.step(row)
        shared.step(row)
        np.testing.assert_array_equal(alone.observe(), shared.observe())
        helpers = shared._shares._helpers
        assert helpers is not None
        wait_until(lambda helpers=helpers: all(map(helpers.is_asleep, (1, 2))))  # type: ignore[misc]


def test_nobody_waits_for_a_helper_that_does_not_come() -> None:
    alone, batch = batch_of(1), batch_of(1)
    actions = np.random.default_rng(0).integers(0, 7, size=(6, 5))
    alone.step(actions)
    arguments = batch._shares._arguments
    arguments[2].actions[...] = actions.reshape(-1)
    desk = aligned(4 * DESK_PART, np.int64)
    for part, (first, end) in zip(desk.reshape(4, -1)[1:], [(0, 2), (2, 4), (4, 6)], strict=True):
        part[FIRST], part[END] = first, end
    post(desk, STEP, NOTHING, NOTHING)
    assert lead(*arguments, desk, 1)
    np.testing.assert_array_equal(alone.observe(), batch.observe())
    # What somebody else has taken is waited for.
    post(desk, STEP, NOTHING, NOTHING)
    desk[DESK_PART + NEXT] += 1
    assert not lead(*arguments, desk, 1_000)


def test_an_interrupt_before_the_first_task_is_survived() -> None:
    alone, batch = batch_of(1), batch_of(1)
    helpers = Helpers(batch._shares._arguments, [(0, 3), (3, 6)])
    helpers._posted = (NOTHING, NOTHING)
    batch._shares._arguments[2].actions[...] = 2
    helpers.play(STEP, NOTHING, NOTHING)
    alone.step(np.full((6, 5), 2))
    np.testing.assert_array_equal(alone.observe(), batch.observe())


@pytest.mark.parametrize(("n_threads", "n_games"), [(2, 3), (2, 40), (3, 17), (5, 5)])
def test_whoever_plays_a_game_it_is_the_same(n_threads: int, n_games: int) -> None:
    alone, shared = batch_of(1, n_games), batch_of(n_threads, n_games)
    for row in np.random.default_rng(0).integers(0, 7, size=(400, n_games, 5)):
        ours, over = shared.advance(row)
        theirs, also_over = alone.advance(row)
        assert (ours == theirs).all() and (over == also_over).all()
    np.testing.assert_array_equal(shared.collected, alone.collected)


def test_helpers_leave_with_their_batch() -> None:
    batch = batch_of(3)
    batch.step(np.zeros((6, 5), dtype=np.uint8))
    threads = helpers_of(batch)
    assert len(threads) == 2 and all(thread.is_alive() for thread in threads)
    del batch
    wait_until(lambda: not any(thread.is_alive() for thread in threads))


def test_one_game_needs_no_helpers() -> None:
    batch = batch_of(4, n_games=1)
    batch.step(np.zeros((1, 5), dtype=np.uint8))
    assert batch._shares._helpers is None


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


@pytest.mark.parametrize(
    ("out", "what"),
    [
        (np.zeros((6, 5, 7, 7), dtype=np.int16), r"int16 \(6, 5, 7, 7\)"),
        (np.zeros((6, 5, 49), dtype=np.uint8), r"uint8 \(6, 5, 49\)"),
        (np.zeros((7, 7, 5, 6), dtype=np.uint8).T, r"uint8 \(6, 5, 7, 7\)"),
    ],
)
def test_views_go_to_arrays_that_fit(out: np.ndarray, what: str) -> None:
    with pytest.raises(ValueError, match=rf"contiguous uint8 array of shape \(6, 5, 7, 7\), got {what}"):
        batch_of(1).observe(out)


def test_actions_of_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"actions must have shape \(6, 5\), \(games, agents\), got \(30,\)"):
        batch_of(2).step(np.zeros(30, dtype=np.uint8))


def test_a_choice_of_other_games_is_refused() -> None:
    with pytest.raises(ValueError, match=r"which must have shape \(6,\), one per game, got \(5,\)"):
        batch_of(2).reset(np.ones(5, dtype=bool))


@pytest.mark.parametrize("view_size", [1, 3, 7, 9])
@pytest.mark.parametrize("tile", [1, 2, 4, 5, 6, 12])
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
