"""
Files of plain data: nothing in them runs when they are read, and damage is detected.

A file is what ``torch.save`` writes, read by ``torch.load(weights_only=True)``, followed by its SHA-256: torch does not
notice changed numbers.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections import deque
from collections.abc import Mapping
from typing import Any, BinaryIO, Final

import numpy as np
import torch as th

from sb3_saf.teams import package_version
from sb3_saf.teams.errors import CheckpointError, DamagedCheckpointError

#: None, bool, int, float, str, arrays, tensors, and lists, tuples, deques and dicts of these.
Tree = Any

FORMAT: Final = 1
#: First entries of the pairs that stand for NumPy's arrays and numbers; the second one is a tensor.
_ARRAY, _NUMBER = "numpy.ndarray", "numpy.generic"
_DIGEST_BYTES: Final = hashlib.sha256().digest_size
_CHUNK: Final = 1 << 20


class _HashedFile:
    """A file that computes the SHA-256 of what is written to it."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.digest = hashlib.sha256()

    def write(self, data: Any) -> int:
        """Write bytes."""
        self.digest.update(data)
        return self._file.write(data)

    def flush(self) -> None:
        """Flush the file, which torch calls at the end."""
        self._file.flush()


def write_tree(file: BinaryIO, tree: Tree) -> None:
    """
    Write plain data, arrays without a copy of them.

    :param tree: see :data:`Tree`; deques are read as lists
    :raises CheckpointError: for any other value, naming its place
    """
    hashed: Any = _HashedFile(file)
    th.save({"format": FORMAT, "version": package_version(), "tree": _packed(tree, "state")}, hashed)
    file.write(hashed.digest.digest())


def read_tree(file: BinaryIO) -> Tree:
    """
    Read the data of :func:`write_tree`, tensors to the CPU.

    :raises DamagedCheckpointError: if the file was changed or truncated
    :raises CheckpointError: if another version wrote it in another format
    """
    size = file.seek(0, os.SEEK_END) - _DIGEST_BYTES
    file.seek(0)
    digest = hashlib.sha256()
    for start in range(0, size, _CHUNK):
        digest.update(file.read(min(_CHUNK, size - start)))
    if size < 0 or file.read(_DIGEST_BYTES) != digest.digest():
        raise DamagedCheckpointError("its checksum does not match: it was truncated or changed")
    file.seek(0)
    try:
        content = th.load(file, map_location="cpu", weights_only=True)
        found, version, tree = content["format"], content["version"], content["tree"]
    except Exception as error:  # not written by this package; torch's errors have no common class
        reason = str(error).partition("\n")[0]
        raise DamagedCheckpointError(f"its content cannot be read: {reason}") from error
    if found != FORMAT:
        raise CheckpointError(
            f"expected format {FORMAT}, got {found}, of sb3_saf {version}; continue with that version"
        )
    return _unpacked(tree)


def encode(tree: Tree) -> bytes:
    """Return the content of a file, see :func:`write_tree`; the data are copied."""
    file = io.BytesIO()
    write_tree(file, tree)
    return file.getvalue()


def decode(data: bytes) -> Tree:
    """Return the data in the content of a file, see :func:`read_tree`."""
    return read_tree(io.BytesIO(data))


def _packed(value: Tree, where: str) -> Any:
    """Return what ``torch.load(weights_only=True)`` reads: NumPy's arrays as tensors, plain containers."""
    if isinstance(value, (np.ndarray, np.generic)):
        try:
            tensor = th.from_numpy(np.require(value, requirements=["C", "W"]))
        except (TypeError, ValueError):  # also for another order of bytes
            raise CheckpointError(
                f"{where} has the dtype {value.dtype}, which a file of plain data cannot hold"
            ) from None
        return (_ARRAY if isinstance(value, np.ndarray) else _NUMBER), tensor
    if value is None or isinstance(value, bool):
        return value
    for kind in (int, float, str):
        if isinstance(value, kind):
            return kind(value)  # subclasses, such as that of torch's version, would not be read
    if isinstance(value, th.Tensor):
        tensor = value.detach().cpu()
        return tensor.clone() if tensor.untyped_storage().nbytes() > tensor.nbytes else tensor
    if isinstance(value, Mapping):
        return {_packed(key, where): _packed(item, f"{where}[{key!r}]") for key, item in value.items()}
    if isinstance(value, (list, tuple, deque)):
        items = [_packed(item, f"{where}[{i}]") for i, item in enumerate(value)]
        return tuple(items) if isinstance(value, tuple) else items
    raise CheckpointError(f"{where} is a {type(value).__name__}; a file of plain data holds numbers, text and arrays")


def _unpacked(value: Any) -> Tree:
    if isinstance(value, dict):
        return {key: _unpacked(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_unpacked(item) for item in value]
    if isinstance(value, tuple):
        if len(value) == 2 and value[0] in (_ARRAY, _NUMBER) and isinstance(value[1], th.Tensor):
            array = value[1].numpy()
            return array if value[0] == _ARRAY else array[()]
        return tuple(_unpacked(item) for item in value)
    return value
