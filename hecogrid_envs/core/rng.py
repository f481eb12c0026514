"""
Random numbers of games: the small generator that kernels draw from (SplitMix64, Steele et al. 2014).

The generator's whole state is one word per game, so a game does not depend on the other games of its batch.
"""

from __future__ import annotations

from numbers import Integral

import numpy as np
import numpy.typing as npt

from hecogrid_envs.core.jit import inlined

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_LOW_32 = np.uint64(0xFFFFFFFF)


def generator_word(seed: int) -> np.uint64:
    """
    Return the first state of a game's random generator.

    :param seed: 0 or larger, of any size
    :raises ValueError: for anything else
    """
    if isinstance(seed, (bool, np.bool_)) or not isinstance(seed, Integral) or seed < 0:
        raise ValueError(f"seed must be an integer of at least 0, or None, got {seed!r}")
    word: np.uint64 = np.random.SeedSequence(int(seed)).generate_state(1, np.uint64)[0]
    return word


@inlined
def next_word(rng: npt.NDArray[np.uint64], game: int) -> np.uint64:
    """Advance a game's generator and return 64 random bits."""
    state = rng[game] + _GAMMA
    rng[game] = state
    word = (state ^ (state >> np.uint64(30))) * _MIX_1
    word = (word ^ (word >> np.uint64(27))) * _MIX_2
    return word ^ (word >> np.uint64(31))


@inlined
def below(rng: npt.NDArray[np.uint64], game: int, n: int) -> int:
    """Draw an integer uniformly from 0 to n - 1 (Lemire 2019); n < 2**32."""
    bound = np.uint64(n)
    product = (next_word(rng, game) >> np.uint64(32)) * bound
    low = product & _LOW_32
    if low < bound:
        threshold = (np.uint64(0x100000000) - bound) % bound
        while low < threshold:
            product = (next_word(rng, game) >> np.uint64(32)) * bound
            low = product & _LOW_32
    drawn: int = np.int64(product >> np.uint64(32))  # type: ignore[assignment]
    return drawn
