"""
Multi-agent path finding in a grid, ``pogema/...``: registered only to explain why it is not supported.

Every released version requires ``gymnasium==0.28.1`` or ``gym``, and versions up to 1.4.0 read attributes through
wrappers, which Gymnasium 1 has removed; their seeds do not determine the maps.
"""

from __future__ import annotations

from typing import Final

from sb3_saf.suites.suite import Suite

SUITE: Final = Suite(
    name="pogema",
    title="path finding of many agents in a grid",
    requires=("pogema>1.4",),
    extra="",
    page="https://github.com/CognitiveAISystems/pogema",
    list_tasks=tuple,
    examples=(),
    unavailable="no released version of pogema (1.4.0 is the newest) works with Gymnasium 1, which Stable-Baselines3 "
    "needs",
)
