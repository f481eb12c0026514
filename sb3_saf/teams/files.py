"""
Files that appear at once or not at all, locks, JSON, comparison of descriptions by name, and files of plain data.

Nothing in a file of plain data runs when it is read, and damage is detected: it is what ``torch.save`` writes, read by
``torch.load(weights_only=True)``, followed by its SHA-256, since torch does not notice changed numbers.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import uuid
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from io import BufferedWriter, BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Final

import filelock
import numpy as np
import torch as th

from sb3_saf.teams import package_version
from sb3_saf.teams.checks import CheckpointError, DamagedCheckpointError

#: Begin of the names of temporary files; one that a killed process leaves may be removed.
TEMPORARY_PREFIX: Final = ".writing-"


@contextmanager
def atomic_file(path: Path) -> Iterator[BufferedWriter]:
    """
    Open a temporary file that replaces a file when it is complete and on disk; after an error the old one is kept.

    Missing folders are made.

    :param path: the file, of any writer that takes an open file, such as SB3's ``model.save``
    :raises OSError: with the path, for instance if the disk is full
    """
    temporary = path.with_name(f"{TEMPORARY_PREFIX}{uuid.uuid4().hex[:12]}-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        reason = error.__context__ if isinstance(error, RuntimeError) else error  # torch hides a full disk
        if isinstance(reason, OSError):
            number = reason.errno or errno.EIO
            raise OSError(number, f"cannot write {path}: {reason.strerror or reason}") from error
        raise
    with suppress(OSError):  # Windows cannot open folders
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # the new name is on disk
        finally:
            os.close(folder)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files that killed processes left in a folder, while no other process writes there."""
    for path in folder.glob(f"{TEMPORARY_PREFIX}*"):
        path.unlink(missing_ok=True)


def try_lock(path: Path) -> filelock.BaseFileLock | None:
    """
    Lock a file against other processes, and against other locks of this one.

    :return: the lock, held until ``release()``, the end of this object, or that of the process; None if it is taken
    :raises OSError: if the file cannot be written
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = filelock.FileLock(path)
    try:
        lock.acquire(timeout=0)
    except filelock.Timeout:
        return None
    return lock


def write_text(path: Path, text: str) -> None:
    """Write a file atomically."""
    with atomic_file(path) as file:
        file.write(text.encode("utf-8"))


def write_json(path: Path, value: object) -> None:
    """Write a value atomically as indented JSON; see :func:`plain`."""
    write_text(path, json.dumps(value, indent=2, default=str) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file; the ValueError for any other content, or none, names the file."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds no JSON object")
    return content


def plain(value: Any) -> Any:
    """Convert a value to what JSON gives back: tuples become lists, paths text."""
    return json.loads(json.dumps(value, default=str))


def digest(path: Path) -> str:
    """Return the SHA-256 of a file; it is computed again when size or time of the file have changed."""
    status = path.stat()
    return _digest(path, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=100_000)
def _digest(path: Path, size: int, changed: int) -> str:
    with path.open("rb") as file:
        result = hashlib.sha256()
        while block := file.read(1 << 20):
            result.update(block)
    return result.hexdigest()


def differences(old: Mapping[str, Any], new: Mapping[str, Any], most: int = 3) -> str:
    """Describe the differences between two mappings with dotted names, at most ``most`` of them; empty if equal."""
    before, after = dict(_flat(old)), dict(_flat(new))
    changed = [key for key in {**before, **after} if before.get(key) != after.get(key)]
    named = [f"{key} was {before.get(key)!r}, now {after.get(key)!r}" for key in changed[:most]]
    more = len(changed) - len(named)
    return ", ".join(named) + (f", and {more} more" if more else "")


def _flat(nested: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in nested.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


# --- files of plain data ----------------------------------------------------------------------------------------------


#: None, bool, int, float, str, arrays, tensors, and lists, tuples, deques and dicts of these.
Tree = Any

FORMAT: Final = 2
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
    file = BytesIO()
    write_tree(file, tree)
    return file.getvalue()


def decode(data: bytes) -> Tree:
    """Return the data in the content of a file, see :func:`read_tree`."""
    return read_tree(BytesIO(data))


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
