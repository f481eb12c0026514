"""
Count machine instructions per agent-step of the compiled kernels, to detect slower code independently of machine load.

``python -m benchmarks.instructions`` counts with Valgrind's Callgrind and prints the counts beside the recorded ones;
``--record`` writes them to ``benchmarks/instructions.json``. Kernels are compiled for plain x86-64, so that counts do
not depend on the machine. The workload is that of ``benchmarks.environments``; new levels are counted separately, per
agent.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import mmap
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from hecogrid_envs import TASK_NAMES, GameBatch, HECOGridParams
from hecogrid_envs.core.types import RESET
from sb3_saf import game_seeds

RECORD: Final = Path(__file__).parent / "instructions.json"
#: Allowed excess over the record: releases of Python differ by some instructions per call.
TOLERANCE: Final = 0.05
N_GAMES: Final = 128
STEPS: Final = 8

# Requests to Callgrind, from valgrind/callgrind.h: numbers count up from 'C', 'T'.
_ZERO_STATS: Final = 0x43540001
_DUMP_STATS_AT: Final = 0x43540003
_START_INSTRUMENTATION: Final = 0x43540004
_STOP_INSTRUMENTATION: Final = 0x43540005
#: The instruction sequence that Valgrind reads as a request and a processor executes as a no-op (rotations by 128 bits
#: in total): rax = rdi; edx = 0; rotate rdi by 3, 13, 61, 51; exchange rbx, rbx; return rdx.
_REQUEST: Final = bytes.fromhex("4889f8 31d2 48c1c703 48c1c70d 48c1c73d 48c1c733 4887db 4889d0 c3")


def why_not() -> str | None:
    """Return why this machine cannot count; None if it can."""
    if shutil.which("valgrind") is None:
        return "valgrind is not installed"
    return None if platform.machine() in ("x86_64", "AMD64") else "requests to valgrind are written for x86-64"


def count() -> dict[str, float]:
    """
    Count in a separate process.

    :return: instructions per agent-step by row
    :raises RuntimeError: with Valgrind's message if it fails
    """
    play = [sys.executable, "-m", "benchmarks.instructions", "--play"]
    plain = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "PYTHONHASHSEED": "0"}
    env = {**os.environ, **plain, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder:
        valgrind = ["valgrind", "--tool=callgrind", "--instr-atstart=no", f"--callgrind-out-file={folder}/counts"]
        # First without Valgrind, where compiling takes minutes: the second run finds the kernels in numba's cache.
        for command in (play, valgrind + play):
            ran = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
            if ran.returncode != 0:
                raise RuntimeError(f"{command[0]} ended with {ran.returncode}: {ran.stderr[-2_000:]}")
        dumps = [path.read_text(errors="replace") for path in Path(folder).glob("counts*")]
    return dict(sorted(filter(None, map(_read_dump, dumps))))


def _read_dump(text: str) -> tuple[str, float] | None:
    name = re.search(r"^desc: Trigger: Client Request: (.+)$", text, re.MULTILINE)
    total = re.search(r"^(?:totals|summary): (\d+)", text, re.MULTILINE)
    if name is None or total is None:
        return None
    return name[1], round(int(total[1]) / (STEPS * N_GAMES * HECOGridParams().n_agents), 1)


def _works() -> Iterator[tuple[str, Callable[[], object]]]:
    for task in TASK_NAMES:
        for observation in ("tiles", "rgb"):
            params = HECOGridParams(observation=observation)
            batch = GameBatch(task, params, N_GAMES)
            batch.reset(seeds=game_seeds(0, N_GAMES))
            out = batch.observe()
            actions = np.random.default_rng(0).integers(0, 7, (STEPS + 1, N_GAMES, params.n_agents), dtype=np.uint8)
            batch.step(actions[STEPS])
            if observation == "tiles":
                yield f"{task}, step", partial(_play_step, batch, iter(actions))
                yield f"{task}, new level", partial(_draw_levels, batch)
            yield f"{task}, step and {observation}", partial(_play_step, batch, iter(actions), out)


def _play_step(
    batch: GameBatch, actions: Iterator[npt.NDArray[np.uint8]], out: npt.NDArray[np.uint8] | None = None
) -> None:
    if out is None:
        batch.step(next(actions))
    else:
        batch.advance(next(actions), out)


def _draw_levels(batch: GameBatch) -> None:
    """Create new levels without the Python part of :meth:`GameBatch.reset`."""
    batch._buffers.fresh[...] = True
    batch._play_all(RESET)


def _play() -> None:
    """Run each work under its name within Valgrind; kernels are compiled and loaded beforehand."""
    request, works = _requests(), list(_works())
    request(_START_INSTRUMENTATION)  # once: Valgrind then translates all code anew
    for name, work in works:
        request(_ZERO_STATS)
        for _ in range(STEPS):
            work()
        request(_DUMP_STATS_AT, name)
    request(_STOP_INSTRUMENTATION)


def _requests() -> Callable[..., None]:
    code = mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    code.write(_REQUEST)
    call = ctypes.CFUNCTYPE(ctypes.c_uint64, ctypes.c_void_p)(ctypes.addressof(ctypes.c_char.from_buffer(code)))

    def request(number: int, text: str = "") -> None:
        written = ctypes.create_string_buffer(text.encode())
        assert not code.closed
        call(ctypes.byref((ctypes.c_uint64 * 6)(number, ctypes.addressof(written))))

    return request


def compare(counts: dict[str, float], record: dict[str, float]) -> list[str]:
    """
    Compare with the recorded counts.

    :return: one sentence for each row that is slower
    """
    most = {name: recorded * (1 + TOLERANCE) for name, recorded in record.items()}
    return [
        f"{name}: {counts[name]:.1f} instructions per agent-step, recorded are {record[name]:.1f}"
        for name in counts
        if counts[name] > most[name]
    ]


def main() -> int:
    """Count, print, compare or record."""
    parser = argparse.ArgumentParser(
        "python -m benchmarks.instructions", description=str(__doc__).strip().split("\n")[0]
    )
    parser.add_argument("--record", action="store_true", help=f"write {RECORD.name}")
    parser.add_argument("--play", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.play:
        _play()
        return 0
    if (reason := why_not()) is not None:
        parser.exit(1, f"cannot count: {reason}\n")
    counts = count()
    if options.record:
        RECORD.write_text(json.dumps(counts, indent=2) + "\n")
    record = json.loads(RECORD.read_text())
    for name, number in counts.items():
        print(f"{name:32} {number:8.1f}   recorded {record[name]:8.1f}")
    slower = compare(counts, record)
    print("\n".join(slower))
    return 1 if slower else 0


if __name__ == "__main__":
    sys.exit(main())
