"""
Encoders: networks that read one agent's own observation. Letters: K observations, C channels, H x W pixels, t pixels
per tile, d features.

Each takes raw observations (uint8 pictures, tile codes, indices) as well as what :func:`preprocess` makes of them
(floats in [0, 1], one-hot vectors). *Tile codes* are whole numbers that come with an atlas (n_codes, t, t, C) of the
pixels of every code; they become pixels on the device of the network. Encoders of tiles and of the same pictures have
the same weights and give the same features. Policies use them through ``sb3_saf.policies.extractors``, exported actors
as they are.
"""

from __future__ import annotations

from math import prod
from typing import Final, Literal

import numpy as np
import torch as th
from torch import nn

from sb3_saf.networks.layers import HIDDEN_GAIN, Linear, mlp
from sb3_saf.networks.spaces import AnySpace, ObservationSpec, SpaceSpec, observation_spec

#: The least side of a picture from which NatureCNN's convolutions leave something.
NATURE_PIXELS: Final = 36
#: A one-hot code is as long as the pixels of a tile, roughly.
_ONE_HOT_SCALE: Final = 2.0


def preprocess(observations: th.Tensor, space: SpaceSpec, normalize_images: bool = True) -> th.Tensor:
    """
    Make floats of raw observations, as SB3 does before it calls a features extractor.

    :param observations: (K, *shape)
    :param space: of one observation
    :param normalize_images: whether pictures of bytes are scaled to [0, 1]
    :return: (K, *shape) float, or (K, n) one-hot vectors of Discrete and MultiDiscrete
    """
    if space.is_one_hot:
        columns = observations.reshape(-1, len(space.choices)).long()
        hot = [columns[:, i : i + 1] == th.arange(n, device=columns.device) for i, n in enumerate(space.choices)]
        return th.cat(hot, dim=1).float()
    floats = observations.float()
    return floats / 255.0 if space.picture and normalize_images else floats


class Encoder(nn.Module):
    """Base of all encoders."""

    def __init__(self) -> None:
        # Not super(): between this and SB3's extractors that inherit from it stands a class that needs arguments.
        nn.Module.__init__(self)


class PixelInput(nn.Module):
    """
    Pictures of any layout, or tile codes, as float pictures in [0, 1].

    The result is a channels-first tensor whose memory is channels-last, which is what convolutions are fastest on.

    :param observation: a Box of shape (C, H, W) or (H, W, C), or of tile codes (rows, columns)
    """

    atlas: th.Tensor

    def __init__(self, observation: ObservationSpec | AnySpace):
        super().__init__()
        space, atlas = observation_spec(observation)
        self.layout: Literal["codes", "channels_first", "channels_last"]
        if atlas is not None:
            self.layout = "codes"
            # Not part of the state dict: what codes look like belongs to the space, and weights fit pictures as well.
            # from_numpy, because it makes numbers even where networks are made without (on the device "meta").
            self.register_buffer("atlas", th.from_numpy(np.array(atlas)).float() / 255.0, persistent=False)
        elif space.kind != "box" or len(space.shape) != 3:
            raise ValueError(
                f"expected pictures, a Box of three axes, or tile codes with an atlas, got {space}; "
                "use MLPEncoder or a features_extractor_class of your own"
            )
        else:
            self.layout = "channels_first" if space.shape == space.picture_shape else "channels_last"
        self.shape = space.picture_shape

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

    def tiles(self, codes: th.Tensor) -> th.Tensor:
        """(U, C, t, t) pictures of single tiles: (U,) codes."""
        return self.atlas[codes].permute(0, 3, 1, 2)


class _FlattenPictures(nn.Flatten):
    """Flattens channels-last memory; the gradient comes back in that order, too, or the layer before is slow."""

    def forward(self, pictures: th.Tensor) -> th.Tensor:
        """(K, C, H, W) to (K, C * H * W)."""
        if pictures.requires_grad:
            pictures.register_hook(_channels_last)
        return super().forward(pictures)


def _channels_last(gradient: th.Tensor) -> th.Tensor:
    return gradient.contiguous(memory_format=th.channels_last)


class PaperCNN(Encoder):
    """
    The paper's encoder: convolutions 4x4/2 -> 32 and 3x3/2 -> 64, linear 512, linear ``features_dim``, ReLU between.

    A 28 x 28 x 3 view gives 2,304 numbers after the convolutions, and the encoder has 1,233,056 parameters.

    :param observation: pictures (either layout) or tile codes
    :param features_dim: size of the features
    """

    def __init__(self, observation: ObservationSpec | AnySpace, features_dim: int = 64):
        super().__init__()
        self.pixels = PixelInput(observation)
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

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(K, *shape) observations to (K, features_dim)."""
        features: th.Tensor = self.net(self.pixels(observations))
        return features


def _after_convolutions(size: int) -> int:
    return ((size - 4) // 2 + 1 - 3) // 2 + 1 if size >= 4 else 0


class NatureEncoder(Encoder):
    """
    The encoder for larger pictures: SB3's ``NatureCNN`` (convolutions 8x8/4 -> 32, 4x4/2 -> 64, 3x3/1 -> 64, linear
    ``features_dim``, ReLU after each).

    Its steps are larger than the paper's and nothing wide follows them: at 84 x 84 x 3 it has 0.3 million weights where
    ``PaperCNN`` has 13 million, and is six times faster; at 280 x 480 it has 7 million instead of 269 million.

    :param observation: pictures (either layout) or tile codes, 36 x 36 pixels or more
    :param features_dim: size of the features
    """

    def __init__(self, observation: ObservationSpec | AnySpace, features_dim: int = 64):
        super().__init__()
        self.pixels = PixelInput(observation)
        _, height, width = self.pixels.shape
        if min(height, width) < NATURE_PIXELS:
            raise ValueError(
                f"NatureEncoder needs pictures of at least {NATURE_PIXELS} x {NATURE_PIXELS} pixels, got {height} x "
                f"{width}; use features_extractor_class=sb3_saf.PaperCNN"
            )
        self.nature = _NatureCNN(self.pixels.shape, features_dim)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(K, *shape) observations to (K, features_dim)."""
        features: th.Tensor = self.nature(self.pixels(observations))
        return features


class _NatureCNN(nn.Module):
    """SB3's ``NatureCNN``, with the same names and the same first weights, without SB3."""

    def __init__(self, shape: tuple[int, int, int], features_dim: int):
        super().__init__()
        channels, height, width = shape
        out = [(((size - 8) // 4 + 1 - 4) // 2 + 1 - 3) + 1 for size in (height, width)]
        self.cnn = nn.Sequential(
            nn.Conv2d(channels, 32, kernel_size=8, stride=4),
            nn.ReLU(),
            nn.Conv2d(32, 64, kernel_size=4, stride=2),
            nn.ReLU(),
            nn.Conv2d(64, 64, kernel_size=3, stride=1),
            nn.ReLU(),
            nn.Flatten(),
        )
        self.linear = nn.Sequential(nn.Linear(64 * prod(out), features_dim), nn.ReLU())

    def forward(self, pictures: th.Tensor) -> th.Tensor:
        """(K, C, H, W) to (K, d)."""
        features: th.Tensor = self.linear(self.cnn(pictures))
        return features


class LightEncoder(Encoder):
    """
    An encoder for small computers: one linear embedding for every tile, linear 128, ReLU, linear ``features_dim``.

    Tile codes are embedded once per code and looked up. In pictures, tiles are cut out first.

    Tiles that look nearly alike have nearly the same embedding, as if they were nearly the same thing. With zones that
    is in the way: an agent in orange means other actions than one in red. ``one_hot_codes`` tells them apart (measured:
    ``results/README.md``).

    :param observation: pictures (either layout) or tile codes
    :param features_dim: size of the features
    :param tile_size: t, pixels per tile of pictures; tile codes bring their own
    :param embedding_dim: size of a tile's embedding
    :param hidden: size of the hidden layer
    :param one_hot_codes: whether the embedding reads a tile's code beside its pixels, which needs tile codes; the
        weights do not fit pictures then. None: where observations are tile codes
    :raises ValueError: for pictures that are not made of whole tiles, or with ``one_hot_codes=True``
    """

    tile_inputs: th.Tensor

    def __init__(
        self,
        observation: ObservationSpec | AnySpace,
        features_dim: int = 64,
        tile_size: int = 4,
        embedding_dim: int = 16,
        hidden: int = 128,
        one_hot_codes: bool | None = None,
    ):
        super().__init__()
        self.pixels = PixelInput(observation)
        self.one_hot_codes = self.pixels.layout == "codes" if one_hot_codes is None else one_hot_codes
        self.tile_size = self.pixels.atlas.shape[1] if self.pixels.layout == "codes" else tile_size
        channels, height, width = self.pixels.shape
        if height % self.tile_size or width % self.tile_size:
            raise ValueError(
                f"LightEncoder needs pictures of whole tiles, got {height} x {width} pixels with "
                f"tile_size={tile_size}; "
                'pass features_extractor_kwargs={"tile_size": ...}'
            )
        self.n_tiles = height * width // self.tile_size**2
        n_inputs = self.tile_size**2 * channels
        if self.pixels.layout == "codes":
            self.register_buffer("tile_inputs", self._inputs_of_codes(self.one_hot_codes), persistent=False)
            n_inputs = self.tile_inputs.shape[1]
        elif self.one_hot_codes:
            raise ValueError(
                'one_hot_codes=True needs tile codes, as make_team_env(..., observation="tiles") gives them (a Box of '
                f"whole numbers with an atlas), got pictures {self.pixels.shape}; leave it False"
            )
        self.embed = Linear(n_inputs, embedding_dim, gain=HIDDEN_GAIN)
        self.net = mlp([self.n_tiles * embedding_dim, hidden, features_dim], nn.ReLU, output_gain=HIDDEN_GAIN)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(K, *shape) observations to (K, features_dim)."""
        if self.pixels.layout == "codes":
            by_code = self.embed(self.tile_inputs)
            tiles = nn.functional.embedding(observations.long().flatten(1), by_code)
        else:
            tiles = self.embed(self._cut(self.pixels(observations)))
        features: th.Tensor = self.net(tiles.flatten(1))
        return features

    def _inputs_of_codes(self, one_hot: bool) -> th.Tensor:
        """(n_codes, inputs) what the embedding reads of every tile."""
        pixels = self.pixels.atlas.flatten(1)
        return (
            th.cat([pixels, _ONE_HOT_SCALE * th.from_numpy(np.eye(len(pixels), dtype=np.float32))], dim=1)
            if one_hot
            else pixels
        )

    def _cut(self, pictures: th.Tensor) -> th.Tensor:
        """(K, tiles, t * t * C) pixels of each tile, in the order of an atlas: (K, C, H, W)."""
        channels, height, width = self.pixels.shape
        t = self.tile_size
        tiles = pictures.reshape(-1, channels, height // t, t, width // t, t).permute(0, 2, 4, 3, 5, 1)
        return tiles.reshape(-1, self.n_tiles, t * t * channels)


class MLPEncoder(Encoder):
    """
    An encoder for vectors: linear 128, tanh, linear ``features_dim``. Whole-number spaces are read as one-hot vectors.

    :param observation: Box (flattened), Discrete, MultiDiscrete or MultiBinary
    :param features_dim: size of the features
    :param hidden: size of the hidden layer
    """

    def __init__(self, observation: ObservationSpec | AnySpace, features_dim: int = 64, hidden: int = 128):
        super().__init__()
        self.space = observation_spec(observation).space
        self.net = mlp([self.space.n_inputs, hidden, features_dim], nn.Tanh, output_gain=HIDDEN_GAIN)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """(K, *shape) observations, raw or preprocessed, to (K, features_dim)."""
        if not observations.is_floating_point():
            observations = preprocess(observations, self.space, normalize_images=False)
        features: th.Tensor = self.net(observations.flatten(1))
        return features
