"""Environments by name, the one look-up of Python, commands and experiments; suites by their files."""

from __future__ import annotations

import importlib
import pkgutil
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache, partial
from importlib.util import find_spec
from typing import Any, Final

import pettingzoo
from stable_baselines3.common.vec_env import VecEnv

import sb3_saf.suites
from sb3_saf.envs.gymnasium_team import as_parallel
from sb3_saf.suites.suite import N_NEAREST, Suite
from sb3_saf.teams.checks import import_by_name

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

    def count_agents(self, params: Mapping[str, Any]) -> int:
        """Count the agents, N; a game is made unless the suite knows them."""
        if self.suite is not None and self.suite.complete is not None:
            return int(params["n_agents"])
        game: Any = None
        if self.make is not None:
            game = self.make_game(params)
        elif self.suite is not None and self.suite.vec_env is not None:
            game = self.make_engine(1, None, params)
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
        except TypeError as error:  # most often an argument that it does not have
            raise ValueError(f"{self.id} cannot be made with {dict(params)}: {error}") from error
        return venv

    def make_game(self, params: Mapping[str, Any], render_mode: str | None = None, **changes: Any) -> Any:
        """
        Make one game.

        :param render_mode: of the game; None to leave the argument out
        :raises ValueError: for invalid parameters, or if it is no ParallelEnv
        """
        if self.make is None:
            raise ValueError(f"{self.id} has an engine only, which makes no single games to wrap: use vec_env_wrapper")
        kwargs = {**params, **changes} if render_mode is None else {**params, **changes, "render_mode": render_mode}
        try:
            game = as_parallel(self.make(**kwargs))
        except TypeError as error:  # most often an argument that it does not have
            hint = ""
            if "render_mode" in kwargs:
                hint = "; to show its games, give it the argument render_mode (PettingZoo's), or use --no-render"
            raise ValueError(f"{self.id} cannot be made with {kwargs}: {error}{hint}") from error
        if not isinstance(game, pettingzoo.ParallelEnv):
            raise ValueError(f"expected {self.id} to make a PettingZoo ParallelEnv, got a {type(game).__name__}")
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
    if name in pettingzoo.parallel_registry:
        return TeamEnvironment(name, partial(pettingzoo.make, "parallel", name))
    is_module = False
    with suppress(ImportError, ValueError):
        is_module = name.isidentifier() and find_spec(name) is not None
    if ":" in name or "." in name or is_module:
        module, _, function = name.partition(":")
        return TeamEnvironment(name, import_by_name(module, function or "parallel_env", f"environment {name!r}"))
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
