"""Import of JaxMARL, which resets ``sys.stdout`` and ``sys.stderr`` of notebooks and tests: undone here."""

import sys

_streams = sys.stdout, sys.stderr
try:
    import jaxmarl
    from jaxmarl.environments import MABRAX_AVAILABLE, SUBMODULE_ENVIRONMENTS, overcooked_layouts, spaces
    from jaxmarl.environments.smax.smax_env import MAP_NAME_TO_SCENARIO
finally:
    sys.stdout, sys.stderr = _streams

__all__ = [
    "MABRAX_AVAILABLE",
    "MAP_NAME_TO_SCENARIO",
    "SUBMODULE_ENVIRONMENTS",
    "jaxmarl",
    "overcooked_layouts",
    "spaces",
]
