"""
Value normalisation: the critic learns returns of mean 0 and variance 1; values outside the critic are on the raw scale.

How it works with SB3's unmodified PPO:

1. The policy passes every output of its critic through its :class:`ValueNormalizer`, so *all* values outside the policy
   are on the raw scale: in the buffer, in the advantages, in the bootstrap of a time limit.
2. SB3 trains with its squared error on the raw scale. The gradient of a value is rescaled in the backward pass to the
   gradient of the squared error of normalised values (:meth:`ValueNormalizer.forward`).
3. The statistics need the returns, which the rollout buffer computes. The minibatches of ``TeamRolloutBuffer`` contain
   them (``sb3_saf.buffers.rollout``); the policy updates the statistics at the first minibatch of a rollout, before the
   gradient step. Training on minibatches of other buffers raises a ValueError.

Letters: B rows.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt
import torch as th
from torch import nn

#: Lower limit of the standard deviation: nearly constant returns are not scaled to variance 1.
MIN_STD: Final = 1e-2


class ValueNormalizer(nn.Module):
    """
    Running mean and variance of all returns with equal weights, and the conversion of the critic's outputs to values.

    Before the first update the mean is 0 and the variance 1: values are the critic's outputs, bit for bit.

    :param n_agents: N for statistics of each agent's own returns; None for one of all
    """

    mean: th.Tensor
    var: th.Tensor
    count: th.Tensor

    def __init__(self, n_agents: int | None = None) -> None:
        super().__init__()
        shape = () if n_agents is None else (n_agents,)
        self.register_buffer("mean", th.zeros(shape))
        self.register_buffer("var", th.ones(shape))
        self.register_buffer("count", th.zeros(shape, dtype=th.int64))

    @property
    def std(self) -> th.Tensor:
        """() or (N,) standard deviation by which values are scaled."""
        return self.var.sqrt().clamp_min(MIN_STD)

    def forward(
        self, outputs: th.Tensor, active: th.Tensor | None = None, agents: th.Tensor | None = None
    ) -> th.Tensor:
        """
        De-normalise: ``v = mean + std * n`` for the critic's outputs n.

        The incoming gradient at v is divided by std². With returns R, SB3's loss sends back
        ``d/dv (R - v)² = -2 (R - v)``, and the chain rule through ``v = mean + std * n`` makes ``-2 std (R - v)`` of it
        at n. The loss of normalised values is ``((R - mean) / std - n)²`` with the gradient
        ``-2 ((R - mean) / std - n) = -2 (R - v) / std`` at n: the same, divided by std². So SB3's ``vf_coef`` weighs
        the normalised loss, while the ``train/value_loss`` that it logs and ``clip_range_vf`` stay on the raw scale.

        :param outputs: (B, ...) outputs of the critic
        :param active: (B, ...) bool, rows that take part; the values of others are exactly zero. All if None
        :param agents: (B, ...) agents of the rows, for statistics of each agent
        :return: (B, ...) values on the scale of returns
        """
        mean, std = (value[agents] if value.ndim else value for value in (self.mean, self.std))
        values = mean + std * outputs
        if values.requires_grad:
            factor = std**-2
            values.register_hook(lambda gradient: gradient * factor)
        return values if active is None else values * active

    def update(
        self, returns: npt.NDArray[np.floating], agents: npt.NDArray[np.integer] | None = None
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Update the statistics with more returns.

        :param returns: returns of any shape, on the raw scale
        :param agents: their agents, in the same shape, for statistics of each agent
        :return: conversion of values under the old statistics, ``scale * value + shift``: new standard deviation / old,
            and a shift in the units of returns, () or (N,) each
        :raises ValueError: for NaN or infinity
        """
        returns = np.asarray(returns, dtype=np.float64)
        if not np.isfinite(returns).all():
            raise ValueError("returns must be finite, got NaN or infinity; check the environment's rewards")
        old_mean, old_std = self.mean.double(), self.std.double()
        for index in range(self.mean.numel()):
            own = returns if self.mean.ndim == 0 else returns[agents == index]
            if not own.size:
                continue
            # Mean and variance of the two sets together.
            means, variances, counts = (values.view(-1) for values in (self.mean, self.var, self.count))
            n_old, mean_before, var_before = int(counts[index]), float(means[index]), float(variances[index])
            mean, share = float(own.mean()), own.size / (n_old + own.size)
            between = share * (1.0 - share) * (mean - mean_before) ** 2 if n_old else 0.0
            means[index] = mean_before + share * (mean - mean_before)
            variances[index] = math.fsum([(1.0 - share) * var_before, share * float(own.var()), between])
            counts[index] = n_old + own.size
        scale = self.std.double() / old_std
        return scale, self.mean.double() - scale * old_mean
