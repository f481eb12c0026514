"""TeamTogether: a treasure needs the whole group on its cell."""

from __future__ import annotations

from typing import Any, ClassVar

from pettingzoo.utils.conversions import parallel_to_aec

from hecogrid_envs.constants import RenderMode
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.params import TaskName


class TeamTogetherEnv(HECOGridEnv):
    """
    Agents meet on a treasure to collect it.

    An agent that enters a treasure's cell, or picks up while standing on it, collects the treasure if at least
    ``coordination`` agents stand on that cell, itself included. With ``coordination=1`` everyone collects alone; with 2
    or more, agents wait for each other on the treasure and the last to arrive collects.

    ```python
    from hecogrid_envs import parallel_env

    env = parallel_env("TeamTogether", n_agents=4, grid_size=12, n_treasures=20, coordination=2)
    observations, infos = env.reset(seed=0)
    ```
    """

    task: ClassVar[TaskName] = "TeamTogether"


def parallel_env(render_mode: RenderMode | None = None, **params: Any) -> TeamTogetherEnv:
    """TeamTogether as a ParallelEnv; parameters as in :class:`~hecogrid_envs.params.HECOGridParams`."""
    return TeamTogetherEnv(render_mode=render_mode, **params)


def env(render_mode: RenderMode | None = None, **params: Any) -> Any:
    """TeamTogether in turn-based (AEC) form."""
    return parallel_to_aec(parallel_env(render_mode=render_mode, **params))
