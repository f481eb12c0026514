"""Encoders: sizes, layouts, and tile codes that equal the images they encode."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from torch import nn

from sb3_saf import LightEncoder, MLPEncoder, NatureEncoder, ObservationEncoder, PaperCNN
from sb3_saf.networks.encoders import Part, PartsSpace, PixelInput
from tests.toy_teams import PICTURE, CodeSpace, samples

CHANNELS_LAST = spaces.Box(0, 255, (12, 12, 3), np.uint8)


def painted(codes: th.Tensor, atlas: np.ndarray) -> th.Tensor:
    """Draw (K, C, H, W) images of tile codes, cell by cell."""
    n_views, rows, columns = codes.shape
    size = atlas.shape[1]
    pictures = np.zeros((n_views, 3, rows * size, columns * size), dtype=np.uint8)
    for view, row, column in np.ndindex(n_views, rows, columns):
        tile = atlas[codes[view, row, column]]
        cell = np.s_[view, :, row * size : (row + 1) * size, column * size : (column + 1) * size]
        pictures[cell] = tile.transpose(2, 0, 1)
    return th.tensor(pictures)


@pytest.fixture
def codes() -> th.Tensor:
    return th.tensor(samples(CodeSpace(), 30))


def test_paper_cnn_has_the_papers_size() -> None:
    encoder = PaperCNN(spaces.Box(0, 255, (3, 28, 28), np.uint8))
    assert sum(parameter.numel() for parameter in encoder.parameters()) == 1_233_056
    assert encoder.net[5].in_features == 2304
    assert encoder(th.zeros(2, 3, 28, 28, dtype=th.uint8)).shape == (2, 64)


def n_weights(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize(
    ("shape", "expected", "count"),
    [
        ((3, 64, 64), PaperCNN, 7_426_208),
        ((3, 65, 64), NatureEncoder, 178_400),
        ((84, 84, 3), NatureEncoder, 276_704),
        ((3, 30, 160), PaperCNN, 8_999_072),
    ],
)
def test_larger_pictures_get_the_smaller_encoder(shape: tuple[int, ...], expected: type, count: int) -> None:
    space = spaces.Box(0, 255, shape, np.uint8)
    encoder = ObservationEncoder(space)
    assert type(encoder.encoder) is expected
    assert n_weights(encoder) == count
    assert encoder(th.tensor(samples(space, 2))).shape == (2, 64)


def test_nature_encoder_is_sb3s_on_either_layout() -> None:
    first, last = (spaces.Box(0, 255, shape, np.uint8) for shape in ((3, 44, 52), (44, 52, 3)))
    of_first, of_last, stock = NatureEncoder(first), NatureEncoder(last), NatureCNN(first, 64)
    of_last.load_state_dict(of_first.state_dict())
    stock.load_state_dict(of_first.nature.state_dict())
    pictures = th.tensor(samples(first, 3))
    th.testing.assert_close(of_first(pictures), stock(pictures.float() / 255.0), rtol=0, atol=1e-6)
    th.testing.assert_close(of_last(pictures.permute(0, 2, 3, 1)), of_first(pictures), rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match=r"NatureEncoder needs pictures of at least 36 x 36 pixels, got 35 x 50; use"):
        NatureEncoder(spaces.Box(0, 255, (3, 35, 50), np.uint8))


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ((280, 480, 3), "280 x 480 pixels, for which NatureEncoder has 7,547,104 weights"),
        ((3, 30, 400), r"have 30 x 400 pixels, for which PaperCNN has 22,\d+,\d+ weights"),
    ],
)
def test_huge_pictures_are_warned_of_with_what_to_do(shape: tuple[int, ...], words: str) -> None:
    with pytest.warns(UserWarning, match=rf"{words} .*supersuit.resize_v1.*features_extractor_class.*LightEncoder"):
        ObservationEncoder(spaces.Box(0, 255, shape, np.uint8))


@pytest.mark.parametrize("shape", [(3, 7, 7), (3, 28, 7), (5, 5, 3)])
def test_too_small_pictures_are_refused(shape: tuple[int, ...]) -> None:
    space = spaces.Box(0, 255, shape, np.uint8)
    with pytest.raises(ValueError, match=r"PaperCNN needs pictures of at least 8 x 8 pixels, got \d+ x \d+; use"):
        ObservationEncoder(space)


@pytest.mark.parametrize(
    "make_encoder",
    [PaperCNN, lambda space: LightEncoder(space, one_hot_codes=False), ObservationEncoder],
    ids=["PaperCNN", "LightEncoder", "ObservationEncoder"],
)
def test_tiles_and_pictures_have_the_same_weights_and_features(
    make_encoder: Callable[[spaces.Space[Any]], BaseFeaturesExtractor], codes: th.Tensor
) -> None:
    of_tiles, of_pictures = make_encoder(CodeSpace()), make_encoder(PICTURE)
    of_last = make_encoder(CHANNELS_LAST)
    of_pictures.load_state_dict(of_tiles.state_dict())
    of_last.load_state_dict(of_tiles.state_dict())
    pictures = painted(codes, CodeSpace().atlas)
    expected = of_tiles(codes)
    th.testing.assert_close(of_pictures(pictures), expected, rtol=0, atol=1e-6)
    th.testing.assert_close(of_last(pictures.permute(0, 2, 3, 1)), expected, rtol=0, atol=1e-6)


def test_light_encoder_embeds_each_tile_by_one_shared_layer() -> None:
    encoder = LightEncoder(PICTURE)
    assert sum(parameter.numel() for parameter in encoder.parameters()) == (48 * 16 + 16) + (144 * 128 + 128) + (
        128 * 64 + 64
    )
    assert LightEncoder(PICTURE, tile_size=6).embed.in_features == 108
    assert LightEncoder(CodeSpace(), tile_size=6).tile_size == 4
    with pytest.raises(ValueError, match=r"one_hot_codes=True needs tile codes, .* got pictures \(3, 12, 12\); leave"):
        LightEncoder(PICTURE, one_hot_codes=True)
    with pytest.raises(ValueError, match=r"whole tiles, got 12 x 12 pixels with tile_size=5; pass features_extractor"):
        LightEncoder(PICTURE, tile_size=5)


def test_one_hot_codes_tell_tiles_apart_that_look_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    space = CodeSpace()
    space.atlas = space.atlas.copy()
    space.atlas[1] = space.atlas[2]
    views = th.zeros(2, *space.shape, dtype=th.uint8)
    views[0, 0, 0], views[1, 0, 0] = 1, 2
    plain, one_hot = LightEncoder(space, one_hot_codes=False), LightEncoder(space)
    assert th.equal(*plain(views))
    first, second = looked_up = one_hot(views)
    assert (first - second).abs().max() > 0.01
    monkeypatch.setattr(PixelInput, "looks_up", lambda *_: False)
    th.testing.assert_close(one_hot(views), looked_up, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    "space",
    [
        PICTURE,
        CHANNELS_LAST,
        CodeSpace(),
        spaces.Box(-1, 1, (2, 3), np.float32),
        spaces.Box(0, 9, (4,), np.int64),
        spaces.Discrete(5),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary(4),
        spaces.Box(0, 255, (20, 16), np.uint8),
        spaces.Box(0, 255, (3,), np.uint8),
    ],
)
def test_raw_observations_and_what_sb3_makes_of_them_give_the_same(space: spaces.Space[Any]) -> None:
    encoder = ObservationEncoder(space)
    raw = th.tensor(samples(space, 6))
    prepared = preprocess_obs(raw, space)
    assert isinstance(prepared, th.Tensor) and prepared.is_floating_point()
    assert encoder(raw).shape == (6, 64)
    assert th.equal(encoder(raw), encoder(prepared))


def test_vectors_go_through_a_small_tanh_network() -> None:
    encoder = MLPEncoder(spaces.Discrete(3), features_dim=2, hidden=4)
    first, _, last = encoder.net
    assert isinstance(first, nn.Linear) and isinstance(last, nn.Linear)
    one_hot = th.eye(3)
    expected = th.tanh(one_hot @ first.weight.t() + first.bias) @ last.weight.t() + last.bias
    th.testing.assert_close(encoder(th.tensor([0, 1, 2])), expected)


SHARES = partial(spaces.Box, 0.0, 1.0, dtype=np.float32)


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (PICTURE, PaperCNN),
        (spaces.Box(0, 255, (84, 84), np.uint8), NatureEncoder),
        (spaces.Box(0, 255, (40, 40, 3), np.float32), PaperCNN),
        (SHARES((4, 84, 84)), NatureEncoder),
        (SHARES((16, 20)), PaperCNN),
        (SHARES((10, 8)), MLPEncoder),  # rather ten things with eight properties
        (spaces.Box(0, 255, (7, 7), np.uint8), MLPEncoder),
        (spaces.Box(0, 30, (20, 20, 3), np.float32), MLPEncoder),
        (spaces.Box(0, 255, (9,), np.uint8), MLPEncoder),
    ],
)
def test_default_encoder_is_chosen_by_space(space: spaces.Space[Any], expected: type) -> None:
    encoder = ObservationEncoder(space)
    assert type(encoder.encoder) is expected
    assert encoder(th.tensor(samples(space, 2))).shape == (2, 64)


def outputs(encoder: BaseFeaturesExtractor, observations: np.ndarray, space: spaces.Space[Any]) -> th.Tensor:
    """Return the features of observations as policies have them."""
    prepared = preprocess_obs(th.as_tensor(observations), space)
    assert isinstance(prepared, th.Tensor)
    return encoder(prepared)


@pytest.mark.parametrize(
    ("space", "of_bytes"),
    [
        (spaces.Box(0, 255, (20, 16), np.uint8), lambda x: x[:, 0]),
        (spaces.Box(0, 255, (20, 16), np.float32), lambda x: x[:, 0].astype(np.float32)),
        (SHARES((20, 16)), lambda x: x[:, 0].astype(np.float32) / 255),
        (SHARES((1, 20, 16)), lambda x: x.astype(np.float32) / 255),
        (spaces.Box(0, 255, (20, 16, 1), np.float64), lambda x: x.transpose(0, 2, 3, 1).astype(np.float64)),
    ],
)
def test_pictures_of_every_form_are_scaled_alike(
    space: spaces.Space[Any], of_bytes: Callable[[np.ndarray], np.ndarray]
) -> None:
    plain = spaces.Box(0, 255, (1, 20, 16), np.uint8)
    encoder, expected = ObservationEncoder(space), ObservationEncoder(plain)
    encoder.load_state_dict(expected.state_dict())
    pictures = samples(plain, 5)
    th.testing.assert_close(
        outputs(encoder, of_bytes(pictures), space), outputs(expected, pictures, plain), rtol=0, atol=1e-5
    )


def test_wide_integers_are_scaled() -> None:
    low, high = np.array([0, -500, 0, 0]), np.array([255, 100_000, 16, 2**40])
    wide, vector = spaces.Box(low, high, dtype=np.int64), spaces.Box(-1, 1, (4,), np.float32)
    encoder, expected = ObservationEncoder(wide), ObservationEncoder(vector)
    encoder.load_state_dict(expected.state_dict())
    x = np.array([[51, -250, 3, 7], [255, 100_000, 16, 0]])
    scaled = (x / [255, 100_000, 1, 1]).astype(np.float32)
    th.testing.assert_close(outputs(encoder, x, wide), expected(th.tensor(scaled)), rtol=0, atol=1e-6)
    narrow = ObservationEncoder(spaces.Box(0, 9, (4,), np.int64))
    narrow.load_state_dict(expected.state_dict())
    assert th.equal(narrow(th.tensor(x)), expected(th.tensor(x).float()))


@pytest.mark.parametrize(
    ("encoder", "shape"),
    [
        (PaperCNN, (11, 10, 3)),
        (NatureEncoder, (67, 40, 1)),
        (ObservationEncoder, (12, 12, 15)),  # five frames of 12 x 12, not 12 of 12 x 15
    ],
)
def test_every_pixel_is_read(encoder: type[BaseFeaturesExtractor], shape: tuple[int, ...]) -> None:
    th.manual_seed(0)
    pictures = th.rand(16, *shape, requires_grad=True)
    reader = encoder(spaces.Box(0, 255, shape, np.uint8))
    reader(pictures).square().sum().backward()
    assert pictures.grad is not None and bool((pictures.grad.abs().sum(0) > 0).all())
    assert next(layer for layer in reader.modules() if isinstance(layer, nn.Conv2d)).in_channels == shape[2]


@pytest.mark.parametrize(("high", "dtype"), [(255, np.float32), (255, np.int64), (1000, np.int32)])
def test_pictures_for_a_named_encoder_are_scaled(high: int, dtype: Any) -> None:
    pixels = PaperCNN(spaces.Box(0, high, (12, 12, 3), dtype)).pixels
    assert pixels(th.full((1, 12, 12, 3), float(high))).max() == 1


def test_bytes_beside_a_picture_are_scaled() -> None:
    bounds = np.zeros(50), np.array([255] * 48 + [255, 1])
    space = PartsSpace(spaces.Box(*bounds, dtype=np.float64), (Part(0, 48, spaces.Box(0, 255, (4, 4, 3), np.uint8)),))
    encoder: Any = ObservationEncoder(space)
    assert encoder.encoder.rest.divisor.tolist() == [255, 1]


def test_bad_spaces_are_refused() -> None:
    small = CodeSpace()
    small.atlas = small.atlas[:10]
    with pytest.raises(ValueError, match=r"an atlas \(n_codes, tile, tile, channels\).*has every code, got"):
        PaperCNN(small)
    with pytest.raises(ValueError, match=r"expected pictures, .* or tile codes with an atlas, got Discrete"):
        PaperCNN(spaces.Discrete(3))
