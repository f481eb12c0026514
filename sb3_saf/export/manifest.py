"""
``actor.json``: what an exported actor is, in plain words and numbers.

A manifest comes from a stranger until proven otherwise: every entry is checked for kind and size before anything is
built from it, names are looked up in closed lists, and entries that nobody knows are refused.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import prod
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from sb3_saf.export.entries import MAX_ENTRIES, MAX_SIZE, Entries, refuse, short, strict_json

FORMAT: Final = "sb3_saf.actor"
FORMAT_VERSION: Final = 2

MANIFEST_FILE: Final = "actor.json"
WEIGHTS_FILE: Final = "actor.safetensors"
ONNX_FILE: Final = "actor.onnx"
SCRIPT_FILE: Final = "act.py"
#: Files whose checksums a manifest states.
DATA_FILES: Final = (WEIGHTS_FILE, ONNX_FILE)

ENCODER_NAMES: Final = ("LightEncoder", "MLPEncoder", "NatureEncoder", "PaperCNN")
#: Least side of a picture, in pixels, that the convolutions of an encoder need.
_LEAST_SIDE: Final = {"PaperCNN": 8, "NatureEncoder": 36}
ACTOR_NAMES: Final = ("AgentPolicies", "PolicyPool", "SinglePolicy")
ACTIVATION_NAMES: Final = (
    "ELU",
    "GELU",
    "Identity",
    "LeakyReLU",
    "Mish",
    "ReLU",
    "ReLU6",
    "SiLU",
    "Sigmoid",
    "Softplus",
    "Tanh",
)
#: Whether an actor can, or must, be told which actions are legal.
ACTION_MASKS: Final = ("none", "optional", "required")
SELECTIONS: Final = ("mixture", "gumbel", "greedy")
KINDS: Final = ("box", "discrete", "multi_discrete", "multi_binary")
DTYPES: Final = tuple(
    ["bool", "float16", "float32", "float64"] + [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]
)

#: Far above what anybody trains, far below what hurts.
MAX_MANIFEST_BYTES: Final = 1 << 24
MAX_DATA_BYTES: Final = 1 << 31
_MAX_LENGTH: Final = 1 << 12
_MAX_AXES: Final = 8

#: One number for all entries of a Box, or nested lists; infinities are the words "inf" and "-inf".
Bound = float | int | str | list[Any]


@dataclass(frozen=True)
class SpaceRecord:
    """
    A space, without Gymnasium.

    :param kind: one of ``KINDS``
    :param shape: shape of an observation or action
    :param dtype: NumPy's name of the type
    :param choices: number of choices of each entry; empty for Boxes
    :param low: lowest values of a Box, else None
    :param high: highest values of a Box, else None
    :param picture: whether it is a picture of bytes, which may come with channels first or last
    :param atlas: shape (n_codes, t, t, C) of the pixels of tile codes, else None
    """

    kind: str
    shape: tuple[int, ...]
    dtype: str
    choices: tuple[int, ...] = ()
    low: Bound | None = None
    high: Bound | None = None
    picture: bool = False
    atlas: tuple[int, int, int, int] | None = None

    @property
    def is_one_hot(self) -> bool:
        """Whether networks read the space as one-hot vectors."""
        return self.kind in ("discrete", "multi_discrete")

    @property
    def n_outputs(self) -> int:
        """Numbers that the last layer of a policy gives for actions of this space."""
        return sum(self.choices) if self.is_one_hot else prod(self.shape)

    @classmethod
    def parse(cls, value: object, where: str) -> SpaceRecord:
        """Read and check; ``where`` is for messages."""
        entries = Entries(value, where)
        space = cls(
            kind=entries.word("kind", KINDS),
            shape=entries.sizes("shape", _MAX_AXES),
            dtype=entries.word("dtype", DTYPES),
            choices=entries.sizes("choices", MAX_ENTRIES),
            low=entries.raw("low"),
            high=entries.raw("high"),
            picture=entries.flag("picture"),
            atlas=entries.atlas("atlas"),
        )
        entries.finish()
        _check_space(space, where)
        return space


def _check_space(space: SpaceRecord, where: str) -> None:
    size = prod(space.shape)
    n_choices = {"box": 0, "discrete": 1, "multi_discrete": size, "multi_binary": size}[space.kind]
    axes = {"discrete": 0, "multi_discrete": 1}.get(space.kind, len(space.shape))
    is_binary = space.kind != "multi_binary" or set(space.choices) == {2}
    is_box = space.kind == "box"
    looks = (space.picture or space.atlas is not None) and not is_box
    if len(space.choices) != n_choices or len(space.shape) != axes or not is_binary or looks:
        refuse(f"{where} has a shape, choices, picture or atlas that a {space.kind!r} space does not have")
    if size > MAX_ENTRIES or sum(space.choices) > MAX_ENTRIES:
        refuse(f"{where} has {max(size, sum(space.choices))} entries or choices, more than {MAX_ENTRIES}")
    if space.picture and (len(space.shape) != 3 or space.dtype != "uint8"):
        refuse(f"{where} must be uint8 of three axes to be a picture, got {space.dtype} of shape {space.shape}")
    if space.atlas is not None and (len(space.shape) != 2 or np.dtype(space.dtype).kind not in "iu"):
        refuse(f"{where} must be whole numbers of two axes to have an atlas, got {space.dtype} of {space.shape}")
    for side, bound in (("low", space.low), ("high", space.high)):
        if (bound is not None) != is_box:
            refuse(f"{where} must have {side!r} exactly if it is a box")
        if bound is not None:
            bound_array(bound, space, f"{where}.{side}")
    if space.atlas is not None:
        assert space.low is not None and space.high is not None
        low, high = bound_array(space.low, space), bound_array(space.high, space)
        if low.min() < 0 or high.max() >= space.atlas[0]:
            refuse(f"{where} has codes without an entry in its atlas")


def bound_array(bound: Bound, space: SpaceRecord, where: str = "a bound") -> npt.NDArray[Any]:
    """
    A bound of a Box as an array.

    :return: of the space's dtype, broadcastable to its shape
    """
    try:
        with np.errstate(all="raise"):
            array = np.asarray(bound, dtype=space.dtype)
    except (ValueError, TypeError, OverflowError, ArithmeticError, RecursionError):
        refuse(f"{where} must be one number of {space.dtype} or nested lists of them")
    if array.shape not in ((), space.shape) or np.isnan(array).any():
        refuse(f"{where} must be one number or have the shape {space.shape}, without NaN; got {array.shape}")
    return array


@dataclass(frozen=True)
class EncoderNet:
    """
    Which encoder, and its sizes.

    :param name: one of ``ENCODER_NAMES``
    :param features_dim: d
    :param divide_by_255: whether pictures of bytes are scaled to [0, 1]
    :param tile_size: of LightEncoder, else 1
    :param embedding_dim: of LightEncoder, else 1
    :param hidden: of LightEncoder and MLPEncoder, else 1
    """

    name: str
    features_dim: int
    divide_by_255: bool
    tile_size: int = 1
    embedding_dim: int = 1
    hidden: int = 1

    @classmethod
    def parse(cls, value: object, where: str) -> EncoderNet:
        """Read and check."""
        entries = Entries(value, where)
        net = cls(
            name=entries.word("name", ENCODER_NAMES),
            features_dim=entries.size("features_dim"),
            divide_by_255=entries.flag("divide_by_255"),
            tile_size=entries.size("tile_size"),
            embedding_dim=entries.size("embedding_dim"),
            hidden=entries.size("hidden"),
        )
        entries.finish()
        return net


@dataclass(frozen=True)
class ActorNet:
    """
    Which policies, and their sizes.

    :param name: one of ``ACTOR_NAMES``
    :param hidden: hidden layers of every policy
    :param activation: one of ``ACTIVATION_NAMES``
    :param n_policies: U, 1 but for the pool
    :param latent_dim: of the pool, else 1
    :param projection_hidden: of the pool, else empty
    """

    name: str
    hidden: tuple[int, ...]
    activation: str
    n_policies: int = 1
    latent_dim: int = 1
    projection_hidden: tuple[int, ...] = ()

    @classmethod
    def parse(cls, value: object, where: str) -> ActorNet:
        """Read and check."""
        entries = Entries(value, where)
        net = cls(
            name=entries.word("name", ACTOR_NAMES),
            hidden=entries.sizes("hidden", _MAX_LENGTH),
            activation=entries.word("activation", ACTIVATION_NAMES),
            n_policies=entries.size("n_policies"),
            latent_dim=entries.size("latent_dim"),
            projection_hidden=entries.sizes("projection_hidden", _MAX_LENGTH),
        )
        entries.finish()
        if (net.name == "PolicyPool") != (net.n_policies > 1):
            refuse(f"{where}: a PolicyPool has at least 2 policies and others have 1, got {net.n_policies}")
        return net


@dataclass(frozen=True)
class MemoryNet:
    """
    The LSTM between encoder and policies.

    :param hidden_size: H
    :param n_layers: layers, one on top of the other
    :param bias: whether it has biases
    """

    hidden_size: int
    n_layers: int
    bias: bool

    @classmethod
    def parse(cls, value: object, where: str) -> MemoryNet:
        """Read and check."""
        entries = Entries(value, where)
        net = cls(entries.size("hidden_size"), entries.size("n_layers", _MAX_LENGTH), entries.flag("bias"))
        entries.finish()
        if net.hidden_size * net.n_layers > MAX_SIZE:
            refuse(f"{where} has {net.n_layers} layers of {net.hidden_size}, more than {MAX_SIZE} numbers")
        return net


@dataclass(frozen=True)
class DataFile:
    """
    A file beside the manifest.

    :param size: its length in bytes
    :param sha256: its checksum
    """

    size: int
    sha256: str

    @classmethod
    def of(cls, data: bytes) -> DataFile:
        """Describe a file's content."""
        return cls(len(data), hashlib.sha256(data).hexdigest())

    @classmethod
    def parse(cls, value: object, where: str) -> DataFile:
        """Read and check."""
        entries = Entries(value, where)
        result = cls(entries.size("size", MAX_DATA_BYTES), entries.text("sha256"))
        entries.finish()
        return result


@dataclass(frozen=True)
class Manifest:
    """
    What an exported actor is.

    :param sb3_saf_version: which version wrote it
    :param policy: name of the policy class it was trained with, for people
    :param n_agents: N
    :param reads_agent: whether every agent has a policy of its own
    :param action_mask: whether actions may be masked: ``"none"``, ``"optional"`` or ``"required"``
    :param selection: ``"mixture"`` or ``"gumbel"``; ``"greedy"`` if parameters are values of actions, of which the best
        is taken
    :param observation: space of one own observation
    :param action: action space
    :param encoder: the encoder; None if only the ONNX file knows
    :param actor: the policies; None if only the ONNX file knows
    :param memory: the LSTM; None without memory
    :param files: what lies beside the manifest
    """

    sb3_saf_version: str
    policy: str
    n_agents: int
    reads_agent: bool
    action_mask: str
    selection: str
    observation: SpaceRecord
    action: SpaceRecord
    encoder: EncoderNet | None
    actor: ActorNet | None
    memory: MemoryNet | None
    files: Mapping[str, DataFile]

    @property
    def gives_log_probs(self) -> bool:
        """Whether every action has a probability."""
        return self.action.kind == "discrete" and self.selection != "greedy"

    def to_json(self) -> str:
        """The text of the file, its own checksum included."""
        entries = {"format": FORMAT, "format_version": FORMAT_VERSION, **asdict(self)}
        return json.dumps({**entries, "checksum": _checksum(entries)}, indent=1, allow_nan=False) + "\n"

    @classmethod
    def from_json(cls, text: bytes) -> Manifest:
        """
        Read and check.

        :raises ExportError: for anything that :meth:`to_json` would not have written
        """
        entries = Entries(strict_json(text, MANIFEST_FILE), MANIFEST_FILE)
        _check_format(entries)
        stated = entries.text("checksum")
        if stated != _checksum({name: value for name, value in entries.value.items() if name != "checksum"}):
            refuse(f"{MANIFEST_FILE} does not have the checksum that it states: it was changed or damaged")
        manifest = cls(
            sb3_saf_version=entries.text("sb3_saf_version"),
            policy=entries.text("policy"),
            n_agents=entries.size("n_agents"),
            reads_agent=entries.flag("reads_agent"),
            action_mask=entries.word("action_mask", ACTION_MASKS),
            selection=entries.word("selection", SELECTIONS),
            observation=SpaceRecord.parse(entries.raw("observation"), "observation"),
            action=SpaceRecord.parse(entries.raw("action"), "action"),
            encoder=entries.optional("encoder", EncoderNet.parse),
            actor=entries.optional("actor", ActorNet.parse),
            memory=entries.optional("memory", MemoryNet.parse),
            files=_parse_files(entries.raw("files")),
        )
        entries.finish()
        manifest.check()
        return manifest

    def check(self) -> None:
        """
        Check that the entries fit together.

        :raises ExportError: if they do not
        """
        has_nets = self.encoder is not None and self.actor is not None
        if has_nets != (WEIGHTS_FILE in self.files) or has_nets != (self.encoder is not None or self.actor is not None):
            refuse(f"{MANIFEST_FILE} must describe encoder and actor exactly if there is a {WEIGHTS_FILE}")
        if not self.files:
            refuse(f"{MANIFEST_FILE} names neither {WEIGHTS_FILE} nor {ONNX_FILE}")
        if self.actor is not None and self.reads_agent != (self.actor.name == "AgentPolicies"):
            refuse(f"reads_agent must say whether the actor is AgentPolicies, got {self.reads_agent}")
        if self.selection == "greedy" and self.action.kind != "discrete":
            refuse(f"selection 'greedy' needs discrete actions, got {self.action.kind}")
        if self.action_mask != "none" and self.action.kind == "box":
            refuse("actions of a box cannot be masked")
        if self.encoder is not None:
            _check_encoder(self.encoder, self.observation)


def _check_encoder(net: EncoderNet, space: SpaceRecord) -> None:
    """Check that an encoder can read a space."""
    if net.name == "MLPEncoder":
        if not space.shape and space.kind == "box":
            refuse("MLPEncoder needs at least one axis")
        return
    if space.kind != "box" or (space.atlas is None and len(space.shape) != 3):
        refuse(f"{net.name} reads pictures or tile codes, got a {space.kind} of shape {space.shape}")
    _, height, width = picture_shape(space)
    least = _LEAST_SIDE.get(net.name, 1)
    if min(height, width) < least:
        refuse(f"{net.name} needs at least {least} x {least} pixels, got {height} x {width}")
    tile = net.tile_size if space.atlas is None else space.atlas[1]
    if net.name == "LightEncoder" and (height % tile or width % tile or tile != net.tile_size):
        refuse(f"LightEncoder needs whole tiles of {net.tile_size} pixels, got {height} x {width} in tiles of {tile}")


def picture_shape(space: SpaceRecord) -> tuple[int, int, int]:
    """
    Channels, height and width of the pictures that an encoder sees.

    :param space: of pictures in either layout, or of tile codes
    """
    if space.atlas is not None:
        _, tile, _, channels = space.atlas
        return channels, space.shape[0] * tile, space.shape[1] * tile
    first, second, third = space.shape
    return (first, second, third) if first == min(space.shape) else (third, first, second)


def _parse_files(value: object) -> dict[str, DataFile]:
    entries = Entries(value, "files")
    # A closed list: no name in a file decides what is opened.
    files = {name: DataFile.parse(entries.raw(name), f"files.{name}") for name in DATA_FILES if name in entries.value}
    entries.finish()
    return files


def _check_format(entries: Entries) -> None:
    if entries.raw("format") != FORMAT:
        refuse(f"{MANIFEST_FILE} is not of an exported actor: its format is {short(entries.raw('format'))}")
    version = entries.raw("format_version")
    if isinstance(version, bool) or version != FORMAT_VERSION:
        refuse(
            f"{MANIFEST_FILE} has format version {short(version)}, written by sb3_saf "
            f"{short(entries.value.get('sb3_saf_version'))}; this version reads {FORMAT_VERSION}: load it with the "
            "version that wrote it, or export again"
        )


def _checksum(entries: Mapping[str, Any]) -> str:
    """SHA-256 of the entries, however they are laid out in the file."""
    try:
        return hashlib.sha256(json.dumps(entries, sort_keys=True).encode("utf-8")).hexdigest()
    except (ValueError, TypeError, RecursionError) as error:
        refuse(f"{MANIFEST_FILE} cannot be summed up: {error}", error)
