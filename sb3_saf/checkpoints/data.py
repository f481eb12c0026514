"""
Reading and writing of a tree of plain data without pickle.

A file is a line of text with the format and the version that wrote it, a line of JSON with the tree, the arrays of the
tree as NumPy's .npy records, then the SHA-256 of all of that. The first line and the checksum are the same in all
formats, so any version can distinguish damage from another format. Arrays are written and read one by one to save
memory.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
from collections import deque
from collections.abc import Mapping
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt
import torch as th

from sb3_saf.teams.errors import CheckpointError, DamagedCheckpointError, UnknownFormatError

FORMAT: Final = 2
#: Versions that read earlier formats.
_EARLIER: Final = {1: "sb3_saf 0.1.0 as of commit 9365c97"}

Array = npt.NDArray[Any]
#: None, bool, int, float, str, arrays, tensors, and lists, tuples, deques and dicts of these.
Tree = Any

_HEADER: Final = re.compile(rb"sb3_saf checkpoint, format (\d{1,9}), written by sb3_saf ([^\n]{1,80})\n")
_LONGEST_HEADER: Final = 200
_DIGEST_BYTES: Final = hashlib.sha256().digest_size
_CHUNK: Final = 1 << 20
#: Key that marks values without a JSON form: {_KIND: "array", "is": 3}.
_KIND: Final = "$"


class _HashedFile:
    """
    A file that computes the SHA-256 of the data written to it.

    :param file: open for writing
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.digest = hashlib.sha256()

    def write(self, data: bytes) -> int:
        """Write bytes."""
        self.digest.update(data)
        return self._file.write(data)


def write_tree(file: BinaryIO, tree: Tree, version: str) -> None:
    """
    Write a checkpoint.

    :param file: open for writing
    :param tree: see :data:`Tree`
    :param version: version of this package
    :raises CheckpointError: for any other value in the tree, naming its place
    """
    arrays: list[Array] = []
    text = json.dumps(_pack(tree, arrays, "state"), separators=(",", ":"))
    hashed = _HashedFile(file)
    hashed.write(f"sb3_saf checkpoint, format {FORMAT}, written by sb3_saf {version}\n".encode())
    hashed.write(text.encode() + b"\n")
    for array in arrays:
        np.lib.format.write_array(hashed, array, allow_pickle=False)
    file.write(hashed.digest.digest())


def read_tree(file: BinaryIO) -> Tree:
    """
    Read a checkpoint.

    :param file: open for reading, at its start
    :raises DamagedCheckpointError: if the file was changed or truncated
    :raises UnknownFormatError: if another version wrote it in another format
    """
    size = file.seek(0, os.SEEK_END) - _DIGEST_BYTES
    if size < 0 or _digest(file, size) != file.read(_DIGEST_BYTES):
        raise DamagedCheckpointError("its checksum does not match: it was cut short or changed")
    file.seek(0)
    header = _HEADER.fullmatch(file.readline(_LONGEST_HEADER))
    if header is None:
        raise DamagedCheckpointError("it does not begin as a checkpoint of sb3_saf does")
    if int(header[1]) != FORMAT:
        reader = _EARLIER.get(int(header[1]), f"sb3_saf {header[2].decode(errors='replace')}")
        raise UnknownFormatError(
            f"it has format {int(header[1])}, which {reader} reads, and this version reads format {FORMAT}; install "
            "that version to go on"
        )
    try:
        packed = json.loads(file.readline())
        arrays: dict[int, Array] = {}
        while file.tell() < size:
            arrays[len(arrays)] = _read_array(file)
        return _unpack(packed, arrays)
    except Exception as error:  # a valid checksum of invalid content: not written by this package
        raise DamagedCheckpointError(f"its content cannot be read: {error}") from error


def encode(tree: Tree, version: str) -> bytes:
    """Return a checkpoint as bytes, see :func:`write_tree`; the tree is copied."""
    file = io.BytesIO()
    write_tree(file, tree, version)
    return file.getvalue()


def decode(data: bytes) -> Tree:
    """Return the tree of a checkpoint in memory, see :func:`read_tree`."""
    return read_tree(io.BytesIO(data))


def _digest(file: BinaryIO, size: int) -> bytes:
    """Return the SHA-256 of the first ``size`` bytes."""
    digest = hashlib.sha256()
    file.seek(0)
    while size > 0 and (chunk := file.read(min(_CHUNK, size))):
        digest.update(chunk)
        size -= len(chunk)
    return digest.digest()


def _read_array(file: BinaryIO) -> Array:
    array: Array = np.lib.format.read_array(file, allow_pickle=False)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"an array has the dtype {array.dtype}")
    return array


def _pack(value: Tree, arrays: list[Array], where: str) -> Any:
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


def _pack_array(kind: str, array: Array, arrays: list[Array], where: str) -> dict[str, Any]:
    if array.dtype.kind not in "biuf":
        raise CheckpointError(f"{where} has the dtype {array.dtype}, which a checkpoint cannot hold")
    arrays.append(np.asarray(array, order="C"))
    return {_KIND: kind, "is": len(arrays) - 1}


def _unpack(packed: Any, arrays: dict[int, Array]) -> Tree:
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
    array = arrays.pop(content)  # each is used once
    if kind == "tensor":
        return th.from_numpy(array)
    return array[()] if kind == "scalar" else array
