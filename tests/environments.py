"""Virtual environments of tests, and commands in them as a user types them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import venv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

#: What an activated environment sets, and the options of the `make` that runs these tests.
_INHERITED: Final = ("VIRTUAL_ENV", "PYTHONPATH", "PYTHONHOME", "MAKEFLAGS", "MAKEOVERRIDES", "MFLAGS")


def make_environment(folder: Path) -> Path:
    """Make ``.venv`` in a folder, with the packages of this environment but ours, and return its site-packages."""
    venv.create(folder / ".venv", symlinks=True)
    (packages,) = (folder / ".venv").glob("lib/*/site-packages")
    (packages / "installed.pth").write_text("\n".join(path for path in sys.path if Path(path).name == "site-packages"))
    return packages


@contextmanager
def start(command: str, folder: Path, activation: str = "", **settings: str) -> Iterator[subprocess.Popen[str]]:
    """
    Start a command in a folder and wait for its end; what it prints is in ``stdout``. Errors and timeouts kill it.

    :param command: one program and its arguments
    :param folder: where it runs
    :param activation: what the shell runs before; by default no environment is active
    :param settings: environment variables
    """
    environment = {name: value for name, value in os.environ.items() if name not in _INHERITED}
    with subprocess.Popen(
        ["bash", "-c", f"{activation}exec {command}"],
        cwd=folder,
        env={**environment, "PATH": os.defpath, "PYTHONUNBUFFERED": "1", **settings},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        # As in a terminal: a background job, such as these tests may be, ignores Ctrl-C, and so would its children.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        try:
            yield process
        except BaseException:
            process.kill()
            raise


def shell(command: str, folder: Path, activation: str = "", **settings: str) -> str:
    """Run a command as :func:`start` does, which must succeed, and return what it prints."""
    with start(command, folder, activation, **settings) as process:
        printed, _ = process.communicate()
    assert process.returncode == 0, f"{command}\n{printed}"
    return printed
