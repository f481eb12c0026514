"""TeamTogether: a treasure needs the whole group on its cell."""

from __future__ import annotations

from typing import ClassVar

from hecogrid_envs.constants import BLACK, GOLD, YELLOW
from hecogrid_envs.core.jit import inlined
from hecogrid_envs.core.occupancy import count_here
from hecogrid_envs.core.types import Games, World
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.task import Task


@inlined
def _group_is_here(games: Games, world: World, e: int, agent: int, old_x: int, old_y: int) -> bool:
    return count_here(games, world, e, agent) >= world.coordination


class TeamTogetherEnv(HECOGridEnv):
    """
    Agents meet on a treasure to collect it.

    An agent that enters a treasure's cell, or picks up while standing on it, collects the treasure if at least
    ``coordination`` agents stand on that cell, itself included. With ``coordination=1`` everyone collects alone, in the
    game of TeamSupport with other colours; with 2 or more, agents wait for each other on the treasure and the last to
    arrive collects.

    ```python
    from hecogrid_envs import parallel_env

    env = parallel_env("TeamTogether", n_agents=4, grid_size=12, n_treasures=20, coordination=2)
    observations, infos = env.reset(seed=0)
    ```
    """

    declaration: ClassVar = Task("TeamTogether", _group_is_here, treasure=YELLOW, collected_released=BLACK, gem=GOLD)


parallel_env = TeamTogetherEnv
env = TeamTogetherEnv.turn_based
