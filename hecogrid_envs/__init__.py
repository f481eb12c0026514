"""
HECOGrid: cooperative gridworlds with adjustable coordination and heterogeneity (arXiv 2210.03022).

PettingZoo environments (:func:`parallel_env`, :func:`env`) and the batched games (:class:`GameBatch`) that
``sb3_saf.make_team_env`` drives. This package imports neither torch, Stable-Baselines3 nor ``sb3_saf``.
"""

from __future__ import annotations

from hecogrid_envs.batch import GameBatch
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.params import HECOGridParams
from hecogrid_envs.state import StateMapping
from hecogrid_envs.tasks import TASKS, env, parallel_env, register_with_pettingzoo
from hecogrid_envs.tasks.key_for_treasure import KeyForTreasureEnv
from hecogrid_envs.tasks.team_support import TeamSupportEnv
from hecogrid_envs.tasks.team_together import TeamTogetherEnv
from hecogrid_envs.tiles import TileSpace, tile_atlas

__all__ = [
    "TASKS",
    "TASK_NAMES",
    "GameBatch",
    "HECOGridEnv",
    "HECOGridParams",
    "KeyForTreasureEnv",
    "StateMapping",
    "TeamSupportEnv",
    "TeamTogetherEnv",
    "TileSpace",
    "env",
    "parallel_env",
    "tile_atlas",
]

#: Names of all tasks.
TASK_NAMES = tuple(TASKS)

register_with_pettingzoo()
