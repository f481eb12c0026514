"""
A small generator of random numbers for each game (SplitMix64, Steele et al. 2014).

Its whole state is one word per game, so a game's future depends on its own past only, whoever its neighbours are.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hecogrid_envs.core.jit import inlined

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_LOW_32 = np.uint64(0xFFFFFFFF)


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
    """Draw an integer from 0 to n - 1, every one equally likely (Lemire 2019); n < 2**32."""
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
