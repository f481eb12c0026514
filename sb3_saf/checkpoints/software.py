"""Versions and hardware that the last bits of a run depend on."""

from __future__ import annotations

import platform
import warnings

import numpy as np
import stable_baselines3
import torch as th

from sb3_saf.checkpoints.checks import check_text, refused
from sb3_saf.checkpoints.data import Tree


def software() -> dict[str, str]:
    """Return versions and the number of threads."""
    from sb3_saf import __version__  # the package imports this module

    return {
        "sb3_saf": __version__,
        "stable_baselines3": stable_baselines3.__version__,
        "torch": th.__version__,
        "numpy": np.__version__,
        "processor": platform.machine(),
        "torch threads": str(th.get_num_threads()),
    }


def check_software(saved: Tree) -> None:
    """Check that a checkpoint names versions as :func:`software` does."""
    if not isinstance(saved, dict):
        raise refused("the versions of software", "a dict", repr(saved)[:80])
    for name, value in saved.items():
        check_text(name, "the name of a software")
        check_text(value, f"the version of {name}")


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
