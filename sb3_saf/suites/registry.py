"""
Environments by name, the one look-up of Python, commands and experiments; the declaration of a suite, and all suites by
their files; and known results of tasks (``references.csv``), to tell whether a return is normal.

The same game is quoted in several units and with several lengths of an episode. A reference therefore names the
parameters of the game that differ from the suite's defaults, and its unit: ``return``, the team's in the suite's unit
(sum or mean over agents, ``Suite.team_return``), or ``won``, the fraction of games won. Others are never compared.
"""

from __future__ import annotations

import csv
import importlib
import math
import pkgutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from difflib import get_close_matches
from fnmatch import fnmatchcase
from functools import cache, cached_property, partial
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from importlib.util import find_spec
from typing import Any, Final, Literal, NamedTuple

import pettingzoo
import yaml
from packaging.requirements import Requirement
from pettingzoo.env_registry.exceptions import FailedToImport
from stable_baselines3.common.vec_env import VecEnv

import sb3_saf.suites
from sb3_saf.envs.audit import check_is_parallel
from sb3_saf.envs.gymnasium_team import as_parallel
from sb3_saf.envs.turns import TurnsInParallel
from sb3_saf.teams.checks import import_by_name

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
    :param is_drawn_from_state: whether games have ``grid_scene()`` and pictures at no cost
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
    module: str | None = None

    @property
    def requirements(self) -> tuple[Requirement, ...]:
        """Parsed requirements of this interpreter."""
        parsed = (Requirement(line) for line in self.requires)
        return tuple(one for one in parsed if one.marker is None or one.marker.evaluate())

    def problem(self) -> str | None:
        """Return why no game can be made, None if all requirements are installed."""
        if not self.requirements:
            return f"needs another version of Python: {'; '.join(self.requires)}"
        for number, requirement in enumerate(self.requirements):
            installed = installed_version(requirement.name)
            if installed is None and number == 0 and self.module is not None and find_spec(self.module) is not None:
                continue  # of a source folder
            if installed is None:
                return f"needs {requirement.name}, which is not installed: pip install 'sb3-saf[{self.extra}]'"
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


def installed_version(distribution: str) -> str | None:
    """Return the version of an installed package, None if it is not installed."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


#: Suite whose tasks are named without it: "TeamSupport" is "hecogrid/TeamSupport-v0".
HOME: Final = "hecogrid"
HOW_TO_NAME: Final = (
    "a HECOGrid task (TeamSupport), a task of a suite (lbf/Foraging-8x8-2p-3f-v3; python -m sb3_saf.suites lists "
    "them), a module with parallel_env (mpe2.simple_spread_v3), a function that makes a ParallelEnv "
    "(my_package.my_module:make_env), or an id registered with PettingZoo"
)


@dataclass(frozen=True)
class TeamEnvironment:
    """
    Environment with a name.

    :param id: its name in files: ``"TeamSupport-v0"``, ``"lbf/Foraging-8x8-2p-3f-v3"``, ``"package.module:function"``
    :param make: makes one game from ``render_mode`` and parameters; None if its suite has an engine only
    :param suite: its suite, None for modules, functions and ids registered with PettingZoo
    :param task: name of the task in its suite
    """

    id: str
    make: Callable[..., Any] | None
    suite: Suite | None = None
    task: str = ""

    @property
    def yaml_keys(self) -> tuple[str, ...]:
        """Entries of YAML files for this environment, from general to specific."""
        return ("default", self.id) if self.suite is None else ("default", self.suite.name, self.id)

    @property
    def folder_name(self) -> str:
        """Name of the environment in file names."""
        return folder_name(self.id)

    def complete(self, params: Mapping[str, Any]) -> dict[str, Any]:
        """Add the suite's defaults to parameters of the game; check all, if the suite can without making a game."""
        if self.suite is None:
            return dict(params)
        params = {**self.suite.defaults, **params}
        return params if self.suite.complete is None else self.suite.complete(self.task, params)

    def of_evaluation(self, params: Mapping[str, Any]) -> dict[str, Any]:
        """Return parameters of the games without those of training only."""
        of_training = () if self.suite is None else self.suite.training_params
        return {name: value for name, value in params.items() if name not in of_training}

    def count_agents(self, params: Mapping[str, Any]) -> int:
        """Count the agents, N; a game is made unless the suite knows them."""
        if self.suite is not None and self.suite.complete is not None:
            return int(params["n_agents"])
        game: Any = self.make_engine(1, None, params) if self.make is None else self.make_game(params)
        agents = getattr(game, "possible_agents", None)
        game.close()
        if not agents:
            raise ValueError(f"expected {self.id} to list its agents in possible_agents, got {agents!r}")
        return len(agents)

    def make_engine(self, n_envs: int, seed: int | None, params: Mapping[str, Any], **options: Any) -> VecEnv:
        """
        Make the suite's engine, which steps all games at once.

        :param options: arguments of the engine that are none of the game
        :raises ValueError: for invalid parameters
        """
        assert self.suite is not None and self.suite.vec_env is not None
        try:
            venv: VecEnv = self.suite.vec_env(self.task, n_envs, seed, **options, **params)
        except (TypeError, AssertionError) as error:  # most often an argument that it does not have
            raise ValueError(f"{self.id} cannot be made with {dict(params)}: {str(error) or repr(error)}") from error
        return venv

    def make_game(self, params: Mapping[str, Any], render_mode: str | None = None) -> Any:
        """
        Make one game.

        :param render_mode: of the game; None to leave the argument out
        :raises ValueError: for invalid parameters, or if it is no ParallelEnv
        """
        if self.make is None:
            raise ValueError(f"{self.id} has an engine only, which makes no single games to wrap: use vec_env_wrapper")
        kwargs = dict(params) if render_mode is None else {**params, "render_mode": render_mode}
        try:
            game = as_parallel(self.make(**kwargs))
        except TypeError as error:  # most often an argument that it does not have
            hint = ""
            if "render_mode" in kwargs:
                hint = "; to show its games, give it the argument render_mode (PettingZoo's), or use --no-render"
            raise ValueError(f"{self.id} cannot be made with {kwargs}: {error}{hint}") from error
        check_is_parallel(game, is_factory=True)
        return game

    def warn_if_competitive(self) -> None:
        """Warn that opposing agents are trained as one team."""
        if self.suite is not None and self.suite.is_competitive(self.task):
            warnings.warn(
                f"agents of {self.id} play against each other; here all agents of a game are one team that shares one "
                "policy, so both sides are trained as one",
                UserWarning,
                stacklevel=3,
            )


def _make_registered(kind: str, name: str, **kwargs: Any) -> Any:
    try:
        game = pettingzoo.make(kind, name, **kwargs)
    except (FailedToImport, ImportError) as error:
        cause = f" ({error.__cause__})" if error.__cause__ else ""
        raise ValueError(f"{name} cannot be made: {error}{cause}") from error
    return TurnsInParallel(game) if kind == "aec" else game


def find_environment(name: str) -> TeamEnvironment:
    """
    Look up an environment.

    :param name: see ``HOW_TO_NAME``; modules in the name are imported
    :raises ValueError: for an unknown name, naming the nearest; for a suite whose package is missing or of another
        version; for a module that cannot be imported
    """
    name = str(name)
    prefix, slash, task = name.partition("/") if "/" in name else (HOME, "", name)
    if (suite := suites().get(prefix)) is not None and (slash or suite.find_task(task) is not None):
        if (found := suite.find_task(task)) is None:
            raise suite.unknown_task(task)
        make = None if suite.game is None else partial(suite.game, found)
        return TeamEnvironment(found if suite.name == HOME else f"{suite.name}/{found}", make, suite, found)
    for kind, registry in {"parallel": pettingzoo.parallel_registry, "aec": pettingzoo.aec_registry}.items():
        if name in registry:
            return TeamEnvironment(name, partial(_make_registered, kind, name))
    is_module = False
    with suppress(ImportError, ValueError):
        is_module = name.isidentifier() and find_spec(name) is not None
    if ":" in name or "." in name or is_module:
        module, _, function = name.partition(":")
        turns = "" if function else "; where agents take turns, name a function that returns sb3_saf.TurnsInParallel"
        make = import_by_name(module, function or "parallel_env", f"environment {name!r}", turns)
        return TeamEnvironment(name, make)
    home, *others = sorted(suites().values(), key=lambda one: one.name != HOME)
    short = [task.removesuffix("-v0") for task in home.tasks]
    ids = [*short, *(f"{one.name}/{task}" for one in others for task in one.examples)]
    nearest = " or ".join(map(repr, get_close_matches(name, ids, n=N_NEAREST)))
    did_you_mean = f" (did you mean {nearest}?)" if nearest else ""
    raise ValueError(f"unknown environment {name!r}{did_you_mean}; expected {HOW_TO_NAME}")


def folder_name(env_id: str) -> str:
    """Return the name of an environment in file names."""
    return env_id.removeprefix(f"{HOME}/").replace("/", "-").replace(":", "-")


@cache
def suites() -> dict[str, Suite]:
    """Return the declarations of all suites by name."""
    declared: dict[str, Suite] = {}
    for module in pkgutil.iter_modules(sb3_saf.suites.__path__, f"{sb3_saf.suites.__name__}."):
        if not module.name.endswith("__main__"):
            suite = getattr(importlib.import_module(module.name), "SUITE", None)
            if isinstance(suite, Suite):
                declared[suite.name] = suite
    return declared


# --- known results ----------------------------------------------------------------------------------------------------


RANDOM: Final = "random"


class Reference(NamedTuple):
    """
    A known result of a task.

    :param params: parameters of the game that differ from the suite's defaults
    :param unit: ``"return"`` or ``"won"``
    :param game_steps: of its training; 0 for players that do not learn
    """

    task: str
    params: Mapping[str, Any]
    unit: str
    value: float
    method: str
    game_steps: int
    source: str

    @property
    def is_own(self) -> bool:
        """Whether it is a result of this package."""
        return self.method.startswith("sb3-saf")

    @property
    def result(self) -> str:
        """The value with its unit."""
        return f"{100 * self.value:.0f} % won" if self.unit == "won" else f"{self.value:g}"

    def __str__(self) -> str:
        steps = f" after {self.game_steps:,} game steps" if self.game_steps else ""
        return f"{self.method} {self.result}{steps}"


@cache
def _all_references() -> tuple[Reference, ...]:
    lines = files("sb3_saf.suites").joinpath("references.csv").read_text(encoding="utf-8").splitlines()
    return tuple(
        Reference(
            row["task"],
            {key: yaml.safe_load(value) for key, _, value in (word.partition(":") for word in row["params"].split())},
            row["unit"],
            float(row["value"]),
            row["method"],
            int(row["game_steps"]),
            row["source"],
        )
        for row in csv.DictReader(lines)
    )


def references(env: str | TeamEnvironment, params: Mapping[str, Any] | None = None) -> list[Reference]:
    """
    Return what is known of a task.

    :param env: the environment, or its id, whose package need not be installed
    :param params: only references of games with these parameters, in training or in evaluation; None for all
    """
    name = (env if isinstance(env, str) else env.id).removeprefix(f"{HOME}/")
    known = [one for one in _all_references() if one.task in (name, f"{name}-v0")]
    if params is None:
        return known
    environment = find_environment(env) if isinstance(env, str) else env
    played = environment.of_evaluation(environment.complete(params))
    return [one for one in known if environment.of_evaluation(environment.complete(one.params)) == played]


class Standing(NamedTuple):
    """
    A result beside what is known of its task.

    :param share: of the way from a random team to the closest published result; None if one of them is unknown
    """

    text: str
    share: float | None


def standing(
    env: TeamEnvironment, params: Mapping[str, Any], scores: Mapping[str, float], game_steps: int
) -> Standing | None:
    """
    Compare a result with what is known of its task: players that do not learn, and the published result whose training
    is closest in game steps, as a ratio; of equally long ones the best of others.

    :param scores: the result by unit, from the most telling one: ``won``, ``return``
    :return: None if nothing is known in these units
    """
    over = "sum" if env.suite is None else env.suite.team_return
    texts, share = [], None
    for unit, score in scores.items():
        known = [one for one in references(env, params) if one.unit == unit]
        trained = [one for one in known if one.game_steps]
        if not known:
            continue
        here = f"{100 * score:.0f} % won" if unit == "won" else f"return, {over} over agents: {score:.4g}"
        texts += [here, *(str(one) for one in known if not one.game_steps)]
        floor = next((one.value for one in known if one.method == RANDOM), None)
        if trained:
            closest = min(
                trained, key=lambda one: (abs(math.log(one.game_steps / max(1, game_steps))), one.is_own, -one.value)
            )
            texts.append(f"{closest} ({closest.source})")
            if share is None and floor is not None and closest.value > floor:
                share = (score - floor) / (closest.value - floor)
    if not texts:
        return None
    if share is not None:
        texts.append("below random" if share < 0 else f"{share:.0%} of the way from random to published")
    return Standing("; ".join(texts), share)
