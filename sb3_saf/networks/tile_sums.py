"""
First layer over tile codes without pixels: a tile's contribution to the layer's output depends on its code only, so it
is computed once per code and looked up.

A linear layer or a convolution over pictures of tiles is a sum of the tiles' contributions. Few codes occur in a batch,
so all contributions fit a small table; a view's output is then a sum of rows of the table, about ten times cheaper than
the products, and the gradient likewise. Equal to the layer over pixels up to float summation order.

Letters: K views, T tiles per view, U codes that occur, P places (positions) of the output, S ways (relative positions
of a tile and a place), W numbers per place, J pairs of a place and a tile in its window.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
import torch as th
from torch.autograd.function import once_differentiable

from hecogrid_envs.core.jit import cached

Ints: TypeAlias = npt.NDArray[np.int64]
Floats: TypeAlias = npt.NDArray[Any]


class Places(NamedTuple):
    """
    Tiles in the window of each place of the output.

    :param size: shape of the output without the W numbers per place: (), or (height, width); P is their product
    :param first: (P + 1,) pairs ``first[p]`` to ``first[p + 1] - 1`` are those of place p; each place has at least one
    :param tile: (J,) in 0..T-1
    :param way: (J,) in 0..S-1
    """

    size: tuple[int, ...]
    first: Ints
    tile: Ints
    way: Ints


def places_of_linear(n_tiles: int) -> Places:
    """Return the places of a linear layer: a single place with every tile, each in its own way."""
    tiles = np.arange(n_tiles)
    return Places((), np.array([0, n_tiles]), tiles, tiles)


def places_of_convolution(rows: int, columns: int, tile: int, kernel: int, stride: int) -> Places:
    """
    Return the places of a convolution without padding whose stride divides the tile, so that ways repeat across tiles.

    Ways are numbered as in :func:`table_of_convolution`; places row by row.
    """
    n_rows, n_columns = ((n * tile - kernel) // stride + 1 for n in (rows, columns))
    before, per_side = (kernel - 1) // stride, _ways_per_side(tile, kernel, stride)
    pairs = [
        (y * n_columns + x, row * columns + column, i * per_side + j)
        for row in range(rows)
        for column in range(columns)
        for i in range(per_side)
        for j in range(per_side)
        if 0 <= (y := row * tile // stride + i - before) < n_rows
        and 0 <= (x := column * tile // stride + j - before) < n_columns
    ]
    place, tiles, ways = np.array(sorted(pairs), dtype=np.int64).T.copy()
    first = np.searchsorted(place, np.arange(n_rows * n_columns + 1))
    return Places((n_rows, n_columns), first, tiles, ways)


def _ways_per_side(tile: int, kernel: int, stride: int) -> int:
    return (kernel - 1) // stride + (tile - 1) // stride + 1


def table_of_convolution(pictures: th.Tensor, weight: th.Tensor, stride: int) -> th.Tensor:
    """
    Return the contributions of single tiles to a convolution.

    :param pictures: (U, C, t, t) pixels of tiles
    :param weight: (W, C, kernel, kernel)
    :param stride: divides t
    :return: (U, S, W), without bias
    """
    kernel, tile = weight.shape[2], pictures.shape[2]
    before = (kernel - 1) // stride * stride
    after = (_ways_per_side(tile, kernel, stride) - 1) * stride + kernel - before - tile
    alone = th.nn.functional.pad(pictures, (before, after, before, after))
    return th.nn.functional.conv2d(alone, weight, stride=stride).flatten(2).transpose(1, 2)


def used_codes(views: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Find the codes that occur, and index the views by them.

    :param views: (K, T) codes of any type on the CPU
    :return: codes (U,) int64, increasing, and the index in them of each tile's code, (K, T) int64
    """
    array = (views.long() if views.is_floating_point() else views).numpy()
    seen = np.bincount(array.reshape(-1)) > 0
    return th.from_numpy(np.flatnonzero(seen)), th.from_numpy((seen.cumsum() - 1)[array])


def rectified_sums(views: th.Tensor, table: th.Tensor, bias: th.Tensor, places: Places) -> th.Tensor:
    """
    Sum the tiles' contributions and the bias, and apply ReLU, in one pass over memory.

    :param views: (K, T) int64 on the CPU, indices of codes
    :param table: (U, S, W)
    :param bias: (W,)
    :return: (K, W) or (K, W, height, width), channels last in memory; twice differentiable in table and bias
    """
    return _Rectified.apply(table, bias, views, places)


class _Rectified(th.autograd.Function):
    """(U, S, W) table and (W,) bias -> (K, W, *size). Apart from the ReLU, :class:`_Back` is its transpose."""

    @staticmethod
    def forward(ctx: Any, table: th.Tensor, bias: th.Tensor, views: th.Tensor, places: Places) -> th.Tensor:
        sums = _gathered(table, bias, views, places, rectify=True)
        ctx.save_for_backward(sums)
        ctx.views, ctx.places, ctx.n_codes, ctx.n_ways = views, places, *table.shape[:2]
        return sums

    @staticmethod
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[Any, ...]:
        (sums,) = ctx.saved_tensors
        return *_Back.apply(gradients[0], sums, ctx.views, ctx.places, ctx.n_codes, ctx.n_ways), None, None


class _Back(th.autograd.Function):
    """(K, W, *size) -> (U, S, W) and (W,): sums over places above zero, for the table and the bias."""

    @staticmethod
    def forward(
        ctx: Any, gradient: th.Tensor, sums: th.Tensor, views: th.Tensor, places: Places, n_codes: int, n_ways: int
    ) -> tuple[th.Tensor, th.Tensor]:
        ctx.save_for_backward(sums)
        ctx.views, ctx.places = views, places
        table = gradient.new_zeros((n_codes, n_ways, gradient.shape[1]))
        bias = gradient.new_zeros(gradient.shape[1])
        arrays = (_flat(views), _flat(_places_last(gradient)), _flat(_places_last(sums)), _flat(table), _flat(bias))
        _scatter(*arrays, *places[1:], views.shape[1], n_ways)
        return table, bias

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[Any, ...]:
        (sums,) = ctx.saved_tensors
        table, bias = gradients
        back = _gathered(table, bias, ctx.views, ctx.places, rectify=False) * (sums > 0)
        return back, None, None, None, None, None


def _gathered(table: th.Tensor, bias: th.Tensor, views: th.Tensor, places: Places, rectify: bool) -> th.Tensor:
    # Not a permuted view: writing into a view in place makes autograd copy.
    sums = table.new_empty((len(views), table.shape[2], *places.size))
    if places.size:
        sums = th.empty_like(sums, memory_format=th.channels_last)
    arrays = (_flat(views), _flat(table), _flat(bias), _flat(_places_last(sums)))
    _gather(*arrays, *places[1:], views.shape[1], table.shape[1], rectify)
    return sums


def _places_last(sums: th.Tensor) -> th.Tensor:
    """Return (K, W, *size) with W moved to the end, its position in memory."""
    return sums.movedim(1, -1)


def _flat(tensor: th.Tensor) -> npt.NDArray[Any]:
    return tensor.detach().contiguous().numpy().reshape(-1)


# --- kernels ----------------------------------------------------------------------------------------------------------
# Arrays are flat and indices unsigned: numba then omits the check for negative indices, and loops are vectorised.


@cached()
def _gather(
    views: Ints,
    table: Floats,
    bias: Floats,
    sums: Floats,
    first: Ints,
    tile: Ints,
    way: Ints,
    n_tiles: int,
    n_ways: int,
    rectify: bool,
) -> None:
    """Write every place's sum, two tiles at a time."""
    u = np.uint64
    width = len(bias)
    size, to = u(width), u(0)
    # Arrays, since a literal zero would have double precision.
    lowest = np.full_like(bias, 0 if rectify else -np.inf)
    for view in range(views.size // n_tiles):
        base = u(view) * u(n_tiles)
        for place in range(first.size - 1):
            j, end = u(first[u(place)]), u(first[u(place) + u(1)])
            a = (u(views[base + u(tile[j])]) * u(n_ways) + u(way[j])) * size
            if (end - j) & u(1):
                for w in range(width):
                    sums[to + u(w)] = table[a + u(w)]
                j += u(1)
            else:
                b = (u(views[base + u(tile[j + u(1)])]) * u(n_ways) + u(way[j + u(1)])) * size
                for w in range(width):
                    sums[to + u(w)] = table[a + u(w)] + table[b + u(w)]
                j += u(2)
            while j < end:
                a = (u(views[base + u(tile[j])]) * u(n_ways) + u(way[j])) * size
                b = (u(views[base + u(tile[j + u(1)])]) * u(n_ways) + u(way[j + u(1)])) * size
                for w in range(width):
                    sums[to + u(w)] += table[a + u(w)] + table[b + u(w)]
                j += u(2)
            for w in range(width):
                whole = sums[to + u(w)] + bias[u(w)]
                sums[to + u(w)] = lowest[u(w)] if whole < lowest[u(w)] else whole
            to += size


@cached()
def _scatter(
    views: Ints,
    gradient: Floats,
    sums: Floats,
    table: Floats,
    bias: Floats,
    first: Ints,
    tile: Ints,
    way: Ints,
    n_tiles: int,
    n_ways: int,
) -> None:
    """Add the gradient of every place above zero to its rows of the table, and to the bias."""
    u = np.uint64
    width = len(bias)
    size, source = u(width), u(0)
    zero, passed, of_view = np.zeros_like(bias), np.zeros_like(bias), np.zeros_like(bias)
    for view in range(views.size // n_tiles):
        base = u(view) * u(n_tiles)
        of_view[:] = 0
        for place in range(first.size - 1):
            for w in range(width):
                passed[u(w)] = zero[u(w)] if sums[source + u(w)] <= zero[u(w)] else gradient[source + u(w)]
                of_view[u(w)] += passed[u(w)]
            for j in range(first[u(place)], first[u(place) + u(1)]):
                to = (u(views[base + u(tile[u(j)])]) * u(n_ways) + u(way[u(j)])) * size
                for w in range(width):
                    table[to + u(w)] += passed[u(w)]
            source += size
        for w in range(width):
            bias[u(w)] += of_view[u(w)]
