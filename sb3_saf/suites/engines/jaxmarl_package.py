"""Import of JaxMARL, which resets ``sys.stdout`` and ``sys.stderr`` of notebooks and tests: undone here."""

import sys
from contextlib import redirect_stderr, redirect_stdout

with redirect_stdout(sys.stdout), redirect_stderr(sys.stderr):
    import jaxmarl
    from jaxmarl.environments import MABRAX_AVAILABLE, SUBMODULE_ENVIRONMENTS, overcooked_layouts, spaces
    from jaxmarl.environments.smax.smax_env import MAP_NAME_TO_SCENARIO

__all__ = [
    "MABRAX_AVAILABLE",
    "MAP_NAME_TO_SCENARIO",
    "SUBMODULE_ENVIRONMENTS",
    "jaxmarl",
    "overcooked_layouts",
    "spaces",
]
