"""
Overcooked on JAX: ``overcooked/cramped_room``.

Both cooks receive the team's reward, 20 for each served soup. ``reward_shaping`` is the weight of JaxMARL's shaped
rewards, given to the acting agent; it decreases to 0 over ``reward_shaping_steps`` game steps, summed over games.
Evaluation counts soups only.
"""

from __future__ import annotations

from typing import Any, Final

from sb3_saf.suites.jaxmarl import JAXMARL, TRAINING_PARAMS
from sb3_saf.suites.registry import Suite


def _tasks() -> list[str]:
    from sb3_saf.suites.engines.jaxmarl import LAYOUTS

    return list(LAYOUTS)


def _games(task: str, n_envs: int, seed: int | None, **params: Any) -> Any:
    from sb3_saf.suites.engines.jaxmarl import LAYOUTS, vec_env

    return vec_env("overcooked", n_envs, seed, fixed={"layout": LAYOUTS[task]}, **params)


SUITE: Final = Suite(
    name="overcooked",
    title="two cooks in one kitchen, on JAX",
    requires=JAXMARL,
    extra="jaxmarl",
    page="https://jaxmarl.foersterlab.com/environments/overcooked/",
    list_tasks=_tasks,
    examples=("cramped_room",),
    vec_env=_games,
    team_return="mean",
    training_params=TRAINING_PARAMS,
)
