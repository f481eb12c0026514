"""
SISL's environments: ``sisl/pursuit_v5``, ``sisl/multiwalker_v9``.

Time limits are truncations.
"""

from __future__ import annotations

from typing import Any, Final

from sb3_saf.suites.suite import Suite

_PREFIX: Final = "sisl/"


def _tasks() -> list[str]:
    import pettingzoo

    # Named as modules are, like everything else of PettingZoo's; its registry writes pursuit-v5.
    return [name.removeprefix(_PREFIX).replace("-v", "_v") for name in pettingzoo.parallel_registry if _PREFIX in name]


def _game(task: str, *, render_mode: str | None = None, **params: Any) -> Any:
    import pettingzoo

    return pettingzoo.make("parallel", _PREFIX + task.replace("_v", "-v"), render_mode=render_mode, **params)


SUITE: Final = Suite(
    name="sisl",
    title="SISL: pursuers who surround, walkers who carry",
    requires=("pettingzoo>=1.27,<2", "pymunk>=6.2", "box2d>=2.3.10"),
    extra="sisl",
    page="https://pettingzoo.farama.org/environments/sisl",
    list_tasks=_tasks,
    examples=("pursuit_v5", "multiwalker_v9"),
    game=_game,
)
