"""The errors of checkpoints."""

from __future__ import annotations


class CheckpointError(ValueError):
    """A checkpoint that cannot be written, read, or used with the given model."""


class DamagedCheckpointError(CheckpointError):
    """A file that is cut short or changed: its checksum does not match."""


class UnknownFormatError(CheckpointError):
    """An undamaged checkpoint in a format that this version does not read."""
