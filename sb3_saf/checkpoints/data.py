"""
A tree of plain data as bytes, and back, without pickle.

A file is a line of text with the format and the version that wrote it, then safetensors, then the SHA-256 of all of
that. The line and the checksum stay as they are in all formats, so any version can tell damage from another format.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import deque
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch as th
from safetensors.numpy import load, save

from sb3_saf.checkpoints.errors import CheckpointError, DamagedCheckpointError, UnknownFormatError

FORMAT: Final = 1

Array = npt.NDArray[Any]
#: None, bool, int, float, str, arrays, tensors, and lists, tuples, deques and dicts of these.
Tree = Any

_HEADER: Final = re.compile(rb"sb3_saf checkpoint, format (\d{1,9}), written by sb3_saf ([^\n]{1,80})\n")
_DIGEST_BYTES: Final = hashlib.sha256().digest_size
#: Name of the JSON among the arrays, whose names are numbers.
_TREE: Final = "tree"
#: Marks what JSON has no form for: {_KIND: "array", "is": 3}.
_KIND: Final = "$"


def encode(tree: Tree, version: str) -> bytes:
    """
    The content of a checkpoint's file.

    :param tree: see :data:`Tree`; copied
    :param version: of this package
    :raises CheckpointError: for anything else in the tree, saying where
    """
    arrays: dict[str, Array] = {}
    text = json.dumps(_pack(tree, arrays, "state"), separators=(",", ":"))
    arrays[_TREE] = np.frombuffer(text.encode(), dtype=np.uint8)
    header = f"sb3_saf checkpoint, format {FORMAT}, written by sb3_saf {version}\n".encode()
    body = save(arrays)
    digest = hashlib.sha256(header)
    digest.update(body)
    return b"".join((header, body, digest.digest()))  # one copy: it may hold a replay buffer


def decode(data: bytes) -> Tree:
    """
    The tree of a checkpoint's file.

    :param data: content of the file
    :raises DamagedCheckpointError: if a bit was changed or the file was cut short
    :raises UnknownFormatError: if another version wrote it in another format
    """
    content, digest = memoryview(data)[:-_DIGEST_BYTES], data[-_DIGEST_BYTES:]  # no copy: it may hold a replay buffer
    if hashlib.sha256(content).digest() != digest:
        raise DamagedCheckpointError("its checksum does not match: it was cut short or changed")
    header = _HEADER.match(content)
    if header is None:
        raise DamagedCheckpointError("it does not begin as a checkpoint of sb3_saf does")
    if int(header[1]) != FORMAT:
        writer = header[2].decode(errors="replace")
        raise UnknownFormatError(
            f"it has format {int(header[1])}, written by sb3_saf {writer}, and this version "
            f"reads format {FORMAT}; install that version to go on"
        )
    try:
        arrays = load(bytes(content[header.end() :]))
        return _unpack(json.loads(arrays.pop(_TREE).tobytes()), arrays)
    except Exception as error:  # a right checksum over wrong content: not written by this package
        raise DamagedCheckpointError(f"its content cannot be read: {error}") from error


def _pack(value: Tree, arrays: dict[str, Array], where: str) -> Any:
    if value is None or (isinstance(value, (bool, int, float, str)) and not isinstance(value, np.generic)):
        return value
    if isinstance(value, th.Tensor):
        return _pack_array("tensor", value.detach().cpu().numpy(), arrays, where)
    if isinstance(value, (np.ndarray, np.generic)):
        kind = "array" if isinstance(value, np.ndarray) else "scalar"
        return _pack_array(kind, np.asarray(value), arrays, where)
    if isinstance(value, (list, tuple, deque)):
        items = [_pack(item, arrays, f"{where}[{i}]") for i, item in enumerate(value)]
        return {_KIND: "tuple", "is": items} if isinstance(value, tuple) else items
    if isinstance(value, Mapping):
        packed = [(key, _pack(item, arrays, f"{where}[{key!r}]")) for key, item in value.items()]
        if all(isinstance(key, str) for key in value) and _KIND not in value:
            return dict(packed)
        return {_KIND: "dict", "is": [[_pack(key, arrays, where), item] for key, item in packed]}
    raise CheckpointError(f"{where} is a {type(value).__name__}, which a checkpoint cannot hold; it holds plain data")


def _pack_array(kind: str, array: Array, arrays: dict[str, Array], where: str) -> dict[str, Any]:
    if array.dtype.kind not in "biuf":
        raise CheckpointError(f"{where} has the dtype {array.dtype}, which a checkpoint cannot hold")
    name = str(len(arrays))
    arrays[name] = array.copy() if array.ndim == 0 else np.ascontiguousarray(array)
    return {_KIND: kind, "is": name}


def _unpack(packed: Any, arrays: dict[str, Array]) -> Tree:
    if isinstance(packed, list):
        return [_unpack(item, arrays) for item in packed]
    if not isinstance(packed, dict):
        return packed
    if _KIND not in packed:
        return {key: _unpack(item, arrays) for key, item in packed.items()}
    kind, content = packed[_KIND], packed["is"]
    if kind == "dict":
        return {_unpack(key, arrays): _unpack(item, arrays) for key, item in content}
    if kind == "tuple":
        return tuple(_unpack(item, arrays) for item in content)
    array = arrays[content].copy()  # safetensors gives views of the file that cannot be written to
    if kind == "tensor":
        return th.from_numpy(array)
    return array[()] if kind == "scalar" else array
