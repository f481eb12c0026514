"""``python -m sb3_saf.plot``: figures of the runs in a log folder."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sb3_saf.teams.checks import unknown_name
from sb3_saf.training.commands import CommandError, OneLineParser, run_command, user_errors

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sb3_saf.training.runs import Run, Source

PROGRAM: Final = "python -m sb3_saf.plot"
#: Columns of :func:`describe` that are not parameters of the game.
_NO_LEVELS: Final = ("env", "size", "seed", "run", "changes", "method")


def make_parser() -> argparse.ArgumentParser:
    """Make the parser, with one command for each kind of figure."""
    parser = OneLineParser(prog=PROGRAM, description="Draw the runs in a log folder.")
    commands = parser.add_subparsers(dest="kind", required=True, parser_class=OneLineParser)
    kinds = {
        "curves": "learning curves: mean and 95 %% interval over seeds, in game steps",
        "levels": "bars of the return against a parameter of the level, mean and 95 %% interval over seeds",
        "aggregate": "interquartile means and performance profiles with stratified bootstrap intervals (rliable)",
    }
    for kind, text in kinds.items():
        command = commands.add_parser(kind, help=text, description=text.replace("%%", "%"))
        command.add_argument("-f", "--log-folder", type=Path, default=Path("logs"), help="where the runs are")
        command.add_argument("--algos", nargs="+", default=[], help="only these")
        command.add_argument("--env", nargs="+", default=[], help="only these environments")
        command.add_argument(
            "--source",
            choices=("evaluation", "training"),
            default="evaluation",
            help="team returns of evaluation games (default), or of the games that were trained on",
        )
        command.add_argument("--title")
        command.add_argument("-o", "--output", type=Path, required=True, help="a file: .png, .pdf, .svg")
        if kind == "levels":
            command.add_argument("--level", default="coordination", help="coordination (default), heterogeneity, ...")
    return parser


def plot(arguments: Sequence[str] | None = None) -> None:
    """Draw a figure and print its path."""
    options = make_parser().parse_args(arguments)
    try:
        with user_errors():
            figure = _draw(options)
    except ModuleNotFoundError as error:
        raise CommandError(f"figures need {error.name}: pip install '.[render,zoo]' in the clone") from None
    options.output.parent.mkdir(parents=True, exist_ok=True)
    with user_errors():  # for invalid file formats
        figure.savefig(options.output)
    print(options.output)


def _draw(options: argparse.Namespace) -> Figure:
    import pandas as pd

    from sb3_saf.training.figures import TEAM_RETURN, draw_aggregates, draw_curves, draw_levels
    from sb3_saf.training.runs import describe, find_runs, setting_names
    from sb3_saf.training.statistics import score_matrices

    table = describe(_with_scores(find_runs(options.log_folder, options.algos, options.env), options.source))
    if options.kind == "levels" and options.level not in table:
        raise unknown_name("parameter", options.level, (column for column in table if column not in _NO_LEVELS))
    without = [options.level] if options.kind == "levels" else []
    table["setting"] = setting_names(table, without)
    for method, changes in dict(zip(table["method"], table["changes"], strict=True)).items():
        if changes not in method:
            print(f"{method}: {changes}")
    are_treasures = "n_treasures" in table and table["n_treasures"].notna().all()
    y_label = TEAM_RETURN if are_treasures else "team return"
    if options.kind == "curves":
        names = ("method", "seed", "setting")
        curves = [
            row.run.curve(options.source).assign(**{k: getattr(row, k) for k in names}) for row in table.itertuples()
        ]
        return draw_curves(pd.concat(curves), options.title, panel="setting", y_label=y_label)
    table["score"] = [run.final_score(options.source) for run in table["run"]]
    if options.kind == "levels":
        return draw_levels(table, options.level, options.title, panel="setting", y_label=y_label)
    if are_treasures:
        table["score"], y_label = table["score"] / table["n_treasures"], "treasures collected / on the map"
    return draw_aggregates(score_matrices(table, "setting"), options.title, y_label)


def _with_scores(runs: Sequence[Run], source: Source) -> list[Run]:
    """Leave out runs without scores, and say why; ValueError if none has any."""
    found, reasons = [], []
    for run in runs:
        try:
            run.curve(source)
            found.append(run)
        except ValueError as error:
            reasons.append(str(error))
    if not found:
        raise ValueError(reasons[0])
    for reason in reasons:
        print(f"left out: {reason}", file=sys.stderr)
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command, with the arguments of this process by default."""
    run_command(PROGRAM, lambda: plot(arguments))
