"""
Encoders: features extractors for one agent's own observation. Letters: K views, C channels, H x W pixels, t pixels
per tile.

Each takes raw observations (uint8 pictures, tile codes, indices) as well as what SB3 makes of them before it calls a
features extractor (floats in [0, 1], one-hot vectors), so each also serves plain SB3 policies. A *tile-code space* is
any Box of whole numbers with an attribute ``atlas`` (n_codes, t, t, C) that holds the pixels of every code; its codes
become pixels on the training device. Encoders of tiles and of the same pictures have the same weights and give the
same features; on the CPU, those whose first layer allows it look up what tiles add to it instead of making pixels
(``sb3_saf.networks.tile_sums``).
"""

from __future__ import annotations

import warnings
from typing import Any, Final, Literal

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space, preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from torch import nn

from sb3_saf.networks.layers import HIDDEN_GAIN, Linear, mlp
from sb3_saf.networks.tile_sums import (
    Places,
    places_of_convolution,
    places_of_linear,
    rectified_sums,
    table_of_convolution,
    used_codes,
)

#: The least side of a picture from which NatureCNN's convolutions leave something.
NATURE_PIXELS: Final = 36
#: Up to this many pixels the paper's encoder is the default; from there on it grows beyond 7 million weights.
_PAPERS_PIXELS: Final = 64 * 64
#: More pixels, or more weights, than anybody wants to train on without being asked.
_MANY_PIXELS: Final = 128 * 128
_MANY_WEIGHTS: Final = 10_000_000
#: A one-hot code is as long as the pixels of a tile, roughly.
_ONE_HOT_SCALE: Final = 2.0


def is_tile_space(space: spaces.Space[Any]) -> bool:
    """Whether the observations of a space are tile codes (see the module's docstring)."""
    return isinstance(space, spaces.Box) and hasattr(space, "atlas")


class PixelInput(nn.Module):
    """
    Pictures of any layout, or tile codes, as float pictures in [0, 1].

    The result is a channels-first tensor whose memory is channels-last, which is what convolutions are fastest on.

    :param observation_space: a Box of shape (C, H, W) or (H, W, C), or a tile-code space of shape (rows, columns)
    """

    atlas: th.Tensor

    def __init__(self, observation_space: spaces.Space[Any]):
        super().__init__()
        self.layout: Literal["codes", "channels_first", "channels_last"]
        if is_tile_space(observation_space):
            self.layout = "codes"
            atlas = _checked_atlas(observation_space)
            # Not part of the state dict: what codes look like belongs to the space, and weights fit pictures as well.
            self.register_buffer("atlas", atlas.float() / 255.0, persistent=False)
            _, tile, _, channels = atlas.shape
            rows, columns = observation_space.shape or ()
            self.shape = (channels, rows * tile, columns * tile)
            return
        if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 3:
            raise ValueError(
                f"expected pictures, a Box of three axes, or tile codes with an atlas, got {observation_space}; "
                "use MLPEncoder or a features_extractor_class of your own"
            )
        height, width, channels = shape = observation_space.shape
        self.layout = "channels_last"
        if int(np.argmin(shape)) == 0:  # as SB3 tells the two layouts apart
            self.layout = "channels_first"
            channels, height, width = shape
        self.shape = (channels, height, width)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        Make pictures.

        :param observations: (K, C, H, W), (K, H, W, C) or codes (K, rows, columns); whole numbers are taken for 0..255
        :return: (K, C, H, W) float
        """
        if self.layout == "codes":
            tiles = self.atlas[observations.long()]  # (K, rows, columns, t, t, C)
            pictures = tiles.transpose(2, 3).reshape(-1, *self.shape[1:], self.shape[0])
            return pictures.permute(0, 3, 1, 2)
        pictures = observations if observations.is_floating_point() else observations.float() / 255.0
        if self.layout == "channels_last":
            pictures = pictures.permute(0, 3, 1, 2)
        return pictures.contiguous(memory_format=th.channels_last)

    def looks_up(self, observations: th.Tensor) -> bool:
        """Whether a first layer may look up what tiles add to it: codes on the CPU. Elsewhere products are cheaper."""
        return self.layout == "codes" and observations.device.type == "cpu"

    def tiles(self, codes: th.Tensor) -> th.Tensor:
        """(U, C, t, t) pictures of single tiles: (U,) codes."""
        return self.atlas[codes].permute(0, 3, 1, 2)


def _checked_atlas(space: Any) -> th.Tensor:
    """(n_codes, t, t, C) uint8 pixels of every code."""
    atlas = np.asarray(space.atlas)
    square = atlas.ndim == 4 and atlas.shape[1] == atlas.shape[2]
    if not square or atlas.dtype != np.uint8 or len(space.shape) != 2 or int(space.high.max()) >= len(atlas):
        raise ValueError(
            "expected tile codes of shape (rows, columns) with an atlas (n_codes, tile, tile, channels) of uint8 that "
            f"has every code, got {space} with an atlas of shape {atlas.shape} and dtype {atlas.dtype}"
        )
    return th.tensor(atlas)


class _FlattenPictures(nn.Flatten):
    """Flattens channels-last memory; the gradient comes back in that order, too, or the layer before is slow."""

    def forward(self, pictures: th.Tensor) -> th.Tensor:
        """(K, C, H, W) to (K, C * H * W)."""
        if pictures.requires_grad:
            pictures.register_hook(_channels_last)
        return super().forward(pictures)


def _channels_last(gradient: th.Tensor) -> th.Tensor:
    return gradient.contiguous(memory_format=th.channels_last)


class PaperCNN(BaseFeaturesExtractor):
    """
    The paper's encoder: convolutions 4x4/2 -> 32 and 3x3/2 -> 64, linear 512, linear ``features_dim``, ReLU between.

    A 28 x 28 x 3 view gives 2,304 numbers after the convolutions, and the encoder has 1,233,056 parameters.

    :param observation_space: pictures (either layout) or tile codes
    :param features_dim: size of the features
    """

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 64):
        super().__init__(observation_space, features_dim)
        self.pixels = PixelInput(observation_space)
        channels, height, width = self.pixels.shape
        out_height, out_width = _after_convolutions(height), _after_convolutions(width)
        if min(out_height, out_width) < 1:
            raise ValueError(
                f"PaperCNN needs pictures of at least 8 x 8 pixels, got {height} x {width}; use "
                "features_extractor_class=sb3_saf.MLPEncoder or sb3_saf.LightEncoder, or larger pictures"
            )
        self.net = nn.Sequential(
            nn.Conv2d(channels, 32, kernel_size=4, stride=2),
            nn.ReLU(inplace=True),
            nn.Conv2d(32, 64, kernel_size=3, stride=2),
            nn.ReLU(inplace=True),
            _FlattenPictures(),
            Linear(64 * out_height * out_width, 512, gain=HIDDEN_GAIN),
            nn.ReLU(inplace=True),
            Linear(512, features_dim, gain=HIDDEN_GAIN),
        )
        self._places: Places | None = None
        if self.pixels.layout == "codes" and (tile := self.pixels.atlas.shape[1]) % 2 == 0:
            self._places = places_of_convolution(height // tile, width // tile, tile, kernel=4, stride=2)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(K, *shape) views to (K, features_dim)."""
        if self._places is None or not self.pixels.looks_up(observations):
            features: th.Tensor = self.net(self.pixels(observations))
            return features
        looked_up: th.Tensor = self.net[2:](self._first_layer(observations, self._places))
        return looked_up

    def _first_layer(self, codes: th.Tensor, places: Places) -> th.Tensor:
        """(K, 32, h, w) outputs of the first convolution and its ReLU: (K, rows, columns)."""
        first = self.net[0]
        assert isinstance(first, nn.Conv2d) and first.bias is not None
        used = used_codes(codes.flatten(1))
        table = table_of_convolution(self.pixels.tiles(used.codes), first.weight, stride=2)
        return rectified_sums(used.views, table, first.bias, places)


def _after_convolutions(size: int) -> int:
    return ((size - 4) // 2 + 1 - 3) // 2 + 1 if size >= 4 else 0


class NatureEncoder(BaseFeaturesExtractor):
    """
    The encoder for larger pictures: SB3's ``NatureCNN`` (convolutions 8x8/4 -> 32, 4x4/2 -> 64, 3x3/1 -> 64, linear
    ``features_dim``, ReLU after each).

    Its steps are larger than the paper's and nothing wide follows them: at 84 x 84 x 3 it has 0.3 million weights where
    ``PaperCNN`` has 13 million, and is six times faster; at 280 x 480 it has 7 million instead of 269 million.

    :param observation_space: pictures (either layout) or tile codes, 36 x 36 pixels or more
    :param features_dim: size of the features
    """

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 64):
        super().__init__(observation_space, features_dim)
        self.pixels = PixelInput(observation_space)
        _, height, width = self.pixels.shape
        if min(height, width) < NATURE_PIXELS:
            raise ValueError(
                f"NatureEncoder needs pictures of at least {NATURE_PIXELS} x {NATURE_PIXELS} pixels, got {height} x "
                f"{width}; use features_extractor_class=sb3_saf.PaperCNN"
            )
        self.nature = NatureCNN(spaces.Box(0, 255, self.pixels.shape, np.uint8), features_dim)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(K, *shape) views to (K, features_dim)."""
        features: th.Tensor = self.nature(self.pixels(observations))
        return features


class LightEncoder(BaseFeaturesExtractor):
    """
    An encoder for small computers: one linear embedding for every tile, linear 128, ReLU, linear ``features_dim``.

    Tile codes are embedded once per code and looked up. In pictures, tiles are cut out first.

    Tiles that look nearly alike have nearly the same embedding, as if they were nearly the same thing. With zones that
    is in the way: an agent in orange means other actions than one in red. ``one_hot_codes`` tells them apart, but then
    what was learned of one tile helps less with its likes (measured: ``results/README.md``).

    :param observation_space: pictures (either layout) or tile codes
    :param features_dim: size of the features
    :param tile_size: t, pixels per tile of pictures; tile codes bring their own
    :param embedding_dim: size of a tile's embedding
    :param hidden: size of the hidden layer
    :param one_hot_codes: whether the embedding reads a tile's code beside its pixels. Needs tile codes, and the weights
        do not fit pictures
    :raises ValueError: for pictures that are not made of whole tiles, or with ``one_hot_codes``
    """

    tile_inputs: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        features_dim: int = 64,
        tile_size: int = 4,
        embedding_dim: int = 16,
        hidden: int = 128,
        one_hot_codes: bool = False,
    ):
        super().__init__(observation_space, features_dim)
        self.pixels = PixelInput(observation_space)
        self.tile_size = self.pixels.atlas.shape[1] if self.pixels.layout == "codes" else tile_size
        channels, height, width = self.pixels.shape
        if height % self.tile_size or width % self.tile_size:
            raise ValueError(
                f"LightEncoder needs pictures of whole tiles, got {height} x {width} pixels with "
                f"tile_size={tile_size}; "
                'pass features_extractor_kwargs={"tile_size": ...}'
            )
        n_tiles = height * width // self.tile_size**2
        n_inputs = self.tile_size**2 * channels
        if self.pixels.layout == "codes":
            self.register_buffer("tile_inputs", self._inputs_of_codes(one_hot_codes), persistent=False)
            n_inputs = self.tile_inputs.shape[1]
        elif one_hot_codes:
            raise ValueError(
                'one_hot_codes=True needs tile codes, as make_team_env(..., observation="tiles") gives them (a Box of '
                f"whole numbers with an atlas), got pictures {observation_space.shape}; leave it False"
            )
        self.embed = Linear(n_inputs, embedding_dim, gain=HIDDEN_GAIN)
        self.net = mlp([n_tiles * embedding_dim, hidden, features_dim], nn.ReLU, output_gain=HIDDEN_GAIN)
        self._places = places_of_linear(n_tiles)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(K, *shape) views to (K, features_dim)."""
        if self.pixels.looks_up(observations):
            looked_up: th.Tensor = self.net[2:](self._first_layer(observations))
            return looked_up
        if self.pixels.layout == "codes":
            by_code = self.embed(self.tile_inputs)
            tiles = nn.functional.embedding(observations.long().flatten(1), by_code)
        else:
            tiles = self.embed(self._cut(self.pixels(observations)))
        features: th.Tensor = self.net(tiles.flatten(1))
        return features

    def _first_layer(self, codes: th.Tensor) -> th.Tensor:
        """(K, hidden) outputs of the first linear layer and its ReLU: (K, rows, columns)."""
        first = self.net[0]
        assert isinstance(first, nn.Linear)
        used = used_codes(codes.flatten(1))
        embedded = self.embed(self.tile_inputs[used.codes])
        # Weights are (hidden, T * e): what a code adds at each of the T places, (U, T, hidden).
        by_tile = first.weight.unflatten(1, (-1, embedded.shape[1])).permute(2, 1, 0)
        table = (embedded @ by_tile.flatten(1)).unflatten(1, by_tile.shape[1:])
        return rectified_sums(used.views, table, first.bias, self._places)

    def _inputs_of_codes(self, one_hot: bool) -> th.Tensor:
        """(n_codes, inputs) what the embedding reads of every tile."""
        pixels = self.pixels.atlas.flatten(1)
        return th.cat([pixels, _ONE_HOT_SCALE * th.eye(len(pixels))], dim=1) if one_hot else pixels

    def _cut(self, pictures: th.Tensor) -> th.Tensor:
        """(K, tiles, t * t * C) pixels of each tile, in the order of an atlas: (K, C, H, W)."""
        channels, height, width = self.pixels.shape
        t = self.tile_size
        tiles = pictures.reshape(-1, channels, height // t, t, width // t, t).permute(0, 2, 4, 3, 5, 1)
        return tiles.reshape(len(pictures), -1, t * t * channels)


class MLPEncoder(BaseFeaturesExtractor):
    """
    An encoder for vectors: linear 128, tanh, linear ``features_dim``. Whole-number spaces are read as one-hot vectors.

    :param observation_space: Box (flattened), Discrete, MultiDiscrete or MultiBinary
    :param features_dim: size of the features
    :param hidden: size of the hidden layer
    """

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 64, hidden: int = 128):
        super().__init__(observation_space, features_dim)
        self.net = mlp(
            [get_flattened_obs_dim(observation_space), hidden, features_dim], nn.Tanh, output_gain=HIDDEN_GAIN
        )

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(K, *shape) observations, raw or made one-hot by SB3, to (K, features_dim)."""
        if not observations.is_floating_point():
            observations = _as_floats(observations, self._observation_space)
        features: th.Tensor = self.net(observations.flatten(1))
        return features


def _as_floats(observations: th.Tensor, space: spaces.Space[Any]) -> th.Tensor:
    result = preprocess_obs(observations, space, normalize_images=False)
    assert isinstance(result, th.Tensor)
    return result


class ObservationEncoder(BaseFeaturesExtractor):
    """
    The default encoder, chosen by space: for pictures (uint8, 0..255) and tile codes :class:`PaperCNN`, or
    :class:`NatureEncoder` if they have more than 64 x 64 pixels; for all else :class:`MLPEncoder`.

    Warns of pictures that make training slow whatever encodes them.

    :param observation_space: one agent's own observation space
    :param features_dim: size of the features
    """

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 64):
        super().__init__(observation_space, features_dim)
        self.encoder: BaseFeaturesExtractor = _encoder_class(observation_space)(observation_space, features_dim)
        if not isinstance(self.encoder, MLPEncoder):
            _warn_if_large(self.encoder, observation_space)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(K, *shape) observations to (K, features_dim)."""
        features: th.Tensor = self.encoder(observations)
        return features


def _encoder_class(space: spaces.Space[Any]) -> type[BaseFeaturesExtractor]:
    if not (is_tile_space(space) or is_image_space(space)):
        return MLPEncoder
    _, height, width = PixelInput(space).shape
    if height * width <= _PAPERS_PIXELS or min(height, width) < NATURE_PIXELS:
        return PaperCNN
    return NatureEncoder


def _warn_if_large(encoder: BaseFeaturesExtractor, space: spaces.Space[Any]) -> None:
    _, height, width = PixelInput(space).shape
    n_weights = sum(parameter.numel() for parameter in encoder.parameters())
    if height * width <= _MANY_PIXELS and n_weights <= _MANY_WEIGHTS:
        return
    warnings.warn(
        f"observations of {space} have {height} x {width} pixels, for which {type(encoder).__name__} has "
        f"{n_weights:,} weights and is slow. Shrink them in the environment (supersuit.resize_v1(env, 84, 84), "
        'supersuit.color_reduction_v0(env, "B")), or choose another encoder, policy_kwargs={"features_extractor_class":'
        ' ...}: sb3_saf.LightEncoder with features_extractor_kwargs={"tile_size": ...} for pictures made of tiles, or '
        "one of your own",
        UserWarning,
        stacklevel=3,
    )


__all__ = [
    "LightEncoder",
    "MLPEncoder",
    "NatureEncoder",
    "ObservationEncoder",
    "PaperCNN",
    "PixelInput",
    "is_tile_space",
]
