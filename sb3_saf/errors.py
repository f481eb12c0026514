"""Errors that more than one part of the package raises."""

from __future__ import annotations


class ExportError(ValueError):
    """A file that cannot be trusted or understood, or a model that cannot be exported."""


class NonFiniteError(ValueError):
    """NaN or infinity where learning from it would ruin the model."""
