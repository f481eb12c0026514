"""Collection of the algorithms' declarations, and registration of their policies with SB3's algorithms by name."""

from __future__ import annotations

import importlib
import pkgutil
import warnings
from collections.abc import Iterator
from types import ModuleType
from typing import Final

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

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


def register(algorithm: type[BaseAlgorithm], name: str, policy: type[BasePolicy]) -> None:
    """Register a policy with an algorithm by name. A name of another policy is not replaced, with a warning."""
    known = algorithm.policy_aliases.setdefault(name, policy)
    if (known.__module__, known.__qualname__) == (policy.__module__, policy.__qualname__):
        algorithm.policy_aliases[name] = policy  # also after a reload of the module
        return
    warnings.warn(
        f"{algorithm.__name__} already knows another policy by the name {name!r}, "
        f"{known.__module__}.{known.__qualname__}; pass the class {policy.__module__}.{policy.__qualname__} instead "
        "of its name",
        stacklevel=2,
    )


def register_all() -> None:
    """Register every policy; called when ``sb3_saf`` is imported, the only side effect of the import."""
    for declaration in DECLARATIONS:
        for algorithm, policies in declaration.policies.items():
            for policy in policies:
                register(algorithm, policy.__name__, policy)
            for name in (f"{declaration.name}Policy", declaration.name, declaration.name.lower()):
                register(algorithm, name, policies[0])
