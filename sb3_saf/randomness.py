"""Randomness of its own: whatever is drawn in here, training draws what it would have drawn."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch as th


@contextmanager
def own_randomness(seed: int, device: th.device) -> Iterator[None]:
    """
    Seed all global generators for a while, then put them back as they were.

    :param seed: of Python's, NumPy's and torch's generators
    :param device: the model's; on a GPU its generator counts, too
    """
    of_python, of_numpy = random.getstate(), np.random.get_state()  # noqa: NPY002 - SB3 draws from it
    try:
        with th.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            random.seed(seed)
            np.random.seed(seed % 2**32)  # noqa: NPY002
            th.manual_seed(seed)
            yield
    finally:
        random.setstate(of_python)
        np.random.set_state(of_numpy)  # noqa: NPY002
