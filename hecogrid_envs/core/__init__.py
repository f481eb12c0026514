"""
Compiled kernels of the rule book: functions on arrays, no classes.

Numba keeps compiled code on disk and renews it when the file of a function changes. These kernels are compiled into one
another across files, so a change of any file must renew all of them; that is checked here, once per import.
"""

from __future__ import annotations

import contextlib
import hashlib
import sys
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]


def _fingerprint() -> str:
    digest = hashlib.sha256()
    for source in sorted([*_PACKAGE.glob("core/*.py"), _PACKAGE / "constants.py", _PACKAGE / "tiles.py"]):
        digest.update(source.read_bytes())
    return digest.hexdigest()


def _drop_stale_kernels() -> None:
    cache = _PACKAGE / "core" / "__pycache__"
    stamp = cache / "kernels.sha256"
    fingerprint = _fingerprint()
    # Without write access there is no cache beside the sources either.
    with contextlib.suppress(OSError):
        if stamp.exists() and stamp.read_text() == fingerprint:
            return
        for stale in [*cache.glob("*.nbi"), *cache.glob("*.nbc")]:
            stale.unlink(missing_ok=True)
        cache.mkdir(exist_ok=True)
        stamp.write_text(fingerprint)


def announce_compilation() -> None:
    """Say that the first call takes longer, where nothing compiled is on disk yet."""
    if not any((_PACKAGE / "core" / "__pycache__").glob("*.nbi")):
        print("hecogrid_envs: compiling the kernels, once on this machine (some seconds)", file=sys.stderr, flush=True)


_drop_stale_kernels()
