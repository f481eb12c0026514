"""
Measure what teams learn on the suites' tasks at the budgets that others publish: ``results/suites.md``.

``python -m benchmarks.suite_results`` trains what is missing (``sb3_saf.experiments run``, one folder for each task),
adds the finished cells to the raw data in ``results/field``, and writes the table and the figure of that page from it;
after an interruption, the same command continues. All tasks get their first seed before any gets its second. Suites
that do not install together are trained in turn (``--tasks``), each in its own environment. Results of other programs,
from ``python -m benchmarks.peers``, are in ``results/suites_baselines.csv``; published ones in
``sb3_saf/suites/references.csv``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

import pandas as pd
from matplotlib.figure import Figure

from benchmarks.paper import add, fill
from benchmarks.peers import FILE as BASELINES
from benchmarks.peers import KITCHENS
from sb3_saf.experiments.cli import main as experiments
from sb3_saf.experiments.definitions import METHODS as NAMED
from sb3_saf.experiments.tables import read_results
from sb3_saf.suites.registry import RANDOM, references
from sb3_saf.training.figures import draw_curves
from sb3_saf.training.statistics import FEWEST_SEEDS, mean_over_seeds

METHODS: Final = ("saf", "mappo", "ippo")
SEEDS: Final = (0, 1, 2)
PAGE: Final = Path("results", "suites.md")
RAW: Final = Path("results", "field")
TEAMS: Final = Path("trained_teams")

#: Game steps of trainings whose curves are drawn.
_LONG: Final = 1_000_000
_MEMORY: Final = "-gru"
#: Shapes the rewards of training only.
_SHAPING: Final = "reward_shaping"


class Task(NamedTuple):
    """
    A row of the table.

    :param env_id: of the suite
    :param game_steps: of one training, equal for all methods
    :param methods: that are trained, besides a random team
    :param settings: ``name:value`` in the place of those in ``zoo_configs``
    :param params: ``name:value`` of the environment, in training only or in every game
    :param folder: name of its experiment and folder, if not that of the environment
    """

    env_id: str
    game_steps: int
    methods: tuple[str, ...] = METHODS
    settings: tuple[str, ...] = ()
    params: tuple[str, ...] = ()
    folder: str = ""

    @property
    def name(self) -> str:
        """Return the name of its experiment and folder."""
        return self.folder or self.env_id.replace("/", "-")

    @property
    def trainings(self) -> str:
        """Return the folder of its trainings, all of which have the same settings."""
        return "-".join([self.name, *self.methods])

    @property
    def game(self) -> str:
        """Return the environment with the parameters of every game."""
        return " ".join([self.env_id, *(param for param in self.params if not param.startswith(_SHAPING))])


#: The cheapest ones first.
TASKS: Final = (
    Task("mpe/simple_spread_v3", 1_000_000, (*METHODS, "pqn")),
    Task("jaxmarl/MPE_simple_spread_v3", 10_000_000, (*METHODS, "pqn")),
    Task("jaxmarl/MPE_simple_speaker_listener_v4", 10_000_000, (*METHODS, "pqn")),
    Task("vmas/balance", 10_000_000),
    *(  # BenchMARL's games
        Task(f"vmas/{scenario}", game_steps, params=params, folder=f"vmas-{scenario}-of-benchmarl-{game_steps}")
        for scenario, params in (
            ("balance", ("n_agents:4",)),
            ("navigation", ("n_agents:3", "shared_rew:False")),
            ("transport", ()),
        )
        for game_steps in (100_000, 1_000_000)
    ),
    Task("lbf/Foraging-10x10-3p-3f-v3", 5_000_000),
    Task("lbf/Foraging-15x15-4p-3f-v3", 5_000_000),
    Task("rware/rware-tiny-2ag-v2", 5_000_000),
    *(
        Task(f"overcooked/{layout}", 5_000_000, (*METHODS, "pqn"), params=(f"{_SHAPING}2500000",))
        for layout in KITCHENS
    ),
    # Returns of whole battles: in long trainings of 3m they win more than short rollouts (results/suites.md).
    *(
        Task(f"smax/{battle}", 10_000_000, methods, settings=settings)
        for battle in ("2s3z", "3s5z", "3s_vs_5z", "5m_vs_6m", "smacv2_5_units")
        for methods, settings in (
            ((*METHODS, f"saf{_MEMORY}"), ("n_envs:256", "n_minibatches:8", "n_steps:32", "gae_lambda:1.0")),
            (("pqn",), ("n_envs:256",)),
        )
    ),
)


def run(task: Task, seed: int, options: argparse.Namespace) -> Path:
    """Train and test the missing cells of a task and seed, one after the other, and return their folder."""
    folder: Path = options.folder / task.trainings
    words = ["run", task.name, "--env", task.env_id, "--size", "small", "--workers", "1", "--seeds", str(seed)]
    words += ["-n", str(task.game_steps), "--methods", *task.methods, "-f", str(folder)]
    words += ["-params", *task.settings] if task.settings else []
    experiments([*words, "--env-kwargs", *task.params] if task.params else words)
    return folder


def beside(task: Task, baselines: pd.DataFrame) -> Iterator[tuple[str, str, float | None]]:
    """
    Yield results of others' trainings, at least half and at most twice as long, notes with method and source, and the
    returns, None for a result of another unit.
    """
    for one in references(task.env_id):
        game = " ".join([one.task, *(f"{name}:{value}" for name, value in one.params.items())])
        is_elsewhere = not one.is_own and BASELINES.name not in one.source
        if is_elsewhere and game == task.game and task.game_steps / 2 <= one.game_steps <= 2 * task.game_steps:
            score = one.value if one.unit == "return" else None
            yield one.result, f"{one.method} after {one.game_steps:,} game steps: {one.source}", score
    is_near = baselines["game_steps"].between(task.game_steps / 2, 2 * task.game_steps)
    here = baselines[(baselines["task"] == task.game) & is_near]
    for (program, game_steps), trainings in here.groupby(["program", "game_steps"]):
        note = f"{program} after {game_steps:,} game steps: `{BASELINES.name}`"
        yield _over_seeds(trainings["return"]), note, float(trainings["return"].mean())


def _in_short(method: str) -> str:
    words = NAMED[method.removesuffix(_MEMORY)].words.partition(",")[0]
    return f"{words}, GRU" if method.endswith(_MEMORY) else words


def _over_seeds(values: pd.Series) -> str:
    if len(values) < FEWEST_SEEDS:
        return ", ".join(f"{value:.2f}" for value in values)
    value, low, high = mean_over_seeds(values.to_numpy())
    return f"{value:.2f} [{low:.2f}, {high:.2f}]"


def _teams() -> dict[tuple[str, int, str], Path]:
    """Return the folders of published teams by game, game steps and method."""
    found: dict[tuple[str, int, str], Path] = {}
    for path in sorted(TEAMS.glob("*/*/run.json")):
        settings = json.loads(path.read_text(encoding="utf-8"))["settings"]
        trained = Task(settings["env"], 0, params=tuple(f"{key}:{one}" for key, one in settings["env_kwargs"].items()))
        found[trained.game, settings["game_steps"], settings["algo"]] = path.parent
    return found


def table(tasks: Iterable[Task], folder: Path) -> Iterator[str]:
    """Yield the lines of the table, of the notes on others' results, and of the tasks that were not trained yet."""
    head = ["task", "game steps", "method", "best policy", "others", "most likely", "last policy", "random", "seeds"]
    head += ["minutes"]
    yield f"| {' | '.join(head)} |"
    yield f"|{' --- |' * len(head)}"
    baselines, teams = pd.read_csv(BASELINES), _teams()
    notes: list[str] = []
    commits: set[str] = set()
    missing, seconds = [], 0.0
    for task in tasks:
        others = []
        for result, note, _ in beside(task, baselines):
            notes += [] if note in notes else [note]
            others.append(f"{result} ({notes.index(note) + 1})")
        if not (folder / task.name).is_dir():
            missing.append(f"`{task.game}` ({'; '.join(others) or 'nothing is published'})")
            continue
        tests = read_results(folder, task.name).tests
        commits |= set(tests["commit"])
        random = tests[tests["method"] == RANDOM]["return_mean"].mean()
        for method in task.methods:
            here = tests[tests["method"] == method]
            team = teams.get((task.game, task.game_steps, method))
            name = _in_short(method) if team is None else f"[{_in_short(method)}](../{team.as_posix()})"
            cells = [f"`{task.game}`", f"{task.game_steps:,}", name]
            if here.empty:
                yield f"| {' | '.join([*cells, 'not trained', '; '.join(others), '', '', f'{random:.2f}', '0', ''])} |"
                continue
            seconds += here["processor_seconds"].sum()
            won = "" if here["success_rate"].isna().any() else f", {here['success_rate'].mean():.0%} won"
            cells += [
                f"**{_over_seeds(here['return_mean'])}**{won}",
                "; ".join(others),
                _over_seeds(here["return_most_likely"]),
                _over_seeds(here["return_last"]),
            ]
            cells += [f"{random:.2f}", str(len(here)), f"{here['processor_seconds'].mean() / 60:.0f}"]
            yield f"| {' | '.join(cells)} |"
    yield ""
    yield from (f"{number}. {note}" for number, note in enumerate(notes, 1))
    yield ""
    untrained = f"Not trained yet: {', '.join(missing)}. " if missing else ""
    yield f"{untrained}{seconds / 3600:.0f} core-hours of training. Commits: {', '.join(sorted(commits))}."


def figure(tasks: Iterable[Task], folder: Path) -> Figure:
    """Draw learning curves of long trainings where there are several methods, beside a random team and others."""
    baselines, runs = pd.read_csv(BASELINES), {}
    lines: dict[str, dict[str, float]] = {"random team": {}, "others, best": {}, "others, lowest": {}}
    for task in tasks:
        if task.game_steps < _LONG or not (folder / task.name).is_dir():
            continue
        frames = read_results(folder, task.name)
        if frames.curves["method"].nunique() > 1:
            runs[task.game] = frames.curves.assign(task=task.game)
            random = frames.tests[frames.tests["method"] == RANDOM]
            lines["random team"][task.game] = random["return_mean"].mean()
            if scores := [score for _, _, score in beside(task, baselines) if score is not None]:
                lines["others, best"][task.game], lines["others, lowest"][task.game] = max(scores), min(scores)
    names = {name: _in_short(name) for name in (*NAMED, f"saf{_MEMORY}")}
    return draw_curves(pd.concat(runs.values()), None, "task", "return", names, lines)


def main() -> None:
    """Run what is missing, and write raw data, table and figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-f", "--folder", type=Path, default=Path("runs", "suites"), help="of the trainings")
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    parser.add_argument("--tasks", nargs="+", default=[task.env_id for task in TASKS], help="to train on")
    parser.add_argument("--table", action="store_true", help="train nothing; use the cells that are finished")
    options = parser.parse_args()
    chosen = [task for task in TASKS if task.env_id in options.tasks]
    for seed in [] if options.table else options.seeds:
        for task in chosen:
            run(task, seed, options)
    for task in chosen:
        if (options.folder / task.trainings).is_dir():
            add(task.name, options.folder / task.trainings / task.name, RAW)
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(fill(text, {"table": "\n".join(table(TASKS, RAW))}), encoding="utf-8")
    figure(TASKS, RAW).savefig(RAW / "curves.png", dpi=80)


if __name__ == "__main__":
    main()
