"""Kernels are compiled once, with a message, and again when any of their files changes."""

from __future__ import annotations

import os
import re
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
    package = shutil.copytree(PACKAGE, tmp_path / "hecogrid_envs", ignore=shutil.ignore_patterns("__pycache__"))
    edit(package / "core" / "play.py", r"(_key = sources).*?(?=\n    return play\n)", r"\1")  # compiles in a second
    edit(package / "batch.py", r"(_SECONDS_WITHOUT_A_WORD: Final) = [\d.]+", r"\1 = 0.0")
    assert start(package) == ("0", True)
    assert start(package)[0] == "1"
    edit(package / "tasks" / "team_support.py", r"\Z", "# Another condition.\n")
    assert start(package)[0] == "0"


def edit(path: Path, pattern: str, replacement: str) -> None:
    text, count = re.subn(pattern, replacement, path.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert count == 1
    path.write_text(text, encoding="utf-8")


LATER = """
import os
import subprocess
import sys
import warnings

with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    import hecogrid_envs
    import sb3_saf.networks.tanh
print(*(str(one.message) for one in caught if "NUMBA_CACHE_DIR" in str(one.message)), sep="\\n")
print(os.environ["NUMBA_CACHE_DIR"])
"""


def test_without_any_place_for_compiled_code_a_temporary_folder_is_used_and_named_once(tmp_path: Path) -> None:
    """Files where numba would make folders stand for folders that cannot be written, also by root."""
    for package in (PACKAGE, PACKAGE.parent / "sb3_saf"):
        copy = shutil.copytree(package, tmp_path / package.name, ignore=shutil.ignore_patterns("__pycache__"))
        for folder in [copy, *(path for path in copy.rglob("*") if path.is_dir())]:
            (folder / "__pycache__").touch()
    (tmp_path / "cache").touch()
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONSAFEPATH": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    environment |= {"XDG_CACHE_HOME": str(tmp_path / "cache"), "TMPDIR": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    command = [sys.executable, "-c", LATER]
    lines = subprocess.run(command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout
    message, place = lines.splitlines()
    assert place in message and not Path(place).exists()
