"""Seeds of evaluation games, apart from those of every training game of every run."""

from __future__ import annotations

from typing import Final

import numpy as np

#: Seeds of runs are below this: NumPy's global generator, which SB3 seeds, takes no larger ones.
MAX_SEED: Final = 2**32 - 1

_EVALUATION: Final = 1


def check_seed(seed: object) -> int:
    """Return the seed of a run if it is a whole number from 0 to 2**32 - 1; else a ValueError."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or not 0 <= seed <= MAX_SEED:
        raise ValueError(f"seed must be a whole number from 0 to {MAX_SEED}, got {seed!r}")
    return int(seed)


def evaluation_seed(seed: int) -> int:
    """
    Return the seed from which a run's evaluation games get theirs, from 2**62 to 2**63 - 1.

    A branch of its own in the run's tree of seeds, with the top bit of 63 set. So it is no seed that a run can have,
    and evaluation games differ from the training games of this run and of all others.
    """
    word = np.random.SeedSequence(check_seed(seed), spawn_key=(_EVALUATION,)).generate_state(1, np.uint64)[0]
    return (int(word) >> 2) | (1 << 62)
