"""
Measure what teams learn on the suites' tasks, compared with the suites' own baselines: ``results/suites.md``.

``python -m benchmarks.suite_results`` trains what is missing (``sb3_saf.experiments run``, one folder for each task)
and writes the table of that page from the finished cells; after an interruption, the same command continues. All tasks
get their first seed before any gets its second. Suites that do not install together are trained in turn (``--tasks``),
each in its own environment. Results of other programs, from ``python -m benchmarks.peers``, are in
``results/suites_baselines.csv``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import pandas as pd

from sb3_saf.experiments.cli import main as experiments
from sb3_saf.experiments.tables import read_results
from sb3_saf.suites.registry import suites
from sb3_saf.training.folders import Run
from sb3_saf.training.statistics import mean_over_seeds

METHODS: Final = ("saf", "mappo", "ippo", "qplex")
SEEDS: Final = (0, 1, 2)
BASELINES: Final = Path("results", "suites_baselines.csv")
PAGE: Final = Path("results", "suites.md")
#: Text before and after the table on the page.
_MARKS: Final = ("<!-- table -->", "<!-- end of table -->")
_NOT_RUN: Final = "not run"
_BOX: Final = "Box actions"


class Task(NamedTuple):
    """
    A row of the table.

    :param env_id: of the suite
    :param game_steps: of one training, equal for all methods
    :param discrete: whether actions are discrete, as QPLEX needs
    :param env_kwargs: ``name:value`` of the environment
    """

    env_id: str
    game_steps: int
    discrete: bool = True
    env_kwargs: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Return the name of its experiment and folder."""
        return self.env_id.replace("/", "-")

    def takes(self, method: str) -> bool:
        """Return whether a method can be trained on it."""
        return self.discrete or method != "qplex"


#: The most important ones first.
TASKS: Final = (
    Task("smax/3m", 100_000),
    Task("lbf/Foraging-8x8-2p-3f-v3", 200_000),
    Task("vmas/balance", 100_000, discrete=False),
    Task("jaxmarl/MPE_simple_spread_v3", 200_000),
    Task("jaxmarl/MPE_simple_speaker_listener_v4", 200_000),
    Task("overcooked/cramped_room", 200_000),
    Task("smax/2s3z", 60_000),
    Task("rware/rware-tiny-2ag-v2", 40_000),
    Task("meltingpot/commons_harvest__open", 20_000, env_kwargs=("pixels_per_sprite:1", "max_cycles:300")),
)


def run(task: Task, seed: int, options: argparse.Namespace) -> None:
    """Train and test the missing cells of a task and seed, one after the other."""
    words = ["run", task.name, "--env", task.env_id, "--size", "small", "--workers", "1", "--seeds", str(seed)]
    methods = [method for method in options.methods if task.takes(method)]
    if not methods:
        return
    words += ["-n", str(task.game_steps), "--methods", *methods, "-f", str(options.folder / task.name)]
    experiments([*words, "--env-kwargs", *task.env_kwargs] if task.env_kwargs else words)


def row(task: Task, folder: Path, methods: Sequence[str], baselines: pd.DataFrame) -> list[str]:
    """Return the cells of a task's row; missing ones say so."""
    beside = "; ".join(_others(baselines))
    try:
        tests = read_results(folder, task.name).tests
    except ValueError:
        return [task.env_id, f"{task.game_steps:,}", *[_NOT_RUN] * (len(methods) + 2), beside]
    by_method = {method: tests[tests["method"] == method] for method in ("random", *methods)}
    figures = [_figures(rows) if task.takes(method) else _BOX for method, rows in by_method.items()]
    spent = [_seconds(rows["processor_seconds"]) for method, rows in by_method.items() if method != "random"]
    return [task.env_id, f"{tests['game_steps'].max():,}", *figures, " / ".join(spent), beside]


def _others(rows: pd.DataFrame) -> Iterator[str]:
    for (program, game_steps), trainings in rows.groupby(["program", "game_steps"]):
        spent = trainings["processor_seconds"].mean()
        figures = _figures(trainings.rename(columns={"return": "return_mean", "won": "success_rate"}))
        yield f"{program}, {game_steps:,} game steps: {figures}, {spent:.0f} s"


def _seconds(values: pd.Series) -> str:
    return "-" if values.empty else f"{values.mean():.0f}"


def _figures(tests: pd.DataFrame) -> str:
    """Return the mean return over seeds with its interval, the share of games won, and the number of seeds."""
    if tests.empty:
        return _NOT_RUN
    value, low, high = mean_over_seeds(tests["return_mean"].to_numpy())
    text = f"{value:.2f}" if pd.isna(low) else f"{value:.2f} [{low:.2f}, {high:.2f}]"
    won = tests["success_rate"].mean()
    return f"{text}{'' if pd.isna(won) else f', {won:.0%} won'} ({len(tests)})"


def table(tasks: Iterable[Task], folder: Path, methods: Sequence[str], earlier: str = "") -> Iterator[str]:
    """Yield the lines of the table and of its sources; rows of suites not installed here remain as ``earlier``."""
    baselines = pd.read_csv(BASELINES)
    names = [method.upper() for method in methods]
    head = ["task", "game steps", "random", *names, f"processor s ({' / '.join(names)})", "others"]
    yield f"| {' | '.join(head)} |"
    yield f"|{' --- |' * len(head)}"
    for task in tasks:
        others = baselines[baselines["task"] == task.env_id]
        rows = [line for line in earlier.splitlines() if line.startswith(f"| {task.env_id} |")]
        if rows and suites()[task.env_id.partition("/")[0]].problem() is not None:
            yield rows[0]
        else:
            yield f"| {' | '.join(row(task, folder / task.name, methods, others))} |"
    runs = [Run(path.parent) for path in folder.glob("*/cells/*/*/*/run.json")]
    yield ""
    yield f"Commits: {', '.join(sorted({run.description['versions']['commit'] for run in runs})) or 'none'}. Others:"
    yield ""
    for (task, program), trainings in baselines.groupby(["task", "program"]):
        yield f"- {task}: {program}, {trainings['source'].iloc[0]}"


def main() -> None:
    """Run what is missing, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-f", "--folder", type=Path, default=Path("runs", "suites"), help="of the trainings")
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    parser.add_argument("--tasks", nargs="+", default=[task.env_id for task in TASKS], help="to train on")
    parser.add_argument("-n", "--game-steps", type=int, help="of each training, in the place of the tasks' own")
    parser.add_argument("--table", action="store_true", help="train nothing")
    parser.add_argument("--page", type=Path, default=PAGE)
    options = parser.parse_args()
    tasks = [task._replace(game_steps=options.game_steps or task.game_steps) for task in TASKS]
    for seed in [] if options.table else options.seeds:
        for task in tasks:
            if task.env_id in options.tasks:
                run(task, seed, options)
    before, _, rest = options.page.read_text(encoding="utf-8").partition(_MARKS[0])
    earlier, _, after = rest.partition(_MARKS[1])
    lines = "\n".join(table(tasks, options.folder, options.methods, earlier))
    options.page.write_text(f"{before}{_MARKS[0]}\n\n{lines}\n\n{_MARKS[1]}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
