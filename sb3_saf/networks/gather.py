"""Select rows of a tensor, with gradients that repeat."""

from __future__ import annotations

import torch as th


def gather(x: th.Tensor, rows: th.Tensor) -> th.Tensor:
    """
    Return ``x[rows]``, with a gradient that is the same every time.

    On the CPU, PyTorch adds up the gradient of ``x[rows]`` in parallel, in an order that changes from run to run; that
    of ``index_select`` is added in order, and in a third of the time.

    :param x: (K, *shape)
    :param rows: int64 of any shape, each in 0..K-1
    :return: (*rows.shape, *shape)
    """
    return x.index_select(0, rows.flatten()).view(*rows.shape, *x.shape[1:])


def gather_agents(x: th.Tensor, teams: th.Tensor, agent: th.Tensor) -> th.Tensor:
    """
    Return ``x[teams, agent]``, see :func:`gather`.

    :param x: (G, N, *shape)
    :param teams: (B,) int64
    :param agent: (B,) int64
    :return: (B, *shape)
    """
    return gather(x.flatten(0, 1), teams * x.shape[1] + agent)
