"""Compiled functions, and a place on disk for them."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
import warnings
from collections.abc import Callable
from typing import Any

from numba import config, njit


def cached(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """
    Compile a function as ``numba.njit(nogil=True, **options)`` does, and keep the code on disk.

    Where neither the package's folder nor the user's cache can be written, it is kept in a temporary folder, as
    ``hecogrid_envs.core.jit`` does for the games, which this package does not import.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return njit(cache=True, nogil=True, **options)(function)
        except RuntimeError as error:
            if "no locator" not in str(error):
                raise
            folder = tempfile.mkdtemp(prefix="numba-")
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
            os.environ["NUMBA_CACHE_DIR"] = folder  # of processes that this one starts
            config.CACHE_DIR = folder  # type: ignore[attr-defined]
            warnings.warn(
                f"neither the package's folder nor the user's cache can be written: compiled code is kept in {folder} "
                "until this process ends; set NUMBA_CACHE_DIR to a folder that can be written, to compile only once",
                UserWarning,
                stacklevel=2,
            )
            return njit(cache=True, nogil=True, **options)(function)

    return decorate
