"""Errors that more than one part of the package raises."""

from __future__ import annotations


class NonFiniteError(ValueError):
    """NaN or infinity where learning from it would ruin the model."""
