"""All suites, found by their files, and tasks by id."""

from __future__ import annotations

import importlib
import pkgutil
import warnings
from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

import sb3_saf.suites
from sb3_saf.suites.suite import Suite


class SuiteTask(NamedTuple):
    """
    A task of an installed suite.

    :param suite: declaration of the suite
    :param task: name after the slash
    """

    suite: Suite
    task: str

    @property
    def id(self) -> str:
        """Id for users."""
        return f"{self.suite.name}/{self.task}"

    def warn_if_competitive(self) -> None:
        """Warn once per caller that opposing agents are trained as one team."""
        if self.suite.is_competitive(self.task):
            warnings.warn(
                f"agents of {self.id} play against each other; here all agents of a game are one team that shares one "
                "policy, so both sides are trained as one",
                UserWarning,
                stacklevel=3,
            )


@cache
def suites() -> dict[str, Suite]:
    """Return the declarations of all suites by name."""
    return {suite.name: suite for suite in _declared()}


def _declared() -> Iterator[Suite]:
    for module in pkgutil.iter_modules(sb3_saf.suites.__path__, f"{sb3_saf.suites.__name__}."):
        if module.name.endswith("__main__"):
            continue
        found = getattr(importlib.import_module(module.name), "SUITE", None)
        if isinstance(found, Suite):
            yield found


def find_task(env_id: str) -> SuiteTask | None:
    """
    Look a task up by an id such as ``"lbf/Foraging-8x8-2p-3f-v3"``.

    :return: None if no suite has the name before the slash
    :raises ValueError: if the suite's package is missing or of another version, or has no such task
    """
    name, slash, task = env_id.partition("/")
    suite = suites().get(name) if slash else None
    return None if suite is None else SuiteTask(suite, suite.check_task(task))
