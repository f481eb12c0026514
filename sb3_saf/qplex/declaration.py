"""Declaration of QPLEX, see ``sb3_saf.policies.parts``."""

from __future__ import annotations

from typing import Final

from sb3_saf.policies.parts import AlgorithmSpec, Declaration
from sb3_saf.qplex.policies import QPLEXLstmPolicy, QPLEXPolicy, QPLEXPoolPolicy
from sb3_saf.qplex.qplex import QPLEX

DECLARATION: Final = Declaration(
    "QPLEX",
    {QPLEX: (QPLEXPolicy, QPLEXPoolPolicy, QPLEXLstmPolicy)},
    {
        "qplex": AlgorithmSpec(QPLEX, "QPLEXPolicy", "qplex", {"mixer": "qplex"}),
        "qplex-pool": AlgorithmSpec(QPLEX, "QPLEXPoolPolicy", "qplex", {"mixer": "qplex"}),
        "qmix": AlgorithmSpec(QPLEX, "QPLEXPolicy", "qplex", {"mixer": "qmix"}),
        "vdn": AlgorithmSpec(QPLEX, "QPLEXPolicy", "qplex", {"mixer": "vdn"}),
    },
)
