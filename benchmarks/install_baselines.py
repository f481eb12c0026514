"""
Create separate environments for baselines whose requirements conflict with this project's.

``python -m benchmarks.install_baselines`` creates them in the folder ``baselines`` of this virtual environment;
existing ones are kept. Failed installations are reported in one line and left out of the benchmarks.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from benchmarks.workers import INTERPRETERS

#: POGEMA pins Gymnasium, NumPy and pydantic itself; the other versions are those it was measured with.
POGEMA = ("pogema==1.4.0", "gymnasium==0.28.1", "numpy==1.26.4", "pydantic==1.9.1")
#: Imports of PufferLib's environments. Its package requires a dozen more, for training.
PUFFERLIB_NEEDS = ("numpy==1.26.4", "gymnasium==0.29.1", "gym==0.23.0")
PUFFERLIB = "pufferlib==3.0.0"
#: The same optimisation as its own build.
COMPILE = (
    "cc",
    "-shared",
    "-fPIC",
    "-O2",
    "-flto",
    "-fwrapv",
    "-DPLATFORM_DESKTOP",
    "-Wno-implicit-function-declaration",
)


def run(*command: str | Path, **variables: str) -> str:
    """
    Run a command.

    :param variables: added to the environment
    :return: its output
    :raises RuntimeError: if it fails, with the last line that contains "error"
    """
    result = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **variables})
    if result.returncode:
        raise RuntimeError(f"{Path(command[0]).name}: {last_word(result.stderr or result.stdout)}")
    return result.stdout


def last_word(output: str) -> str:
    """Return the last line that contains "error", else the last line."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    return ([line for line in lines if "error" in line.lower()] or lines or ["no message"])[-1]


def new_interpreter(folder: Path, *requirements: str) -> Path:
    """
    Create a virtual environment.

    :param folder: its folder
    :return: its interpreter
    """
    run(sys.executable, "-m", "venv", folder)
    python = folder / "bin" / "python"
    # gym 0.23 is built from source, with these two and an old setuptools.
    run(python, "-m", "pip", "install", "--quiet", "setuptools==80.9.0", "wheel==0.45.1")
    run(python, "-m", "pip", "install", "--quiet", "--no-build-isolation", *requirements)
    return python


def install_pogema(folder: Path) -> None:
    """Install POGEMA from its wheel."""
    new_interpreter(folder, *POGEMA)


def install_pufferlib(folder: Path) -> None:
    """
    Build one of PufferLib's environments from the source package.

    Its own build downloads raylib for the web and Box2D from outside the package registry and compiles thirty
    environments that are not needed here.
    """
    python = new_interpreter(folder, *PUFFERLIB_NEEDS)
    source = _pufferlib_source(folder)
    headers = run(python, "-c", "import numpy, sysconfig; print(numpy.get_include(), sysconfig.get_path('include'))")
    suffix = run(python, "-c", "import sysconfig; print(sysconfig.get_config_var('EXT_SUFFIX'))").strip()
    environment = source / "pufferlib" / "ocean" / "trash_pickup"
    raylib = source / "raylib-5.5_linux_amd64"
    includes = [f"-I{path}" for path in (*headers.split(), raylib / "include")]
    files = [environment / "binding.c", raylib / "lib" / "libraylib.a"]
    run(*COMPILE, *includes, *files, "-lm", "-lpthread", "-ldl", "-o", environment / f"binding{suffix}")
    packages = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    (packages / "pufferlib.pth").write_text(f"{source}\n")


def _pufferlib_source(folder: Path) -> Path:
    """Unpack the source with pip, whose next step, reading the package's metadata, fails (see above)."""
    with tempfile.TemporaryDirectory() as downloads:
        command = [
            sys.executable,
            "-m",
            "pip",
            "download",
            "--quiet",
            "--no-deps",
            "--no-build-isolation",
            "--no-clean",
        ]
        command += ["--no-binary", "pufferlib", "--dest", downloads, PUFFERLIB]
        # NO_OCEAN: do not try to download the rest.
        variables = {"TMPDIR": downloads, "NO_OCEAN": "1", "NO_TRAIN": "1"}
        result = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **variables})
        found = list(Path(downloads).glob("*/pufferlib_*/pufferlib/ocean"))
        if not found:
            raise RuntimeError(f"pip: no source of {PUFFERLIB}: {last_word(result.stderr)}")
        return Path(shutil.move(found[0].parents[1], folder / "source"))


def main() -> None:
    """Create missing environments; remove those whose installation was interrupted or failed."""
    programs: dict[str, Callable[[Path], None]] = {"pogema": install_pogema, "pufferlib": install_pufferlib}
    for name, install in programs.items():
        folder = INTERPRETERS / name
        if (folder / ".installed").exists():
            continue
        shutil.rmtree(folder, ignore_errors=True)
        print(f"== {name}, into {folder}", flush=True)
        try:
            install(folder)
            (folder / ".installed").touch()
        except (OSError, RuntimeError) as error:
            shutil.rmtree(folder, ignore_errors=True)
            print(f"   not installed: {error}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
