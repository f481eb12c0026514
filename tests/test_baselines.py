"""The speed comparison with third-party gridworlds: installed ones step, the others are left out."""

from __future__ import annotations

import pytest

from benchmarks.environments import BASELINES


@pytest.mark.parametrize("title", BASELINES)
def test_an_installed_baseline_steps(title: str) -> None:
    try:
        work = BASELINES[title]()
    except ImportError as error:
        pytest.skip(str(error))
    assert all(work() > 0 for _ in range(60))  # beyond the end of an episode
