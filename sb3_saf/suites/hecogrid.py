"""
HECOGrid, the games of this repository: ``hecogrid/TeamSupport-v0``, or ``TeamSupport`` for short.

Each agent receives its share of the treasures collected in a step, so that the team's return counts treasures.
Parameters are those of :class:`hecogrid_envs.HECOGridParams`. Observations are tile codes unless
``observation="rgb"``: the same views as one code per cell, in 48 times less memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Final

from sb3_saf.suites.registry import Suite

_VERSION: Final = "-v0"


def _tasks() -> list[str]:
    from hecogrid_envs import TASK_NAMES

    return [f"{name}{_VERSION}" for name in TASK_NAMES]


def _game(task: str, *, render_mode: Any = None, **params: Any) -> Any:
    from hecogrid_envs import parallel_env

    return parallel_env(task.removesuffix(_VERSION), render_mode, **params)


def _games(task: str, n_envs: int, seed: int | None, **params: Any) -> Any:
    from sb3_saf.suites.engines.hecogrid import vec_env

    return vec_env(task.removesuffix(_VERSION), n_envs, seed, **params)


def _complete(task: str, params: Mapping[str, Any]) -> dict[str, Any]:
    from hecogrid_envs import HECOGridParams

    checked = HECOGridParams.from_kwargs(params)
    checked.check_fits(task.removesuffix(_VERSION))
    return asdict(checked)


SUITE: Final = Suite(
    name="hecogrid",
    title="gridworlds with adjustable coordination and heterogeneity",
    requires=("sb3-saf",),
    extra="",
    page="https://arxiv.org/abs/2210.03022",
    list_tasks=_tasks,
    examples=("TeamTogether-v0", "TeamSupport-v0", "KeyForTreasure-v0"),
    game=_game,
    vec_env=_games,
    defaults={"observation": "tiles"},
    complete=_complete,
    level_params=("coordination", "heterogeneity"),
    always_active=True,
    is_drawn_from_state=True,
    module="hecogrid_envs",
)
