"""Atomic writing of files, and folders as bytes."""

from __future__ import annotations

import io
import json
import os
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any


def pack(folder: Path) -> bytes:
    """Return the files of a folder as one archive; models are compressed already."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as packed:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            packed.write(path, path.relative_to(folder).as_posix())
    return buffer.getvalue()


def unpack(archive: bytes, folder: Path) -> None:
    """
    Write the files of :func:`pack`.

    :param folder: created if missing
    :raises ValueError: before anything is written, if a name leads out of the folder
    """
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(io.BytesIO(archive)) as packed:
        for name in packed.namelist():
            if not (folder / name).resolve().is_relative_to(folder.resolve()):
                raise ValueError(f"the archive's {name!r} leads out of {folder}; it was not packed by this package")
        packed.extractall(folder)


def plain(value: Any) -> Any:
    """Convert a value to what JSON gives back: tuples become lists."""
    return json.loads(json.dumps(value, default=str))


def read_json(path: Path) -> dict[str, Any] | None:
    """Return the content of a file, None if it does not exist; ValueError for a file without a JSON object."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds no JSON object")
    return content


def write_json(path: Path, value: object) -> None:
    """Write a value atomically as indented JSON."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a file atomically."""
    with tempfile.NamedTemporaryFile(
        "w", dir=path.parent, prefix=f".{path.name}-", delete=False, encoding="utf-8", newline=""
    ) as file:
        file.write(text)
    os.replace(file.name, path)


def differences(old: Mapping[str, Any], new: Mapping[str, Any], most: int = 3) -> str:
    """Describe the differences between two mappings with dotted names, at most ``most`` of them."""
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
