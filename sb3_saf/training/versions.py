"""What a result was made with."""

from __future__ import annotations

import platform
from importlib import metadata
from typing import Final

_PACKAGES: Final = (
    "sb3-saf",
    "stable-baselines3",
    "sb3-contrib",
    "rl_zoo3",
    "optuna",
    "torch",
    "numpy",
    "numba",
    "gymnasium",
    "pettingzoo",
    "supersuit",
)


def software_versions() -> dict[str, str]:
    """Versions of Python, the system, and every package that can change a result; those not installed are left out."""
    versions = {"python": platform.python_version(), "system": platform.platform()}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return versions
