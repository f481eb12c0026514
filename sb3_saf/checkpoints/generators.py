"""States of the random generators that a process draws from."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_saf.checkpoints.data import Tree


def generator_states(action_space: spaces.Space[Any]) -> Tree:
    """States of Python's, NumPy's and torch's global generators and of the action space's own."""
    version, words, gauss = random.getstate()
    return {
        "python": [version, np.array(words, dtype=np.uint32), gauss],
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002 - SB3 draws from it
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
        # Asking for a generator that is not there would make one; then there is nothing to restore either.
        "action_space": None if action_space._np_random is None else action_space._np_random.bit_generator.state,
    }


def load_generator_states(states: Tree, action_space: spaces.Space[Any]) -> None:
    """Let all of them go on from there."""
    version, words, gauss = states["python"]
    random.setstate((version, tuple(words.tolist()), gauss))
    np.random.set_state(states["numpy"])  # noqa: NPY002
    th.set_rng_state(states["torch"])
    if states["cuda"] and th.cuda.is_available():
        th.cuda.set_rng_state_all(states["cuda"])
    if states["action_space"] is not None:
        action_space.np_random.bit_generator.state = states["action_space"]
