"""Environments by name: HECOGrid tasks, suites, modules, functions, PettingZoo's registry."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Final

import pettingzoo

import hecogrid_envs
from hecogrid_envs import TASK_NAMES
from hecogrid_envs.params import HECOGridParams
from hecogrid_envs.task import TaskName
from sb3_saf.envs.equal_spaces import team_game
from sb3_saf.envs.vec_game import VecGame
from sb3_saf.suites.registry import SuiteTask, find_task
from sb3_saf.teams.checks import unknown_name

#: HECOGrid's environments by names in the style of RL-Zoo3 and Gymnasium.
TASK_OF_ENV: Final[dict[str, TaskName]] = {f"{task}-v0": task for task in TASK_NAMES}
ENV_IDS: Final = tuple(TASK_OF_ENV)
#: Entries of YAML files for all environments of a kind.
HECOGRID: Final = "hecogrid"
#: Tile codes are the default: the same views as the paper's pictures in 49 bytes.
_HECOGRID_DEFAULTS: Final = {"observation": "tiles"}
_OTHERS: Final = (
    "a task of a suite (lbf/Foraging-8x8-2p-3f-v3; python -m sb3_saf.suites lists them), a "
    "module with parallel_env (mpe2.simple_spread_v3), a function that makes a ParallelEnv "
    "(my_package.my_module:make_env), or an id registered with PettingZoo"
)
HOW_TO_NAME: Final = f"{', '.join(ENV_IDS)}, {_OTHERS}"


@dataclass(frozen=True)
class TeamEnvironment:
    """
    Named environment.

    :param id: its name
    :param make: makes a game from ``render_mode`` and parameters; None for HECOGrid
    :param suite_task: the task of a suite, None for others
    """

    id: str
    make: Callable[..., Any] | None = None
    suite_task: SuiteTask | None = None

    @property
    def task(self) -> TaskName | None:
        """HECOGrid task; None for other environments."""
        return TASK_OF_ENV.get(self.id)

    @property
    def yaml_keys(self) -> tuple[str, ...]:
        """Entries of YAML files for this environment, from general to specific."""
        if self.suite_task is not None:
            return ("default", self.suite_task.suite.name, self.id)
        return ("default", HECOGRID, self.id) if self.task else ("default", self.id)

    @property
    def training_params(self) -> tuple[str, ...]:
        """Parameters of the games for training only."""
        return () if self.suite_task is None else self.suite_task.suite.training_params

    @property
    def folder_name(self) -> str:
        """Name of the environment in file names."""
        return folder_name(self.id)

    def complete(self, env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
        """Check parameters of the game and add the defaults, if known."""
        if self.task is None:
            return dict(env_kwargs)
        params = HECOGridParams.from_kwargs({**_HECOGRID_DEFAULTS, **env_kwargs})
        params.check_fits(self.task)
        return asdict(params)

    def count_agents(self, env_kwargs: Mapping[str, Any]) -> int:
        """Count the agents, N, by making a game."""
        if self.task is not None:
            return int(env_kwargs["n_agents"])
        game = self.make_game(env_kwargs)
        agents = getattr(game, "possible_agents", None)
        game.close()
        if not agents:
            raise ValueError(f"expected {self.id} to list its agents in possible_agents, got {agents!r}")
        return len(agents)

    def make_game(self, env_kwargs: Mapping[str, Any], render_mode: str | None = None) -> Any:
        """Make one game of agents with equal spaces; ValueError for invalid parameters or if it is no ParallelEnv."""
        kwargs = dict(env_kwargs) if render_mode is None else {**env_kwargs, "render_mode": render_mode}
        if self.make is None:
            assert self.task is not None
            return hecogrid_envs.parallel_env(self.task, **kwargs)
        try:
            game = team_game(self.make(**kwargs))
        except TypeError as error:  # most often an argument that it does not have
            hint = "" if render_mode is None else "; to show its games, give it the argument render_mode (PettingZoo's)"
            raise ValueError(f"{self.id} cannot be made with {kwargs}: {error}{hint}") from error
        if not isinstance(game, pettingzoo.ParallelEnv):
            raise ValueError(f"expected {self.id} to make a PettingZoo ParallelEnv, got a {type(game).__name__}")
        return game


def folder_name(env_id: str) -> str:
    """Return the name of an environment in file names."""
    return env_id.removeprefix(f"{HECOGRID}/").replace("/", "-").replace(":", "-")


def find_environment(env_id: str) -> TeamEnvironment:
    """Look up an environment by a name as in ``HOW_TO_NAME``. Modules in the name are imported."""
    name = env_id.removeprefix(f"{HECOGRID}/") if isinstance(env_id, str) else str(env_id)
    if name in TASK_OF_ENV:
        return TeamEnvironment(name)
    if name in pettingzoo.parallel_registry:
        return TeamEnvironment(name, partial(pettingzoo.make, "parallel", name))
    suite_task = find_task(name)
    if suite_task is not None:
        return TeamEnvironment(name, _maker(suite_task), suite_task)
    if ":" in name or "." in name or _is_module(name):
        module, _, function = name.partition(":")
        return TeamEnvironment(name, import_by_name(module, function or "parallel_env", f"--env {name}"))
    raise ValueError(f"{unknown_name('environment', env_id, ENV_IDS)}; others are named by {_OTHERS}")


def _maker(one: SuiteTask) -> Callable[..., Any]:
    """Return a function that makes one game of a suite's task."""
    if one.suite.vec_env is None:
        assert one.suite.game is not None
        return partial(one.suite.game, one.task)
    return partial(_vec_game, one.suite.vec_env, one.task)


def _vec_game(make: Callable[..., Any], task: str, **params: Any) -> VecGame:
    return VecGame(make(task, 1, None, **params))


def _is_module(name: str) -> bool:
    try:
        return name.isidentifier() and importlib.util.find_spec(name) is not None
    except (ImportError, ValueError):
        return False


def import_by_name(module: str, name: str, what: str) -> Any:
    """Import a callable from a module; ``what`` describes it in errors."""
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"{what}: cannot import {name} from {module!r} ({error}); install the package, or set PYTHONPATH to "
            "the folder that has it"
        ) from error
    if not callable(found):
        raise ValueError(f"{what}: expected a function or class, got {module}.{name} = {found!r}")
    return found
