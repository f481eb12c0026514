"""
MAgent2's battles and hunts of many agents: ``magent/tiger_deer_v4``.

Most of its games have several groups, which play against each other. Dead agents keep their rows; groups with other
spaces are padded and masked. With N agents, a critic of the whole team reads N times N observations per step: for
hundreds of agents use a smaller map (``map_size=20``).
"""

from __future__ import annotations

from functools import partial
from typing import Final

from sb3_saf.suites.registry import Suite, modules_with_versions, parallel_env

SUITE: Final = Suite(
    name="magent",
    title="MAgent2: battles, hunts and gathering of many agents",
    requires=("magent2>=0.3.4,<0.4",),
    extra="magent",
    page="https://magent2.farama.org",
    list_tasks=partial(modules_with_versions, "magent2.environments"),
    examples=("gather_v5", "adversarial_pursuit_v4", "tiger_deer_v4"),
    game=partial(parallel_env, "magent2.environments"),
    competitive=("adversarial_*", "battle*", "combined_*", "tiger_*"),
)
