"""TeamSupport: a treasure needs teammates nearby."""

from __future__ import annotations

from typing import Any, ClassVar

from pettingzoo.utils.conversions import parallel_to_aec

from hecogrid_envs.constants import RenderMode
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.params import TaskName


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

    task: ClassVar[TaskName] = "TeamSupport"


def parallel_env(render_mode: RenderMode | None = None, **params: Any) -> TeamSupportEnv:
    """TeamSupport as a ParallelEnv; parameters as in :class:`~hecogrid_envs.params.HECOGridParams`."""
    return TeamSupportEnv(render_mode=render_mode, **params)


def env(render_mode: RenderMode | None = None, **params: Any) -> Any:
    """TeamSupport in turn-based (AEC) form."""
    return parallel_to_aec(parallel_env(render_mode=render_mode, **params))
