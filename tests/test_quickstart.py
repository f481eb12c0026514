"""Wrong arguments of ``make train``; tests/test_first_pages.py runs it."""

from __future__ import annotations

from pathlib import Path

import pytest

from sb3_saf import quickstart


def test_wrong_levels_are_one_line_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        quickstart.main(["--coordination", "6", "--output", str(tmp_path)])
    assert exit_.value.code == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.endswith("coordination must be an integer from 1 to 5 (1 <= coordination <= n_agents), got 6")
