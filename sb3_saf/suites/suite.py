"""Declaration of a suite, and errors for missing packages."""

from __future__ import annotations

import importlib
import pkgutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
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
N_NEAREST: Final = 3


@dataclass(frozen=True)
class Suite:
    """
    A package of games for teams, with ``game``, ``vec_env`` or both; see :mod:`sb3_saf.suites`.

    :param name: part of an id before the slash
    :param title: one line
    :param requires: requirements in pip's format, the suite's own package first; as in the extra of ``setup.cfg``
    :param extra: extra of ``setup.cfg`` that installs them; empty for packages of this repository
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
    :param defaults: parameters of the games in ``make_team_env`` and the commands where they differ from the package's
    :param complete: ``complete(task, params)`` checks parameters without making a game, and returns them with all
        others of the game, ``n_agents`` among them; None if a game must be made to know them
    :param level_params: parameters that name a level in logs; empty for all that are given
    :param always_active: whether all agents take part from beginning to end, so that rows need no ``"active"``
    :param is_drawn_from_state: whether games have ``grid_scene()`` and pictures at no cost (see ``inspection.games``)
    :param is_seeded: whether seeds determine its games
    :param module: module of the package, if it may be a source folder on ``PYTHONPATH`` instead of an installed package
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
    defaults: Mapping[str, Any] = field(default_factory=dict)
    complete: Callable[[str, Mapping[str, Any]], dict[str, Any]] | None = None
    level_params: tuple[str, ...] = ()
    always_active: bool = False
    is_drawn_from_state: bool = False
    is_seeded: bool = True
    module: str | None = None

    def __post_init__(self) -> None:
        assert self.game is not None or self.vec_env is not None, f"{self.name}: neither game nor vec_env"

    @property
    def requirements(self) -> tuple[Requirement, ...]:
        """Parsed requirements of this interpreter."""
        parsed = (Requirement(line) for line in self.requires)
        return tuple(one for one in parsed if one.marker is None or one.marker.evaluate())

    @property
    def pip_line(self) -> str:
        """Command that installs the suite, in a clone of this repository."""
        return f"pip install 'sb3-saf[{self.extra}]'"

    def installed_version(self) -> str | None:
        """Return the version of the suite's own package, None if it is not installed."""
        installed = _version(self._package)
        return "of a source folder" if installed is None and self._is_source_folder(self._package) else installed

    @property
    def _package(self) -> str:
        return Requirement(self.requires[0]).name

    def _is_source_folder(self, package: str) -> bool:
        return package == self._package and self.module is not None and find_spec(self.module) is not None

    def problem(self) -> str | None:
        """Return why no game can be made, None if all requirements are installed."""
        if not self.requirements:
            return f"needs another version of Python: {'; '.join(self.requires)}"
        for requirement in self.requirements:
            installed = _version(requirement.name)
            if installed is None and self._is_source_folder(requirement.name):
                continue
            if installed is None:
                return f"needs {requirement.name}, which is not installed: {self.pip_line}"
            if not requirement.specifier.contains(installed, prereleases=True):
                return (
                    f"works with {requirement.name}{requirement.specifier}, got version {installed}: "
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

    def find_task(self, task: str) -> str | None:
        """Return a task by its name, with or without the version ``-v0``; None if there is none."""
        return next((name for name in (task, f"{task}-v0") if name in self.tasks), None)

    def unknown_task(self, task: str) -> ValueError:
        """Return an error that names the nearest tasks and the command that lists all."""
        near = get_close_matches(task, self.tasks, n=N_NEAREST)
        names = ", ".join(f"{self.name}/{name}" for name in near or self.examples)
        hint = f"did you mean {names}?" if near else f"there are {names}, ..."
        return ValueError(
            f"unknown task '{self.name}/{task}'; {hint} (python -m sb3_saf.suites {self.name} lists all "
            f"{len(self.tasks)})"
        )


def modules_with_versions(package: str) -> list[str]:
    """Return the names of a package's modules that end with a version, such as ``simple_spread_v3``."""
    modules = pkgutil.iter_modules(importlib.import_module(package).__path__)
    return [module.name for module in modules if module.name[-1].isdigit()]


def parallel_env(package: str, task: str, *, render_mode: str | None = None, **params: Any) -> Any:
    """Make a game of one of these modules, named as in PettingZoo's packages."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The old environment creation API", DeprecationWarning)  # names no other
        module = importlib.import_module(f"{package}.{task}")
    return module.parallel_env(render_mode=render_mode, **params)


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None
