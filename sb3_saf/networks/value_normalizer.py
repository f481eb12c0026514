"""
Value normalisation: the critic learns returns of mean 0 and variance 1, everybody else sees values on the raw scale.

How it works inside stock PPO:

1. The policy sends every output of its critic through its :class:`ValueNormalizer`, so *all* values that leave the
   policy are on the raw scale: those in the buffer, in the advantages, in the bootstrap of a time limit.
2. SB3 trains with its squared error on the raw scale. The gradient of a value is rescaled on its way back, which makes
   it the gradient of the squared error of normalised numbers (:meth:`ValueNormalizer.forward`).
3. The statistics need the returns, which the rollout buffer computes. The minibatches of ``TeamRolloutBuffer`` carry
   them (``sb3_saf.buffers.rollout``); the policy takes them in when it sees the first minibatch of a rollout, before
   anything is learned from it. Training on minibatches of other buffers raises a ValueError.

Letters: B rows.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from torch import nn

#: Returns that hardly vary are not blown up to a variance of 1.
MIN_STD: Final = 1e-2


class Rescaling(NamedTuple):
    """
    How new statistics change values that the critic gave under the old ones: ``scale * value + shift``.

    :param scale: new standard deviation / old
    :param shift: in the units of returns
    """

    scale: float
    shift: float


class ValueNormalizer(nn.Module):
    """
    Mean and variance of all returns so far, each counting alike, and the way from the critic's outputs to values.

    Before the first update the mean is 0 and the variance 1: values are the critic's outputs, bit for bit.
    """

    mean: th.Tensor
    var: th.Tensor
    count: th.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", th.tensor(0.0))
        self.register_buffer("var", th.tensor(1.0))
        self.register_buffer("count", th.tensor(0, dtype=th.int64))

    @property
    def std(self) -> th.Tensor:
        """() standard deviation that values are scaled by."""
        return self.var.sqrt().clamp_min(MIN_STD)

    def forward(self, outputs: th.Tensor, active: th.Tensor | None = None) -> th.Tensor:
        """
        De-normalise: ``v = mean + std * n`` for the critic's outputs n.

        The gradient that arrives at v is divided by std². With returns R, SB3's loss sends back
        ``d/dv (R - v)² = -2 (R - v)``, and the chain rule through ``v = mean + std * n`` makes ``-2 std (R - v)`` of it
        at n. The loss of normalised numbers is ``((R - mean) / std - n)²`` with the gradient
        ``-2 ((R - mean) / std - n) = -2 (R - v) / std`` at n: the same, divided by std². So SB3's ``vf_coef`` weighs
        the normalised loss, while the ``train/value_loss`` that it logs and ``clip_range_vf`` stay on the raw scale.

        :param outputs: (B, ...) of the critic
        :param active: (B, ...) bool, rows that take part; the values of others are exactly zero. All do if None
        :return: (B, ...) values on the scale of returns
        """
        std = self.std
        values = self.mean + std * outputs
        if values.requires_grad:
            factor = std**-2
            values.register_hook(lambda gradient: gradient * factor)
        return values if active is None else values * active

    def update(self, returns: npt.NDArray[np.floating]) -> Rescaling:
        """
        Take more returns into the statistics.

        :param returns: of any shape, on the raw scale
        :return: how values of before change
        :raises ValueError: for NaN or infinity
        """
        returns = np.asarray(returns, dtype=np.float64)
        if not np.isfinite(returns).all():
            raise ValueError("returns must be finite, got NaN or infinity; check the environment's rewards")
        old_mean, old_std = float(self.mean), float(self.std)
        if returns.size:
            self._merge(float(returns.mean()), float(returns.var()), returns.size)
        scale = float(self.std) / old_std
        return Rescaling(scale, float(self.mean) - scale * old_mean)

    def _merge(self, mean: float, var: float, count: int) -> None:
        """Mean and variance of two sets of numbers together, from those of each."""
        n_old = int(self.count)
        share = count / (n_old + count)
        old_mean, old_var = float(self.mean), float(self.var)
        between = share * (1.0 - share) * (mean - old_mean) ** 2 if n_old else 0.0
        self.mean.fill_(old_mean + share * (mean - old_mean))
        self.var.fill_(math.fsum([(1.0 - share) * old_var, share * var, between]))
        self.count.fill_(n_old + count)
