"""Folder of checkpoints with atomic writes, a lock against other runs, and detection of damaged files."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable
from itertools import zip_longest
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import filelock

from sb3_saf.teams.checks import CheckpointError, DamagedCheckpointError
from sb3_saf.teams.files import Tree, atomic_file, read_tree, remove_leftovers, try_lock

_NAME: Final = re.compile(r"checkpoint-(\d{12,})\.ckpt")


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
        self._lock: filelock.BaseFileLock | None = None

    def checkpoints(self) -> list[Path]:
        """Return the files of all checkpoints, newest first."""
        if not self.path.is_dir():
            return []
        files = [(int(match[1]), path) for path in self.path.iterdir() if (match := _NAME.fullmatch(path.name))]
        return [path for _, path in sorted(files, reverse=True) if path.is_file()]

    def write(self, content: Callable[[BinaryIO], object], game_steps: int) -> Path:
        """
        Add a checkpoint, then remove all but the newest ``keep``.

        A run killed here leaves the previous checkpoints and perhaps a temporary file, which the next write removes.

        :param game_steps: game steps, for the file's name
        :raises CheckpointError: if it cannot be written, for instance because the disk is full
        """
        target = self.path / f"checkpoint-{game_steps:012d}.ckpt"
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            remove_leftovers(self.path)
            with atomic_file(target) as file:
                content(file)
        except OSError as error:
            older = self.checkpoints()
            last = f"the last good one is {older[0]}" if older else "there is no earlier one"
            raise CheckpointError(
                f"cannot write the checkpoint {target}: {error}; {last}. Make room or choose another "
                "folder, then resume"
            ) from error
        # Newer ones are damaged, otherwise this run would have resumed from them.
        older = [path for path in self.checkpoints() if path.name <= target.name]
        for path in older[self.keep :]:
            path.unlink(missing_ok=True)
        return target

    def newest(self) -> Loaded | None:
        """
        Read the newest undamaged checkpoint, with a warning for each newer one.

        :return: None if there is no checkpoint
        :raises CheckpointError: if all are damaged, or the newest undamaged one has another format
        """
        paths = self.checkpoints()
        for path, older in zip_longest(paths, paths[1:]):
            try:
                with path.open("rb") as file:
                    return Loaded(path, read_tree(file))
            except (DamagedCheckpointError, OSError) as error:
                if older is None:
                    raise DamagedCheckpointError(
                        f"no checkpoint in {self.path} can be read; the last one tried, {path}: {error}"
                    ) from error
                warnings.warn(
                    f"the checkpoint {path} cannot be read: {error}. Going back to {older}", UserWarning, stacklevel=2
                )
            except CheckpointError as error:
                raise CheckpointError(f"cannot use the checkpoint {path}: {error}") from None
        return None

    def acquire(self) -> None:
        """
        Lock the folder until :meth:`release` or the end of this process.

        :raises CheckpointError: if the folder cannot be created, or another run uses it
        """
        if self._lock is not None:
            return
        try:
            self._lock = try_lock(self.path / "lock")
        except OSError as error:
            raise CheckpointError(
                f"cannot keep checkpoints in {self.path}: {error}; give the run a folder that it may write to"
            ) from error
        if self._lock is None:
            raise CheckpointError(
                f"another run writes checkpoints to {self.path}; wait for its end, or give this run a folder of its own"
            )

    def release(self) -> None:
        """Unlock the folder."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None
