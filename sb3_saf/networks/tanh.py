"""
Tanh as a rational function for the CPU: x P(x^2) / Q(x^2), in vectorised float32 loops. PyTorch's tanh takes ten times
as long, a fifth of the training time with small networks.

P and Q are the least-squares fit to tanh at the Chebyshev nodes of [0, 9], weighted to minimise the error of the
quotient; beyond 9 tanh rounds to 1. In float32 the error is at most 4e-7.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch as th
from numba import njit

from hecogrid_envs.core.jit import cached

_LIMIT: Final = np.float32(9.0)
_P0, _P1, _P2, _P3, _P4 = (
    np.float32(c) for c in (0.99999989628, 0.13369542274, 3.4823105218e-3, 2.0404522545e-5, 1.3096937960e-8)
)
_Q1, _Q2, _Q3, _Q4 = (np.float32(c) for c in (0.46702835693, 2.5825546283e-2, 3.2645262420e-4, 7.6656541996e-7))
_ONE: Final = np.float32(1.0)


class Tanh(th.nn.Tanh):
    """``nn.Tanh`` that is faster on the CPU."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Return the tanh of a tensor of any shape."""
        if x.device.type != "cpu" or x.dtype != th.float32 or th.compiler.is_compiling():
            return super().forward(x)
        if not (x.requires_grad and th.is_grad_enabled()):
            return _tanh(x)
        return _Tanh.apply(x)


class _Tanh(th.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: th.Tensor) -> th.Tensor:
        y = _tanh(x)
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *gradients: th.Tensor) -> th.Tensor:
        # Autograd's formula, which is differentiable again, as TRPO needs.
        return th.ops.aten.tanh_backward(gradients[0], *ctx.saved_tensors)


def _tanh(x: th.Tensor) -> th.Tensor:
    x = x.detach().contiguous()
    y = th.empty_like(x)
    _fill(x.numpy().reshape(-1), y.numpy().reshape(-1))
    return y


@njit(inline="always")
def tanh_of(x: np.float32) -> np.float32:
    """Return the tanh of a number, in compiled loops; NaN stays NaN."""
    v = min(max(x, -_LIMIT), _LIMIT)
    s = v * v
    above = v * (_P0 + s * (_P1 + s * (_P2 + s * (_P3 + s * _P4))))
    return above / (_ONE + s * (_Q1 + s * (_Q2 + s * (_Q3 + s * _Q4))))


@cached(error_model="numpy", fastmath={"contract"})
def _fill(x: npt.NDArray[np.float32], y: npt.NDArray[np.float32]) -> None:
    """Write the tanh of all numbers."""
    for i in range(x.size):
        y[i] = tanh_of(x[i])
