"""
The multi-agent particle environments: ``mpe/simple_spread_v3``.

Time limits are truncations. Agents of ``simple_speaker_listener_v4`` and others differ in their spaces: shorter
observations are padded with zeros, actions that an agent does not have are masked. ``state()`` is the observations of
all agents, one after the other.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any, Final

from sb3_saf.suites.suite import Suite


def _tasks() -> list[str]:
    import mpe2

    return [module.name for module in pkgutil.iter_modules(mpe2.__path__) if module.name[-1].isdigit()]


def _game(task: str, *, render_mode: str | None = None, **params: Any) -> Any:
    return importlib.import_module(f"mpe2.{task}").parallel_env(render_mode=render_mode, **params)


SUITE: Final = Suite(
    name="mpe",
    title="multi-agent particle environments: landmarks, speakers and listeners",
    requires=("mpe2>=1.1,<2",),
    extra="mpe",
    page="https://mpe2.farama.org",
    list_tasks=_tasks,
    examples=("simple_spread_v3", "simple_reference_v3", "simple_speaker_listener_v4"),
    game=_game,
    competitive=("simple_adversary_*", "simple_crypto_*", "simple_push_*", "simple_tag_*", "simple_world_comm_*"),
    has_state=True,
)
