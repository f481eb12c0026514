"""
VMAS, batched two-dimensional robotics in torch: ``vmas/balance``.

Parameters are those of the scenario, and ``max_steps``, a time limit, by default BenchMARL's;
``continuous_actions=False`` gives discrete actions instead of forces. BenchMARL changes some of the scenarios' own
parameters, too: its ``balance`` has ``n_agents=4`` instead of 3, its ``navigation`` ``n_agents=3, shared_rew=False``
instead of 4 and True. The games of a batch share one random stream, so a game depends on the number of games.
"""

from __future__ import annotations

from typing import Any, Final

from sb3_saf.suites.registry import Suite

#: Time limits in game steps that BenchMARL's tasks have; of all others 100.
_LIMITS: Final = {
    **dict.fromkeys(("ball_passage", "football", "joint_passage", "joint_passage_size", "passage"), 500),
    "multi_give_way": 200,
}


def _tasks() -> list[str]:
    from sb3_saf.suites.engines.vmas import scenarios

    return scenarios()


def _games(task: str, n_envs: int, seed: int | None, **params: Any) -> Any:
    from sb3_saf.suites.engines.vmas import vec_env

    return vec_env(task, n_envs, seed, **{"max_steps": _LIMITS.get(task, 100), **params})


SUITE: Final = Suite(
    name="vmas",
    title="robots that carry, balance and navigate together, batched in torch",
    requires=("vmas>=1.5.2,<2",),
    extra="vmas",
    page="https://vmas.readthedocs.io",
    list_tasks=_tasks,
    examples=("balance", "navigation"),
    vec_env=_games,
    competitive=("football", "simple_adversary", "simple_crypto", "simple_push", "simple_tag", "simple_world_comm"),
    team_return="mean",
)
