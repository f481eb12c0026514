"""The three tasks, one file each: its rule and its documentation page."""

from __future__ import annotations

from typing import Final

from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.params import TaskName
from hecogrid_envs.tasks.key_for_treasure import KeyForTreasureEnv
from hecogrid_envs.tasks.team_support import TeamSupportEnv
from hecogrid_envs.tasks.team_together import TeamTogetherEnv

TASKS: Final[dict[TaskName, type[HECOGridEnv]]] = {
    env.task: env for env in (TeamTogetherEnv, TeamSupportEnv, KeyForTreasureEnv)
}

__all__ = ["TASKS", "KeyForTreasureEnv", "TeamSupportEnv", "TeamTogetherEnv"]
