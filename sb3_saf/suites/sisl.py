"""
SISL's environments: ``sisl/pursuit_v5``, ``sisl/multiwalker_v9``.

Time limits are truncations in pursuit. Multiwalker terminates at ``max_cycles``, so ``time_limit="bootstrap"`` adds
nothing there.
"""

from __future__ import annotations

from functools import partial
from typing import Final

from sb3_saf.suites.registry import Suite, modules_with_versions, parallel_env

SUITE: Final = Suite(
    name="sisl",
    title="SISL: pursuers who surround, walkers who carry",
    requires=("pettingzoo>=1.27,<2", "pymunk>=6.2", "box2d>=2.3.10"),
    extra="sisl",
    page="https://pettingzoo.farama.org/environments/sisl",
    list_tasks=partial(modules_with_versions, "pettingzoo.sisl"),
    examples=("pursuit_v5", "multiwalker_v9"),
    game=partial(parallel_env, "pettingzoo.sisl"),
)
