"""The sdist, the wheel built from it as ``python -m build`` does, and what its programs print, run as printed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Sequence
from email.message import Message
from email.parser import Parser
from pathlib import Path
from zipfile import ZipFile

import pytest

from tests.environments import make_environment, shell

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("hecogrid_envs", "sb3_saf", "zoo_configs")
METADATA = (
    "CHANGELOG.md",
    "CITATION.cff",
    "LICENSE",
    "README.md",
    "constraints.txt",
    "pyproject.toml",
    "setup.cfg",
    "setup.py",
)


OFFLINE = ("--no-deps", "--no-index", "--quiet", "--disable-pip-version-check")


def call(arguments: Sequence[str | Path], folder: Path, **environment: str) -> str:
    """Run a command, which must succeed, and return its output."""
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, env=os.environ | environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the sdist from a copy, because building leaves folders beside the sources."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("sdist")
    for name in (*PACKAGES, "tests"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in (*METADATA, "MANIFEST.in"):
        shutil.copy(ROOT / name, source)
    call(["-c", f"from setuptools import build_meta; build_meta.build_sdist({str(target)!r})"], source)
    (path,) = target.glob("*.tar.gz")
    return path


@pytest.fixture(scope="module")
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel from the sdist, which must have all that it needs."""
    target = tmp_path_factory.mktemp("wheel")
    call(["-m", "pip", "wheel", *OFFLINE, "--no-build-isolation", "--wheel-dir", target, sdist], target)
    (path,) = target.glob("*.whl")
    return path


def test_sdist_has_the_packages_and_no_tests(sdist: Path) -> None:
    with tarfile.open(sdist) as archive:
        paths = [name.split("/")[1:] for name in archive.getnames()]
    others = {"MANIFEST.in", "PKG-INFO", "sb3_saf.egg-info"}
    assert {path[0] for path in paths if path} == {*PACKAGES, *METADATA, *others}


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


def test_metadata_show_the_readme_with_links_into_the_repository_that_it_names(metadata: Message) -> None:
    urls = dict(url.split(", ") for url in metadata.get_all("Project-URL", []))
    shown, readme = str(metadata.get_payload()), (ROOT / "README.md").read_text(encoding="utf-8")
    assert f"git+{urls['Repository']}" in readme
    assert not re.search(r"\]\((?!https?:|#)", shown)
    assert re.sub(rf"{urls['Repository']}/(blob|raw)/main/", "", shown).strip() == readme.strip()


def test_version_is_the_newest_of_the_changelog(metadata: Message) -> None:
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = next(line for line in changelog.splitlines() if line.startswith("## "))
    assert newest.startswith(f"## {metadata['Version']},")


@pytest.fixture(scope="module")
def folder(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder whose .venv has the wheel; its dependencies come from this environment."""
    folder = tmp_path_factory.mktemp("installed")
    packages = make_environment(folder)
    call(["-m", "pip", "install", *OFFLINE, "--no-warn-conflicts", "--target", packages, wheel], folder)
    for path in (path for package in PACKAGES for path in (ROOT / package).rglob("__pycache__/*")):
        if path.suffix in (".nbi", ".nbc"):  # compiled kernels, which numba accepts if the source is the same
            copy = packages / path.relative_to(ROOT)
            copy.parent.mkdir(exist_ok=True)
            shutil.copy(path, copy)
    return folder


@pytest.mark.timeout(1200)
def test_programs_and_the_commands_that_they_print_run_without_activation(folder: Path) -> None:
    """One cell of an experiment, of 40 game steps; workers find the package, too."""
    run = ".venv/bin/python -m sb3_saf.experiments run coordination --size smoke -n 40 --episodes 2"
    printed = shell(f"{run} --methods ippo --tasks TeamSupport --levels 1 --seeds 0", folder)
    shell(re.findall("next: (.*)", printed)[0], folder)
    assert (folder / "runs" / "experiments" / "smoke" / "coordination" / "report.md").is_file()
