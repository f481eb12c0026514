"""The tasks, one file each: condition for collecting, colours and documentation page. A new file here is a new task."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules
from typing import Final

from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.task import TaskName

#: The paper's tasks in the paper's order; others follow by name.
_PAPER: Final = ("team_together", "team_support", "key_for_treasure")
_FOUND: Final = sorted(module.name for module in iter_modules(__path__) if module.name not in _PAPER)
_MODULES: Final = [import_module(f"{__name__}.{name}") for name in (*_PAPER, *_FOUND)]

#: The class of each task.
TASKS: Final[dict[TaskName, type[HECOGridEnv]]] = {module.parallel_env.task: module.parallel_env for module in _MODULES}
