"""Declaration of a suite, and errors for missing packages."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from fnmatch import fnmatchcase
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from typing import Any, Final, Literal

from packaging.requirements import Requirement

#: Reduction of the rewards of a team's agents to one number.
Reduction = Literal["sum", "mean"]

#: Maximum number of nearest names in a message.
_N_NEAREST: Final = 3


@dataclass(frozen=True)
class Suite:
    """
    A package of games for teams. Exactly one of ``game`` and ``vec_env`` is given; see :mod:`sb3_saf.suites`.

    :param name: part of an id before the slash
    :param title: one line
    :param requires: requirements in pip's format, the suite's own package first; as in the extra of ``setup.cfg``
    :param extra: extra of ``setup.cfg`` that installs them
    :param page: address of the package's documentation
    :param list_tasks: returns the names after the slash; only called if the package is installed, so it may import it
    :param examples: tasks shown by ``python -m sb3_saf.suites`` with agents and spaces
    :param game: makes one game: ``game(task, *, render_mode=None, **params)``
    :param vec_env: makes all games: ``vec_env(task, n_envs, seed, *, state=False, render_mode=None, **params)``
    :param competitive: patterns of tasks whose agents play against each other
    :param team_return: the suite's unit of returns: the sum over agents of their rewards, or the mean (if every agent
        receives the team's whole reward)
    :param team_reward: default reward for learning, see ``make_team_env``
    :param training_params: parameters of the games for training only, such as shaped rewards
    :param is_seeded: whether seeds determine its games
    :param module: module of the package, if it may be a source folder on ``PYTHONPATH`` instead of an installed package
    :param unavailable: why no version of the package works; such a suite has no games, only this message
    """

    name: str
    title: str
    requires: tuple[str, ...]
    extra: str
    page: str
    list_tasks: Callable[[], Sequence[str]]
    examples: tuple[str, ...]
    game: Callable[..., Any] | None = None
    vec_env: Callable[..., Any] | None = None
    competitive: tuple[str, ...] = ()
    team_return: Reduction = "sum"
    team_reward: Literal["given"] | Reduction = "given"
    training_params: tuple[str, ...] = ()
    is_seeded: bool = True
    module: str | None = None
    unavailable: str | None = None

    def __post_init__(self) -> None:
        ways = [self.game, self.vec_env, self.unavailable]
        assert sum(way is not None for way in ways) == 1, f"{self.name}: exactly one of game and vec_env"

    @property
    def requirements(self) -> tuple[Requirement, ...]:
        """Parsed requirements of this interpreter."""
        parsed = (Requirement(line) for line in self.requires)
        return tuple(one for one in parsed if one.marker is None or one.marker.evaluate())

    @property
    def pip_line(self) -> str:
        """Command that installs the suite, in a clone of this repository."""
        return f"pip install -e '.[{self.extra}]'"

    def installed_version(self) -> str | None:
        """Return the version of the suite's own package, None if it is not installed."""
        found = _version(self._package)
        return "of a source folder" if found is None and self._is_source_folder(self._package) else found

    @property
    def _package(self) -> str:
        return Requirement(self.requires[0]).name

    def _is_source_folder(self, package: str) -> bool:
        return package == self._package and self.module is not None and find_spec(self.module) is not None

    def problem(self) -> str | None:
        """Return why no game can be made, None if all requirements are installed."""
        if self.unavailable is not None:
            return self.unavailable
        if not self.requirements:
            return f"needs another version of Python: {'; '.join(self.requires)}"
        for requirement in self.requirements:
            found = _version(requirement.name)
            if found is None and self._is_source_folder(requirement.name):
                continue
            if found is None:
                return f"needs {requirement.name}, which is not installed: {self.pip_line}"
            if not requirement.specifier.contains(found, prereleases=True):
                return (
                    f"works with {requirement.name}{requirement.specifier}, got version {found}: "
                    f"pip install '{requirement.name}{requirement.specifier}'"
                )
        return None

    @cached_property
    def tasks(self) -> tuple[str, ...]:
        """
        Names after the slash.

        :raises ValueError: if the package is missing or has an unsupported version, with the install command
        """
        if (problem := self.problem()) is not None:
            raise ValueError(f"{self.name}/...: {problem}")
        return tuple(self.list_tasks())

    def is_competitive(self, task: str) -> bool:
        """Return whether the agents of a task play against each other."""
        return any(fnmatchcase(task, pattern) for pattern in self.competitive)

    def check_task(self, task: str) -> str:
        """
        Return the name of a task.

        :raises ValueError: if there is no such task, naming the nearest and the command that lists all
        """
        if task in self.tasks:
            return task
        near = get_close_matches(task, self.tasks, n=_N_NEAREST)
        shown = [f"{self.name}/{name}" for name in near or self.examples]
        raise ValueError(
            f"unknown task {f'{self.name}/{task}'!r}; "
            f"{'did you mean' if near else 'there are'} {', '.join(shown)}{'?' if near else ', ...'} "
            f"(python -m sb3_saf.suites {self.name} lists all {len(self.tasks)})"
        )


def modules_with_versions(package: str) -> list[str]:
    """Return the names of a package's modules that end with a version, such as ``simple_spread_v3``."""
    found = pkgutil.iter_modules(importlib.import_module(package).__path__)
    return [module.name for module in found if module.name[-1].isdigit()]


def parallel_env(package: str, task: str, *, render_mode: str | None = None, **params: Any) -> Any:
    """Make a game of one of these modules, named as in PettingZoo's packages."""
    return importlib.import_module(f"{package}.{task}").parallel_env(render_mode=render_mode, **params)


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None
