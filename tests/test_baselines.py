"""The speed comparison with third-party gridworlds: installed ones step, the others are left out."""

from __future__ import annotations

import pytest

from benchmarks.environments import BASELINES, COPY, copy_work, measure


@pytest.mark.parametrize("title", BASELINES)
def test_an_installed_baseline_steps(title: str) -> None:
    try:
        work = BASELINES[title]()
    except ImportError as error:
        pytest.skip(str(error))
    assert all(work() > 0 for _ in range(60))  # beyond the end of an episode


def test_what_cannot_run_is_left_out_of_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    def missing() -> None:
        raise ImportError("no such package")

    rates = measure({"missing": missing, COPY: copy_work}, seconds=0.0, rounds=3)  # type: ignore[dict-item]
    assert list(rates) == [COPY]
    assert len(rates[COPY]) == 3
    assert capsys.readouterr().out == "left out: missing (ImportError: no such package)\n"
