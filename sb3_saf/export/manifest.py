"""
``actor.json``: the manifest that describes an exported actor.

It may be untrusted: msgspec checks the type and size of every entry before use, names are looked up in closed lists,
and unknown entries are refused.
"""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Any, Final, Literal, NoReturn, TypeAlias

import msgspec
from msgspec import Meta

from sb3_saf.networks.spaces import MAX_SIZE, Size, SpaceSpec
from sb3_saf.teams.errors import ExportError

FORMAT: Final = "sb3_saf.actor"
#: Version 2 had no actor_identity and one_hot_codes, and its graphs did not choose actions.
FORMAT_VERSION: Final = 3
READABLE_VERSIONS: Final = (2, 3)

MANIFEST_FILE: Final = "actor.json"
WEIGHTS_FILE: Final = "actor.safetensors"
ONNX_FILE: Final = "actor.onnx"
SCRIPT_FILE: Final = "act.py"
#: Files with checksums in the manifest.
DATA_FILES: Final = (WEIGHTS_FILE, ONNX_FILE)

#: Minimum side of a picture in pixels for the convolutions of an encoder.
_LEAST_SIDE: Final = {"PaperCNN": 8, "NatureEncoder": 36}

#: Limits, far above the sizes of real models.
MAX_MANIFEST_BYTES: Final = 1 << 24

EncoderName: TypeAlias = Literal["LightEncoder", "MLPEncoder", "NatureEncoder", "PaperCNN"]
ActorName: TypeAlias = Literal["AgentPolicies", "PolicyPool", "SinglePolicy"]
Activation: TypeAlias = Literal[
    "ELU", "GELU", "Identity", "LeakyReLU", "Mish", "ReLU", "ReLU6", "SiLU", "Sigmoid", "Softplus", "Tanh"
]
Text: TypeAlias = Annotated[str, Meta(max_length=200)]
Length: TypeAlias = Annotated[int, Meta(ge=1, le=1 << 12)]
Sizes: TypeAlias = Annotated[tuple[Size, ...], Meta(max_length=1 << 12)]


class EncoderNet(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """
    Encoder and its sizes.

    :param name: class in ``sb3_saf.networks.encoders``
    :param features_dim: d
    :param divide_by_255: whether uint8 pictures are scaled to [0, 1]
    :param tile_size: for LightEncoder, else 1
    :param embedding_dim: for LightEncoder, else 1
    :param hidden: for LightEncoder and MLPEncoder, else 1
    :param one_hot_codes: for LightEncoder
    """

    name: EncoderName
    features_dim: Size
    divide_by_255: bool
    tile_size: Size = 1
    embedding_dim: Size = 1
    hidden: Size = 1
    one_hot_codes: bool = False


class ActorNet(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """
    Actor and its sizes.

    :param name: one policy for all, one for each agent, or a pool
    :param hidden: hidden layers of every policy
    :param activation: of hidden layers, a class in ``torch.nn``
    :param n_policies: U, 1 without pool
    :param latent_dim: for the pool, else 1
    :param projection_hidden: for the pool, else empty
    :param agent_identity: whether the policies read the agent's index
    """

    name: ActorName
    hidden: Sizes
    activation: Activation
    n_policies: Size = 1
    latent_dim: Size = 1
    projection_hidden: Sizes = ()
    agent_identity: bool = False

    def __post_init__(self) -> None:
        if (self.name == "PolicyPool") != (self.n_policies > 1):
            raise ValueError(f"a PolicyPool has at least 2 policies and others have 1, got {self.n_policies}")
        if self.name == "AgentPolicies" and self.agent_identity:
            raise ValueError("policies of each agent's own do not read who acts, got agent_identity true")

    @property
    def reads_agent(self) -> bool:
        """Whether the actor depends on the agent's index."""
        return self.name == "AgentPolicies" or self.agent_identity


class MemoryNet(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """
    LSTM between encoder and policies.

    :param hidden_size: H
    :param n_layers: number of stacked layers
    :param bias: whether it has biases
    """

    hidden_size: Size
    n_layers: Length
    bias: bool

    def __post_init__(self) -> None:
        if self.hidden_size * self.n_layers > MAX_SIZE:
            raise ValueError(f"{self.n_layers} layers of {self.hidden_size} are more than {MAX_SIZE} numbers")


class DataFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file beside the manifest: its length in bytes and its checksum."""

    size: Annotated[int, Meta(ge=1, le=1 << 31)]
    sha256: Text

    @classmethod
    def of(cls, data: bytes) -> DataFile:
        """Describe a file's content."""
        return cls(len(data), hashlib.sha256(data).hexdigest())


class Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """
    Description of an exported actor.

    :param sb3_saf_version: version that wrote it
    :param policy: name of the trained policy class, for information
    :param n_agents: N
    :param reads_agent: whether the actor depends on the agent's index
    :param action_mask: whether action masks are optional, required or not supported
    :param selection: ``"greedy"`` if parameters are action values, of which the best is taken
    :param observation: space of one own observation
    :param action: action space
    :param encoder: the encoder; None if it is in the ONNX file only
    :param actor: the policies; None if they are in the ONNX file only
    :param memory: the LSTM; None without memory
    :param files: data files of the export
    :param format_version: version of this format
    """

    sb3_saf_version: Text
    policy: Text
    n_agents: Size
    reads_agent: bool
    action_mask: Literal["none", "optional", "required"]
    selection: Literal["mixture", "gumbel", "greedy"]
    observation: SpaceSpec
    action: SpaceSpec
    encoder: EncoderNet | None
    actor: ActorNet | None
    memory: MemoryNet | None
    #: A closed list: names in the manifest cannot refer to other files.
    files: dict[Literal["actor.safetensors", "actor.onnx"], DataFile]
    format_version: Literal[2, 3] = FORMAT_VERSION

    @property
    def gives_log_probs(self) -> bool:
        """Whether the actor has probabilities of single actions."""
        return self.action.kind == "discrete" and self.selection != "greedy"

    def to_json(self) -> str:
        """Return the text of the file, its own checksum included."""
        entries = {"format": FORMAT, **msgspec.to_builtins(self)}
        return json.dumps({**entries, "checksum": checksum(entries)}, indent=1, allow_nan=False) + "\n"

    @classmethod
    def from_json(cls, text: bytes) -> Manifest:
        """Read and check a manifest; ExportError for anything that :meth:`to_json` would not write."""
        try:
            entries = msgspec.json.decode(text)
            stated = _checked_format(entries).pop("checksum", None)
            if stated != checksum(entries):
                refuse("does not have the checksum that it states: it was changed or damaged")
            return msgspec.convert({name: value for name, value in entries.items() if name != "format"}, cls)
        except (msgspec.MsgspecError, RecursionError, UnicodeError) as error:
            refuse(f"cannot be read: {str(error)[:200]}", error)

    def __post_init__(self) -> None:
        has_nets = self.encoder is not None and self.actor is not None
        if has_nets != (WEIGHTS_FILE in self.files) or has_nets != (self.encoder is not None or self.actor is not None):
            raise ValueError(f"encoder and actor must be described exactly if there is a {WEIGHTS_FILE}")
        if not self.files:
            raise ValueError(f"it names neither {WEIGHTS_FILE} nor {ONNX_FILE}")
        if self.actor is not None and self.reads_agent != self.actor.reads_agent:
            raise ValueError(f"reads_agent must say whether the actor depends on who acts, got {self.reads_agent}")
        if self.selection == "greedy" and self.action.kind != "discrete":
            raise ValueError(f"selection 'greedy' needs discrete actions, got {self.action.kind}")
        if self.action_mask != "none" and self.action.kind == "box":
            raise ValueError("actions of a box cannot be masked")
        if self.encoder is not None:
            _check_encoder(self.encoder, self.observation)


def refuse(message: str, cause: Exception | None = None) -> NoReturn:
    """Raise ExportError for an invalid manifest, with a one-line message."""
    raise ExportError(f"{MANIFEST_FILE} {message}") from cause


def checksum(entries: Any) -> str:
    """Return the SHA-256 of a manifest's entries, independent of their layout in the file."""
    try:
        return hashlib.sha256(json.dumps(entries, sort_keys=True).encode("utf-8")).hexdigest()
    except (ValueError, TypeError, RecursionError) as error:
        refuse(f"cannot be summed up: {error}", error)


def _checked_format(entries: Any) -> dict[str, Any]:
    if not isinstance(entries, dict) or entries.get("format") != FORMAT:
        refuse(f"is not of an exported actor: expected an object of the format {FORMAT!r}")
    version = entries.get("format_version")
    if isinstance(version, bool) or version not in READABLE_VERSIONS:
        refuse(
            f"has format version {str(version)[:20]}, written by sb3_saf {str(entries.get('sb3_saf_version'))[:20]}; "
            "this version reads 2 and 3: load it with the version that wrote it, or export again"
        )
    return entries


def _check_encoder(net: EncoderNet, space: SpaceSpec) -> None:
    """Check that an encoder can read a space."""
    if net.one_hot_codes and (net.name != "LightEncoder" or space.atlas is None):
        raise ValueError("one_hot_codes needs a LightEncoder of tile codes")
    if net.name == "MLPEncoder":
        if not space.shape and space.kind == "box":
            raise ValueError("MLPEncoder needs at least one axis")
        return
    if space.kind != "box" or (space.atlas is None and len(space.shape) != 3):
        raise ValueError(f"{net.name} reads pictures or tile codes, got {space}")
    _, height, width = space.picture_shape
    least = _LEAST_SIDE.get(net.name, 1)
    if min(height, width) < least:
        raise ValueError(f"{net.name} needs at least {least} x {least} pixels, got {height} x {width}")
    tile = net.tile_size if space.atlas is None else space.atlas[1]
    if net.name == "LightEncoder" and (height % tile or width % tile or tile != net.tile_size):
        raise ValueError(
            f"LightEncoder needs whole tiles of {net.tile_size} pixels, got {height} x {width} in tiles of {tile}"
        )
