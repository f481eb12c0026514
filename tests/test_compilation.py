"""Kernels are compiled once, with a word to the user, and anew when any of their files changes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from hecogrid_envs.core import jit
from hecogrid_envs.core.occupancy import plane_offset
from hecogrid_envs.core.sharing import is_asleep

_ARGUMENTS = (np.zeros(32, dtype=np.int64), 1)


@pytest.fixture
def fresh_start(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[], Any]:
    """Makes a kernel as a new process would, with compiled code in a folder of the user's choice."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))

    def make() -> Any:
        jit._announce_compilation.cache_clear()
        return jit.hot_entry(is_asleep.py_func)  # type: ignore[attr-defined]

    return make


def test_it_says_so_when_it_compiles_and_only_then(
    fresh_start: Callable[[], Any], capfd: pytest.CaptureFixture[str]
) -> None:
    compiled = jit.entry_point(fresh_start(), *_ARGUMENTS)
    assert capfd.readouterr().err.count("compiling the kernels") == 1
    assert not compiled(*_ARGUMENTS)

    kernel = fresh_start()
    assert not jit.entry_point(kernel, *_ARGUMENTS)(*_ARGUMENTS)
    assert capfd.readouterr().err == ""
    assert sum(kernel.stats.cache_hits.values()) == 1


def test_a_change_of_any_file_of_the_kernels_compiles_anew(
    fresh_start: Callable[[], Any], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    jit.entry_point(fresh_start(), *_ARGUMENTS)
    capfd.readouterr()
    monkeypatch.setattr(jit, "_FINGERPRINT", "of other files")
    kernel = fresh_start()
    jit.entry_point(kernel, *_ARGUMENTS)
    assert "compiling the kernels" in capfd.readouterr().err
    assert not kernel.stats.cache_hits


def test_the_fingerprint_reads_every_file_of_the_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []

    def read_bytes(path: Path) -> bytes:
        read.append(path.name)
        return b""

    monkeypatch.setattr(Path, "read_bytes", read_bytes)
    jit._fingerprint()
    core = {path.name for path in Path(jit.__file__).parent.glob("*.py")}
    assert core | {"constants.py", "tiles.py"} == set(read)


def test_what_only_kernels_call_says_so() -> None:
    with pytest.raises(TypeError, match="plane_offset is compiled for kernels only: mark it as an entry to call it"):
        plane_offset(None, 0, 1, 1)  # type: ignore[arg-type]
