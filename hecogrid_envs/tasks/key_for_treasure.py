"""KeyForTreasure: a treasure needs a key, and the group on its cell."""

from __future__ import annotations

from typing import Any, ClassVar

from pettingzoo.utils.conversions import parallel_to_aec

from hecogrid_envs.constants import RenderMode
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.params import TaskName


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

    task: ClassVar[TaskName] = "KeyForTreasure"


def parallel_env(render_mode: RenderMode | None = None, **params: Any) -> KeyForTreasureEnv:
    """KeyForTreasure as a ParallelEnv; parameters as in :class:`~hecogrid_envs.params.HECOGridParams`."""
    return KeyForTreasureEnv(render_mode=render_mode, **params)


def env(render_mode: RenderMode | None = None, **params: Any) -> Any:
    """KeyForTreasure in turn-based (AEC) form."""
    return parallel_to_aec(parallel_env(render_mode=render_mode, **params))
