"""
Encoders of one agent's own observation, as SB3 features extractors. Letters: K observations, C channels, H x W pixels,
t pixels per tile, d features.

Each takes raw observations (uint8 pictures, tile codes, indices) as well as results of SB3's ``preprocess_obs`` (floats
in [0, 1], one-hot vectors). *Tile codes* are integers with an atlas (n_codes, t, t, C) of the pixels of every code.
Encoders of tile codes and of the same pictures have the same weights and features. On the CPU, encoders of tile codes
look up the tiles' contributions to their first layer instead of making pixels (``sb3_saf.networks.tile_sums``): the
same features, up to the order of summation.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
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

#: Smallest side of a picture for the paper's encoder, and for NatureCNN's convolutions.
PAPER_PIXELS: Final = 8
NATURE_PIXELS: Final = 36
#: Smallest side of a picture that SB3 does not take for one: of two axes, or of floats.
_UNMARKED_PIXELS: Final = 16
#: Maximum pixels for which the paper's encoder is the default; beyond, it has more than 7 million weights.
_PAPERS_PIXELS: Final = 64 * 64
#: Numbers of pixels and weights above which a warning about slow training is issued.
_MANY_PIXELS: Final = 128 * 128
_MANY_WEIGHTS: Final = 10_000_000
#: MLPs scale integers whose largest value is above the first limit; from the second on, bounds say nothing.
_WIDE: Final = 16
_UNBOUNDED: Final = 2**31 - 1
#: Value of one-hot codes, so that their norm is close to that of a tile's pixels.
_ONE_HOT_SCALE: Final = 2.0


class Picture(NamedTuple):
    """
    Pictures of an observation space.

    :param shape: C, H, W
    :param layout: order of the axes; ``"plane"`` has height and width only, ``"codes"`` are tile codes
    :param divisor: scales observations to [0, 1] after SB3's preprocessing
    """

    shape: tuple[int, int, int]
    layout: Literal["codes", "plane", "channels_first", "channels_last"]
    divisor: float


def picture_of(space: spaces.Space[Any], asked: bool = False) -> Picture | None:
    """
    Describe the pictures of an observation space; None if it has none.

    Pictures are tile codes, what SB3 takes for an image (uint8 of three axes, 0 to 255), and other Boxes of 0 to 255 or
    of floats of 0 to 1 with two axes, or with three axes of which the smallest, the channels, is first or last.

    :param asked: whether every Box of three axes counts as a picture
    :raises ValueError: for a wrong atlas
    """
    if not isinstance(space, spaces.Box):
        return None
    shape = space.shape
    if hasattr(space, "atlas"):
        _, tile, _, channels = checked_atlas(space).shape
        return Picture((channels, shape[0] * tile, shape[1] * tile), "codes", 1)
    layout: Literal["plane", "channels_first", "channels_last"]
    if len(shape) == 2:
        layout, sizes = "plane", (1, *shape)
    elif len(shape) == 3 and shape[0] == min(shape) and not shape[0] == shape[1] < shape[2]:  # a stack of small squares
        layout, sizes = "channels_first", shape
    elif len(shape) == 3:
        layout, sizes = "channels_last", (shape[2], *shape[:2])
    else:
        return None
    if is_image_space(space):
        return Picture(sizes, layout, 1)
    bounds = space.low.min(), space.high.max()
    of_bytes = bounds == (0, 255)
    of_shares = bounds == (0, 1) and np.issubdtype(space.dtype, np.floating)
    if (of_bytes or of_shares) and sizes[0] < min(sizes[1:]) and min(sizes[1:]) >= _UNMARKED_PIXELS:
        return Picture(sizes, layout, 255 if of_bytes else 1)
    is_wide = np.issubdtype(space.dtype, np.integer) and _WIDE < bounds[1] < _UNBOUNDED
    divisor = int(bounds[1]) if of_bytes or is_wide else 1
    return Picture(sizes, layout, divisor) if asked and len(shape) == 3 else None


def checked_atlas(space: Any) -> npt.NDArray[np.uint8]:
    """Return the atlas of a space of tile codes, (n_codes, t, t, C); ValueError if it does not fit."""
    atlas = np.asarray(space.atlas)
    square = atlas.ndim == 4 and atlas.shape[1] == atlas.shape[2]
    if not square or atlas.dtype != np.uint8 or len(space.shape) != 2 or int(space.high.max()) >= len(atlas):
        raise ValueError(
            "expected tile codes of shape (rows, columns) with an atlas (n_codes, tile, tile, channels) of uint8 that "
            f"has every code, got {space} with an atlas of shape {atlas.shape} and dtype {atlas.dtype}"
        )
    return atlas


class Part(NamedTuple):
    """
    Picture in a vector.

    :param start: index of its first entry
    :param stop: index after its last entry
    :param space: its space in the game
    """

    start: int
    stop: int
    space: spaces.Box


class PartsSpace(spaces.Box):
    """
    Pictures, scalars and vectors concatenated to one float32 vector, which encoders take apart and scale.

    :param flat: the vector, from ``gymnasium.spaces.flatten_space``
    :param pictures: in the order of the vector
    :param whole: (n,), whether entries are integers in the game; None if none is
    """

    def __init__(
        self, flat: spaces.Box, pictures: tuple[Part, ...] = (), whole: npt.NDArray[np.bool_] | None = None
    ) -> None:
        super().__init__(flat.low.astype(np.float32), flat.high.astype(np.float32), dtype=np.float32)
        self.pictures = pictures
        self.whole = np.zeros(self.shape, dtype=np.bool_) if whole is None else whole

    def __eq__(self, other: object) -> bool:
        """Return whether bounds, pictures and integers are equal."""
        if not isinstance(other, PartsSpace) or not super().__eq__(other):
            return False
        return self.pictures == other.pictures and np.array_equal(self.whole, other.whole)

    __hash__ = None  # type: ignore[assignment]  # as in every space with arrays


def has_pictures(space: spaces.Space[Any]) -> bool:
    """Return whether observations of a space are, or contain, pictures or tile codes."""
    return picture_of(space) is not None or (isinstance(space, PartsSpace) and len(space.pictures) > 0)


class Encoder(BaseFeaturesExtractor):
    """Base of the encoders that also take raw observations: tile codes reach them as integers."""


def encoded(
    module: Callable[[Any], th.Tensor], observations: th.Tensor, space: spaces.Space[Any], normalize_images: bool
) -> th.Tensor:
    """
    Apply an encoder to observations as SB3 preprocesses them; tile codes stay integers where it takes them.

    :param module: (K, *shape), or one-hot vectors, to (K, ...)
    :param observations: (K, *shape)
    :param normalize_images: whether SB3 divides images by 255
    """
    if isinstance(module, Encoder) and hasattr(space, "atlas"):
        return module(observations)
    return module(preprocess_obs(observations, space, normalize_images))


class PixelInput(nn.Module):
    """
    Convert pictures of any layout, or tile codes, to float pictures in [0, 1].

    The result is a channels-first tensor with channels-last memory, for which convolutions are fastest.

    :param space: see :func:`picture_of`
    """

    atlas: th.Tensor

    def __init__(self, space: spaces.Space[Any]):
        super().__init__()
        picture = picture_of(space, asked=True)
        if picture is None:
            raise ValueError(
                "expected pictures, a Box of three axes or of two from 0 to 255, or tile codes with an atlas, got "
                f"{space}; use MLPEncoder or a features_extractor_class of your own"
            )
        self.shape, self.layout, self.divisor = picture
        if self.layout == "codes":
            # Not part of the state dict: the atlas belongs to the space, and the weights also fit pictures.
            self.register_buffer("atlas", th.from_numpy(checked_atlas(space).copy()).float() / 255.0, persistent=False)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        Return pictures.

        :param observations: (K, C, H, W), (K, H, W, C), (K, H, W) or codes (K, rows, columns); integers are in 0..255
        :return: (K, C, H, W) float
        """
        if self.layout == "codes":
            tiles = self.atlas[observations.long()]  # (K, rows, columns, t, t, C)
            pictures = tiles.transpose(2, 3).reshape(-1, *self.shape[1:], self.shape[0])
            return pictures.permute(0, 3, 1, 2)
        pictures = observations if observations.is_floating_point() else observations.float() / (255.0 / self.divisor)
        if self.divisor != 1:
            pictures = pictures / self.divisor
        if self.layout == "plane":
            pictures = pictures.unsqueeze(1)
        elif self.layout == "channels_last":
            pictures = pictures.permute(0, 3, 1, 2)
        return pictures.contiguous(memory_format=th.channels_last)

    def looks_up(self, observations: th.Tensor) -> bool:
        """Return whether a first layer looks tiles up: of codes on the CPU. On other devices products are cheaper."""
        return self.layout == "codes" and observations.device.type == "cpu" and not th.compiler.is_compiling()


def _border(rows: int, columns: int) -> nn.Module:
    """Return a layer that adds zeros below and to the right of pictures."""
    return nn.ZeroPad2d((0, columns, 0, rows)) if rows or columns else nn.Identity()


class _FlattenPictures(nn.Flatten):
    """Flatten pictures, and keep the gradient in channels-last memory, which makes the previous layer fast."""

    def forward(self, pictures: th.Tensor) -> th.Tensor:
        """Flatten (K, C, H, W) to (K, C * H * W)."""
        if pictures.requires_grad:
            pictures.register_hook(lambda gradient: gradient.contiguous(memory_format=th.channels_last))
        return super().forward(pictures)


class PaperCNN(Encoder):
    """
    The paper's encoder: convolutions 4x4/2 -> 32 and 3x3/2 -> 64, linear 512, linear ``features_dim``, ReLU between.

    A 28 x 28 x 3 view gives 2,304 numbers after the convolutions, and the encoder has 1,233,056 parameters. Sides that
    are no multiples of 4 get zeros at their ends, else the strides would leave pixels out.

    :param observation_space: pictures (any layout) or tile codes
    :param features_dim: size of the features
    """

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 64):
        super().__init__(observation_space, features_dim)
        self.pixels = PixelInput(observation_space)
        channels, height, width = self.pixels.shape
        self.border = _border(-height % 4, -width % 4)  # else strides leave the last rows and columns out
        out_height, out_width = (((size + -size % 4 - 4) // 2 + 1 - 3) // 2 + 1 for size in (height, width))
        if min(height, width) < PAPER_PIXELS:
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
        is_whole = isinstance(self.border, nn.Identity)
        if is_whole and self.pixels.layout == "codes" and (tile := self.pixels.atlas.shape[1]) % 2 == 0:
            self._places = places_of_convolution(height // tile, width // tile, tile, kernel=4, stride=2)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Encode observations (K, ...) as (K, features_dim)."""
        if self._places is None or not self.pixels.looks_up(observations):
            return self.net(self.border(self.pixels(observations)))
        first = self.net[0]
        assert isinstance(first, nn.Conv2d) and first.bias is not None
        codes, views = used_codes(observations.flatten(1))
        tiles = self.pixels.atlas[codes].permute(0, 3, 1, 2)
        table = table_of_convolution(tiles, first.weight, stride=2)
        return self.net[2:](rectified_sums(views, table, first.bias, self._places))


class NatureEncoder(Encoder):
    """
    The encoder for larger pictures: SB3's ``NatureCNN`` (convolutions 8x8/4 -> 32, 4x4/2 -> 64, 3x3/1 -> 64, linear
    ``features_dim``, ReLU after each).

    Its strides are larger than the paper's and no wide layer follows: at 84 x 84 x 3 it has 0.3 million weights instead
    of ``PaperCNN``'s 13 million, and is six times faster; at 280 x 480 it has 8 million instead of 269 million. Sides
    other than 36, 44, 52 ... get zeros at their ends, else the strides would leave pixels out.

    :param observation_space: pictures (any layout) or tile codes, 36 x 36 pixels or more
    :param features_dim: size of the features
    """

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 64):
        super().__init__(observation_space, features_dim)
        self.pixels = PixelInput(observation_space)
        channels, height, width = self.pixels.shape
        if min(height, width) < NATURE_PIXELS:
            raise ValueError(
                f"NatureEncoder needs pictures of at least {NATURE_PIXELS} x {NATURE_PIXELS} pixels, got {height} x "
                f"{width}; use features_extractor_class=sb3_saf.PaperCNN"
            )
        rows, columns = (4 - height) % 8, (4 - width) % 8  # else strides leave the last rows and columns out
        self.border = _border(rows, columns)
        padded = (channels, height + rows, width + columns)
        self.nature = NatureCNN(spaces.Box(0, 255, padded, np.uint8), features_dim)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Encode observations (K, ...) as (K, features_dim)."""
        return self.nature(self.border(self.pixels(observations)))


class LightEncoder(Encoder):
    """
    Fast encoder for CPUs: a linear embedding of each tile, linear 128, ReLU, linear ``features_dim``.

    Tile codes are embedded once per code and looked up. Pictures are cut into tiles first.

    Tiles with similar pixels have similar embeddings. With zones that is a disadvantage: an orange agent's actions
    differ from a red one's. ``one_hot_codes`` separates them.

    :param observation_space: pictures (any layout) or tile codes
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
        observation_space: spaces.Space[Any],
        features_dim: int = 64,
        tile_size: int = 4,
        embedding_dim: int = 16,
        hidden: int = 128,
        one_hot_codes: bool | None = None,
    ):
        super().__init__(observation_space, features_dim)
        self.pixels = PixelInput(observation_space)
        has_codes = self.pixels.layout == "codes"
        self.one_hot_codes = has_codes if one_hot_codes is None else one_hot_codes
        self.tile_size = self.pixels.atlas.shape[1] if has_codes else tile_size
        channels, height, width = self.pixels.shape
        if height % self.tile_size or width % self.tile_size:
            raise ValueError(
                f"LightEncoder needs pictures of whole tiles, got {height} x {width} pixels with "
                f"tile_size={tile_size}; "
                'pass features_extractor_kwargs={"tile_size": ...}'
            )
        self.n_tiles = height * width // self.tile_size**2
        n_inputs = self.tile_size**2 * channels
        if has_codes:
            inputs = self.pixels.atlas.flatten(1)
            if self.one_hot_codes:
                one_hot = th.from_numpy(np.eye(len(inputs), dtype=np.float32))
                inputs = th.cat([inputs, _ONE_HOT_SCALE * one_hot], dim=1)
            self.register_buffer("tile_inputs", inputs, persistent=False)
            n_inputs = inputs.shape[1]
        elif self.one_hot_codes:
            raise ValueError(
                'one_hot_codes=True needs tile codes, as make_team_env(..., observation="tiles") gives them (a Box of '
                f"whole numbers with an atlas), got pictures {self.pixels.shape}; leave it False"
            )
        self.embed = Linear(n_inputs, embedding_dim, gain=HIDDEN_GAIN)
        self.net = mlp([self.n_tiles * embedding_dim, hidden, features_dim], nn.ReLU, output_gain=HIDDEN_GAIN)
        self._places = places_of_linear(self.n_tiles)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Encode observations (K, ...) as (K, features_dim)."""
        if self.pixels.looks_up(observations):
            first = self.net[0]
            assert isinstance(first, nn.Linear)
            codes, views = used_codes(observations.flatten(1))
            embedded = self.embed(self.tile_inputs[codes])
            # Weights are (hidden, T * e); contributions of a code at each of the T places are (U, T, hidden).
            by_tile = first.weight.unflatten(1, (-1, embedded.shape[1])).permute(2, 1, 0)
            table = (embedded @ by_tile.flatten(1)).unflatten(1, by_tile.shape[1:])
            return self.net[2:](rectified_sums(views, table, first.bias, self._places))
        if self.pixels.layout == "codes":
            tiles = nn.functional.embedding(observations.long().flatten(1), self.embed(self.tile_inputs))
        else:
            channels, height, width = self.pixels.shape
            t = self.tile_size
            cut = self.pixels(observations).reshape(-1, channels, height // t, t, width // t, t)
            # Pixels in the order of an atlas: (K, tiles, t * t * C).
            tiles = self.embed(cut.permute(0, 2, 4, 3, 5, 1).reshape(-1, self.n_tiles, t * t * channels))
        return self.net(tiles.flatten(1))


class MLPEncoder(Encoder):
    """
    Encoder for vectors: linear 128, tanh, linear ``features_dim``. Integer spaces are read as one-hot vectors; Boxes of
    integers beyond 16, such as bytes or distances, are divided by their largest value (below 2**31 - 1).

    :param observation_space: Box (flattened), Discrete, MultiDiscrete or MultiBinary
    :param features_dim: size of the features
    :param hidden: size of the hidden layer
    """

    divisor: th.Tensor

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 64, hidden: int = 128):
        super().__init__(observation_space, features_dim)
        if isinstance(observation_space, spaces.MultiDiscrete) and len(observation_space.shape) != 1:
            raise ValueError(f"expected MultiDiscrete of one axis, got {observation_space}; flatten it in a wrapper")
        self.space = observation_space
        self.net = mlp([int(get_flattened_obs_dim(observation_space)), hidden, features_dim], nn.Tanh, HIDDEN_GAIN)
        divisor = _divisor_of(observation_space)
        self.is_scaled = divisor is not None
        if divisor is not None:
            self.register_buffer("divisor", th.from_numpy(divisor), persistent=False)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Encode observations (K, ...), raw or preprocessed, as (K, features_dim)."""
        if not observations.is_floating_point():
            observations = preprocess_obs(observations, self.space)  # type: ignore[assignment]
        return self.net((observations / self.divisor if self.is_scaled else observations).flatten(1))


def wide_integers(space: spaces.Box) -> npt.NDArray[np.bool_]:
    """Return which entries of a Box are integers so large that MLPs scale them."""
    whole = getattr(space, "whole", np.issubdtype(space.dtype, np.integer))
    largest = _largest(space)
    return whole & (largest > _WIDE) & (largest < _UNBOUNDED)


def _largest(space: spaces.Box) -> npt.NDArray[np.float64]:
    return np.maximum(np.abs(space.low.astype(np.float64)), np.abs(space.high.astype(np.float64)))


def _divisor_of(space: spaces.Space[Any]) -> npt.NDArray[np.float32] | None:
    """Return what scales a Box of wide integers or bytes to [-1, 1], in its shape; None for other spaces."""
    if not isinstance(space, spaces.Box) or hasattr(space, "atlas") or is_image_space(space):
        return None
    is_scaled = wide_integers(space) | ((space.low == 0) & (space.high == 255))
    return np.where(is_scaled, _largest(space), 1).astype(np.float32) if is_scaled.any() else None


class PartsEncoder(Encoder):
    """
    Encoder for pictures together with scalars and vectors: one encoder per picture (an MLP below 8 pixels), one
    :class:`MLPEncoder` for the rest, then linear ``features_dim`` and ReLU.

    :param observation_space: a :class:`PartsSpace` with pictures, which ``make_team_env`` makes of Dicts
    :param features_dim: size of the features, of each encoder and of the output
    :raises ValueError: for any other space
    """

    rest_indices: th.Tensor

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 64):
        if not isinstance(observation_space, PartsSpace) or not has_pictures(observation_space):
            raise ValueError(f"expected pictures beside vectors in one PartsSpace, got {observation_space}")
        super().__init__(observation_space, features_dim)
        self.parts = observation_space.pictures
        encoders: list[Encoder] = []
        is_rest = np.ones(observation_space.shape, dtype=np.bool_)
        for part in self.parts:
            is_rest[part.start : part.stop] = False
            is_tiny = sorted(part.space.shape)[-2] < PAPER_PIXELS  # the smallest of three axes are channels
            encoders.append((MLPEncoder if is_tiny else _encoder_class(part.space))(part.space, features_dim))
        self.pictures = nn.ModuleList(encoders)
        rest = np.flatnonzero(is_rest)
        bounds = observation_space.low[rest], observation_space.high[rest]
        vector = PartsSpace(spaces.Box(*bounds, dtype=np.float32), whole=observation_space.whole[rest])
        self.rest = MLPEncoder(vector, features_dim) if len(rest) else None
        # Not part of the state dict: it follows from the space.
        self.register_buffer("rest_indices", th.from_numpy(rest), persistent=False)
        self.join = nn.Sequential(nn.Linear((len(encoders) + bool(len(rest))) * features_dim, features_dim), nn.ReLU())

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Encode observations (K, n) as (K, features_dim)."""
        features = []
        for encoder, part in zip(self.pictures, self.parts, strict=True):
            picture = observations[:, part.start : part.stop].reshape(-1, *part.space.shape)
            features.append(encoder(preprocess_obs(picture, part.space)))
        if self.rest is not None:
            features.append(self.rest(observations[:, self.rest_indices]))
        return self.join(th.cat(features, dim=1))


class ObservationEncoder(Encoder):
    """
    The default encoder, chosen by space.

    Pictures and tile codes: :class:`PaperCNN`, or :class:`NatureEncoder` for more than 64 x 64 pixels; pictures beside
    vectors: :class:`PartsEncoder`; other spaces: :class:`MLPEncoder`. Boxes of 0 to 255 and of floats of 0 to 1 count
    as pictures if they have two axes, or two and one of channels, of at least 16 pixels; uint8 of three axes always.
    Warns about pictures so large that training is slow with any encoder.

    :param observation_space: one agent's own observation space
    :param features_dim: size of the features
    """

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 64):
        super().__init__(observation_space, features_dim)
        self.encoder = _encoder_class(observation_space)(observation_space, features_dim)
        picture = picture_of(observation_space)
        if picture is None:
            return
        _, height, width = picture.shape
        n_weights = sum(parameter.numel() for parameter in self.encoder.parameters())
        if height * width > _MANY_PIXELS or n_weights > _MANY_WEIGHTS:
            warnings.warn(
                f"observations of {observation_space} have {height} x {width} pixels, for which "
                f"{type(self.encoder).__name__} has {n_weights:,} weights and is slow. Shrink them in the environment "
                '(supersuit.resize_v1(env, 84, 84), supersuit.color_reduction_v0(env, "B")), or choose another '
                'encoder, policy_kwargs={"features_extractor_class": ...}: sb3_saf.LightEncoder with '
                'features_extractor_kwargs={"tile_size": ...} for pictures made of tiles, or one of your own',
                UserWarning,
                stacklevel=2,
            )

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Encode observations (K, ...) as (K, features_dim)."""
        return self.encoder(observations)


def _encoder_class(space: spaces.Space[Any]) -> type[Encoder]:
    if isinstance(space, PartsSpace) and has_pictures(space):
        return PartsEncoder
    picture = picture_of(space)
    if picture is None:
        return MLPEncoder
    _, height, width = picture.shape
    is_small = height * width <= _PAPERS_PIXELS or min(height, width) < NATURE_PIXELS
    return PaperCNN if is_small else NatureEncoder
