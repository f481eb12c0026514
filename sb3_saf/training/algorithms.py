"""The algorithms by the names of the command line, the log folders and the YAML files."""

from __future__ import annotations

from typing import Final

from sb3_saf.policies.parts import AlgorithmSpec
from sb3_saf.registration import COMMANDS
from sb3_saf.training.names import unknown_name

#: What the files of the algorithms declare.
ALGOS: Final[dict[str, AlgorithmSpec]] = COMMANDS


def find_algorithm(algo: str) -> AlgorithmSpec:
    """Return an algorithm; an unknown name is a ValueError that names the nearest one."""
    if algo not in ALGOS:
        raise unknown_name("algorithm", algo, ALGOS)
    return ALGOS[algo]


__all__ = ["ALGOS", "AlgorithmSpec", "find_algorithm"]
