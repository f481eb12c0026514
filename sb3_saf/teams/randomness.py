"""Context manager for random numbers that do not affect those of training."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch as th


@contextmanager
def own_randomness(seed: int, device: th.device) -> Iterator[None]:
    """
    Seed all global generators temporarily, then restore their states.

    :param seed: seed of Python's, NumPy's and torch's generators
    :param device: the model's device; on a GPU its generator is included
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
