"""Packaging: what is installed, with which versions, what the first commands find, what an import changes."""

from __future__ import annotations

import ast
import configparser
import importlib
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("hecogrid_envs", "sb3_saf", "zoo_configs")
#: Files that determine the sources of software.
INSTALL_FILES = ("setup.cfg", "pyproject.toml", "constraints.txt", "Makefile", ".ci/run")


def _requirements(lines: str) -> list[Requirement]:
    stripped = (line.partition("#")[0].strip() for line in lines.splitlines())
    return [Requirement(line) for line in stripped if line]


def _setup_cfg() -> configparser.ConfigParser:
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg", encoding="utf-8")
    return config


def _declared() -> list[tuple[str, Requirement]]:
    config = _setup_cfg()
    groups = {"install_requires": config["options"]["install_requires"], **config["options.extras_require"]}
    declared = [(group, requirement) for group, lines in groups.items() for requirement in _requirements(lines)]
    return [(group, requirement) for group, requirement in declared if requirement.name != config["metadata"]["name"]]


def _pins() -> list[Requirement]:
    return _requirements((ROOT / "constraints.txt").read_text(encoding="utf-8"))


@pytest.mark.parametrize(("group", "requirement"), _declared(), ids=lambda value: str(value))
def test_every_declared_dependency_is_pinned_inside_its_range(group: str, requirement: Requirement) -> None:
    pins = [pin for pin in _pins() if canonicalize_name(pin.name) == canonicalize_name(requirement.name)]
    assert pins, f"{requirement.name} ({group}) is missing in constraints.txt"
    for pin in pins:
        (specifier,) = pin.specifier
        assert specifier.version in requirement.specifier


def _third_party_imports() -> set[str]:
    """Return top-level modules that our packages import anywhere, except Python's and ours."""
    names: set[str] = set()
    for path in (path for package in PACKAGES for path in (ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names.add(node.module.partition(".")[0])
    return names - set(sys.stdlib_module_names) - set(PACKAGES)


def test_every_import_is_declared() -> None:
    declared = {canonicalize_name(requirement.name) for _, requirement in _declared()}
    distributions = metadata.packages_distributions()
    undeclared = {
        module
        for module in _third_party_imports()
        if declared.isdisjoint(map(canonicalize_name, distributions.get(module, [module])))
    }
    assert undeclared == set()


def test_constraints_are_exact_and_name_each_version_once_per_python() -> None:
    pins = _pins()
    assert all(re.fullmatch(r"==[\w.]+", str(pin.specifier)) and not pin.url for pin in pins)
    for python in ("3.10", "3.11", "3.12", "3.13"):
        environment = {"python_version": python}
        names = [canonicalize_name(pin.name) for pin in pins if not pin.marker or pin.marker.evaluate(environment)]
        assert sorted(names) == sorted(set(names))


def test_installed_versions_are_the_pinned_ones() -> None:
    applicable = [pin for pin in _pins() if not pin.marker or pin.marker.evaluate()]
    for pin in applicable:
        try:
            installed = metadata.version(pin.name)
        except metadata.PackageNotFoundError:
            continue  # of an extra that is not installed here
        if pin.name != "pip":  # may be newer: pip installs, but is not used
            assert installed in pin.specifier, f"{pin.name} {installed} is installed, constraints.txt says {pin}"


def test_version_is_written_once() -> None:
    version = _setup_cfg()["metadata"]["version"]
    assert metadata.version("sb3-saf") == version
    for package in PACKAGES:
        assert getattr(importlib.import_module(package), "__version__", version) == version


def _modules_after(*statements: str) -> list[set[str]]:
    """Return the top-level modules loaded by a new interpreter after each statement."""
    code = "import sys\n" + "\n".join(
        f"{one}\nprint(*{{n.partition('.')[0] for n in sys.modules}})" for one in statements
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return [set(line.split()) for line in result.stdout.splitlines()]


def test_the_game_needs_neither_torch_nor_stable_baselines() -> None:
    (modules,) = _modules_after("import hecogrid_envs.rendering, hecogrid_envs.state, hecogrid_envs.play")
    assert "hecogrid_envs" in modules
    learning = {"torch", "stable_baselines3", "supersuit", "sb3_contrib", "sb3_saf", "tensorboard"}
    assert modules.isdisjoint({*learning, "pygame", "PIL"})


def test_the_learning_needs_no_pictures_and_settings_need_neither_rl_zoo_nor_optuna() -> None:
    learning, settings = _modules_after("import sb3_saf", "import sb3_saf.training.settings")
    assert "stable_baselines3" in learning
    assert learning.isdisjoint({"matplotlib", "pygame", "rl_zoo3", "ray"})
    assert settings.isdisjoint({"rl_zoo3", "optuna", "matplotlib", "pandas"})


@pytest.mark.parametrize("name", INSTALL_FILES)
def test_no_hosts_indexes_or_machine_paths(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    found = re.findall(
        r"\w+://\S+|--(?:extra-)?index-url|--find-links|--trusted-host|/(?:home|root|opt|tmp|work)/", text
    )
    assert found == []


def test_ci_runs_the_check_target() -> None:
    script = ROOT / ".ci" / "run"
    assert script.stat().st_mode & 0o111
    assert script.read_text(encoding="utf-8").splitlines()[-1] == "exec make check"


def test_workflows_call_make_targets_on_the_declared_versions_of_python() -> None:
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "tests.yml").read_text(encoding="utf-8"))["jobs"]
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    called = {target for command in commands if command.startswith("make ") for target in command.split()[1:]}
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert {"test", "docs", "notebooks", "lint", "types"} <= called <= targets
    classifiers = _setup_cfg()["metadata"]["classifiers"]
    assert jobs["tests"]["strategy"]["matrix"]["python"] == re.findall(r":: (3\.\d+)", classifiers)


# --- imports ----------------------------------------------------------------------------------------------------------


_SCRIPT = """
import importlib, pkgutil, sys
import sb3_contrib, stable_baselines3, supersuit

def modules():
    for package in (stable_baselines3, sb3_contrib, supersuit):
        for info in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            try:
                importlib.import_module(info.name)
            except ImportError:  # an optional dependency
                pass
    return {name: module for name, module in list(sys.modules.items()) if name.split(".")[0] in NAMES}

NAMES = {"stable_baselines3", "sb3_contrib", "supersuit"}

def contents():
    found = {}
    for name, module in modules().items():
        for key, value in vars(module).items():
            found[name, key] = id(value)
            if isinstance(value, type) and value.__module__.split(".")[0] in NAMES:
                for attribute, member in vars(value).items():
                    kept = dict(member) if isinstance(member, dict) and attribute == "policy_aliases" else None
                    found[name, key, attribute] = kept if kept is not None else id(member)
    return found

modules()
before = contents()
IMPORTS
after = contents()
assert len(before) > 5000 and before.keys() == after.keys(), sorted(before.keys() ^ after.keys())
changed = {key for key in before if before[key] != after[key] and key[-1] not in ("_abc_impl", "__warningregistry__")}
assert {key[-1] for key in changed} == {"policy_aliases"}, changed
for key in changed:
    assert after[key].items() >= before[key].items(), key
print("same", len(before))
"""


def test_importing_changes_nothing_of_the_libraries() -> None:
    """Compare all modules and classes of SB3, sb3-contrib and SuperSuit before and after, in a separate process."""
    script = _SCRIPT.replace("IMPORTS", "import sb3_saf, hecogrid_envs")
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.startswith("same")
