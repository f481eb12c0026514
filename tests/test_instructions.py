"""The kernels run no more machine instructions than recorded, counted by Valgrind."""

from __future__ import annotations

import json

import pytest

from benchmarks.instructions import RECORD, compare, count, why_not


def test_kernels_are_not_slower_than_recorded() -> None:
    if (reason := why_not()) is not None:
        pytest.skip(reason)
    record = json.loads(RECORD.read_text())
    counts = count()
    assert counts.keys() == record.keys()
    assert compare(counts, record) == []
    assert min(counts.values()) > 100  # with fewer, the workload did not run


def test_a_slower_kernel_is_named() -> None:
    counts = {"TeamSupport, step": 331.0, "TeamSupport, step and tiles": 1_040.0}
    record = {"TeamSupport, step": 300.0, "TeamSupport, step and tiles": 1_000.0}
    assert compare(counts, record) == ["TeamSupport, step: 331.0 instructions per agent-step, recorded are 300.0"]
