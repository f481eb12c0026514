"""The wheel built by ``pip wheel``: its content, and that it runs without the checkout."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from email.message import Message
from email.parser import Parser
from pathlib import Path
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("hecogrid_envs", "sb3_saf", "zoo_configs")
SOURCES = (*PACKAGES, "setup.cfg", "pyproject.toml", "README.md", "LICENSE")


def call(arguments: Sequence[str | Path], folder: Path, **environment: str) -> str:
    """Run a command, which must succeed, and return its output."""
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, env=os.environ | environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel from a copy, because building leaves folders beside the sources."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, source)
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--disable-pip-version-check"]
    call(["-m", "pip", "wheel", *options, "--wheel-dir", target, source], source)
    (path,) = target.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def names(wheel: Path) -> list[str]:
    with ZipFile(wheel) as archive:
        return archive.namelist()


@pytest.fixture(scope="module")
def metadata(wheel: Path) -> Message:
    with ZipFile(wheel) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        return Parser().parsestr(archive.read(name).decode())


def test_everything_that_belongs_to_the_packages_is_inside(names: list[str]) -> None:
    files = [path for package in PACKAGES for path in (ROOT / package).rglob("*") if path.suffix in (".py", ".yml")]
    assert len(files) > 100
    expected = {path.relative_to(ROOT).as_posix() for path in files}
    assert expected | {f"{package}/py.typed" for package in PACKAGES} <= set(names)


def test_nothing_else_is_inside(names: list[str], wheel: Path) -> None:
    assert {name.partition("/")[0] for name in names} == {*PACKAGES, "-".join(wheel.name.split("-")[:2]) + ".dist-info"}


def test_the_licence_is_inside(names: list[str], wheel: Path, metadata: Message) -> None:
    (name,) = [name for name in names if name.endswith("LICENSE")]
    with ZipFile(wheel) as archive:
        assert archive.read(name) == (ROOT / "LICENSE").read_bytes()
    assert (metadata["License"], metadata["License-File"]) == ("MIT", "LICENSE")


def test_metadata_show_the_readme_and_the_version_of_the_changelog(metadata: Message) -> None:
    assert str(metadata.get_payload()).strip() == (ROOT / "README.md").read_text(encoding="utf-8").strip()
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = next(line for line in changelog.splitlines() if line.startswith("## "))
    assert newest.startswith(f"## {metadata['Version']},")


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the wheel's content; its dependencies come from this environment."""
    folder = tmp_path_factory.mktemp("installed")
    options = ["--no-deps", "--no-index", "--quiet", "--disable-pip-version-check", "--no-warn-conflicts"]
    call(["-m", "pip", "install", *options, "--target", folder, wheel], folder)
    take_over_compiled_kernels(folder)
    return folder


def take_over_compiled_kernels(folder: Path) -> None:
    """Reuse kernels compiled in the checkout; numba accepts them if the source is the same."""
    for path in (path for package in PACKAGES for path in (ROOT / package).rglob("__pycache__/*")):
        if path.suffix in (".nbi", ".nbc"):
            copy = folder / path.relative_to(ROOT)
            copy.parent.mkdir(exist_ok=True)
            shutil.copy(path, copy)


def test_its_commands_run_outside_the_checkout(installed: Path, tmp_path: Path) -> None:
    code = "import zoo_configs, hecogrid_envs; print(zoo_configs.__file__, hecogrid_envs.__file__)"
    files = call(["-c", code], tmp_path, PYTHONPATH=str(installed)).split()
    assert [Path(file).parents[1] for file in files] == [installed] * 2
    options = ["--algo", "saf", "--env", "TeamSupport-v0", "--size", "smoke", "-f", "logs", "--eval-freq", "-1"]
    call(["-m", "sb3_saf.train", *options], tmp_path, PYTHONPATH=str(installed))
    assert (tmp_path / "logs" / "saf" / "TeamSupport-v0_1" / "TeamSupport-v0.zip").is_file()
