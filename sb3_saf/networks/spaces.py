"""
Spaces as plain data, for building networks and for the manifest of an export.

Neither Gymnasium nor torch is imported here, so that exported actors run without them.
"""

from __future__ import annotations

from math import prod
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

if TYPE_CHECKING:
    from gymnasium import spaces

Array: TypeAlias = npt.NDArray[Any]

#: Upper limit for sizes read from files.
MAX_SIZE: Final = 1 << 20
MAX_ENTRIES: Final = 1 << 22

Size: TypeAlias = Annotated[int, Meta(ge=1, le=MAX_SIZE)]
Kind: TypeAlias = Literal["box", "discrete", "multi_discrete", "multi_binary"]
DType: TypeAlias = Literal[
    "bool",
    "float16",
    "float32",
    "float64",
    "int8",
    "int16",
    "int32",
    "int64",
    "uint8",
    "uint16",
    "uint32",
    "uint64",
]
#: One number for all entries of a Box, or nested lists; infinities are the words "inf" and "-inf".
Bound: TypeAlias = float | int | str | list[Any]


class SpaceSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """
    A space of observations or actions, without Gymnasium.

    :param kind: which kind of space
    :param shape: shape of an observation or action
    :param dtype: NumPy's name of the type
    :param choices: number of choices of each entry; empty for Boxes
    :param low: lowest values of a Box, else None
    :param high: highest values of a Box, else None
    :param picture: whether it is a uint8 picture, with channels first or last
    :param atlas: shape (n_codes, t, t, C) of the pixels of tile codes, else None
    """

    kind: Kind
    shape: Annotated[tuple[Size, ...], Meta(max_length=8)]
    dtype: DType
    choices: Annotated[tuple[Size, ...], Meta(max_length=MAX_ENTRIES)] = ()
    low: Any = None
    high: Any = None
    picture: bool = False
    atlas: tuple[Size, Size, Size, Size] | None = None

    def __post_init__(self) -> None:
        _check(self)

    def __str__(self) -> str:
        return f"a {self.kind} space of shape {self.shape} and {self.dtype}"

    @property
    def is_one_hot(self) -> bool:
        """Whether networks read the space as one-hot vectors."""
        return self.kind in ("discrete", "multi_discrete")

    @property
    def n_inputs(self) -> int:
        """Number of inputs of a network for vectors."""
        return sum(self.choices) if self.is_one_hot else prod(self.shape)

    @property
    def n_outputs(self) -> int:
        """Number of outputs of a policy's last layer for actions of this space."""
        return self.n_inputs

    @property
    def picture_shape(self) -> tuple[int, int, int]:
        """Channels, height and width of the pictures for an encoder."""
        if self.atlas is not None:
            _, tile, _, channels = self.atlas
            return channels, self.shape[0] * tile, self.shape[1] * tile
        first, second, third = self.shape
        # SB3's rule for the two layouts.
        return (first, second, third) if first == min(self.shape) else (third, first, second)

    def bounds(self) -> tuple[Array, Array]:
        """Return the lowest and highest values of a Box, broadcastable to its shape."""
        return _bound_array(self.low, self, "low"), _bound_array(self.high, self, "high")


AnySpace: TypeAlias = "SpaceSpec | spaces.Space[Any]"


class ObservationSpec(NamedTuple):
    """
    Input of an encoder.

    :param space: space of one agent's own observation
    :param atlas: (n_codes, t, t, C) uint8 pixels of every tile code, else None
    """

    space: SpaceSpec
    atlas: Array | None = None


def spec_of(space: AnySpace) -> SpaceSpec:
    """
    Describe a space.

    :param space: Box, Discrete, MultiDiscrete (of one axis) or MultiBinary, or a description
    :raises ValueError: for any other space
    """
    if isinstance(space, SpaceSpec):
        return space
    from gymnasium import spaces

    shape, dtype = tuple(int(size) for size in space.shape or ()), str(space.dtype)
    if isinstance(space, spaces.Box):
        low, high = _bound(space.low), _bound(space.high)
        atlas = getattr(space, "atlas", None)
        if atlas is not None:
            return SpaceSpec("box", shape, dtype, low=low, high=high, atlas=_checked_atlas(space).shape)  # type: ignore[arg-type]
        picture = len(shape) == 3 and dtype == "uint8" and low == 0 and high == 255
        return SpaceSpec("box", shape, dtype, low=low, high=high, picture=picture)  # type: ignore[arg-type]
    if isinstance(space, spaces.Discrete):
        return SpaceSpec("discrete", (), dtype, (int(space.n),))  # type: ignore[arg-type]
    if isinstance(space, spaces.MultiDiscrete) and len(shape) == 1:
        return SpaceSpec("multi_discrete", shape, dtype, tuple(int(n) for n in space.nvec))  # type: ignore[arg-type]
    if isinstance(space, spaces.MultiBinary):
        return SpaceSpec("multi_binary", shape, dtype, (2,) * prod(shape))  # type: ignore[arg-type]
    raise ValueError(
        f"expected a Discrete, MultiDiscrete (of one axis), MultiBinary or Box space, got {space}; flatten it in a "
        "wrapper of the environment"
    )


def observation_spec(space: ObservationSpec | AnySpace) -> ObservationSpec:
    """
    Describe a space of observations, with the pixels of its tile codes if it has any.

    :param space: see :func:`spec_of`; a Box of tile codes has an attribute ``atlas``
    """
    if isinstance(space, ObservationSpec):
        return space
    if isinstance(space, SpaceSpec):
        return ObservationSpec(space)
    return ObservationSpec(spec_of(space), _checked_atlas(space) if hasattr(space, "atlas") else None)


def pixels_to_codes(pictures: Array, atlas: Array) -> Array:
    """
    Convert pictures to tile codes, exactly.

    With them an agent trained on tile codes can act on the game's pixels. Of several codes with equal pixels the first
    is returned; for networks that read the pixels of codes these are equivalent.

    :param pictures: (..., rows * t, columns * t, C) uint8, or channels first
    :param atlas: (n_codes, t, t, C) uint8 pixels of every code
    :return: (..., rows, columns) int64
    :raises ValueError: if a picture has a tile that the atlas lacks
    """
    pictures, (n_codes, tile, _, channels) = np.asarray(pictures), atlas.shape
    if pictures.ndim >= 3 and pictures.shape[-1] != channels and pictures.shape[-3] == channels:
        pictures = np.moveaxis(pictures, -3, -1)
    if pictures.ndim < 3 or pictures.dtype != np.uint8 or pictures.shape[-1] != channels:
        raise ValueError(f"expected uint8 pictures of {channels} channels, got {pictures.dtype} of {pictures.shape}")
    *batch, height, width, _ = pictures.shape
    if height % tile or width % tile:
        raise ValueError(f"expected pictures of whole tiles of {tile} pixels, got {height} x {width}")
    cut = pictures.reshape(*batch, height // tile, tile, width // tile, tile, channels).swapaxes(-4, -3)
    known: dict[bytes, int] = {}
    for code in range(n_codes):
        known.setdefault(atlas[code].tobytes(), code)
    tiles = np.ascontiguousarray(cut).reshape(-1, tile * tile * channels)
    codes = [known.get(pixels.tobytes(), -1) for pixels in tiles]
    if -1 in codes:
        column, row = codes.index(-1) % (width // tile), codes.index(-1) // (width // tile) % (height // tile)
        raise ValueError(
            f"the tile in row {row}, column {column} is none of the {n_codes} tiles that this agent was trained on; "
            "give it pictures of the same game, drawn with the same colours and tile size"
        )
    return np.array(codes, dtype=np.int64).reshape(*batch, height // tile, width // tile)


# --- checks -----------------------------------------------------------------------------------------------------------


def _check(space: SpaceSpec) -> None:
    size = prod(space.shape)
    n_choices = {"box": 0, "discrete": 1, "multi_discrete": size, "multi_binary": size}[space.kind]
    axes = {"discrete": 0, "multi_discrete": 1}.get(space.kind, len(space.shape))
    is_binary = space.kind != "multi_binary" or set(space.choices) <= {2}
    is_box = space.kind == "box"
    looks = (space.picture or space.atlas is not None) and not is_box
    if len(space.choices) != n_choices or len(space.shape) != axes or not is_binary or looks:
        raise ValueError(f"a shape, choices, picture or atlas that a {space.kind!r} space does not have")
    if size > MAX_ENTRIES or sum(space.choices) > MAX_ENTRIES:
        raise ValueError(f"the space has {max(size, sum(space.choices))} entries or choices, more than {MAX_ENTRIES}")
    if space.picture and (len(space.shape) != 3 or space.dtype != "uint8"):
        raise ValueError(f"a picture must be uint8 of three axes, got {space.dtype} of shape {space.shape}")
    if (space.low is not None) != is_box or (space.high is not None) != is_box:
        raise ValueError("a space must have 'low' and 'high' exactly if it is a box")
    if is_box:
        low, high = space.bounds()
        if space.atlas is not None:
            _check_codes(space, space.atlas, low, high)


def _check_codes(space: SpaceSpec, atlas: tuple[int, int, int, int], low: Array, high: Array) -> None:
    if len(space.shape) != 2 or np.dtype(space.dtype).kind not in "iu":
        raise ValueError(f"tile codes must be whole numbers of two axes, got {space.dtype} of {space.shape}")
    if atlas[1] != atlas[2] or prod(atlas) > MAX_ENTRIES:
        raise ValueError(f"an atlas must be (codes, tile, tile, channels), got {atlas}")
    if low.min() < 0 or high.max() >= atlas[0]:
        raise ValueError("the space has codes without an entry in its atlas")


def _bound_array(bound: Bound, space: SpaceSpec, side: str) -> Array:
    try:
        with np.errstate(all="raise"):
            array = np.asarray(bound, dtype=space.dtype)
    except (ValueError, TypeError, OverflowError, ArithmeticError, RecursionError) as error:
        raise ValueError(f"{side!r} must be one number of {space.dtype} or nested lists of them") from error
    if array.shape not in ((), space.shape) or np.isnan(array).any():
        raise ValueError(f"{side!r} must be one number or have the shape {space.shape}, without NaN; got {array.shape}")
    return array


def _checked_atlas(space: Any) -> Array:
    """Return the checked atlas, (n_codes, t, t, C) uint8."""
    atlas = np.asarray(space.atlas)
    square = atlas.ndim == 4 and atlas.shape[1] == atlas.shape[2]
    if not square or atlas.dtype != np.uint8 or len(space.shape) != 2 or int(space.high.max()) >= len(atlas):
        raise ValueError(
            "expected tile codes of shape (rows, columns) with an atlas (n_codes, tile, tile, channels) of uint8 that "
            f"has every code, got {space} with an atlas of shape {atlas.shape} and dtype {atlas.dtype}"
        )
    return atlas


def _bound(values: Array) -> Bound:
    """Return one number if all are equal, else nested lists."""
    if values.size and (values == values.flat[0]).all():
        values = values.flat[0]
    words = np.where(np.isinf(values), np.where(values > 0, "inf", "-inf"), "")
    numbers = np.where(words == "", values, 0).astype(values.dtype)
    return _merged(numbers.tolist(), words.tolist())


def _merged(number: Any, word: Any) -> Bound:
    if isinstance(number, list):
        return [_merged(*pair) for pair in zip(number, word, strict=True)]
    return word or number
