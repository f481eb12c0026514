"""
Test the guarantees of docs/trust.md, one campaign after another, and print a table::

    python -m tests.campaigns --minutes 15 --write docs/trust.md

Each campaign is a command, which ``--list`` prints; its number of repetitions scales with ``--minutes`` on one idle
core. Campaigns whose packages are missing are named and left out. The exit code is 1 if a guarantee failed.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import resource
import shlex
import subprocess
import sys
import tempfile
from datetime import datetime, timezone
from pathlib import Path
from typing import Final, NamedTuple

ROOT: Final = Path(__file__).resolve().parents[1]
PYTEST: Final = "-m pytest -q -n 0 -p no:cacheprovider --timeout 3600"
BEGIN, END = "<!-- campaigns: begin -->", "<!-- campaigns: end -->"


class Campaign(NamedTuple):
    """
    A test that is repeated many times.

    :param name: in the table, after the number
    :param arguments: of Python; ``{n}`` is the number
    :param number: repetitions in 15 minutes for all campaigns together
    :param variables: environment variables, the same way
    :param least: minimum number of repetitions
    :param needs: packages
    """

    name: str
    arguments: str
    number: int
    variables: str = ""
    least: int = 4
    needs: tuple[str, ...] = ()

    def times(self, minutes: float) -> int:
        """Return the repetitions in a number of minutes."""
        return max(self.least, round(self.number * minutes / 15))

    def missing(self) -> list[str]:
        """Return the missing packages."""
        return [name for name in self.needs if importlib.util.find_spec(name) is None]

    def line(self, minutes: float) -> str:
        """Return the shell command."""
        n = self.times(minutes)
        return f"{self.variables.format(n=n)} python {self.arguments.format(n=n)}".strip()


def _kills(name: str, options: str, number: int = 8, needs: tuple[str, ...] = ()) -> Campaign:
    return Campaign(
        f"kills, {name}", f"-m tests.kill_harness {options} --rollouts 7 --kills {{n}}", number, least=8, needs=needs
    )


def _mutated(name: str, of: str, number: int) -> Campaign:
    return Campaign(f"mutated {name}", f"{PYTEST} -k {of}", number, "MUTATIONS={n}", least=400)


CAMPAIGNS: Final = (
    _kills("SAF, HECOGrid", "--algo saf", 12),
    _kills("QPLEX, HECOGrid", "--algo qplex", 12),
    _kills("SAF with a GRU, HECOGrid", "--algo saf-gru"),
    _kills("QPLEX with a GRU, HECOGrid", "--algo qplex-gru"),
    _kills("IPPO by A2C, HECOGrid", "--algo ippo-a2c"),
    _kills("MAPPO by TRPO, HECOGrid", "--algo mappo-trpo"),
    _kills("SAF, a curriculum", "--game curriculum"),
    _kills("SAF by MaskablePPO, agents that die and join", "--algo maskable --game dying"),
    _kills("MAPPO with an LSTM, agents that die and join", "--algo mappo-lstm --game dying"),
    _kills("SAF with VecNormalize, agents that die and join", "--algo normalized --game dying"),
    _kills("SAF, simple_spread_v3", "--game spread", needs=("mpe2",)),
    _kills("QPLEX, simple_spread_v3", "--algo qplex --game spread", needs=("mpe2",)),
    _kills("SAF, simple_spread_v3 in two processes", "--game spread --cpus 2", needs=("mpe2",)),
    _kills("SAF, pursuit_v5", "--game pursuit", needs=("pymunk",)),
    _kills("SAF, a game that makes its generator late", "--game lazy"),
    _kills("SAF, JaxMARL's MPE in a batch", "--game jax", needs=("jaxmarl",)),
    *(
        Campaign(f"kills, {name}", f"-m tests.kill_harness --command {key} --kills {{n}}", 8, least=8)
        for name, key in (
            ("sb3_saf.train", "train"),
            ("sb3_saf.train with VecNormalize", "train-normalize"),
            ("sb3_saf.train, QPLEX with a GRU", "train-memory"),
            ("sb3_saf.experiments with two workers", "grid"),
        )
    ),
    Campaign(
        "each of bit flips, truncations, bytes too many in checkpoints",
        f"{PYTEST} tests/test_checkpoints_files.py",
        1_000,
        "CHECKPOINT_DAMAGES={n}",
    ),
    _mutated("settings and states, each", "mutated tests/test_mutations.py", 1_000),
    Campaign(
        "configurations of each game, as in the reference world, under NUMBA_BOUNDSCHECK",
        f"{PYTEST} tests/test_reference_agreement.py -k kernels",
        100,
        # Do not use kernels without the check from the disk cache.
        f"NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR={tempfile.gettempdir()}/sb3_saf_bounds",
        least=100,
    ),
    Campaign("run of the faults of games, 1 and 2 processes", f"{PYTEST} tests/test_misbehaving_games.py", 1, least=1),
    Campaign("run of threads, forks, copies", f"{PYTEST} tests/test_concurrency.py", 1, least=1),
)


class Outcome(NamedTuple):
    """
    The result of a campaign.

    :param tried: repetitions
    :param found: the text for the table
    :param held: whether the guarantee held
    :param seconds: of processor time
    """

    tried: str
    found: str
    held: bool
    seconds: float


def carry_out(campaign: Campaign, minutes: float) -> Outcome:
    """Run a campaign; print its output if it fails."""
    if missing := campaign.missing():
        return Outcome("0", f"not tried: no {', '.join(missing)}", True, 0.0)
    n = campaign.times(minutes)
    variables = dict(word.split("=", 1) for word in campaign.variables.format(n=n).split())
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    result = subprocess.run(
        [sys.executable, *shlex.split(campaign.arguments.format(n=n))],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1", **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if result.returncode:
        print(result.stdout, flush=True)
    return Outcome(f"{n:,}", _in_short(result.stdout, result.returncode), result.returncode == 0, seconds)


def _in_short(text: str, status: int) -> str:
    """Return how many killed runs ended equal, or how many tests passed."""
    kills = re.findall(r"(\d+) of (\d+) end bit-equal", text)
    if kills:
        equal, of = (sum(map(int, column)) for column in zip(*kills, strict=True))
        return f"{equal} of {of} end bit-equal"
    words = re.findall(r"\d+ (?:passed|failed|skipped|errors?)", "".join(text.splitlines()[-1:]))
    return f"held ({', '.join(words)})" if words and not status else ", ".join(words) or f"ended with {status}"


def commit() -> str:
    """Return the tested commit, and whether files were changed since."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", "*.py")
    return git("rev-parse", "--short", "HEAD") + (" with changes" if changed else "")


def table(found: dict[str, Outcome], minutes: float) -> str:
    """Return the table of outcomes, in Markdown."""
    day = datetime.now(timezone.utc).date()
    total = sum(outcome.seconds for outcome in found.values()) / 60
    lines = [
        f"Commit {commit()}, {day}, Python {sys.version.split()[0]}, {total:.1f} minutes of processor time: "
        f"`python -m tests.campaigns --minutes {minutes:g}`",
        "",
        "| repetitions | campaign | outcome | processor seconds |",
        "| ---: | --- | --- | ---: |",
        *(f"| {o.tried} | {name} | {o.found} | {o.seconds:.0f} |" for name, o in found.items()),
    ]
    return "\n".join(lines)


def write(path: Path, text: str) -> None:
    """Write the table between its marks in a page."""
    before, found, rest = path.read_text(encoding="utf-8").partition(BEGIN)
    _, ended, after = rest.partition(END)
    if not found or not ended:
        raise SystemExit(f"expected the lines {BEGIN} and {END} in {path}")
    path.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after}", encoding="utf-8")


def main() -> None:
    """Run the campaigns."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--minutes", type=float, default=15, help="of one quiet core, for all of them")
    parser.add_argument("--only", default="", metavar="WORD", help="those with this word in their name")
    parser.add_argument("--write", type=Path, metavar="PAGE", help="put the table there, between its marks")
    parser.add_argument("--list", action="store_true", help="print the commands")
    options = parser.parse_args()
    chosen = [campaign for campaign in CAMPAIGNS if options.only in campaign.name]
    if options.list:
        print(*(campaign.line(options.minutes) for campaign in chosen), sep="\n")
        return
    found: dict[str, Outcome] = {}
    for campaign in chosen:
        found[campaign.name] = outcome = carry_out(campaign, options.minutes)
        print(f"{outcome.tried} {campaign.name}: {outcome.found}, {outcome.seconds:.0f} s", flush=True)
    print(f"\n{table(found, options.minutes)}")
    if options.write is not None:
        write(options.write, table(found, options.minutes))
    sys.exit(not all(outcome.held for outcome in found.values()))


if __name__ == "__main__":
    main()
