"""TeamSupport: a treasure needs teammates nearby."""

from __future__ import annotations

from typing import ClassVar

from hecogrid_envs.core.jit import inlined
from hecogrid_envs.core.occupancy import count_near
from hecogrid_envs.core.types import Games, World
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.task import Task


@inlined
def _group_is_near(games: Games, world: World, e: int, agent: int, old_x: int, old_y: int) -> bool:
    return count_near(games, world, e, agent, old_x, old_y) >= world.coordination


class TeamSupportEnv(HECOGridEnv):
    """
    Agents keep close to each other to collect treasures.

    An agent that enters a treasure's cell, or picks up while standing on it, collects the treasure if at least
    ``coordination`` agents, itself included, are within ``support_radius`` (Chebyshev distance) of that cell. The
    others need not stand on it: two cells away is near enough by default.

    ```python
    from hecogrid_envs import parallel_env

    env = parallel_env("TeamSupport", n_agents=4, grid_size=12, n_treasures=20, coordination=2)
    observations, infos = env.reset(seed=0)
    ```
    """

    declaration: ClassVar = Task("TeamSupport", _group_is_near)


parallel_env = TeamSupportEnv
env = TeamSupportEnv.turn_based
