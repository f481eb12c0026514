"""First layers by tile lookup equal the layers over pixels, including all gradients."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_saf import LightEncoder, PaperCNN, make_vec_env
from sb3_saf.networks.encoders import PixelInput
from sb3_saf.networks.tile_sums import (
    Places,
    places_of_convolution,
    places_of_linear,
    rectified_sums,
    used_codes,
)

N_CODES = 11


def _views(rows: int, columns: int, n_views: int = 5) -> th.Tensor:
    return th.from_numpy(np.random.default_rng(0).integers(0, N_CODES, (n_views, rows * columns)))


def _some_places() -> list[Places]:
    return [places_of_linear(6), places_of_convolution(2, 3, tile=4, kernel=4, stride=2)]


@pytest.mark.parametrize("places", _some_places(), ids=["linear", "convolution"])
def test_gradients_of_first_and_second_order(places: Places) -> None:
    views = used_codes(_views(2, 3, n_views=3)).views
    table = th.randn(int(views.max()) + 1, int(places.way.max()) + 1, 2, dtype=th.float64, requires_grad=True)
    bias = th.randn(2, dtype=th.float64, requires_grad=True)

    def square(table: th.Tensor, bias: th.Tensor) -> th.Tensor:
        """Square the output, because a linear function has no second derivative."""
        return rectified_sums(views, table, bias, places) ** 2

    assert (square(table, bias) == 0).any()
    assert th.autograd.gradcheck(square, (table, bias))
    assert th.autograd.gradgradcheck(square, (table, bias))


@pytest.mark.parametrize("encoder_class", [LightEncoder, PaperCNN])
@pytest.mark.parametrize("params", [{}, {"view_size": 5}, {"view_tile_size": 8}, {"view_tile_size": 5}], ids=str)
def test_encoders_by_looking_up_and_by_pixels(
    encoder_class: type[LightEncoder | PaperCNN], params: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    space = make_vec_env("KeyForTreasure", 1, seed=0, observation="tiles", **params).observation_space
    assert isinstance(space, spaces.Box)
    space.seed(1)
    codes = th.tensor(np.stack([space.sample() for _ in range(20)]))
    encoder = encoder_class(space)
    results = []
    for looks_up in (True, False):
        monkeypatch.setattr(PixelInput, "looks_up", lambda pixels, observations, answer=looks_up: answer)
        encoder.zero_grad()
        features = encoder(codes)
        features.square().sum().backward()
        results.append([features.detach(), *(weight.grad for weight in encoder.parameters())])
    for found, expected in zip(*results, strict=True):
        th.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
