"""Files are complete or as before, whatever interrupts their writing."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from sb3_saf.teams.files import atomic_file, write_text


def test_content_is_written_whole(tmp_path: Path) -> None:
    write_text(tmp_path / "file", "täxt\n")
    assert (tmp_path / "file").read_bytes() == "täxt\n".encode()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("place", ["content", "fsync", "replace"])
def test_a_failure_leaves_the_earlier_content_and_names_the_file(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "file"
    target.write_bytes(b"earlier")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def write() -> None:
        with atomic_file(target) as file:
            file.write(b"half")
            if place == "content":
                full()

    if place != "content":
        monkeypatch.setattr(os, place, full)
    with pytest.raises(OSError, match=f"{target}.*No space left"):
        write()
    assert target.read_bytes() == b"earlier"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
