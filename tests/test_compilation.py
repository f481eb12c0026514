"""Kernels are compiled once, with a message, and again when any of their files changes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import hecogrid_envs

PACKAGE = Path(hecogrid_envs.__file__).parent
CODE = """
import hecogrid_envs
from hecogrid_envs.core import play
hecogrid_envs.GameBatch("TeamSupport", hecogrid_envs.HECOGridParams())
print(sum(play.play.stats.cache_hits.values()))
"""


def start(package: Path) -> tuple[str, bool]:
    """Count in a new process how often compiled code was loaded from disk, and whether compiling was announced."""
    environment = {**os.environ, "PYTHONPATH": str(package.parent), "PYTHONSAFEPATH": "1"}
    environment.pop("NUMBA_CACHE_DIR", None)
    command = [sys.executable, "-c", CODE]  # before Python 3.11 the working directory comes first
    process = subprocess.run(command, cwd=package.parent, env=environment, capture_output=True, text=True, check=True)
    return process.stdout.strip(), "once on this machine they are compiled" in process.stderr


def test_kernels_are_compiled_once_and_anew_after_a_change(tmp_path: Path) -> None:
    package = shutil.copytree(PACKAGE, tmp_path / "hecogrid_envs")
    start(package)  # loads what other tests have compiled; where there is none, compiles
    with (package / "tasks" / "team_support.py").open("a") as file:
        file.write("# Another condition.\n")
    assert start(package) == ("0", True)
    assert start(package)[0] == "1"
