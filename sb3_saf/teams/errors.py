"""Errors shared by several parts of the package."""

from __future__ import annotations


class ExportError(ValueError):
    """Raised for an invalid or untrusted file, or a model that cannot be exported."""


class SettingsError(ValueError):
    """Raised for settings that do not fit the model."""


class NonFiniteError(ValueError):
    """Raised for NaN or infinity in training data, losses or gradients."""


class CheckpointError(ValueError):
    """Raised for a checkpoint that cannot be written, read, or used with the given model."""


class DamagedCheckpointError(CheckpointError):
    """Raised for a truncated or changed file, whose checksum does not match."""
