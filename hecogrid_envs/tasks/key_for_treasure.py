"""KeyForTreasure: a treasure needs a key, and the group on its cell."""

from __future__ import annotations

from typing import ClassVar

from hecogrid_envs.core.jit import inlined
from hecogrid_envs.core.occupancy import count_here, count_near
from hecogrid_envs.core.types import Games, World
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.task import Task


@inlined
def _group_is_here_with_key(games: Games, world: World, e: int, agent: int, old_x: int, old_y: int) -> bool:
    if not games.has_key[e, agent]:
        return False
    if world.released:
        return count_near(games, world, e, agent, old_x, old_y) >= world.coordination
    return count_here(games, world, e, agent) >= world.coordination


class KeyForTreasureEnv(HECOGridEnv):
    """
    Agents fetch keys and meet on treasures to open them.

    An agent that enters a treasure's cell, or picks up while standing on it, collects the treasure if it carries a key
    and at least ``coordination`` agents stand on that cell, itself included. A key is not used up. An agent carries one
    key at most, takes it from the cell in front with pickup and puts it down with drop.

    ```python
    from hecogrid_envs import parallel_env

    env = parallel_env("KeyForTreasure", n_agents=4, grid_size=12, n_treasures=20, n_keys=6)
    observations, infos = env.reset(seed=0)
    ```
    """

    declaration: ClassVar = Task("KeyForTreasure", _group_is_here_with_key, has_keys=True)


parallel_env = KeyForTreasureEnv
env = KeyForTreasureEnv.turn_based
