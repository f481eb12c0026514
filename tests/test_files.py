"""Files are complete or as before, whatever interrupts their writing."""

from __future__ import annotations

import errno
import multiprocessing
import os
import resource
import signal
from pathlib import Path
from typing import Any

import pytest
import torch as th
from stable_baselines3 import PPO

from sb3_saf.teams.files import atomic_file, try_lock, write_text


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


def test_a_full_disk_keeps_the_previous_model_and_names_the_file(tmp_path: Path) -> None:
    """With each writer of this package's files: a plain one, torch's, and SB3's ``model.save``."""
    model = PPO("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8, device="cpu")
    writers: list[Any] = [lambda file: file.write(bytes(9000)), lambda file: th.save(th.zeros(9000), file), model.save]
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    for number, write in enumerate(writers):
        path = tmp_path / f"{number}.zip"
        write_text(path, "good")
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
            with pytest.raises(OSError, match=f"{number}.zip.*too large"), atomic_file(path) as file:
                write(file)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert path.read_text() == "good"
    signal.signal(signal.SIGXFSZ, before)
    assert len(list(tmp_path.iterdir())) == len(writers)


def _hold(path: Path, ready: Any) -> None:
    lock = try_lock(path)
    ready.set()
    signal.pause()
    assert lock is not None


def test_a_lock_ends_with_its_process_also_by_sigkill(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    ready = context.Event()
    other = context.Process(target=_hold, args=(tmp_path / "lock", ready))
    other.start()
    assert ready.wait(30)
    assert try_lock(tmp_path / "lock") is None
    other.kill()
    other.join()
    lock = try_lock(tmp_path / "lock")
    assert lock is not None and try_lock(tmp_path / "lock") is None
    lock.release()
