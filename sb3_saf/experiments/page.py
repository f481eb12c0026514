"""A report's Markdown page."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from sb3_saf.experiments.cells import Cell, LeftOut, Protocol
from sb3_saf.experiments.comparisons import FEWEST_SEEDS, compare
from sb3_saf.experiments.definitions import RANDOM, Experiment, View
from sb3_saf.experiments.files import write_text
from sb3_saf.experiments.options import PROGRAM
from sb3_saf.experiments.results import FAILED, Results
from sb3_saf.experiments.selection import complete, of_view, strata, with_levels
from sb3_saf.zoo.statistics import Estimate, interquartile_means, mean_over_seeds, score_matrices

#: Missing cells that are named.
_MOST_NAMED = 20


class Content(NamedTuple):
    """
    What a page is about.

    :param experiment: the experiment
    :param protocol: how its cells were trained and tested
    :param results: where they are
    :param cells: all that were asked for
    :param missing: those that are not finished
    :param left_out: levels that do not fit the size
    :param table: columns of ``Row``
    :param figures: pictures beside the page
    """

    experiment: Experiment
    protocol: Protocol
    results: Results
    cells: Sequence[Cell]
    missing: Sequence[Cell]
    left_out: Sequence[LeftOut]
    table: pd.DataFrame
    figures: Sequence[Path]


def write_page(content: Content, path: Path) -> Path:
    """Write the page."""
    sections = [
        _head(content),
        _missing(content),
        _pictures(content, "levels-", "aggregates"),
        *(_means(content, view) for view in content.experiment.views),
        _aggregates(content),
        *(_comparisons(content, view) for view in content.experiment.views),
        _pictures(content, "curve-"),
        _reproduction(content),
    ]
    write_text(path, "\n\n".join(section for section in sections if section) + "\n")
    return path


def _head(content: Content) -> str:
    experiment, protocol, table = content.experiment, content.protocol, content.table
    trained = table[table["method"] != RANDOM]
    methods = list(dict.fromkeys(trained["method"]))
    steps = " or ".join(f"{count:,}" for count in sorted(trained["game_steps"].unique()))
    action = "their most likely actions" if protocol.deterministic else "sampled actions"
    lines = [
        f"# {experiment.name}: {experiment.question}",
        "",
        f"Size `{protocol.size}`: {_numbers(table['n_agents'])} agents, {_numbers(table['n_treasures'])} treasures, "
        f"{steps} game steps of training. {', '.join(methods) or 'No method'} and a random team, seeds "
        f"{_numbers(table['seed'])}. Each number is a team return (treasures collected) over {protocol.episodes} "
        f"episodes with {action}, in games that no run trains on and that are the same for all methods of a seed.",
    ]
    if protocol.overrides:
        lines += ["", f"Settings in the place of the zoo's: `{dict(protocol.overrides)}`."]
    return "\n".join(lines)


def _numbers(column: pd.Series) -> str:
    return ", ".join(str(value) for value in sorted(column.unique()))


def _missing(content: Content) -> str:
    lines = [f"- {left_out}" for left_out in content.left_out]
    if content.missing:
        lines.append(
            f"- **{len(content.missing)} of {len(content.cells)} cells are missing**; numbers below lack them:"
        )
        for cell in content.missing[:_MOST_NAMED]:
            failed = content.results.status(cell).get("state") == FAILED
            why = f"failed, see `{content.results.cell_folder(cell) / 'error.txt'}`" if failed else "not run yet"
            lines.append(f"  - {cell}: {why}")
        if len(content.missing) > _MOST_NAMED:
            lines.append(f"  - and {len(content.missing) - _MOST_NAMED} more")
    return "\n".join(["## What is missing", "", *lines]) if lines else ""


def _pictures(content: Content, *prefixes: str) -> str:
    names = [path.name for path in content.figures if path.name.startswith(prefixes)]
    heading = "## Learning curves\n\nMean and 95 % interval over seeds, returns of the training episodes.\n\n"
    pictures = "\n\n".join(f"![{name.removesuffix('.png')}]({name})" for name in names)
    return (heading if "curve-" in prefixes else "") + pictures if names else ""


def _means(content: Content, view: View) -> str:
    """Mean returns: a table for each task, a column for each level."""
    rows = with_levels(of_view(content.table, view))
    if rows.empty:
        return ""
    levels = [level for level in view.levels if level in set(rows["level"])]
    parts = [f"## Team return by {view.axis}{_trained(view)}", "", "Mean over seeds, 95 % interval (Student's t).", ""]
    for task, of_task in rows.groupby("task", sort=False):
        body = []
        for method, of_method in of_task.groupby("method", sort=False):
            by_level = [of_method.loc[of_method["level"] == level, "return_mean"] for level in levels]
            counts = sorted({len(values) for values in by_level if len(values)})
            body.append([str(method), *map(_mean, by_level), " or ".join(map(str, counts))])
        parts += [*markdown_table([f"{task}", *map(str, levels), "seeds"], body), ""]
    return "\n".join(parts).rstrip()


def _trained(view: View) -> str:
    return "" if view.train is None else f", trained at {view.train}"


def _mean(values: pd.Series) -> str:
    return "–" if values.empty else show(mean_over_seeds(values.to_numpy()))


def show(estimate: Estimate, digits: int = 2) -> str:
    """An estimate as text; the interval only if there is one."""
    value = f"{estimate.value:.{digits}f}"
    if math.isnan(estimate.low):
        return value
    return f"{value} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"


def markdown_table(head: Sequence[str], body: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a table."""
    return [_line(head), _line(["---"] * len(head)), *map(_line, body)]


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _aggregates(content: Content) -> str:
    """Interquartile means, for each level over the tasks and over everything."""
    common = complete(strata(content.experiment, content.table))
    if common.empty:
        return "## Aggregates\n\nNone yet: the methods have no seed in common on the same settings."
    columns: dict[str, dict[str, Estimate]] = {}
    for view in content.experiment.views:
        for level in view.levels:
            train = view.train or level
            kept = [
                row.level == level and (row.method == RANDOM or row.trained_at == train) for row in common.itertuples()
            ]
            rows = common[kept]
            if not rows.empty:
                columns[f"{level}{_trained(view)}"] = interquartile_means(score_matrices(rows, "task"))
    columns["all"] = interquartile_means(score_matrices(common, "stratum"))
    methods = list(dict.fromkeys(common["method"]))
    body = [[method, *(show(column[method], 3) for column in columns.values())] for method in methods]
    text = (
        "Interquartile mean of the share of treasures collected, over tasks and the seeds "
        f"{_numbers(common['seed'])}, which all methods have; 95 % stratified bootstrap intervals (rliable)."
    )
    return "\n".join(["## Aggregates", "", text, "", *markdown_table(["", *columns], body)])


def _comparisons(content: Content, view: View) -> str:
    """The first method against each other one, seed by seed."""
    rows = with_levels(of_view(content.table, view))
    methods = list(dict.fromkeys(rows["method"]))
    if len(methods) < 2:
        return ""
    ours = "saf" if "saf" in methods else methods[0]
    body = list(_compared(rows, ours, [method for method in methods if method != ours]))
    head = ["task", "level", f"{ours} against", "seeds", ours, "other", "difference", f"{ours} is"]
    text = (
        "Mean returns on the seeds that both have, with 95 % intervals over seeds; differences are taken seed by seed. "
        f"Where the intervals of the two overlap, that of the difference holds 0, or there are fewer than "
        f"{FEWEST_SEEDS} seeds, no winner is named. Every line is a test of its own; many lines name a winner "
        "by chance now and then."
    )
    title = f"## Paired comparisons by {view.axis}{_trained(view)}"
    return "\n".join([title, "", text, "", *markdown_table(head, body)])


def _compared(rows: pd.DataFrame, ours: str, others: Sequence[str]) -> Iterator[list[str]]:
    for (task, level), here in rows.groupby(["task", "level"], sort=False):
        for other in others:
            first, second = (here.loc[here["method"] == method, ["seed", "return_mean"]] for method in (ours, other))
            found = compare(first, second)
            if found is not None:
                numbers = [show(found.first), show(found.second), show(found.difference)]
                seeds = ", ".join(map(str, found.seeds))
                yield [str(task), str(level), other, seeds, *numbers, found.verdict]


def _reproduction(content: Content) -> str:
    folder = content.results.folder
    lines = ["## Run it again", "", "```sh"]
    for request in content.results.requests(content.experiment.name):
        words = [*PROGRAM.split(), "run", content.experiment.name, *_protocol_words(content.protocol)]
        for option in ("seeds", "methods", "tasks", "levels"):
            if values := getattr(request, option):
                words += [f"--{option}", *map(str, values)]
        lines.append(f"{shlex.join(words)} -f {shlex.quote(str(folder))}")
    lines += [f"{PROGRAM} report {content.experiment.name} -f {shlex.quote(str(folder))}", "```", ""]
    lines.append(f"Every cell by itself (`{folder}/cells/*/*/*/command.txt`):")
    commands = [content.results.cell_folder(cell) / "command.txt" for cell in content.cells]
    texts = [path.read_text(encoding="utf-8").strip() for path in commands if path.exists()]
    lines += ["", "<details><summary>Commands</summary>", "", "```sh", *texts, "```", "", "</details>"]
    return "\n".join([*lines, "", _versions(content)])


def _protocol_words(protocol: Protocol) -> list[str]:
    """The options that make a protocol."""
    overrides = dict(protocol.overrides)
    words = ["--size", protocol.size]
    if "game_steps" in overrides:
        words += ["--game-steps", str(overrides.pop("game_steps"))]
    for option, pairs in (("--env-kwargs", overrides.pop("env_kwargs", {})), ("--hyperparams", overrides)):
        if pairs:
            words += [option, *(f"{key}:{value}" for key, value in pairs.items())]
    if protocol.episodes != Protocol(protocol.size).episodes:
        words += ["--episodes", str(protocol.episodes)]
    return words + ["--deterministic"] * protocol.deterministic


def _versions(content: Content) -> str:
    """What the cells ran on; more than one line is worth a look."""
    found: dict[str, set[str]] = {}
    for cell in content.cells:
        for name, version in content.results.versions(cell).items():
            found.setdefault(name, set()).add(version)
    lines = [f"{name} {' and '.join(sorted(versions))}" for name, versions in found.items() if name != "host"]
    mixed = [name for name, versions in found.items() if len(versions) > 1 and name not in ("host", "commit")]
    warning = f" **Cells differ in {', '.join(mixed)}.**" if mixed else ""
    return f"Versions: {', '.join(lines)}.{warning}"
