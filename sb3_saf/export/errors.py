"""The error of everything that reads or writes exported actors."""

from __future__ import annotations


class ExportError(ValueError):
    """A file that cannot be trusted or understood, or a model that cannot be exported."""
