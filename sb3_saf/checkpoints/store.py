"""Folder of checkpoints with atomic writes, a lock against other runs, and detection of damaged files."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from sb3_saf.checkpoints.data import Tree, read_tree
from sb3_saf.teams.errors import CheckpointError, DamagedCheckpointError, UnknownFormatError

try:
    import fcntl
except ImportError:  # Windows: no lock
    fcntl = None  # type: ignore[assignment]

_NAME: Final = re.compile(r"checkpoint-(\d{12,})\.ckpt")
_LOCK_FILE: Final = "lock"
_TEMPORARY_PREFIX: Final = ".writing-"


class Loaded(NamedTuple):
    """A checkpoint that was read."""

    path: Path
    tree: Tree


class CheckpointFolder:
    """
    Checkpoints of one run, named by their game steps.

    :param path: the folder, created at the first write
    :param keep: number of newest checkpoints to keep
    """

    def __init__(self, path: str | os.PathLike[str], keep: int = 3) -> None:
        self.path = Path(path)
        self.keep = keep
        self._lock: int | None = None

    def checkpoints(self) -> list[Path]:
        """Return the files of all checkpoints, newest first."""
        if not self.path.is_dir():
            return []
        found = [(int(match[1]), path) for path in self.path.iterdir() if (match := _NAME.fullmatch(path.name))]
        return [path for _, path in sorted(found, reverse=True) if path.is_file()]

    def write(self, content: Callable[[BinaryIO], object], game_steps: int) -> Path:
        """
        Add a checkpoint, then remove all but the newest ``keep``.

        The content is written to a temporary file, which is renamed when it is on disk: a run killed here leaves the
        previous checkpoints and perhaps a temporary file, which the next write removes.

        :param content: writes the content to a file
        :param game_steps: game steps, for the file's name
        :raises CheckpointError: if it cannot be written, for instance because the disk is full
        """
        target = self.path / f"checkpoint-{game_steps:012d}.ckpt"
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            for path in self.path.glob(f"{_TEMPORARY_PREFIX}*"):
                path.unlink(missing_ok=True)
            _write_atomically(target, content)
        except OSError as error:
            older = self.checkpoints()
            last = f"the last good one is {older[0]}" if older else "there is no earlier one"
            raise CheckpointError(
                f"cannot write the checkpoint {target}: {error}; {last}. Make room or choose another "
                "folder, then resume"
            ) from error
        # Newer ones are damaged, otherwise this run would have resumed from them.
        own = [path for path in self.checkpoints() if path.name <= target.name]
        for path in own[self.keep :]:
            path.unlink(missing_ok=True)
        return target

    def newest(self) -> Loaded | None:
        """
        Read the newest undamaged checkpoint, with a warning for each newer one.

        :return: None if there is no checkpoint
        :raises CheckpointError: if all are damaged, or the newest undamaged one has an unknown format
        """
        paths = self.checkpoints()
        for i, path in enumerate(paths):
            try:
                with path.open("rb") as file:
                    return Loaded(path, read_tree(file))
            except UnknownFormatError as error:
                raise UnknownFormatError(f"cannot use the checkpoint {path}: {error}") from None
            except (DamagedCheckpointError, OSError) as error:
                if i + 1 == len(paths):
                    raise DamagedCheckpointError(
                        f"no checkpoint in {self.path} can be read; the last one tried, {path}: {error}"
                    ) from error
                warnings.warn(
                    f"the checkpoint {path} cannot be read: {error}. Going back to {paths[i + 1]}",
                    UserWarning,
                    stacklevel=2,
                )
        return None

    def acquire(self) -> None:
        """
        Lock the folder until :meth:`release` or the end of this process.

        :raises CheckpointError: if the folder cannot be created, or another run uses it, naming its process
        """
        if self._lock is not None or fcntl is None:
            return
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            lock = os.open(self.path / _LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise CheckpointError(
                f"cannot keep checkpoints in {self.path}: {error}; give the run a folder that it may write to"
            ) from error
        try:
            # The system releases the lock when the process ends, also if it is killed.
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            owner = os.pread(lock, 20, 0).decode(errors="replace").strip() or "unknown"
            os.close(lock)
            raise CheckpointError(
                f"another run (process {owner}) writes checkpoints to {self.path}; wait for its end, or give this run "
                "a folder of its own"
            ) from None
        os.ftruncate(lock, 0)
        os.pwrite(lock, f"{os.getpid()}\n".encode(), 0)
        self._lock = lock

    def release(self) -> None:
        """Unlock the folder."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def _write_atomically(target: Path, content: Callable[[BinaryIO], object]) -> None:
    temporary = target.with_name(f"{_TEMPORARY_PREFIX}{os.getpid()}-{target.name}")
    try:
        with temporary.open("wb") as file:
            content(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(target.parent)


def _sync_folder(folder: Path) -> None:
    """Sync the folder, so that a new file name is on disk."""
    if fcntl is None:  # Windows cannot open folders
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
