"""
Level-based foraging: ``lbf/Foraging-8x8-2p-3f-v3``.

An episode's rewards of all agents sum to at most 1, and 1 means that all food was collected, which is the success.
Agents learn from the team's sum, as in EPyMARL's cooperative experiments. The package reports its time limit as
termination; here it is a truncation if food is left.
"""

from __future__ import annotations

from typing import Any, Final

from sb3_saf.suites.registry import Suite

_PREFIX: Final = "Foraging"


def _tasks() -> list[str]:
    import gymnasium
    import lbforaging  # noqa: F401  # registers them

    return [name for name in gymnasium.registry if name.startswith(_PREFIX)]


def _game(task: str, *, render_mode: str | None = None, **params: Any) -> Any:
    from sb3_saf.envs.gymnasium_team import GymnasiumTeam, make_gymnasium

    _tasks()
    return GymnasiumTeam(make_gymnasium(task, render_mode, params), is_success=_all_collected, is_ended=_all_collected)


def _all_collected(env: Any) -> bool:
    return not env.unwrapped.field.any()


SUITE: Final = Suite(
    name="lbf",
    title="level-based foraging: food that takes several agents to collect",
    requires=("lbforaging>=2,<3",),
    extra="lbf",
    page="https://github.com/semitable/lb-foraging",
    list_tasks=_tasks,
    examples=("Foraging-8x8-2p-3f-v3", "Foraging-2s-8x8-2p-2f-coop-v3", "Foraging-15x15-4p-3f-v3"),
    game=_game,
    team_reward="sum",
)
