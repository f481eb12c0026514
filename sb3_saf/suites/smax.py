"""
SMAX, StarCraft micromanagement without StarCraft: ``smax/3m``.

Allies are trained, enemies follow JaxMARL's heuristic. Every ally receives the team's reward: the enemy health removed,
at most 1 in total, and 1 for a won battle, which is the success. Dead allies receive it, too, so their rows continue,
with one legal action without effect. An episode that ends with both sides alive was stopped by its time limit. With
``state=True`` the state is ``world_state``.
"""

from __future__ import annotations

from typing import Any, Final

from sb3_saf.suites.jaxmarl import JAXMARL
from sb3_saf.suites.registry import Suite


def _tasks() -> list[str]:
    from sb3_saf.suites.engines.jaxmarl import SCENARIOS

    return list(SCENARIOS)


def _games(task: str, n_envs: int, seed: int | None, **params: Any) -> Any:
    from sb3_saf.suites.engines.jaxmarl import SCENARIOS, vec_env

    return vec_env("HeuristicEnemySMAX", n_envs, seed, fixed={"scenario": SCENARIOS[task]}, **params)


SUITE: Final = Suite(
    name="smax",
    title="StarCraft's micromanagement, on JAX",
    requires=JAXMARL,
    extra="jaxmarl",
    page="https://jaxmarl.foersterlab.com/environments/smax/",
    list_tasks=_tasks,
    examples=("3m",),
    vec_env=_games,
    team_return="mean",
)
