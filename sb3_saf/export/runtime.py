"""What computes an exported actor. Letters: K rows, D action dimensions, A actions, M choices, H size of a memory."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[Any]
#: Hidden and cell state of an LSTM, (layers, K, H) each; empty without memory.
States: TypeAlias = tuple[Array, ...]
#: Where random numbers come from; None goes on where the last call ended.
Rng: TypeAlias = int | np.random.Generator | None


class Inputs(NamedTuple):
    """What an agent knows: (K, *shape) own observations, (K, M) legal choices, None if all are, and its memory."""

    observation: Array
    action_mask: Array | None
    states: States = ()


class Runtime(Protocol):
    """Torch or onnxruntime, with the network of one actor."""

    #: (n_codes, t, t, C) uint8 pixels of tile codes, where observations are such.
    atlas: Array | None

    def act(self, inputs: Inputs, deterministic: bool, rng: Rng) -> tuple[Array, States]:
        """Return (K, *shape) actions, and what is remembered then."""

    def log_probs(self, inputs: Inputs) -> Array:
        """Return (K, A) log-probabilities of discrete actions."""

    def log_prob(self, inputs: Inputs, actions: Array) -> Array:
        """Return (K,) log-likelihoods of actions (K, D)."""
