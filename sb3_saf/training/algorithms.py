"""Algorithms by their names on the command line, in log folders and YAML files."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from sb3_saf.policies.parts import AlgorithmSpec
from sb3_saf.registration import COMMANDS, DECLARATIONS
from sb3_saf.teams.checks import unknown_name

#: All declared algorithms.
ALGOS: Final[dict[str, AlgorithmSpec]] = COMMANDS


def find_algorithm(algo: str, trained_by: str | None = None) -> AlgorithmSpec:
    """
    Return an algorithm.

    :param algo: name in ``ALGOS``
    :param trained_by: name of a class that trains the policy instead of the method's own, such as ``"MaskablePPO"``
    :raises ValueError: for an unknown name, with the nearest one
    """
    if algo not in ALGOS:
        raise unknown_name("algorithm", algo, ALGOS)
    spec = ALGOS[algo]
    if trained_by is None:
        return spec
    classes = {
        kind.__name__: kind for one in DECLARATIONS for kind in one.policies if spec.policy in kind.policy_aliases
    }
    if trained_by not in classes:
        raise unknown_name(f"algorithm that trains {spec.policy}", trained_by, classes)
    return replace(spec, algorithm=classes[trained_by])


__all__ = ["ALGOS", "AlgorithmSpec", "find_algorithm"]
