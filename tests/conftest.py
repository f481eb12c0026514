"""Setup of every test: one thread, no window, the same random numbers."""

from __future__ import annotations

import os
import random
import sys
import tempfile

import numpy as np
import pytest
from hypothesis import settings

# Libraries read these at import, so they are set before any test module imports them (torch is not imported for tests
# of the game alone). One thread each: the networks are small, the tests run in several processes, and sums have the
# same order everywhere.
for variable, value in {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "MPLBACKEND": "Agg",
    "PYGAME_HIDE_SUPPORT_PROMPT": "1",
    "SDL_AUDIODRIVER": "dummy",
    "SDL_VIDEODRIVER": "dummy",
    # Folder of the key that signs games in checkpoints.
    "XDG_STATE_HOME": os.path.join(tempfile.gettempdir(), "sb3_saf_tests"),
}.items():
    os.environ.setdefault(variable, value)

# No deadline: the first example compiles the kernels. In CI the examples are the same in every run.
# Ten thousand: EXAMPLES=10000 python -m pytest tests/test_bad_input.py --timeout 3600
EXAMPLES = int(os.environ.get("EXAMPLES", "30"))
settings.register_profile("sb3_saf", deadline=None, max_examples=EXAMPLES, derandomize="CI" in os.environ)
settings.load_profile("sb3_saf")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the tests that may take longest, so that no process is left alone with them at the end."""

    def limit(item: pytest.Item) -> float:
        marker = item.get_closest_marker("timeout")
        return marker.args[0] if marker else 0

    items.sort(key=limit, reverse=True)


@pytest.fixture(autouse=True)
def _same_random_numbers() -> None:
    """Seed the global generators, so that no test depends on the tests before it."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 - SB3's replay buffer and spaces draw from it
    if torch := sys.modules.get("torch"):
        torch.manual_seed(0)
