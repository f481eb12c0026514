"""
Multi-agent particle environments: ``mpe/simple_spread_v3``.

Time limits are truncations. Agents of ``simple_speaker_listener_v4`` and others differ in their spaces: shorter
observations are padded with zeros, actions that an agent lacks are masked. ``state()`` concatenates all agents'
observations.
"""

from __future__ import annotations

from functools import partial
from typing import Final

from sb3_saf.suites.registry import Suite, modules_with_versions, parallel_env

SUITE: Final = Suite(
    name="mpe",
    title="multi-agent particle environments: landmarks, speakers and listeners",
    requires=("mpe2>=1.1,<2",),
    extra="mpe",
    page="https://mpe2.farama.org",
    list_tasks=partial(modules_with_versions, "mpe2"),
    examples=("simple_spread_v3", "simple_reference_v3", "simple_speaker_listener_v4"),
    game=partial(parallel_env, "mpe2"),
    competitive=("simple_adversary_*", "simple_crypto_*", "simple_push_*", "simple_tag_*", "simple_world_comm_*"),
)
