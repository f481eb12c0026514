"""
The encoders of ``sb3_saf.networks`` as SB3 features extractors, and the default choice among them.

On the CPU, extractors of tile codes look up the tiles' contributions to their first layer instead of making pixels
(``sb3_saf.networks.tile_sums``): the same features, up to the order of summation.
"""

from __future__ import annotations

import warnings
from typing import Any, Final

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_saf.envs.space_reader import PartsSpace
from sb3_saf.networks import encoders
from sb3_saf.networks.encoders import NATURE_PIXELS, PixelInput
from sb3_saf.networks.spaces import observation_spec
from sb3_saf.networks.tile_sums import (
    Places,
    places_of_convolution,
    places_of_linear,
    rectified_sums,
    table_of_convolution,
    used_codes,
)

#: Maximum pixels for which the paper's encoder is the default; beyond, it has more than 7 million weights.
_PAPERS_PIXELS: Final = 64 * 64
#: Smallest side of a picture for the paper's encoder.
_FEWEST_PIXELS: Final = 8
#: Numbers of pixels and weights above which a warning about slow training is issued.
_MANY_PIXELS: Final = 128 * 128
_MANY_WEIGHTS: Final = 10_000_000


def looks_up(pixels: PixelInput, observations: th.Tensor) -> bool:
    """Return whether a first layer uses the lookup: for codes on the CPU. On other devices products are cheaper."""
    return pixels.layout == "codes" and observations.device.type == "cpu"


class PaperCNN(encoders.PaperCNN, BaseFeaturesExtractor):
    """SB3 features extractor of :class:`sb3_saf.networks.encoders.PaperCNN`, with its parameters."""

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 64):
        BaseFeaturesExtractor.__init__(self, observation_space, features_dim)
        encoders.PaperCNN.__init__(self, observation_space, features_dim)
        self._places: Places | None = None
        if self.pixels.layout == "codes" and (tile := self.pixels.atlas.shape[1]) % 2 == 0:
            _, height, width = self.pixels.shape
            self._places = places_of_convolution(height // tile, width // tile, tile, kernel=4, stride=2)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Encode observations (K, *shape) as (K, features_dim)."""
        if self._places is None or not looks_up(self.pixels, observations):
            return super().forward(observations)
        return self.net[2:](self._first_layer(observations, self._places))

    def _first_layer(self, codes: th.Tensor, places: Places) -> th.Tensor:
        """Apply the first convolution and its ReLU: codes (K, rows, columns) to (K, 32, h, w)."""
        first = self.net[0]
        assert isinstance(first, nn.Conv2d) and first.bias is not None
        used = used_codes(codes.flatten(1))
        table = table_of_convolution(self.pixels.tiles(used.codes), first.weight, stride=2)
        return rectified_sums(used.views, table, first.bias, places)


class NatureEncoder(encoders.NatureEncoder, BaseFeaturesExtractor):
    """SB3 features extractor of :class:`sb3_saf.networks.encoders.NatureEncoder`, with its parameters."""

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 64):
        BaseFeaturesExtractor.__init__(self, observation_space, features_dim)
        encoders.NatureEncoder.__init__(self, observation_space, features_dim)


class LightEncoder(encoders.LightEncoder, BaseFeaturesExtractor):
    """SB3 features extractor of :class:`sb3_saf.networks.encoders.LightEncoder`, with its parameters."""

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        features_dim: int = 64,
        tile_size: int = 4,
        embedding_dim: int = 16,
        hidden: int = 128,
        one_hot_codes: bool | None = None,
    ):
        BaseFeaturesExtractor.__init__(self, observation_space, features_dim)
        encoders.LightEncoder.__init__(
            self, observation_space, features_dim, tile_size, embedding_dim, hidden, one_hot_codes
        )
        self._places = places_of_linear(self.n_tiles)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Encode observations (K, *shape) as (K, features_dim)."""
        if not looks_up(self.pixels, observations):
            return super().forward(observations)
        return self.net[2:](self._first_layer(observations))

    def _first_layer(self, codes: th.Tensor) -> th.Tensor:
        """Apply the first linear layer and its ReLU: codes (K, rows, columns) to (K, hidden)."""
        first = self.net[0]
        assert isinstance(first, nn.Linear)
        used = used_codes(codes.flatten(1))
        embedded = self.embed(self.tile_inputs[used.codes])
        # Weights are (hidden, T * e); contributions of a code at each of the T places are (U, T, hidden).
        by_tile = first.weight.unflatten(1, (-1, embedded.shape[1])).permute(2, 1, 0)
        table = (embedded @ by_tile.flatten(1)).unflatten(1, by_tile.shape[1:])
        return rectified_sums(used.views, table, first.bias, self._places)


class MLPEncoder(encoders.MLPEncoder, BaseFeaturesExtractor):
    """SB3 features extractor of :class:`sb3_saf.networks.encoders.MLPEncoder`, with its parameters."""

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 64, hidden: int = 128):
        BaseFeaturesExtractor.__init__(self, observation_space, features_dim)
        encoders.MLPEncoder.__init__(self, observation_space, features_dim, hidden)


class PartsEncoder(BaseFeaturesExtractor):
    """
    Encoder for pictures together with scalars and vectors: one encoder per picture (an MLP below 8 pixels), one
    :class:`MLPEncoder` for the rest, then linear ``features_dim`` and ReLU.

    :param observation_space: a :class:`~sb3_saf.envs.space_reader.PartsSpace`, which ``make_team_env`` makes of Dicts
    :param features_dim: size of the features, of each encoder and of the output
    :raises ValueError: for any other space
    """

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 64):
        if not isinstance(observation_space, PartsSpace):
            raise ValueError(f"expected pictures beside vectors in one PartsSpace, got {observation_space}")
        super().__init__(observation_space, features_dim)
        self.parts = observation_space.parts
        pictures = [spaces.Box(0, 255, part.picture, np.uint8) for part in self.parts if part.picture is not None]
        self.pictures = nn.ModuleList(_picture_encoder_class(space)(space, features_dim) for space in pictures)
        n_rest = sum(part.stop - part.start for part in self.parts if part.picture is None)
        rest = spaces.Box(-np.inf, np.inf, (n_rest,), np.float32)
        self.rest = MLPEncoder(rest, features_dim) if n_rest else None
        n_encoders = len(pictures) + (n_rest > 0)
        self.join = nn.Sequential(nn.Linear(n_encoders * features_dim, features_dim), nn.ReLU())

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Encode observations (K, n) as (K, features_dim)."""
        slices = [observations[:, part.start : part.stop] for part in self.parts]
        shown = [
            slice_.reshape(-1, *part.picture) / 255.0
            for slice_, part in zip(slices, self.parts, strict=True)
            if part.picture is not None
        ]
        found = [encoder(pixels) for encoder, pixels in zip(self.pictures, shown, strict=True)]
        if self.rest is not None:
            vectors = [slice_ for slice_, part in zip(slices, self.parts, strict=True) if part.picture is None]
            found.append(self.rest(th.cat(vectors, dim=1)))
        return self.join(th.cat(found, dim=1))


class ObservationEncoder(BaseFeaturesExtractor):
    """
    The default encoder, chosen by space.

    Pictures (uint8, 0..255) and tile codes: :class:`PaperCNN`, or :class:`NatureEncoder` for more than 64 x 64 pixels;
    pictures beside vectors: :class:`PartsEncoder`; other spaces: :class:`MLPEncoder`.
    Warns about pictures so large that training is slow with any encoder.

    :param observation_space: one agent's own observation space
    :param features_dim: size of the features
    """

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 64):
        super().__init__(observation_space, features_dim)
        self.encoder: BaseFeaturesExtractor = _encoder_class(observation_space)(observation_space, features_dim)
        if not isinstance(self.encoder, (MLPEncoder, PartsEncoder)):
            _warn_if_large(self.encoder, observation_space)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Encode observations (K, *shape) as (K, features_dim)."""
        return self.encoder(observations)


def _encoder_class(observation_space: spaces.Space[Any]) -> type[BaseFeaturesExtractor]:
    if isinstance(observation_space, PartsSpace):
        return PartsEncoder
    space = observation_spec(observation_space).space
    if space.atlas is None and not space.picture:
        return MLPEncoder
    _, height, width = space.picture_shape
    if height * width <= _PAPERS_PIXELS or min(height, width) < NATURE_PIXELS:
        return PaperCNN
    return NatureEncoder


def _picture_encoder_class(space: spaces.Box) -> type[BaseFeaturesExtractor]:
    """As :func:`_encoder_class`, but an MLP for pictures too small for convolutions."""
    _, height, width = observation_spec(space).space.picture_shape
    return MLPEncoder if min(height, width) < _FEWEST_PIXELS else _encoder_class(space)


def _warn_if_large(encoder: BaseFeaturesExtractor, space: spaces.Space[Any]) -> None:
    _, height, width = observation_spec(space).space.picture_shape
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
