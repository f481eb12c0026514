"""Files are complete or as before; checkpoint files: content, damage, other formats, two runs in one folder."""

from __future__ import annotations

import errno
import io
import multiprocessing
import os
import resource
import signal
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO

from sb3_saf.checkpoints.learning import CheckpointFolder
from sb3_saf.teams import files as trees
from sb3_saf.teams.checks import CheckpointError, DamagedCheckpointError
from sb3_saf.teams.files import atomic_file, decode, encode, try_lock, write_text, write_tree


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


# --- checkpoint files -------------------------------------------------------------------------------------------------


TREE: dict[str, Any] = {
    "numbers": [1, -1.5, float("-inf"), True, None, 2**127, "text"],
    "by number": {0: "a", 1: (1, 2.0)},
    "array": np.arange(6, dtype=np.uint64).reshape(2, 3),
    "no axes": np.array(3.0),
    "scalar": np.float32(0.1),
    "tensor": th.arange(4.0),
    "part of a large tensor": th.zeros(10_000)[:3],
    "not writeable": np.frombuffer(b"abc", dtype=np.uint8),
}


def put(folder: CheckpointFolder, tree: Any, game_steps: int) -> None:
    folder.write(lambda file: write_tree(file, tree), game_steps)


ROUNDS = int(os.environ.get("CHECKPOINT_DAMAGES", "200"))


def test_what_goes_in_comes_out() -> None:
    tree = decode(encode(TREE))
    assert tree["numbers"] == TREE["numbers"] and tree["by number"] == TREE["by number"]
    assert list(map(type, tree["numbers"])) == list(map(type, TREE["numbers"]))
    for name in [*TREE][2:]:
        assert type(tree[name]) is type(TREE[name])
        assert tree[name].dtype == TREE[name].dtype and tree[name].shape == TREE[name].shape
        assert bool((tree[name] == TREE[name]).all())
    assert tree["array"].flags.writeable
    assert decode(encode(deque([1, 2]))) == [1, 2]


@pytest.mark.parametrize("value", [object(), np.array([object()]), {"a": {1, 2}}, np.zeros(1, np.longdouble)])
def test_what_is_no_data_is_named(value: Any) -> None:
    with pytest.raises(CheckpointError, match=r"state\['here'\]"):
        encode({"here": value})


def test_every_truncation_and_bit_flip_is_recognised() -> None:
    data = encode(TREE)
    rng = np.random.default_rng(0)
    for _ in range(ROUNDS):
        flipped = bytearray(data)
        flipped[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        for damaged in (bytes(flipped), data[: rng.integers(len(data))], data + b"x"):
            with pytest.raises(DamagedCheckpointError):
                decode(damaged)


class Harm:
    def __reduce__(self) -> Any:
        return print, ("harm",)


def test_nothing_in_a_file_runs(capsys: pytest.CaptureFixture[str]) -> None:
    file = io.BytesIO()
    hashed: Any = trees._HashedFile(file)
    th.save({"format": trees.FORMAT, "version": "1", "tree": Harm()}, hashed)
    with pytest.raises(DamagedCheckpointError, match="cannot be read"):
        decode(file.getvalue() + hashed.digest.digest())
    assert capsys.readouterr().out == ""


def test_another_format_says_which_version_wrote_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = CheckpointFolder(tmp_path)
    put(folder, 1, 10)
    monkeypatch.setattr(trees, "FORMAT", 9)
    monkeypatch.setattr(trees, "package_version", lambda: "7.5.0")
    put(folder, 1, 20)
    monkeypatch.undo()
    with pytest.raises(CheckpointError, match=r"checkpoint-000000000020.*format 2, got 9.*sb3_saf 7\.5\.0"):
        folder.newest()


def test_the_last_ones_are_kept_and_the_newest_is_read(tmp_path: Path) -> None:
    folder = CheckpointFolder(tmp_path / "new" / "folder", keep=2)
    assert folder.newest() is None
    for steps in (5, 30, 100, 999_999_999_999):
        put(folder, steps, steps)
    assert [int(path.stem.split("-")[1]) for path in folder.checkpoints()] == [999_999_999_999, 100]
    loaded = folder.newest()
    assert loaded is not None and loaded.tree == 999_999_999_999


def test_a_damaged_file_is_passed_over_with_a_warning_that_names_both(tmp_path: Path) -> None:
    folder = CheckpointFolder(tmp_path)
    for steps in (10, 20):
        put(folder, steps, steps)
    newest, before = folder.checkpoints()
    newest.write_bytes(newest.read_bytes()[:-1])
    with pytest.warns(UserWarning, match=rf"{newest}.*checksum.*Going back to {before}"):
        loaded = folder.newest()
    assert loaded is not None and loaded.tree == 10
    before.write_bytes(b"")
    with (
        pytest.warns(UserWarning, match="Going back"),
        pytest.raises(DamagedCheckpointError, match=f"no checkpoint in {tmp_path}"),
    ):
        folder.newest()


def test_a_damaged_newer_file_does_not_push_out_what_is_written_after_it(tmp_path: Path) -> None:
    folder = CheckpointFolder(tmp_path, keep=1)
    (tmp_path / "checkpoint-000000000020.ckpt").write_bytes(b"damaged")
    put(folder, 10, 10)
    put(folder, 15, 15)
    with pytest.warns(UserWarning, match="Going back to .*15.ckpt"):
        loaded = folder.newest()
    assert loaded is not None and loaded.tree == 15


def test_a_full_disk_names_the_checkpoint_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    folder = CheckpointFolder(tmp_path)
    put(folder, 1, 10)
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(CheckpointError, match=r"No space left.*last good one is .*checkpoint-000000000010"):
        put(folder, 2, 20)


def test_what_a_killed_write_left_is_removed_and_never_read(tmp_path: Path) -> None:
    (tmp_path / ".writing-abc").write_bytes(b"half")
    folder = CheckpointFolder(tmp_path)
    assert folder.newest() is None
    put(folder, 1, 10)
    assert not (tmp_path / ".writing-abc").exists()


def test_one_run_per_folder(tmp_path: Path) -> None:
    run, other = CheckpointFolder(tmp_path), CheckpointFolder(tmp_path)
    run.acquire()
    with pytest.raises(CheckpointError, match=f"another run writes checkpoints to {tmp_path}"):
        other.acquire()
    run.release()
    other.acquire()
    other.release()
