"""
VMAS, batched two-dimensional robotics in torch: ``vmas/balance``.

Parameters are those of the scenario, and ``max_steps`` (100, as in BenchMARL), which is a time limit;
``continuous_actions=False`` gives discrete actions instead of forces. The games of a batch share one random stream, so
a game depends on the number of games.
"""

from __future__ import annotations

from typing import Any, Final

from sb3_saf.suites.registry import Suite


def _tasks() -> list[str]:
    from sb3_saf.suites.engines.vmas import scenarios

    return scenarios()


def _games(task: str, n_envs: int, seed: int | None, **params: Any) -> Any:
    from sb3_saf.suites.engines.vmas import vec_env

    return vec_env(task, n_envs, seed, **params)


SUITE: Final = Suite(
    name="vmas",
    title="robots that carry, balance and navigate together, batched in torch",
    requires=("vmas>=1.5,<2",),
    extra="vmas",
    page="https://vmas.readthedocs.io",
    list_tasks=_tasks,
    examples=("balance", "navigation"),
    vec_env=_games,
    competitive=("football", "simple_adversary", "simple_crypto", "simple_push", "simple_tag", "simple_world_comm"),
    team_return="mean",
)
