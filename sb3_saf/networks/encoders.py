"""
Encoders: networks for one agent's own observation. Letters: K observations, C channels, H x W pixels, t pixels
per tile, d features.

Each takes raw observations (uint8 pictures, tile codes, indices) as well as results of :func:`preprocess` (floats in
[0, 1], one-hot vectors). *Tile codes* are integers with an atlas (n_codes, t, t, C) of the pixels of every code; they
become pixels on the device of the network. Encoders of tile codes and of the same pictures have the same weights and
features. Policies use them through ``sb3_saf.policies.extractors``, exported actors directly.
"""

from __future__ import annotations

from math import prod
from typing import Final, Literal

import numpy as np
import torch as th
from torch import nn

from sb3_saf.networks.layers import HIDDEN_GAIN, Linear, mlp
from sb3_saf.networks.spaces import AnySpace, ObservationSpec, SpaceSpec, observation_spec

#: Smallest side of a picture for NatureCNN's convolutions.
NATURE_PIXELS: Final = 36
#: Value of one-hot codes, so that their norm is close to that of a tile's pixels.
_ONE_HOT_SCALE: Final = 2.0


def preprocess(observations: th.Tensor, space: SpaceSpec, normalize_images: bool = True) -> th.Tensor:
    """
    Convert raw observations to floats, as SB3 does before it calls a features extractor.

    :param observations: (K, *shape)
    :param space: space of one observation
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
        # Not super(): in SB3's extractors that inherit from this class, the next class needs arguments.
        nn.Module.__init__(self)


class PixelInput(nn.Module):
    """
    Convert pictures of any layout, or tile codes, to float pictures in [0, 1].

    The result is a channels-first tensor with channels-last memory, for which convolutions are fastest.

    :param observation: a Box of shape (C, H, W) or (H, W, C), or of tile codes (rows, columns)
    """

    atlas: th.Tensor

    def __init__(self, observation: ObservationSpec | AnySpace):
        super().__init__()
        space, atlas = observation_spec(observation)
        self.layout: Literal["codes", "channels_first", "channels_last"]
        if atlas is not None:
            self.layout = "codes"
            # Not part of the state dict: the atlas belongs to the space, and the weights also fit pictures. from_numpy,
            # because it holds data even if networks are made on the device "meta".
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
        Return pictures.

        :param observations: (K, C, H, W), (K, H, W, C) or codes (K, rows, columns); integers are in 0..255
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
        """Return pictures (U, C, t, t) of single tiles with codes (U,)."""
        return self.atlas[codes].permute(0, 3, 1, 2)


class _FlattenPictures(nn.Flatten):
    """Flatten pictures, and keep the gradient in channels-last memory, which makes the previous layer fast."""

    def forward(self, pictures: th.Tensor) -> th.Tensor:
        """Flatten (K, C, H, W) to (K, C * H * W)."""
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
        """Encode observations (K, *shape) as (K, features_dim)."""
        return self.net(self.pixels(observations))


def _after_convolutions(size: int) -> int:
    return ((size - 4) // 2 + 1 - 3) // 2 + 1 if size >= 4 else 0


class NatureEncoder(Encoder):
    """
    The encoder for larger pictures: SB3's ``NatureCNN`` (convolutions 8x8/4 -> 32, 4x4/2 -> 64, 3x3/1 -> 64, linear
    ``features_dim``, ReLU after each).

    Its strides are larger than the paper's and no wide layer follows: at 84 x 84 x 3 it has 0.3 million weights instead
    of ``PaperCNN``'s 13 million, and is six times faster; at 280 x 480 it has 7 million instead of 269 million.

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
        """Encode observations (K, *shape) as (K, features_dim)."""
        return self.nature(self.pixels(observations))


class _NatureCNN(nn.Module):
    """SB3's ``NatureCNN`` without SB3: the same parameter names and initial weights."""

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
        """Encode pictures (K, C, H, W) as (K, d)."""
        return self.linear(self.cnn(pictures))


class LightEncoder(Encoder):
    """
    Fast encoder for CPUs: a linear embedding of each tile, linear 128, ReLU, linear ``features_dim``.

    Tile codes are embedded once per code and looked up. Pictures are cut into tiles first.

    Tiles with similar pixels have similar embeddings. With zones that is a disadvantage: an orange agent's actions
    differ from a red one's. ``one_hot_codes`` separates them.

    :param observation: pictures (either layout) or tile codes
    :param features_dim: size of the features
    :param tile_size: t, pixels per tile of pictures; tile codes have their own
    :param embedding_dim: size of a tile's embedding
    :param hidden: size of the hidden layer
    :param one_hot_codes: whether the embedding reads a tile's code beside its pixels, which needs tile codes; the
        weights then do not fit pictures. None: True for tile codes
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
        """Encode observations (K, *shape) as (K, features_dim)."""
        if self.pixels.layout == "codes":
            by_code = self.embed(self.tile_inputs)
            tiles = nn.functional.embedding(observations.long().flatten(1), by_code)
        else:
            tiles = self.embed(self._cut(self.pixels(observations)))
        return self.net(tiles.flatten(1))

    def _inputs_of_codes(self, one_hot: bool) -> th.Tensor:
        """Return the embedding's inputs of every tile, (n_codes, inputs)."""
        pixels = self.pixels.atlas.flatten(1)
        return (
            th.cat([pixels, _ONE_HOT_SCALE * th.from_numpy(np.eye(len(pixels), dtype=np.float32))], dim=1)
            if one_hot
            else pixels
        )

    def _cut(self, pictures: th.Tensor) -> th.Tensor:
        """Cut pictures (K, C, H, W) into tiles (K, tiles, t * t * C), with pixels in the order of an atlas."""
        channels, height, width = self.pixels.shape
        t = self.tile_size
        tiles = pictures.reshape(-1, channels, height // t, t, width // t, t).permute(0, 2, 4, 3, 5, 1)
        return tiles.reshape(-1, self.n_tiles, t * t * channels)


class MLPEncoder(Encoder):
    """
    Encoder for vectors: linear 128, tanh, linear ``features_dim``. Integer spaces are read as one-hot vectors.

    :param observation: Box (flattened), Discrete, MultiDiscrete or MultiBinary
    :param features_dim: size of the features
    :param hidden: size of the hidden layer
    """

    def __init__(self, observation: ObservationSpec | AnySpace, features_dim: int = 64, hidden: int = 128):
        super().__init__()
        self.space = observation_spec(observation).space
        self.net = mlp([self.space.n_inputs, hidden, features_dim], nn.Tanh, output_gain=HIDDEN_GAIN)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Encode observations (K, *shape), raw or preprocessed, as (K, features_dim)."""
        if not observations.is_floating_point():
            observations = preprocess(observations, self.space, normalize_images=False)
        return self.net(observations.flatten(1))
