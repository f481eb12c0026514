"""
HECOGrid: cooperative gridworlds with adjustable coordination and heterogeneity (arXiv 2210.03022).

PettingZoo environments (:func:`parallel_env`, :func:`env`) and Stable-Baselines3 vector environments
(:func:`make_vec_env`). Importing this package imports neither torch nor Stable-Baselines3.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hecogrid_envs.batch import GameBatch
from hecogrid_envs.core.rng import game_seeds
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.params import HECOGridParams
from hecogrid_envs.state import StateMapping
from hecogrid_envs.tasks import TASKS, env, parallel_env, register_with_pettingzoo
from hecogrid_envs.tasks.key_for_treasure import KeyForTreasureEnv
from hecogrid_envs.tasks.team_support import TeamSupportEnv
from hecogrid_envs.tasks.team_together import TeamTogetherEnv
from hecogrid_envs.tiles import TileSpace, tile_atlas

if TYPE_CHECKING:
    from hecogrid_envs.vec_env import NativeVecEnv, make_vec_env

__all__ = [
    "TASKS",
    "TASK_NAMES",
    "GameBatch",
    "HECOGridEnv",
    "HECOGridParams",
    "KeyForTreasureEnv",
    "NativeVecEnv",
    "StateMapping",
    "TeamSupportEnv",
    "TeamTogetherEnv",
    "TileSpace",
    "env",
    "game_seeds",
    "make_vec_env",
    "parallel_env",
    "tile_atlas",
]

#: Names of all tasks.
TASK_NAMES = tuple(TASKS)

register_with_pettingzoo()


def __getattr__(name: str) -> Any:
    # The vector environments need Stable-Baselines3, hence torch: imported on first access.
    if name in ("NativeVecEnv", "make_vec_env"):
        from hecogrid_envs import vec_env

        return getattr(vec_env, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
