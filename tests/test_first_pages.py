"""
The first pages as a new user follows them: every command on them runs as printed.

They run in order, in a folder like a fresh clone, with no environment activated until the README's ``source`` does it.
``tests/test_wheel.py`` runs programs as the README says for those who activate none, and what they print;
``tests/test_docs.py`` runs all blocks of Python.
"""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest
from stable_baselines3 import PPO

from tests.environments import make_environment, shell, start

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("README.md", "docs/index.md", "docs/reference/installation.md", "docs/reference/own_environment.md")
#: Make the commands small: set where make and pip take them from the environment, appended to the others.
SETTINGS = {
    "TRAIN_ARGS": "--game-steps 800",
    "PYTEST_ARGS": "-k version_is_written_once tests/test_packaging.py",
    "JOBS": "0",
    "PIP_DRY_RUN": "1",
    "PIP_NO_DEPS": "1",
    "PIP_NO_INDEX": "1",
    "PIP_NO_BUILD_ISOLATION": "0",  # pip's way to say that there is none
}
APPENDED = {
    "python -m sb3_saf.train": "--size smoke -n 40",
    "python -m sb3_saf.enjoy": "--episodes 2 --env-kwargs max_cycles:5",
    "python -m sb3_saf.replay": "--env-kwargs max_cycles:5",
}
#: What `make check` runs anyhow or what installs from a network: shown by make, not run.
SHOWN_ONLY = {"make docs", "make bench"}
#: Runs until its window is closed.
ENDLESS = "python -m hecogrid_envs.play"


def commands() -> list[str]:
    """Return the commands on the pages, in order, each once."""
    printed: list[str] = []
    for page in PAGES:
        text = (ROOT / page).read_text(encoding="utf-8")
        for block, span in re.findall(r"^```sh\n(.*?)^```$|`([^`\n]+)`", text, re.MULTILINE | re.DOTALL):
            printed += [line.split("  #")[0].strip() for line in (block or span).splitlines()]
    starts = ("python ", "make ", "pip ", "source ")
    return [command for command in dict.fromkeys(printed) if command.startswith(starts)]


def small(command: str, clone: Path) -> str:
    """Return the command as the test runs it."""
    if command in SHOWN_ONLY:
        return command.replace("make", "make --dry-run")
    command = re.sub(r"git\+https://[^\"]+", clone.as_uri(), command)
    return " ".join([command, *(more for program, more in APPENDED.items() if command.startswith(program))])


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder like a fresh clone, whose .venv is installed."""
    folder = tmp_path_factory.mktemp("clone")
    for path in ROOT.iterdir():
        if path.name[0] != "." and path.name not in ("build", "dist", "logs", "runs") and path.suffix != ".egg-info":
            (folder / path.name).symlink_to(path)
    packages = make_environment(folder)
    (packages / "sb3_saf.pth").write_text(str(folder))
    for name in ("bin/pip", ".training", ".installed"):
        (folder / ".venv" / name).write_text('#!/bin/sh\nexec "$(dirname "$0")/python" -m pip "$@"\n')
    (folder / ".venv" / "bin" / "pip").chmod(0o755)
    return folder


@pytest.mark.timeout(1200)
def test_every_command_of_the_first_pages_runs_as_printed(clone: Path) -> None:
    printed, activation = commands(), ""
    assert len(printed) >= 12 and printed[:3] == ["make train", "make test", "source .venv/bin/activate"]
    outputs: dict[str, str] = {}
    for command in printed:
        if command.startswith("source"):
            activation = f"{command} && "
        elif command.startswith(ENDLESS):
            stop_when_begun(command, clone, activation)
        else:
            outputs[command] = shell(small(command, clone), clone, activation, **SETTINGS)
    assert "1 passed" in outputs["make test"]
    assert len(list(clone.glob("logs/saf/TeamSupport-v0_1/TeamSupport-v0.zip"))) == 1
    for name in ("game.gif", "replay.html", "curves.png"):
        assert (clone / name).is_file(), name

    train = outputs["make train"]
    assert re.search(r"^  SAF +\d.*\n  random +\d", train, re.MULTILINE), train
    assert PPO.load(clone / "runs" / "quickstart" / "model.zip").num_timesteps == 800 * 5
    for name in ("model.zip", "learning_curve.png", "episode.gif", "replay.html", "tb"):
        assert f"runs/quickstart/{name}" in train and (clone / "runs" / "quickstart" / name).exists()
    (tensorboard,) = re.findall("TensorBoard +(.*)", train)
    stop_when_begun(tensorboard, clone)


def stop_when_begun(command: str, clone: Path, activation: str = "") -> None:
    """Start a window or a server, and press Ctrl-C when it says how it is used."""
    with start(command, clone, activation) as process:
        assert process.stdout is not None
        said = next((line for line in process.stdout if re.search("^keys:|http://", line)), None)
        process.send_signal(signal.SIGINT)
        process.stdout.read()
    assert said is not None and process.returncode in (0, -signal.SIGINT), command
