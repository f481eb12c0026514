"""Declaration of QPLEX, see ``sb3_saf.policies.parts``."""

from __future__ import annotations

from typing import Final

from sb3_saf.policies.parts import AlgorithmSpec, Declaration, memory_variants
from sb3_saf.qplex.mixers import MIXER_NAMES
from sb3_saf.qplex.policies import QPLEXPolicy, QPLEXPoolPolicy
from sb3_saf.qplex.qplex import QPLEX

DECLARATION: Final = Declaration(
    "QPLEX",
    {QPLEX: (QPLEXPolicy, QPLEXPoolPolicy)},
    {
        "qplex": AlgorithmSpec(QPLEX, "QPLEXPolicy", "qplex", {"mixer": "qplex"}),
        "qplex-pool": AlgorithmSpec(QPLEX, "QPLEXPoolPolicy", "qplex", {"mixer": "qplex"}),
        "qmix": AlgorithmSpec(QPLEX, "QPLEXPolicy", "qplex", {"mixer": "qmix"}),
        "vdn": AlgorithmSpec(QPLEX, "QPLEXPolicy", "qplex", {"mixer": "vdn"}),
        **{
            name: spec
            for mixer in MIXER_NAMES
            for name, spec in memory_variants(
                AlgorithmSpec(QPLEX, "QPLEXPolicy", "qplex", {"mixer": mixer}), mixer
            ).items()
        },
    },
)
