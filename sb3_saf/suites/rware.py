"""
Multi-robot warehouse: ``rware/rware-tiny-2ag-v2``.

The return is the number of shelves that the team delivered. Agents learn from the team's sum, as in EPyMARL's
cooperative experiments. The package reports the limit of 500 steps as termination; here it is a truncation.
"""

from __future__ import annotations

from typing import Any, Final

from sb3_saf.suites.registry import Suite

_PREFIX: Final = "rware"


def _tasks() -> list[str]:
    import gymnasium
    import rware  # registers them

    if f"{_PREFIX}-img-tiny-2ag-v2" not in gymnasium.registry:
        rware.image_registration()
    return [name for name in gymnasium.registry if name.startswith(_PREFIX)]


def _game(task: str, *, render_mode: str | None = None, **params: Any) -> Any:
    from sb3_saf.envs.gymnasium_team import GymnasiumTeam, make_gymnasium

    _tasks()
    return GymnasiumTeam(make_gymnasium(task, render_mode, params), is_ended=_never)


def _never(env: Any) -> bool:
    return False


SUITE: Final = Suite(
    name="rware",
    title="the multi-robot warehouse: shelves to deliver, paths to keep clear",
    requires=("rware>=2,<3",),
    extra="rware",
    page="https://github.com/semitable/robotic-warehouse",
    list_tasks=_tasks,
    examples=("rware-tiny-2ag-v2", "rware-tiny-4ag-v2", "rware-small-4ag-v2"),
    game=_game,
    team_reward="sum",
)
