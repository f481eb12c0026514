"""Unique rows are found exactly, and observations are encoded once each with unchanged results."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st

from sb3_saf.networks import row_encoder
from sb3_saf.networks.row_encoder import RowEncoder, UniqueRows, unique_rows


def reference(x: th.Tensor) -> tuple[list[int], list[int]]:
    """Find unique rows with a dict of their bytes."""
    seen: dict[bytes, int] = {}
    index: list[int] = []
    inverse: list[int] = []
    for row, value in enumerate(x):
        key = value.contiguous().view(-1).view(th.uint8).numpy().tobytes()
        if key not in seen:
            seen[key] = len(index)
            index.append(row)
        inverse.append(seen[key])
    return index, inverse


def assert_matches_reference(x: th.Tensor, found: UniqueRows) -> None:
    index, inverse = reference(x)
    assert found.index.tolist() == index
    assert found.inverse.tolist() == inverse
    assert found.index.dtype == found.inverse.dtype == th.int64


DTYPES = [th.uint8, th.int64, th.float32, th.float64, th.bool, th.bfloat16]


@given(
    n_rows=st.integers(1, 60),
    shape=st.sampled_from([(), (1,), (3,), (7, 7), (2, 4), (33,)]),
    dtype=st.sampled_from(DTYPES),
    n_values=st.integers(1, 30),
    seed=st.integers(0, 2**31),
)
def test_agrees_with_a_dict_of_bytes(
    n_rows: int, shape: tuple[int, ...], dtype: th.dtype, n_values: int, seed: int
) -> None:
    generator = th.Generator().manual_seed(seed)
    pool = th.randint(0, 100, (n_values, *shape), generator=generator).to(dtype)
    x = pool[th.randint(n_values, (n_rows,), generator=generator)]
    assert_matches_reference(x, unique_rows(x))


def test_edges() -> None:
    assert [part.tolist() for part in unique_rows(th.zeros(0, 3))] == [[], []]
    assert [part.tolist() for part in unique_rows(th.zeros(2, 0))] == [[0], [0, 0]]
    assert unique_rows(th.tensor([[0.0], [-0.0], [0.0]])).inverse.tolist() == [0, 1, 0]
    assert unique_rows(th.tensor([[float("nan")], [float("nan")]])).inverse.tolist() == [0, 0]
    transposed = th.arange(12).view(3, 4).t() // 6
    assert_matches_reference(transposed, unique_rows(transposed))
    unaligned = th.randint(0, 2, (67,), dtype=th.uint8)[3:].view(8, 8)
    assert_matches_reference(unaligned, unique_rows(unaligned))


def test_exact_although_every_hash_collides(monkeypatch: pytest.MonkeyPatch) -> None:
    x = th.randint(0, 4, (60, 2))
    monkeypatch.setattr(row_encoder, "_hash_row", lambda words, row: np.uint64(7))
    monkeypatch.setattr(row_encoder, "_find_unique", row_encoder._find_unique.py_func)
    assert_matches_reference(x, unique_rows(x))


@pytest.mark.parametrize(("once", "device"), [(False, "cpu"), (True, "meta")])
def test_without_a_search_every_row_is_encoded(once: bool, device: str) -> None:
    seen: list[th.Tensor] = []

    def encode(observations: th.Tensor) -> th.Tensor:
        seen.append(observations)
        return observations.flatten(1)

    x = th.zeros(3, 2, device=device)
    encoder = RowEncoder(encode, once)
    assert encoder.rows(x).of_rows().shape == (3, 2) and seen[0] is x
    assert [len(part) for part in encoder.find(x)] == [3, 3]
