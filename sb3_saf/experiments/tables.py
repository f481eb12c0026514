"""
Results as tidy pandas tables, for reports and custom figures, and as ``runs.csv`` and ``curves.csv`` of an experiment.

Everything that reports draw is in the two files, so that committed ones can be drawn beside new results. ``runs.csv``
has one row per cell and test level:

``method``, ``task``                 name of the method, or ``"random"``; the environment
``train_level``, ``level``           levels of training and test, such as ``"c2-h1"``
``train_...``, one column each       parameters of these levels, such as ``train_coordination``, ``coordination``
``seed``                             of the run
``n_agents``, ``max_return``         N; the largest possible team return, if known
``game``, ``training``               digests: of the games' parameters that are not of the level, of all other settings
``game_steps``, ``best_game_steps``  of the training, 0 for a random team; until the best policy of the evaluations
``episodes``, ``actions``            of the test, and whether they are drawn, as in training, or the most likely ones
``return_mean``, ``return_low``,     absolute metric: mean team return of the best policy, with its 95 % interval over
``return_high``, ``return_sd``       episodes (Student's t) and their standard deviation
``return_last``                      the same of the last policy
``return_most_likely``,              the same of best and last policy with the most likely actions
``return_last_most_likely``
``success_rate``, ``length``         fraction of episodes won; empty if the games do not report it; mean game steps
``score``                            fraction of the largest return; if that is unknown, of the range of all returns
                                     in the table on this task and level
``agent_returns``                    mean own return of every agent, separated by spaces
``processor_seconds``,               cost of training with its evaluations, and of the tests
``wall_seconds_training``, ``wall_seconds_test``
``commit``, ``processor``            version of this package, and kind of processor
``cell``                             folder below ``cells``

``curves.csv`` has one row per evaluation during training: ``method``, ``task``, ``level`` and its parameters, ``seed``,
``game_steps``, ``processor_seconds`` of the training until then, and ``score``, the mean team return.

Comparisons of methods are on the same seeds and test games. The spread of paired differences over seeds is not taken to
be below the noise of the tests: with few seeds it may be small by chance. A difference is *equivalent* to none if a
test with both bounds (TOST, 5 %) excludes 2 % of the largest return. Other differences are *higher* or *lower* if the
95 % interval excludes 0, *open* if it does not.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from sb3_saf.experiments.definitions import MODULE, RANDOM, Cell, Experiment, Level, View, expand, merge
from sb3_saf.experiments.results import BEST, BEST_MODEL, EVALUATIONS, LAST, MOST_LIKELY, Results
from sb3_saf.export.writer import save_weights
from sb3_saf.teams.files import read_json, write_json, write_text
from sb3_saf.training.enjoy import make_policy
from sb3_saf.training.folders import RUN_FILE, WEIGHTS, Run, check_runs_no_code, finish_run, python_command, read_curve
from sb3_saf.training.replay import write_page
from sb3_saf.training.statistics import FEWEST_SEEDS, Estimate, Floats, mean_over_seeds, require_columns

RUNS: Final = "runs.csv"
CURVES: Final = "curves.csv"
_NEEDED: Final = (
    *("method", "task", "train_level", "level", "seed", "n_agents", "max_return", "game_steps", "return_mean", "score"),
)
#: Largest page of an episode that is published with a team.
_PAGE_BYTES: Final = 300_000
#: Settings of a run that are not of its training, or have a column of their own.
_OF_GAMES: Final = frozenset({"algo", "env", "env_kwargs", "n_agents", "size", "game_steps"})
#: Settings that change returns, and with them what is compared.
_OF_REWARDS: Final = ("env_wrapper", "vec_env_wrapper", "team_reward")


class Frames(NamedTuple):
    """Tables of an experiment, see the module: ``runs.csv``, and ``curves.csv`` of evaluations during training."""

    tests: pd.DataFrame
    curves: pd.DataFrame


def read_results(folder: str | Path, name: str) -> Frames:
    """
    Return the results of an experiment, complete or not.

    :param folder: folder of results, as in ``python -m sb3_saf.experiments run NAME -f FOLDER``; or one that has only
        ``runs.csv`` and ``curves.csv``, or a folder ``NAME`` with them
    :raises ValueError: for an unknown name, or if no cell is finished
    """
    results = Results(Path(folder))
    if results.config() is None:
        for published in (results.folder / name, results.folder):
            paths = [published / file for file in (RUNS, CURVES)]
            if not all(path.is_file() for path in paths):
                continue
            try:
                # Hashes of digits alone, or with one "e", look like numbers.
                texts = dict.fromkeys(("game", "training", "commit"), str)
                tests, curves = (pd.read_csv(path, float_precision="round_trip", dtype=texts) for path in paths)
                require_columns(tests, _NEEDED)
                require_columns(curves, ("method", "task", "level", "seed", "game_steps", "score"))
            except ValueError as error:
                raise ValueError(f"{published} has no {RUNS} and {CURVES} of experiments: {error}") from None
            return Frames(tests, curves)
        raise ValueError(f"{folder} has no results of {name!r}: expected a folder of cells, or {RUNS} and {CURVES}")
    cells = requested(results.experiment(name), results)
    tests = frame_of_tests(results, cells)
    if tests.empty:
        raise ValueError(
            f"{folder} has no finished cell of {name!r}; run it first: {python_command(MODULE)} run {name} -f {folder}"
        )
    return Frames(tests, frame_of_curves(results, cells))


def beside(ours: Frames, theirs: Frames) -> Frames:
    """
    Return results with published ones beside them.

    :param ours: results, whose cells take precedence
    :param theirs: published results; only those on the same games (task, level, agents, largest return, parameters) and
        of trainings of the same length are taken. A method that was trained with other settings than ours of its name,
        or does not tell them, or was tested by other numbers of episodes or kinds of actions, is ``NAME (published)``
    """
    here, games = ours.tests, ["task", "level", "n_agents", "max_return"]
    games += ["game"] if "game" in theirs.tests else []  # older ones do not tell
    rows, known = (one.assign(max_return=one["max_return"].astype(float).fillna(-1)) for one in (theirs.tests, here))
    same_games = keys_of(rows, *games).isin(keys_of(known, *games))
    rows = theirs.tests[same_games & rows["game_steps"].isin({0, *here["game_steps"]})]
    if rows.empty:
        steps = ", ".join(f"{n:,}" for n in sorted(set(here["game_steps"]) - {0}))
        warnings.warn(
            "published results are of other games (task, level, agents, parameters) or of trainings that are not of "
            f"{steps} game steps: none is beside",
            stacklevel=2,
        )
    protocol = "method", "training", "episodes", "actions"
    rows = rows.assign(**{name: rows.get(name, "not told") for name in protocol})
    differs = rows["method"].isin(here["method"]) & (rows["method"] != RANDOM)
    differs &= ~keys_of(rows, *protocol).isin(keys_of(here, *protocol))
    other = {method: f"{method} (published)" for method in rows["method"][differs]}
    for method, name in other.items():  # another folder may have published one, of other settings
        told = keys_of(here[here["method"] == name], *protocol[1:])
        if len(told) and not keys_of(rows[rows["method"] == method], *protocol[1:]).isin(told).all():
            number = 1 + sum(one.startswith(name[:-1]) for one in set(here["method"]))
            other[method] = f"{method} (published, {number})"
    rows, their_curves = (table.assign(method=table["method"].replace(other)) for table in (rows, theirs.curves))
    names = "method", "task", "train_level", "level", "seed"
    tests = rows[~keys_of(rows, *names).isin(keys_of(here, *names))]
    if tests.empty:
        return ours
    of_curves = keys_of(their_curves, "method", "task", "level", "seed")
    curves = their_curves[of_curves.isin(keys_of(tests, "method", "task", "train_level", "seed"))]
    together, all_curves = (pd.concat(pair, ignore_index=True) for pair in ((here, tests), (ours.curves, curves)))
    return Frames(_scored(together)[list(here)], all_curves)


def keys_of(table: pd.DataFrame, *columns: str) -> pd.Series:
    """Return the entries of some columns as one tuple for each row."""
    return pd.Series(list(table[list(columns)].itertuples(index=False, name=None)), index=table.index, dtype=object)


def requested(experiment: Experiment, results: Results) -> list[Cell]:
    """Return all cells ever requested in a folder with settings, random teams last."""
    config = results.config()
    assert config is not None
    selections = results.selections(experiment.name)
    cells = merge(cell for selection in selections for cell in expand(experiment, selection, config))
    return sorted(cells, key=lambda cell: not cell.is_trained)


def frame_of_tests(results: Results, cells: Iterable[Cell]) -> pd.DataFrame:
    """Return the finished tests of some cells, in the order of cells, then of tests."""
    table = pd.DataFrame([row for cell in cells for row in _rows(results, cell)])
    return table if table.empty else _scored(table).drop(columns=["low", "span"])


def _scored(tests: pd.DataFrame) -> pd.DataFrame:
    """Return tests with ``score``, (return - low) / span: 0 and the largest return if that is known, else the range."""
    of_game = tests.groupby(["task", "level"])["return_mean"]
    known = pd.to_numeric(tests["max_return"])
    low = of_game.transform("min").where(known.isna(), 0.0)
    span = known.fillna(of_game.transform("max") - low)
    span = span.where(span > 0, 1.0)
    return tests.assign(score=((tests["return_mean"] - low) / span).astype(float), low=low, span=span)


def _rows(results: Results, cell: Cell) -> Iterator[dict[str, Any]]:
    run = results.run(cell)
    for level in cell.tests:
        test = results.test(cell, level)
        if run is None or test is None:
            continue
        evaluation, cost = test.evaluation, run.finished()
        low, high = evaluation.interval()
        means = {(play.policy, play.actions): play.evaluation.mean for play in test.plays}
        actions, versions, settings = test.plays[0].actions, run.description["versions"], run.description["settings"]
        yield {
            **{"method": cell.method, "task": cell.task, "train_level": cell.level.slug, "level": level.slug},
            **{f"train_{name}": value for name, value in cell.level.parameters},
            **level.env_kwargs,
            "n_agents": test.n_agents,
            "max_return": test.max_return,
            "game": _digest(
                {key: value for key, value in settings["env_kwargs"].items() if key not in level.env_kwargs}
                | {key: settings[key] for key in _OF_REWARDS if key in settings}
            ),
            "training": _digest({key: value for key, value in settings.items() if key not in _OF_GAMES}),
            "seed": cell.seed,
            "game_steps": int(settings.get("game_steps", 0)),
            "best_game_steps": best_game_steps(run.folder) if cell.is_trained else 0,
            "episodes": len(evaluation.returns),
            "actions": actions,
            "return_mean": evaluation.mean,
            "return_low": low,
            "return_high": high,
            "return_sd": float(np.std(evaluation.returns, ddof=1)) if len(evaluation.returns) > 1 else math.nan,
            "return_last": means.get((LAST, actions), evaluation.mean),
            "return_most_likely": means.get((BEST, MOST_LIKELY), math.nan),
            "return_last_most_likely": means.get((LAST, MOST_LIKELY), math.nan),
            "success_rate": math.nan if evaluation.success_rate is None else evaluation.success_rate,
            "length": float(np.mean(evaluation.lengths)),
            "score": math.nan,
            "agent_returns": " ".join(f"{value:.12g}" for value in test.plays[0].agent_means),
            "processor_seconds": cost["processor_seconds"],
            "wall_seconds_training": cost["wall_seconds"],
            "wall_seconds_test": sum(play.wall_seconds for play in test.plays),
            "commit": versions["commit"],
            "processor": versions.get("processor", ""),
            "cell": cell.id,
        }


def _digest(settings: Mapping[str, Any]) -> str:
    """Return letters and digits that are equal for equal settings."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]


def best_game_steps(folder: Path) -> int:
    """Return the game steps of a run's best evaluation, the first of equal ones."""
    curve = pd.read_csv(folder / EVALUATIONS)
    return int(curve["game_steps"][curve["return_mean"].idxmax()])


def write_tables(experiment: Experiment, results: Results) -> Frames:
    """Write ``runs.csv`` and ``curves.csv`` of all requested and finished cells, with exact floats; return them."""
    cells = requested(experiment, results)
    frames = Frames(frame_of_tests(results, cells), frame_of_curves(results, cells))
    for name, frame in zip((RUNS, CURVES), frames, strict=True):
        write_text(results.folder / experiment.name / name, frame.to_csv(index=False, lineterminator="\n"))
    return frames


def _team_name(env: str, method: str) -> str:
    return f"{env.removesuffix('-default')}/{method}"


def publish(folder: Path, target: Path, only: str = "*") -> list[str]:
    """
    Write teams for others to play (``docs/zoo.md``, "Trained teams"): of each task, level and method of a folder of
    experiments the seed with the best test at the level of its training.

    :param target: folder of all teams; a team of the same name is replaced
    :param only: pattern of names, such as ``"TeamSupport-*/saf"``
    :return: names of the teams
    :raises ValueError: if there are none, or a team could not be loaded without running code
    """
    rows: list[dict[str, Any]] = []
    results = Results(folder)
    if results.config() is None:
        raise ValueError(f"expected a folder of experiments with its settings.json, got {folder}")
    for path in sorted(folder.glob("*/selections")):
        tests = frame_of_tests(results, requested(results.experiment(path.parent.name), results))
        if tests.empty:
            continue
        own = tests[(tests["game_steps"] > 0) & (tests["level"] == tests["train_level"])]
        rows += own.assign(experiment=path.parent.name).to_dict("records")
    best = {}
    for row in sorted(rows, key=lambda row: row["return_mean"]):
        name = _team_name(*row["cell"].split("/")[:2])
        if fnmatchcase(name, only):
            best[name] = row
    for path, damage in results.damaged.items():
        where, *names = path.relative_to(folder).parts
        if where != "cells" or (names[1] != RANDOM and fnmatchcase(_team_name(*names[:2]), only)):
            raise ValueError(f"{damage}; the same run command writes it anew")
    if not best:
        raise ValueError(f"expected finished cells of experiments in {folder} that fit {only!r}, got none")
    for name, row in best.items():
        source, team = Run(folder / "cells" / row["cell"]), target / name
        check_runs_no_code(source.description["settings"], source.folder)
        policy = make_policy(source.settings, source.folder / BEST_MODEL)
        shutil.rmtree(team, ignore_errors=True)
        save_weights(policy, team / WEIGHTS)
        returns = read_json(source.folder / "tests" / f"{row['level']}.json")["plays"][0]["returns"]
        row = {key: value for key, value in row.items() if value == value and "seconds" not in key}  # no NaN
        versions = {
            key: value for key, value in source.description["versions"].items() if key not in ("system", "host")
        }
        content = {**source.description, "versions": versions, "row": {**row, "returns": " ".join(map(repr, returns))}}
        write_json(team / RUN_FILE, content)
        finish_run(team, **{key: value for key, value in source.finished().items() if key != "files"})
        suite = source.settings.environment.suite
        if suite is not None and suite.is_drawn_from_state:
            page = write_page(["--model", str(team / WEIGHTS), "-o", str(team / "replay.html")])
            if page.stat().st_size > _PAGE_BYTES:
                page.unlink()
            finish_run(team)
    return list(best)


def frame_of_curves(results: Results, cells: Iterable[Cell]) -> pd.DataFrame:
    """Return the evaluations during training of all trained cells in one table; empty if there are none."""
    curves = []
    for cell in cells:
        run = results.run(cell) if cell.is_trained else None
        if run is not None:
            names = {"method": cell.method, "task": cell.task, "level": cell.level.slug, **cell.level.env_kwargs}
            evaluations, training = pd.read_csv(run.folder / EVALUATIONS), read_curve(run.folder)
            steps = evaluations["game_steps"].astype(float)
            seconds = seconds_at(steps, training, run.finished()["processor_seconds"])
            curve = pd.DataFrame(
                {"game_steps": steps, "processor_seconds": seconds, "score": evaluations["return_mean"]}
            )
            curves.append(curve.assign(**names, seed=cell.seed))
    columns = ["game_steps", "processor_seconds", "score", "method", "task", "level", "seed"]
    return pd.concat(curves, ignore_index=True) if curves else pd.DataFrame(columns=columns)


def seconds_at(steps: pd.Series, training: pd.DataFrame, total: float) -> Floats:
    """
    Return the processor seconds until evaluations, by interpolation between episodes that ended.

    :param steps: game steps of the evaluations; a last rollout may go beyond those that were asked for
    :param training: game steps and processor seconds at ends of episodes
    :param total: processor seconds of the whole training
    """
    end = max(steps.max(), training["game_steps"].max())
    return np.interp(steps, [0, *training["game_steps"], end], [0, *training["processor_seconds"], total])


def marl_eval(frames: Frames, environment: str) -> dict[str, Any]:
    """
    Return results in the format of marl-eval: environment, task, algorithm, run, step, metrics.

    Its functions compare complete data only: settings and seeds that every method has, with as many evaluations. These
    are at those game steps of the setting's shortest curve that all its runs have reached, interpolated where others
    differ.
    Absolute metrics are means over the test episodes of a run; ``score`` is normalised by the largest return.
    """
    tests = _scored(frames.tests).query("train_level == level and game_steps > 0")
    tests = complete(tests.assign(stratum=tests["task"] + " " + tests["level"]))
    curves = dict(list(frames.curves.groupby(["method", "task", "level", "seed"]))) if len(frames.curves) else {}
    content: dict[str, Any] = {}
    for (task, level), rows in tests.groupby(["task", "level"], sort=False):
        runs = zip(rows["method"], rows["task"], rows["train_level"], rows["seed"], strict=True)
        own = [curves[run].sort_values("game_steps") for run in runs]
        at = min((curve["game_steps"] for curve in own), key=len)
        at = at[
            at.between(max(curve["game_steps"].min() for curve in own), min(curve["game_steps"].max() for curve in own))
        ]
        for row, curve in zip(rows.itertuples(index=False), own, strict=True):
            values = np.interp(at, curve["game_steps"], curve["score"]).tolist()
            steps: dict[str, Any] = {
                f"step_{index}": {"step_count": int(step), "return": [value], "score": [(value - row.low) / row.span]}
                for index, (step, value) in enumerate(zip(at, values, strict=True))
            }
            steps["absolute_metrics"] = {"return": [row.return_mean], "score": [row.score]}
            of_task = content.setdefault(f"{task}_{level}".lower().replace("-", "_"), {})
            of_task.setdefault(row.method.replace("-", "_"), {})[f"seed_{row.seed}"] = steps
    return {environment: content}


def of_view(table: pd.DataFrame, view: View) -> pd.DataFrame:
    """
    Return the rows of a view, with their position on the axis in a column with the axis's name.

    The random team belongs to every view, since it does not depend on training levels.
    """
    positions = {level.slug: view.position(level) for level in view.levels}
    trained_at = table["level"] if view.train is None else view.train.slug
    rows = table[table["level"].isin(positions) & ((table["method"] == RANDOM) | (table["train_level"] == trained_at))]
    return rows.assign(**{view.axis: rows["level"].map(positions)})


def strata(experiment: Experiment, table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of all views, each once, with a column ``stratum``, the task of aggregates."""
    parts = []
    for view in experiment.views:
        shown = of_view(table, view)
        parts.append(shown.assign(stratum=shown["task"] + " " + shown["level"] + view.suffix))
    return pd.concat(parts, ignore_index=True).drop_duplicates(["method", "seed", "stratum"])


def complete(rows: pd.DataFrame) -> pd.DataFrame:
    """
    Return the strata and seeds that every method has, so that aggregates are comparable.

    :param rows: columns ``method``, ``seed``, ``stratum``, one row for each
    :return: subset of the rows; empty if the methods have none in common
    """
    n_methods = rows["method"].nunique()
    rows = rows[rows.groupby("stratum")["method"].transform("nunique") == n_methods]
    n_strata = rows["stratum"].nunique()
    return rows[rows.groupby("seed")["stratum"].transform("size") == n_methods * n_strata]


# --- comparisons ------------------------------------------------------------------------------------------------------


#: Differences below this share of the largest return do not matter.
MARGIN: Final = 0.02
_LEVEL: Final = 0.05


class Difference(NamedTuple):
    """
    Mean of differences of independent pairs.

    :param estimate: mean with its 95 % interval (Student's t), NaN for a single pair
    :param p: of the two-sided test of no difference
    :param p_equivalent: of the test that the difference is at least the margin; NaN without margin
    """

    estimate: Estimate
    p: float
    p_equivalent: float
    n: int

    @property
    def verdict(self) -> str:
        """``"higher"``, ``"lower"``, ``"equivalent"`` or ``"open"``; or that there are too few pairs."""
        if self.n < FEWEST_SEEDS:
            return f"fewer than {FEWEST_SEEDS} pairs"
        if self.p_equivalent < _LEVEL:
            return "equivalent"
        return "open" if self.p >= _LEVEL else "higher" if self.estimate.value > 0 else "lower"


def mean_difference(differences: Sequence[float] | Floats, noise: float = 0.0, margin: float = np.nan) -> Difference:
    """
    Test the mean of paired differences.

    :param differences: (n,) one for each pair
    :param noise: standard deviation that the tests alone give a difference: the floor of their spread
    :param margin: smallest difference that matters
    """
    sample = np.asarray(differences, dtype=np.float64)
    n, mean = len(sample), float(sample.mean())
    if n < 2:
        return Difference(Estimate(mean, np.nan, np.nan), np.nan, np.nan, n)
    error = max(float(sample.std(ddof=1)), noise) / np.sqrt(n)
    if error == 0:
        p_equivalent = np.nan if np.isnan(margin) else float(abs(mean) >= margin)
        return Difference(Estimate(mean, mean, mean), float(mean == 0), p_equivalent, n)
    from scipy.special import stdtr, stdtrit  # imported here, since it takes a tenth of a second

    half = float(stdtrit(n - 1, 0.975)) * error
    p = 2 * float(stdtr(n - 1, -abs(mean) / error))
    p_equivalent = float(stdtr(n - 1, (abs(mean) - margin) / error))
    return Difference(Estimate(mean, mean - half, mean + half), p, p_equivalent, n)


class Comparison(NamedTuple):
    """
    Comparison of two methods on the same seeds and the same test games.

    :param first: mean return of the first, with its 95 % interval over these seeds
    :param test: mean of first - second, paired by seed
    """

    seeds: list[int]
    first: Estimate
    second: Estimate
    test: Difference


class Compared(NamedTuple):
    """Comparison of a view's first method with another one, at a level of a task."""

    task: str
    level: Level
    ours: str
    other: str
    found: Comparison


def compare(first: pd.DataFrame, second: pd.DataFrame) -> Comparison | None:
    """
    Compare two methods at one level of one task.

    :param first: columns ``seed`` and ``return_mean``; with ``return_sd`` and ``episodes`` the noise of tests is known,
        with ``max_return`` the margin of equivalence
    :return: None if they have no seed in common
    """
    pairs = first.merge(second, on="seed", suffixes=("", "_second")).sort_values("seed")
    if pairs.empty:
        return None
    ours, theirs = (pairs[name].to_numpy(dtype=np.float64) for name in ("return_mean", "return_mean_second"))
    known = pairs["max_return"].iloc[0] if "max_return" in pairs else np.nan
    margin = MARGIN * float(known) if pd.notna(known) else np.nan
    test = mean_difference(ours - theirs, float(np.sqrt(variance_of_tests(pairs).mean())), margin)
    return Comparison(pairs["seed"].tolist(), mean_over_seeds(ours), mean_over_seeds(theirs), test)


def variance_of_tests(pairs: pd.DataFrame) -> Floats:
    """Return the variance of each pair's difference from the tests' episodes; 0 where it is not known."""
    if "return_sd" not in pairs:
        return np.zeros(len(pairs))
    parts = [pairs[f"return_sd{end}"] ** 2 / pairs[f"episodes{end}"] for end in ("", "_second")]
    return (parts[0] + parts[1]).fillna(0).to_numpy(dtype=np.float64)


def comparisons(table: pd.DataFrame, view: View) -> list[Compared]:
    """Compare SAF, or the first method if SAF is missing, with each other one, if they have common seeds."""
    rows = of_view(table, view)
    methods = list(dict.fromkeys(rows["method"]))
    ours = "saf" if "saf" in methods else next(iter(methods), RANDOM)
    found = []
    for task in dict.fromkeys(rows["task"]):
        for level in view.levels:
            here = rows[(rows["task"] == task) & (rows["level"] == level.slug)]
            for other in [method for method in methods if method != ours]:
                comparison = compare(*(here[here["method"] == one] for one in (ours, other)))
                if comparison is not None:
                    found.append(Compared(str(task), level, ours, other, comparison))
    return found


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p values corrected for the number of declared tests (Holm)."""
    p, order = np.asarray(p_values, dtype=np.float64), np.argsort(p_values)
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(1, np.maximum.accumulate((len(p) - np.arange(len(p))) * p[order]))
    return [float(value) for value in corrected]
