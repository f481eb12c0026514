"""One seed for a run, an independent one for each of its games."""

from __future__ import annotations

import secrets

import numpy as np

#: Game seeds stay within a signed 64-bit integer, so that every stack between here and a game carries them.
_SEED_BITS = 63


def game_seeds(seed: int, n_games: int, first: int = 0) -> list[int]:
    """
    Return the seeds of the games of a vector environment.

    Game ``i`` gets the same seed whatever the number of games, and the seeds of neighbouring runs
    (``seed`` and ``seed + 1``) have nothing in common.

    :param seed: the run's seed, 0 or larger
    :param n_games: E, number of games
    :param first: index of the first game
    :return: E integers below 2**63
    """
    return [_game_seed(seed, index) for index in range(first, first + n_games)]


def _game_seed(seed: int, index: int) -> int:
    words = np.random.SeedSequence(seed, spawn_key=(index,)).generate_state(1, np.uint64)
    return int(words[0]) >> (64 - _SEED_BITS)


def generator_word(seed: int) -> np.uint64:
    """
    Return the first state of a game's random generator.

    :param seed: 0 or larger, of any size
    :raises ValueError: for anything else
    """
    if isinstance(seed, (bool, np.bool_)) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed must be an integer of at least 0 or None, got {seed!r}")
    word: np.uint64 = np.random.SeedSequence(int(seed)).generate_state(1, np.uint64)[0]
    return word


def fresh_seed() -> int:
    """Draw a seed from the operating system, for games that nobody seeded; no global generator is touched."""
    return secrets.randbits(_SEED_BITS)
