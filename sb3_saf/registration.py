"""Collection of the algorithms' declarations, and registration of their policies with SB3's algorithms by name."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator
from types import ModuleType
from typing import Final

import sb3_saf.policies
import sb3_saf.qplex
from sb3_saf.policies.parts import AlgorithmSpec, Declaration


def _declared_in(package: ModuleType) -> Iterator[Declaration]:
    for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        found = getattr(importlib.import_module(module.name), "DECLARATION", None)
        if isinstance(found, Declaration):
            yield found


#: All algorithms, those of the paper first.
DECLARATIONS: Final[tuple[Declaration, ...]] = tuple(
    sorted(
        [*_declared_in(sb3_saf.policies), *_declared_in(sb3_saf.qplex)],
        key=lambda one: ("SAF", "MAPPO", "IPPO", one.name).index(one.name),
    )
)

#: Algorithms by their names on command lines.
COMMANDS: Final[dict[str, AlgorithmSpec]] = {name: spec for one in DECLARATIONS for name, spec in one.commands.items()}


def register_all() -> None:
    """Register every policy; called when ``sb3_saf`` is imported, the only side effect of the import."""
    for declaration in DECLARATIONS:
        for algorithm, policies in declaration.policies.items():
            for policy in policies:
                algorithm.policy_aliases[policy.__name__] = policy
            for name in (f"{declaration.name}Policy", declaration.name, declaration.name.lower()):
                algorithm.policy_aliases[name] = policies[0]
