"""Interface of runtimes. Letters: K rows, D action dimensions, A actions, M choices, H size of a memory."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[Any]
#: Hidden and cell state of an LSTM, (layers, K, H) each; empty without memory.
States: TypeAlias = tuple[Array, ...]
#: Source of random numbers; None continues from the last call.
Rng: TypeAlias = int | np.random.Generator | None


class Inputs(NamedTuple):
    """Own observations (K, *shape), legal choices (K, M), None if all are, and memory."""

    observation: Array
    action_mask: Array | None
    states: States = ()


class Runtime(Protocol):
    """Runtime (torch or onnxruntime) of one actor's network."""

    #: (n_codes, t, t, C) uint8 pixels of tile codes, None for other observations.
    atlas: Array | None

    def act(self, inputs: Inputs, deterministic: bool, rng: Rng) -> tuple[Array, States]:
        """Return actions (K, *shape), and the next memory."""

    def log_probs(self, inputs: Inputs) -> Array:
        """Return log-probabilities (K, A) of discrete actions."""

    def log_prob(self, inputs: Inputs, actions: Array) -> Array:
        """Return log-likelihoods (K,) of actions (K, D)."""
