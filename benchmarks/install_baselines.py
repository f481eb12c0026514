"""
Interpreters of their own for baselines that ask for versions which this project does not work with.

``python -m benchmarks.install_baselines`` makes them in the folder ``baselines`` of this virtual environment; what is
there already stays. What cannot be installed is told in one line and left out of the benchmarks.
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

#: POGEMA pins Gymnasium, NumPy and pydantic itself; the rest is what it was measured with.
POGEMA = ("pogema==1.4.0", "gymnasium==0.28.1", "numpy==1.26.4", "pydantic==1.9.1")
#: What PufferLib's environments import. Its package asks for a dozen more, which train.
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
    :return: what it printed
    :raises RuntimeError: if it fails, with the last line that says "error"
    """
    result = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **variables})
    if result.returncode:
        raise RuntimeError(f"{Path(command[0]).name}: {last_word(result.stderr or result.stdout)}")
    return result.stdout


def last_word(output: str) -> str:
    """The last line that says "error", else the last."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    return ([line for line in lines if "error" in line.lower()] or lines or ["no message"])[-1]


def new_interpreter(folder: Path, *requirements: str) -> Path:
    """
    Make a virtual environment.

    :param folder: where
    :return: its interpreter
    """
    run(sys.executable, "-m", "venv", folder)
    python = folder / "bin" / "python"
    # gym 0.23 is built from source: its builder needs these two, and setuptools of its time.
    run(python, "-m", "pip", "install", "--quiet", "setuptools==80.9.0", "wheel==0.45.1")
    run(python, "-m", "pip", "install", "--quiet", "--no-build-isolation", *requirements)
    return python


def install_pogema(folder: Path) -> None:
    """From its wheel."""
    new_interpreter(folder, *POGEMA)


def install_pufferlib(folder: Path) -> None:
    """
    One of its environments from the source package, by hand.

    Its own build fetches raylib for the web and Box2D from outside the package registry and compiles thirty
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
    """Unpacked by pip, whose next step, asking the package for its metadata, fails: see above."""
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
        # NO_OCEAN: do not even try to fetch the rest.
        variables = {"TMPDIR": downloads, "NO_OCEAN": "1", "NO_TRAIN": "1"}
        result = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **variables})
        found = list(Path(downloads).glob("*/pufferlib_*/pufferlib/ocean"))
        if not found:
            raise RuntimeError(f"pip: no source of {PUFFERLIB}: {last_word(result.stderr)}")
        return Path(shutil.move(found[0].parents[1], folder / "source"))


def main() -> None:
    """Make what is not there; an interrupted or failed installation is taken away."""
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
