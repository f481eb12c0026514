"""Seeds of evaluation games, disjoint from those of the training games of all runs."""

from __future__ import annotations

from typing import Final

import numpy as np

#: Largest seed of a run: the limit of NumPy's global generator, which SB3 seeds.
MAX_SEED: Final = 2**32 - 1

_EVALUATION: Final = 1


def check_seed(seed: object) -> int:
    """Return the seed of a run if it is an integer from 0 to 2**32 - 1; otherwise raise ValueError."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or not 0 <= seed <= MAX_SEED:
        raise ValueError(f"seed must be a whole number from 0 to {MAX_SEED}, got {seed!r}")
    return int(seed)


def evaluation_seed(seed: int) -> int:
    """
    Return the seed from which the seeds of a run's evaluation games are derived, from 2**62 to 2**63 - 1.

    It is a separate branch in the run's tree of seeds, with the top bit of 63 set. No run can have this seed, so
    evaluation games differ from the training games of all runs.
    """
    word = np.random.SeedSequence(check_seed(seed), spawn_key=(_EVALUATION,)).generate_state(1, np.uint64)[0]
    return (int(word) >> 2) | (1 << 62)
