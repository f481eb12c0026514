"""Errors that more than one part of the package raises."""

from __future__ import annotations


class ExportError(ValueError):
    """A file that cannot be trusted or understood, or a model that cannot be exported."""


class NonFiniteError(ValueError):
    """NaN or infinity where learning from it would ruin the model."""


class CheckpointError(ValueError):
    """A checkpoint that cannot be written, read, or used with the given model."""


class DamagedCheckpointError(CheckpointError):
    """A file that is cut short or changed: its checksum does not match."""


class UnknownFormatError(CheckpointError):
    """An undamaged checkpoint in a format that this version does not read."""
