"""Files that appear at once or not at all, locks, JSON, and comparison of descriptions by name."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from io import BufferedWriter
from pathlib import Path
from typing import Any, Final

import filelock

#: Begin of the names of temporary files; one that a killed process leaves may be removed.
TEMPORARY_PREFIX: Final = ".writing-"


@contextmanager
def atomic_file(path: Path) -> Iterator[BufferedWriter]:
    """
    Open a temporary file that replaces a file when it is complete and on disk; after an error the old one is kept.

    :param path: the file, of any writer that takes an open file, such as SB3's ``model.save``
    :raises OSError: with the path, for instance if the disk is full
    """
    temporary = path.with_name(f"{TEMPORARY_PREFIX}{uuid.uuid4().hex[:12]}-{path.name}")
    try:
        with temporary.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        reason = error.__context__ if isinstance(error, RuntimeError) else error  # torch hides a full disk
        if isinstance(reason, OSError):
            number = reason.errno or errno.EIO
            raise OSError(number, f"cannot write {path}: {reason.strerror or reason}") from error
        raise
    with contextlib.suppress(OSError):  # Windows cannot open folders
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
