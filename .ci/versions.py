"""
Run the tests with the oldest or the newest releases that setup.cfg allows.

``python .ci/versions.py oldest`` and ``python .ci/versions.py newest`` make a virtual environment of their own under
``build/`` (or ``--folder``) and install the package there with the libraries that it stands on (``LIBRARIES``) at one
end of their ranges; everything else is as in constraints.txt. They print the versions and run the tests. Further
arguments go to pytest::

    python .ci/versions.py oldest --python python3.10 -x -k policies
"""

from __future__ import annotations

import argparse
import configparser
import os
import subprocess
import sys
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
#: The libraries whose releases differ between the two ends.
LIBRARIES: Final = (
    *("gymnasium", "numba", "numpy", "pettingzoo", "sb3-contrib", "stable-baselines3", "supersuit", "torch"),
)
#: What follows from that choice, and so is not pinned.
FOLLOWING: Final = (
    *("huggingface-hub", "huggingface-sb3", "llvmlite", "ml-dtypes", "rl-zoo3", "scipy", "setuptools", "shimmy"),
    *("sympy", "triton"),
)
EXTRAS: Final = "export,render,zoo,dev"


def lower_bounds() -> dict[str, str]:
    """Return the oldest release of each library that setup.cfg allows."""
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg", encoding="utf-8")
    bounds = {}
    for line in config["options"]["install_requires"].splitlines():
        name, separator, rest = line.partition(">=")
        if separator and name.strip() in LIBRARIES:
            bounds[name.strip()] = rest.split(",")[0].strip()
    missing = set(LIBRARIES) - set(bounds)
    if missing:
        raise SystemExit(f"setup.cfg has no lower bound of the form name>=version for {', '.join(sorted(missing))}")
    return bounds


def constraints() -> str:
    """Return the lines of constraints.txt, less those that the choice of releases decides."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    free = {*LIBRARIES, *FOLLOWING}
    return "\n".join(line for line in lines if _normal(line) not in free) + "\n"


def _normal(requirement: str) -> str:
    """Return the name in a line ``name==version`` as package indexes compare it."""
    return requirement.partition("==")[0].strip().lower().replace("_", "-")


def install(end: str, folder: Path, interpreter: str) -> Path:
    """
    Install into a virtual environment.

    :param end: ``"oldest"`` or ``"newest"``
    :param folder: of the environment
    :param interpreter: that it is made with
    :return: its Python
    """
    subprocess.run([interpreter, "-m", "venv", folder], check=True)
    python = folder / "bin" / "python"
    pins = folder / "constraints.txt"
    pins.write_text(constraints(), encoding="utf-8")
    requirements = (
        [f"{name}=={bound}" for name, bound in lower_bounds().items()] if end == "oldest" else list(LIBRARIES)
    )
    upgrade = [] if end == "oldest" else ["--upgrade"]
    command: list[str | Path] = [
        python,
        "-m",
        "pip",
        "install",
        "--quiet",
        *upgrade,
        "-c",
        pins,
        "-e",
        f".[{EXTRAS}]",
        *requirements,
    ]
    subprocess.run(command, cwd=ROOT, check=True)
    return python


def main() -> None:
    """Install, print versions, test."""
    parser = argparse.ArgumentParser(prog="python .ci/versions.py", description=__doc__)
    parser.add_argument("end", choices=["oldest", "newest"])
    parser.add_argument("--python", default=sys.executable, help="interpreter, this one by default")
    parser.add_argument("--folder", type=Path, help="of the virtual environment")
    options, pytest_arguments = parser.parse_known_args()
    folder = options.folder or ROOT / "build" / f"venv-{options.end}"
    python = install(options.end, folder, options.python)
    listing: list[str | Path] = [python, "-m", "pip", "list", "--format=freeze"]
    listed = subprocess.run(listing, capture_output=True, text=True, check=True)
    names = {*LIBRARIES, *FOLLOWING}
    print(subprocess.run([python, "--version"], capture_output=True, text=True, check=True).stdout.strip())
    print(*(line for line in listed.stdout.splitlines() if _normal(line) in names), sep="\n")
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "numba")}
    tests: list[str | Path] = [python, "-m", "pytest", "-q", "-n", "2", "--dist", "loadscope"]
    tests += pytest_arguments
    sys.exit(subprocess.run(tests, cwd=ROOT, env=environment, check=False).returncode)


if __name__ == "__main__":
    main()
