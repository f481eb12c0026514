"""The tasks by name, one file each: condition for collecting, colours, documentation page. A new file is a new task."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules
from typing import Any, Final

import pettingzoo

from hecogrid_envs.constants import RenderMode
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.task import TaskName, check_task

#: The paper's tasks in the paper's order; others follow by name.
_PAPER: Final = ("team_together", "team_support", "key_for_treasure")
_FOUND: Final = sorted(module.name for module in iter_modules(__path__) if module.name not in _PAPER)
_MODULES: Final = [import_module(f"{__name__}.{name}") for name in (*_PAPER, *_FOUND)]

#: The class of each task.
TASKS: Final[dict[TaskName, type[HECOGridEnv]]] = {module.parallel_env.task: module.parallel_env for module in _MODULES}


def parallel_env(task: str, render_mode: RenderMode | None = None, **params: Any) -> HECOGridEnv:
    """
    Make one game.

    :param task: a name in :data:`hecogrid_envs.TASK_NAMES`, such as ``"TeamSupport"``
    :param render_mode: ``"rgb_array"``, ``"human"``, ``"ansi"`` or None
    :param params: fields of :class:`~hecogrid_envs.params.HECOGridParams`
    :raises ValueError: for an unknown task or parameter, or a value out of range
    """
    return TASKS[check_task(task)](render_mode=render_mode, **params)


def env(task: str, render_mode: RenderMode | None = None, **params: Any) -> Any:
    """
    Make one game in PettingZoo's turn-based (AEC) form.

    Agents act in index order; the game step is played when the last has chosen its action.
    """
    return TASKS[check_task(task)].turn_based(render_mode=render_mode, **params)


def register_with_pettingzoo() -> None:
    """Make ``pettingzoo.make("parallel" | "aec", "hecogrid/<task>-v0", **params)`` work."""
    for task, env_class in TASKS.items():
        env_id, module = f"hecogrid/{task}-v0", env_class.__module__
        if env_id not in pettingzoo.parallel_registry:
            pettingzoo.register("parallel", env_id, entry_point=f"{module}:parallel_env")
        if env_id not in pettingzoo.aec_registry:
            pettingzoo.register("aec", env_id, entry_point=f"{module}:env")
