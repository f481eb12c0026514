"""Seeds of games, and random numbers that do not affect those of training."""

from __future__ import annotations

import random
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Integral
from typing import Any, Final

import numpy as np
import torch as th

#: Game seeds have 32 bits, the most that ``np.random.seed`` and ``RandomState`` of other games take.
_SEED_BITS: Final = 32
#: Odd, so that the seeds of a run's games differ: 2**32 over the golden ratio.
_STRIDE: Final = 0x9E3779B1


def game_seeds(seed: int | None, n_games: int) -> list[int]:
    """
    Return the seeds of the games of a vector environment.

    Game ``i`` gets the same seed for any number of games, and the games of a run have different seeds; seeds of runs
    ``seed`` and ``seed + 1`` are unrelated.

    :param seed: the run's seed, 0 or larger, of any size; None draws one from the operating system
    :param n_games: E, number of games
    :return: E integers below 2**32
    :raises ValueError: for an invalid seed
    """
    if seed is None:
        seed = secrets.randbits(64)
    elif isinstance(seed, (bool, np.bool_)) or not isinstance(seed, Integral) or seed < 0:
        raise ValueError(f"seed must be an integer of at least 0, or None, got {seed!r}")
    start = int(np.random.SeedSequence(int(seed)).generate_state(1, np.uint32)[0])
    return [(start + index * _STRIDE) % 2**_SEED_BITS for index in range(n_games)]


def generator_states() -> tuple[Any, Any]:
    """Return the states of Python's and NumPy's global generators, from which SB3 and games draw."""
    return random.getstate(), np.random.get_state()  # noqa: NPY002


def set_generator_states(states: tuple[Any, Any]) -> None:
    """Restore what :func:`generator_states` returned."""
    random.setstate(states[0])
    np.random.set_state(states[1])  # noqa: NPY002


@contextmanager
def own_randomness(seed: int, device: th.device | None = None) -> Iterator[None]:
    """
    Seed all global generators temporarily, then restore their states.

    :param seed: seed of Python's, NumPy's and torch's generators
    :param device: the model's device, if there is one; on a GPU its generator is included
    """
    states = generator_states()
    try:
        with th.random.fork_rng(devices=[device] if device is not None and device.type == "cuda" else []):
            random.seed(seed)
            np.random.seed(seed % 2**32)  # noqa: NPY002
            th.manual_seed(seed)
            yield
    finally:
        set_generator_states(states)
