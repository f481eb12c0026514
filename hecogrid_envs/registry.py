"""The tasks by name: in Python, and in PettingZoo's registry."""

from __future__ import annotations

from typing import Any

import pettingzoo
from pettingzoo.utils.conversions import parallel_to_aec

from hecogrid_envs.constants import RenderMode
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.params import TASK_NAMES, check_task
from hecogrid_envs.tasks import TASKS

_MODULES = {"TeamTogether": "team_together", "TeamSupport": "team_support", "KeyForTreasure": "key_for_treasure"}


def parallel_env(task: str, render_mode: RenderMode | None = None, **params: Any) -> HECOGridEnv:
    """
    Make one game.

    :param task: ``"TeamTogether"``, ``"TeamSupport"`` or ``"KeyForTreasure"``
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
    return parallel_to_aec(parallel_env(task, render_mode, **params))


def register_with_pettingzoo() -> None:
    """Make ``pettingzoo.make("parallel" | "aec", "hecogrid/<task>-v0", **params)`` work."""
    for task in TASK_NAMES:
        env_id, module = f"hecogrid/{task}-v0", f"hecogrid_envs.tasks.{_MODULES[task]}"
        if env_id not in pettingzoo.parallel_registry:
            pettingzoo.register("parallel", env_id, entry_point=f"{module}:parallel_env")
        if env_id not in pettingzoo.aec_registry:
            pettingzoo.register("aec", env_id, entry_point=f"{module}:env")
