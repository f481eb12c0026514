"""What the bits of a run depend on beside its settings."""

from __future__ import annotations

import platform
import warnings
from importlib.metadata import PackageNotFoundError, version

import torch as th


def software() -> dict[str, str]:
    """Versions and the number of threads."""
    return {
        "sb3_saf": _version("sb3-saf"),
        "stable_baselines3": _version("stable-baselines3"),
        "torch": th.__version__,
        "numpy": _version("numpy"),
        "processor": platform.machine(),
        "torch threads": str(th.get_num_threads()),
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:  # run from a checkout that was never installed
        return "0+unknown"


def warn_of_differences(saved: dict[str, str]) -> None:
    """Say what may change the last bits of the weights."""
    own = software()
    different = [f"{name} {saved.get(name)} there, {own[name]} here" for name in own if own[name] != saved.get(name)]
    if different:
        warnings.warn(
            f"the checkpoint was made under other conditions ({'; '.join(different)}): the run goes on, but its "
            "weights may differ from those of the undisturbed run",
            UserWarning,
            stacklevel=3,
        )
