"""
Report of an experiment: finished and missing cells, the paper's figures, marl-eval's JSON, and a Markdown page of
means, losses, aggregates, comparisons and the commands to reproduce them.
"""

from __future__ import annotations

import json
import math
import os
import re
import shlex
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import pandas as pd
from matplotlib.figure import Figure

from sb3_saf.experiments.definitions import (
    COORDINATION,
    EXPERIMENTS,
    HETEROGENEITY,
    METHODS,
    PROGRAM,
    RANDOM,
    Cell,
    Experiment,
    Level,
    RunConfig,
    Selection,
    View,
    find_method,
)
from sb3_saf.experiments.results import Results
from sb3_saf.experiments.tables import (
    MARGIN,
    Frames,
    beside,
    comparisons,
    complete,
    holm,
    keys_of,
    marl_eval,
    of_view,
    requested,
    strata,
    write_tables,
)
from sb3_saf.suites.registry import find_environment, folder_name
from sb3_saf.training.commands import option_words
from sb3_saf.training.figures import TEAM_RETURN, draw_aggregates, draw_curves, draw_differences, draw_levels
from sb3_saf.training.statistics import (
    Estimate,
    interquartile_means,
    mean_over_seeds,
    optimality_gaps,
    probability_of_improvement,
    score_matrices,
)

#: Names of methods in words.
WORDS = {name: method.words for name, method in METHODS.items()}


class Content(NamedTuple):
    """
    Content of a report.

    :param cells: all requested cells
    :param frames: tables of tests and curves, see ``tables``
    :param figures: names of their files
    """

    experiment: Experiment
    config: RunConfig
    results: Results
    cells: Sequence[Cell]
    missing: Sequence[Cell]
    frames: Frames
    figures: Sequence[str]


def write_report(
    experiment: Experiment, results: Results, wanted: Selection, published: Sequence[Frames] = ()
) -> Content:
    """
    Write the report of an experiment, complete or not. The old report is replaced when the new one is complete.

    :param wanted: the seeds, methods, environments and levels to show; empty for all that were run
    :param published: results to draw beside these, on the same games
    :raises ValueError: if nothing is finished
    """
    config = results.config()
    assert config is not None
    shown = experiment.at(wanted.levels)
    shown_tests = shown.tests()
    cells = [
        replace(cell, tests=tuple(level for level in cell.tests if level in shown_tests.get(cell.level, ())))
        for cell in requested(experiment, results)
        if wanted.has(cell, experiment)
    ]
    tests, curves = write_tables(experiment, results)
    names = [(cell.id, level.slug) for cell in cells for level in cell.tests]
    tests = tests[keys_of(tests, "cell", "level").isin(names)] if len(tests) else tests
    if len(curves):
        runs = [(cell.method, cell.task, cell.level.slug, cell.seed) for cell in cells]
        curves = curves[keys_of(curves, "method", "task", "level", "seed").isin(runs)]
    frames = Frames(tests, curves)
    if frames.tests.empty:
        raise ValueError(f"{results.folder} has no finished cell of {experiment.name!r} among those to be shown")
    for others in published:
        frames = beside(frames, others)
    figures = {**_views(shown, frames), **_aggregates(shown, frames), **_curves(shown, frames)}
    missing = [cell for cell in cells if results.missing_tests(cell)]
    content = Content(shown, config, results, cells, missing, frames, list(figures))
    suite = find_environment(experiment.envs[0]).suite
    environment = "games" if suite is None else suite.name
    folder = results.folder / experiment.name
    with tempfile.TemporaryDirectory(dir=folder, prefix=".report-") as name:
        fresh = Path(name)
        for file, figure in figures.items():
            figure.savefig(fresh / file)
        (fresh / "report.md").write_text(page(content), encoding="utf-8")
        (fresh / "marl_eval.json").write_text(json.dumps(marl_eval(frames, environment), indent=1), encoding="utf-8")
        for file in (*figures, "marl_eval.json", "report.md"):
            os.replace(fresh / file, folder / file)
    return content


def _maximum(tests: pd.DataFrame) -> float | None:
    """Return the largest possible return if it is known and the same everywhere."""
    values = tests["max_return"].unique()
    return float(values[0]) if len(values) == 1 and pd.notna(values[0]) else None


def _y_label(tests: pd.DataFrame) -> str:
    return TEAM_RETURN if tests["max_return"].notna().all() else "team return"


def _views(experiment: Experiment, frames: Frames) -> dict[str, Figure]:
    """Return, for each axis of levels, a bar chart of the returns, and the paired differences."""
    figures = {}
    for view in experiment.views:
        rows = of_view(frames.tests, view)
        if rows.empty:
            continue
        name = view.axis.replace(" = ", "-")
        figures[f"levels-{name}.png"] = draw_levels(
            rows.assign(score=rows["return_mean"]),
            view.axis,
            title=f"{experiment.name}{view.suffix}",
            panel="task",
            y_label=_y_label(rows),
            names=WORDS,
            maximum=_maximum(rows),
        )
        compared = [one for one in comparisons(frames.tests, view) if one.other != RANDOM]
        if compared:
            tests = [(one, one.found.test) for one in compared]
            lines = [(one.task, one.other, str(one.level), *test.estimate.drawn(test.n)) for one, test in tests]
            maximum, ours = _maximum(rows), compared[0].ours
            figures[f"differences-{name}.png"] = draw_differences(
                pd.DataFrame(lines, columns=["task", "method", "level", "value", "low", "high"]),
                title=f"{WORDS.get(ours, ours)} minus others, seed by seed{view.suffix}",
                panel="task",
                x_label="difference of team returns, 95 % interval",
                names=WORDS,
                band=None if maximum is None else MARGIN * maximum,
                reference=ours,
            )
    return figures


def _aggregates(experiment: Experiment, frames: Frames) -> dict[str, Figure]:
    """Return interquartile means and performance profiles over the results that all methods have."""
    common = complete(strata(experiment, frames.tests))
    if common.empty:
        return {}
    seeds = ", ".join(map(str, sorted(common["seed"].unique())))
    title = f"{experiment.name}: {common['stratum'].nunique()} settings, seeds {seeds}"
    label = "treasures collected (share)" if common["max_return"].notna().all() else "normalised return"
    figure = draw_aggregates(score_matrices(common, "stratum"), title=title, x_label=label, names=WORDS)
    return {"aggregates.png": figure}


def _curves(experiment: Experiment, frames: Frames) -> dict[str, Figure]:
    """Return the learning curves of each training setting, against game steps and processor time."""
    figures: dict[str, Figure] = {}
    if frames.curves.empty:
        return figures
    titles = {level.slug: str(level) for level in experiment.tests()}
    tests = frames.tests[frames.tests["method"] == RANDOM]
    for (task, level), runs in frames.curves.groupby(["task", "level"], sort=False):
        random = tests[(tests["task"] == task) & (tests["level"] == level)]
        random = random[["method", "seed", "return_mean"]].rename(columns={"return_mean": "score"})
        panels = []
        for name, x in (("against game steps", "game_steps"), ("against processor time", "processor_seconds")):
            ends = pd.DataFrame({"game_steps": [runs[x].min(), runs[x].max()]})
            parts = [runs[["method", "seed", "score"]].assign(game_steps=runs[x]), random.merge(ends, how="cross")]
            panels.append(pd.concat([part for part in parts if len(part)]).assign(panel=name))
        figure = draw_curves(
            pd.concat(panels, ignore_index=True),
            title=f"{experiment.name}: {task}, {titles.get(level, level)}",
            panel="panel",
            y_label=_y_label(frames.tests),
            names=WORDS,
        )
        figure.axes[1].set_xlabel("processor time of the training (s)")
        figures[f"curve-{folder_name(str(task))}-{level}.png"] = figure
    return figures


# --- the page ---------------------------------------------------------------------------------------------------------


#: Maximum number of missing cells to list.
_MOST_NAMED: Final = 20
_NOTHING: Final = "–"


def page(content: Content) -> str:
    """Return the page."""
    views, table = content.experiment.views, content.frames.tests
    sections = [
        _head(content),
        _missing(content),
        _pictures(content, "levels-", "differences-", "aggregates"),
        *(means(table, view) for view in views),
        known(content),
        *(losses(table, view) for view in views if table["max_return"].notna().all()),
        aggregates(content.experiment, table),
        *(_comparisons(table, view) for view in views),
        _pictures(content, "curve-"),
        _reproduction(content),
    ]
    return "\n\n".join(section for section in sections if section) + "\n"


def _head(content: Content) -> str:
    experiment, config, table = content.experiment, content.config, content.frames.tests
    trained = table[table["method"] != RANDOM]
    methods = list(dict.fromkeys(trained["method"]))
    steps = " or ".join(f"{count:,}" for count in sorted(trained["game_steps"].unique()))
    actions = " or ".join(f"{actions} actions" for actions in dict.fromkeys(trained["actions"]))
    of_treasures = table["max_return"].notna().all()
    treasures = f", {_numbers(table['max_return'])} treasures" if of_treasures else ""
    meaning = "a team return (treasures collected)" if of_treasures else "a team return (rewards of all agents)"
    lines = [
        f"# {experiment.name}: {_text(experiment.question)}",
        "",
        f"Size `{config.size}`: {_numbers(table['n_agents'])} agents{treasures}, {steps} game steps of training. "
        f"{', '.join(methods) or 'No method'} and a random team, seeds {_numbers(table['seed'])}. Each number is "
        f"{meaning} of the best policy of a run by evaluations during training, over {_numbers(table['episodes'])} new "
        f"games with {actions}{', the same for all methods of a seed' if table['episodes'].nunique() == 1 else ''}.",
    ]
    if config.overrides:
        lines += ["", f"Settings in the place of those of `zoo_configs`: `{dict(config.overrides)}`."]
    return "\n".join(lines)


def _numbers(column: pd.Series) -> str:
    """Return the distinct integers of a column, in order."""
    return ", ".join(str(int(value)) for value in sorted(column.unique()))


def _missing(content: Content) -> str:
    results = content.results
    lines = []
    if content.missing:
        lines.append(
            f"- **{len(content.missing)} of {len(content.cells)} cells are missing**; numbers below lack them:"
        )
        for cell in content.missing[:_MOST_NAMED]:
            levels = ", ".join(map(str, results.missing_tests(cell)))
            state = "not run yet" if results.run(cell) is None else f"not tested yet at {levels}"
            failure = results.failure(cell)
            lines.append(f"  - {_text(cell)}: {state if failure is None else f'failed, see `{failure}`'}")
        if len(content.missing) > _MOST_NAMED:
            lines.append(f"  - and {len(content.missing) - _MOST_NAMED} more")
    lines += [f"- damaged: {error}" for error in results.damaged.values()]
    return "\n".join(["## What is missing", "", *lines]) if lines else ""


def _pictures(content: Content, *prefixes: str) -> str:
    names = [name for name in content.figures if name.startswith(prefixes)]
    heading = "## Learning curves\n\nMean and 95 % interval over seeds, returns of evaluations on other games.\n\n"
    pictures = "\n\n".join(f"![{name.removesuffix('.png')}]({name})" for name in names)
    return (heading if "curve-" in prefixes else "") + pictures if names else ""


def _table(head: Sequence[object], body: Iterable[Sequence[object]]) -> list[str]:
    """Return the lines of a table; ``|`` in a cell would end it."""
    rows = [[" ".join(str(cell).split()).replace("|", "\\|") for cell in cells] for cells in (head, *body)]
    return [f"| {' | '.join(cells)} |" for cells in (rows[0], ["---"] * len(head), *rows[1:])]


def _text(name: object) -> str:
    """Return a user's name as text that Markdown does not format."""
    return re.sub(r"([\\`*<>\[\]])", r"\\\1", str(name))


def _name(method: object) -> str:
    """Return the name of a method in words."""
    return _text(find_method(str(method)).words)


def _show(estimate: Estimate, digits: int = 2) -> str:
    """Return an estimate as text; the interval only if there is one."""
    value = f"{estimate.value:.{digits}f}"
    if math.isnan(estimate.low):
        return value
    return f"{value} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"


def means(table: pd.DataFrame, view: View) -> str:
    """Return mean returns: one table per task, one column per level."""
    rows = of_view(table, view)
    if rows.empty:
        return ""
    levels = [level for level in view.levels if level.slug in set(rows["level"])]
    parts = [f"## Team return by {view.axis}{view.suffix}", "", "Mean over seeds, 95 % interval (Student's t).", ""]
    for task, of_task in rows.groupby("task", sort=False):
        body = []
        for method, of_method in of_task.groupby("method", sort=False):
            by_level = [of_method.loc[of_method["level"] == level.slug, "return_mean"] for level in levels]
            counts = sorted({len(values) for values in by_level if len(values)})
            shown = [_NOTHING if values.empty else _show(mean_over_seeds(values.to_numpy())) for values in by_level]
            body.append([_name(method), *shown, " or ".join(map(str, counts))])
        parts += [*_table([_text(task), *map(_text, levels), "seeds"], body), ""]
    return "\n".join(parts).rstrip()


def known(content: Content) -> str:
    """Return mean results beside what is known of the same games, see ``sb3_saf.suites.registry``."""
    lines = []
    keys = ["task", "method", "train_level", "level"]
    results = content.frames.tests.groupby(keys)[["success_rate", "return_mean", "game_steps"]].mean()
    cells = {(cell.task, cell.method, cell.level.slug): cell for cell in content.cells if cell.is_trained}
    for key, cell in cells.items():
        for level in cell.tests:
            if (*key, level.slug) in results.index:
                won, score, game_steps = results.loc[(*key, level.slug)]
                settings = content.config.settings(cell, level)
                scores = {"return": score} if pd.isna(won) else {"won": won, "return": score}
                beside = settings.standing(scores, int(game_steps))
                if beside is not None:
                    trained = "" if level == cell.level else f" (trained at {_text(cell.level)})"
                    lines.append(f"- {_text(cell.task)}, {_text(level)}{trained}, {_name(cell.method)}: {beside.text}")
    return "\n".join(["## Beside known results", "", *lines]) if lines else ""


def losses(table: pd.DataFrame, view: View) -> str:
    """Return the loss at harder levels: the lost fraction of the easiest level's return, paired by seed."""
    if view.train is not None or view.parameter not in (COORDINATION, HETEROGENEITY):
        return ""
    rows = of_view(table, view)
    first, *harder = sorted(view.levels, key=view.position)
    harder = [level for level in harder if level.slug in set(rows["level"])]
    if not harder:
        return ""
    body = []
    for task, of_task in rows.groupby("task", sort=False):
        for method, of_method in of_task.groupby("method", sort=False):
            by_level = of_method.pivot_table(index="seed", columns="level", values="return_mean")
            body.append([_text(task), _name(method), *(_loss(by_level, first, level) for level in harder)])
    text = (
        f"Share of the return at {first} that is lost, in percent: mean over seeds of each seed's own loss, 95 % "
        f"interval (Student's t). {_NOTHING} where a seed has no return at {first} to lose."
    )
    return "\n".join([f"## Loss by {view.axis}", "", text, "", *_table(["task", "", *map(_text, harder)], body)])


def _loss(returns: pd.DataFrame, easy: Level, hard: Level) -> str:
    """Return the loss from an easy to a hard level by the returns of each seed (rows) at each level (columns)."""
    pairs = returns.reindex(columns=[easy.slug, hard.slug]).dropna()
    if pairs.empty or not (pairs[easy.slug] > 0).all():
        return _NOTHING
    return _show(mean_over_seeds((100 * (1 - pairs[hard.slug] / pairs[easy.slug])).to_numpy()), digits=0)


def aggregates(experiment: Experiment, table: pd.DataFrame) -> str:
    """Return interquartile means over the tasks, for each level and over all levels."""
    common = complete(strata(experiment, table))
    if common.empty:
        return "## Aggregates\n\nNone yet: no seed was run by all methods on all of their common settings."
    of_treasures = common["max_return"].notna().all()
    what = (
        "the share of treasures collected"
        if of_treasures
        else "the return, scaled to 0 to 1 by the range of all returns on a setting"
    )
    text = (
        f"Interquartile mean of {what}, over tasks and the seeds {_numbers(common['seed'])}, which all methods have; "
        "95 % stratified bootstrap intervals (rliable)."
    )
    parts = ["## Aggregates", "", text, ""]
    methods = list(dict.fromkeys(common["method"]))
    for view in experiment.views:
        columns = {}
        for level in view.levels:
            rows = of_view(common, view)
            rows = rows[rows["level"] == level.slug].drop_duplicates(["method", "seed", "task"])
            if not rows.empty:
                columns[_text(level)] = interquartile_means(score_matrices(rows, "task"))
        if columns:
            parts += [*_estimates([f"by {view.axis}{view.suffix}", *columns], methods, columns.values()), ""]
    scores = score_matrices(common, "stratum")
    ours = "saf" if "saf" in methods else methods[0]
    better = {method: probability_of_improvement(scores[ours], scores[method]) for method in methods}
    head = ["over everything", "all", "optimality gap", f"probability that {_name(ours)} is better"]
    return "\n".join(
        [*parts, *_estimates(head, methods, [interquartile_means(scores), optimality_gaps(scores), better])]
    )


def _estimates(head: Sequence[str], methods: Iterable[str], columns: Iterable[Mapping[str, Estimate]]) -> list[str]:
    found = list(columns)
    return _table(head, [[_name(method), *(_show(column[method], 3) for column in found)] for method in methods])


def _comparisons(table: pd.DataFrame, view: View) -> str:
    """Return comparisons of the first method with each other one, paired by seed."""
    compared = comparisons(table, view)
    if not compared:
        return ""
    ours = _name(compared[0].ours)
    text = (
        "Mean returns on the seeds that both have, with 95 % intervals over seeds; differences are taken seed by seed, "
        "and their spread is at least the noise of the tests. Equivalent: a difference of "
        f"{100 * MARGIN:g} % of the largest return is excluded (5 %). p is of no difference, corrected for the lines "
        "of this table (Holm)."
    )
    head = ["task", "level", f"{ours} against", "seeds", ours, "other", "difference", "p", f"{ours} is"]
    corrected = iter(holm([one.found.test.p for one in compared if not math.isnan(one.found.test.p)]))
    body = []
    for task, level, _, other, found in compared:
        numbers = [_show(found.first), _show(found.second), _show(found.test.estimate)]
        p = _NOTHING if math.isnan(found.test.p) else f"{next(corrected):.3f}"
        seeds = ", ".join(map(str, found.seeds))
        body.append([_text(task), _text(level), _name(other), seeds, *numbers, p, found.test.verdict])
    heading = f"## Paired comparisons by {view.axis}{view.suffix}"
    return "\n".join([heading, "", text, "", *_table(head, body)])


def _reproduction(content: Content) -> str:
    folder = content.results.folder
    experiment = content.results.experiment(content.experiment.name)  # with all levels
    grid = ["--env", *experiment.envs, *option_words("--vary", experiment.vary)]
    own = [] if experiment.name in EXPERIMENTS else grid
    lines = ["## Run it again", "", "```sh"]
    for selection in content.results.selections(experiment.name):
        words = [*PROGRAM.split(), "run", experiment.name, *own, *content.config.words()]
        words += ["--episodes", str(content.config.episodes), "--seeds", *map(str, selection.seeds)]
        for option, values in (("methods", selection.methods), ("levels", selection.levels)):
            words += [f"--{option}", *values] if values else []
        if selection.envs:
            words += ["--tasks", *selection.envs]
        lines.append(f"{shlex.join(words)} -f {shlex.quote(str(folder))}")
    lines += [f"{PROGRAM} report {experiment.name} -f {shlex.quote(str(folder))}", "```", ""]
    lines.append(
        f"`{PROGRAM} check {folder}/cells/TASK-LEVEL/METHOD/seed-N` runs a cell again and compares. Each cell:"
    )
    runs = [run for cell in content.cells if cell.is_trained and (run := content.results.run(cell)) is not None]
    texts = [run.description["command"] for run in runs]
    lines += ["", "<details><summary>Commands</summary>", "", "```sh", *texts, "```", "", "</details>"]
    return "\n".join([*lines, "", _versions(content)])


def _versions(content: Content) -> str:
    """Return the software and hardware of the cells, one line per variant."""
    variants: dict[str, set[str]] = {}
    for cell in content.cells:
        if (run := content.results.run(cell)) is not None:
            for name, version in {**run.description["versions"], "device": run.finished().get("device")}.items():
                if version is not None and name != "host":
                    variants.setdefault(name, set()).add(str(version))
    lines = [f"{name} {' and '.join(sorted(versions))}" for name, versions in variants.items()]
    mixed = [name for name, versions in variants.items() if len(versions) > 1]
    trainings = content.frames.tests.groupby(["method", "task", "train_level"])["training"]
    mixed += ["settings of training"] if (trainings.nunique() > 1).any() else []
    warning = f" **Cells differ in {', '.join(mixed)}.**" if mixed else ""
    return f"Versions: {', '.join(lines)}.{warning}"
