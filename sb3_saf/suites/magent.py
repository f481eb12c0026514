"""
MAgent2's battles and hunts of many agents: ``magent/tiger_deer_v4``.

Most of its games are of several groups, which play against each other. Agents that die keep their rows; those of
groups with other spaces are padded and masked. With N agents a critic that reads the whole team gets N times N
observations a step: for hundreds of agents make the map smaller (``map_size=20``).
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any, Final

from sb3_saf.suites.suite import Suite


def _tasks() -> list[str]:
    import magent2.environments

    return [module.name for module in pkgutil.iter_modules(magent2.environments.__path__) if module.name[-1].isdigit()]


def _game(task: str, *, render_mode: str | None = None, **params: Any) -> Any:
    return importlib.import_module(f"magent2.environments.{task}").parallel_env(render_mode=render_mode, **params)


SUITE: Final = Suite(
    name="magent",
    title="MAgent2: battles, hunts and gathering of many agents",
    requires=("magent2>=0.3.4,<0.4",),
    extra="magent",
    page="https://magent2.farama.org",
    list_tasks=_tasks,
    examples=("gather_v5", "adversarial_pursuit_v4", "tiger_deer_v4"),
    game=_game,
    competitive=("adversarial_*", "battle*", "combined_*", "tiger_*"),
    has_state=True,
)
