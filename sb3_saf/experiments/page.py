"""A report's Markdown page."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from sb3_saf.experiments.cells import Cell, LeftOut, Protocol
from sb3_saf.experiments.definitions import RANDOM, Experiment
from sb3_saf.experiments.files import write_text
from sb3_saf.experiments.options import PROGRAM
from sb3_saf.experiments.page_tables import aggregates, comparisons, losses, means, numbers
from sb3_saf.experiments.results import FAILED, Results
from sb3_saf.training.algorithms import ALGOS
from sb3_saf.training.commands import option_words

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
        *(means(content.table, view) for view in content.experiment.views),
        *(losses(content.table, view) for view in content.experiment.views),
        aggregates(content.experiment, content.table),
        *(comparisons(content.table, view) for view in content.experiment.views),
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
    actions = "their most likely actions" if protocol.deterministic else "sampled actions"
    if not protocol.deterministic and not all(ALGOS[method].draws_actions for method in methods):
        actions += " (the best ones of methods that learn values)"
    lines = [
        f"# {experiment.name}: {experiment.question}",
        "",
        f"Size `{protocol.size}`: {numbers(table['n_agents'])} agents, {numbers(table['n_treasures'])} treasures, "
        f"{steps} game steps of training. {', '.join(methods) or 'No method'} and a random team, seeds "
        f"{numbers(table['seed'])}. Each number is a team return (treasures collected) over {protocol.episodes} "
        f"episodes with {actions}, in games that no run trains on and that are the same for all methods of a seed.",
    ]
    if protocol.overrides:
        lines += ["", f"Settings in the place of the zoo's: `{dict(protocol.overrides)}`."]
    return "\n".join(lines)


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
    words += option_words("--env-kwargs", overrides.pop("env_kwargs", {}))
    words += option_words("--hyperparams", overrides)
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
