"""
Measure the seconds from the start of Python to the first step of a game: cold (kernels are compiled), and warm.
``python -m benchmarks.first_call``

A cold start gets an empty ``NUMBA_CACHE_DIR``, a warm one that of the previous cold start. Both find Python's own
cached files (``__pycache__``).
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from typing import Final, NamedTuple

import numpy as np

#: Prints the seconds of its imports once the first step is done.
PROGRAMS: Final = {
    "`parallel_env`, PettingZoo": """
import time; start = time.perf_counter()
from hecogrid_envs import parallel_env
imported = time.perf_counter() - start
env = parallel_env("TeamSupport"); env.reset(seed=0); env.step({agent: 0 for agent in env.agents})
print(imported)
""",
    "`make_team_env`, 128 games, with torch and SB3": """
import time; start = time.perf_counter()
import numpy, sb3_saf
imported = time.perf_counter() - start
env = sb3_saf.make_team_env("TeamSupport", n_envs=128, seed=0)
env.reset(); env.step(numpy.zeros(env.num_envs, dtype=int))
print(imported)
""",
    "the libraries alone: SB3 with torch, an empty function of numba": """
import time; start = time.perf_counter()
import numba, stable_baselines3
imported = time.perf_counter() - start
numba.njit(lambda: 0)()
print(imported)
""",
}


class Start(NamedTuple):
    """Seconds to the first step, and the part spent on imports."""

    total: float
    imports: float


def start(code: str, cache: str) -> Start:
    """
    Run a program in a fresh interpreter.

    :param code: prints the seconds of its imports
    :param cache: folder of numba's compiled code
    """
    began = time.perf_counter()
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
    command = [sys.executable, "-W", "ignore", "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        total = time.perf_counter() - began
    if process.returncode:
        raise RuntimeError(f"the first step failed with {process.returncode}")
    return Start(total, float(line))


def measure(code: str, rounds: int) -> dict[str, list[Start]]:
    """
    Measure cold and warm starts in turns.

    :param code: one of ``PROGRAMS``
    """
    found: dict[str, list[Start]] = {"cold": [], "warm": []}
    for _ in range(rounds):
        with tempfile.TemporaryDirectory(prefix="numba-cache-") as cache:
            for starts in found.values():
                starts.append(start(code, cache))
    return found


def first_call_table(rounds: int) -> str:
    """Markdown, medians and spread in seconds."""
    lines = ["| first step of | start | seconds | lowest - highest | of them imports |", "|" + " --- |" * 5]
    for name, code in PROGRAMS.items():
        for temperature, starts in measure(code, rounds).items():
            totals = [each.total for each in starts]
            imports = float(np.median([each.imports for each in starts]))
            spread = f"{min(totals):.2f} - {max(totals):.2f}"
            lines.append(f"| {name} | {temperature} | {np.median(totals):.2f} | {spread} | {imports:.2f} |")
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    print(first_call_table(parser.parse_args().rounds))


if __name__ == "__main__":
    main()
