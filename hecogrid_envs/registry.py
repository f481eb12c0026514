"""The tasks by name: in Python, and in PettingZoo's registry."""

from __future__ import annotations

from typing import Any

import pettingzoo

from hecogrid_envs.constants import RenderMode
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.task import check_task
from hecogrid_envs.tasks import TASKS


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

    Agents choose in index order; the game step happens when the last has chosen.
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
