"""Files and folders of exports: reading with limits, atomic writing."""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from sb3_saf.export.manifest import DATA_FILES, FORMAT, MANIFEST_FILE, SCRIPT_FILE, DataFile
from sb3_saf.teams.errors import ExportError

#: All names in a folder of an export. The cache is created by importing ``act.py``.
_KNOWN: Final = frozenset({MANIFEST_FILE, SCRIPT_FILE, "__pycache__", *DATA_FILES})


def read_limited(path: Path, limit: int) -> bytes:
    """
    Read an untrusted file.

    :raises ExportError: if it is missing, no regular file (reading a pipe would block) or longer than the limit
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise ExportError(f"{path} is not a regular file")
        with path.open("rb") as file:
            data = file.read(limit + 1)
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        raise ExportError(f"cannot read {path}: {error}; expected a file of sb3_saf.export_actors") from error
    if len(data) > limit:
        raise ExportError(f"{path} has more than the {limit} bytes expected")
    return data


def read_checked(path: Path, expected: DataFile) -> bytes:
    """Read a file and compare it with its description in the manifest."""
    data = read_limited(path, expected.size)
    if DataFile.of(data) != expected:
        raise ExportError(
            f"{path} does not have the length and checksum that {MANIFEST_FILE} states: it was changed, damaged or cut "
            "short; export again or copy the whole folder again"
        )
    return data


def write_folder(folder: Path, files: Mapping[str, bytes], overwrite: bool) -> None:
    """
    Write a folder of files by name, atomically.

    Files are written to a new sibling folder, which is then renamed. A previous folder is removed last; ``overwrite``
    also replaces a folder that is not an export, with all its content.
    """
    target = folder.expanduser().resolve()
    _check_replaceable(target, overwrite)
    target.parent.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    try:
        for name, data in files.items():
            _write_durably(fresh / name, data)
        fresh.chmod(0o777 & ~_umask())  # default permissions; mkdtemp's are for one user only
        _put_in_place(fresh, target)
    except BaseException:
        shutil.rmtree(fresh, ignore_errors=True)
        raise


def _check_replaceable(target: Path, overwrite: bool) -> None:
    if not target.exists():
        return
    if not target.is_dir():
        raise ExportError(f"expected a folder to write to, got the file {target}")
    names = {path.name for path in target.iterdir()}
    if not names or overwrite:
        return
    if not _is_export(target, names):
        raise ExportError(
            f"{target} is not a folder that sb3_saf.export_actors wrote, or has other files beside: name a new folder, "
            "or pass overwrite=True to remove everything in it"
        )


def _is_export(target: Path, names: set[str]) -> bool:
    if MANIFEST_FILE not in names or not names <= _KNOWN:
        return False
    try:
        return f'"{FORMAT}"'.encode() in read_limited(target / MANIFEST_FILE, 1 << 26)
    except ExportError:
        return False


def _write_durably(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _put_in_place(fresh: Path, target: Path) -> None:
    if not target.exists():
        fresh.rename(target)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{target.name}-old-", dir=target.parent))
    old.rmdir()  # only its name is needed; some systems cannot rename onto a folder
    target.rename(old)
    try:
        fresh.rename(target)
    except BaseException:
        old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)
