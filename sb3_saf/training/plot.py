"""``python -m sb3_saf.plot``: learning curves of the runs in a log folder."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from sb3_saf.suites.registry import folder_name
from sb3_saf.teams.checks import unknown_name
from sb3_saf.training.commands import (
    OneLineParser,
    add_gym_packages,
    require,
    run_command,
    user_errors,
)
from sb3_saf.training.folders import FINISHED, RUN_FILE, Run, python_command
from sb3_saf.training.settings import Settings, load_settings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PROGRAM: Final = "python -m sb3_saf.plot"
#: Maximum number of changed settings in a method's name.
_MOST_NAMED: Final = 2
#: Value of a parameter that a run leaves to the game.
_DEFAULT: Final = "default"
#: Settings that change what scores mean; they are named if any other run of the environment differs.
_MEASURED: Final = ("deterministic_eval", "env_wrapper", "eval_env_kwargs", "trained_agent")


def make_parser() -> argparse.ArgumentParser:
    """Make the parser."""
    text = "Draw learning curves of the runs in a log folder: mean and 95 % interval over seeds, in game steps."
    parser = OneLineParser(prog=PROGRAM, description=text)
    parser.add_argument("-f", "--log-folder", type=Path, default=Path("logs"), help="where the runs are")
    parser.add_argument("--algos", nargs="+", default=[], help="only these")
    parser.add_argument("--env", nargs="+", default=[], help="only these environments")
    add_gym_packages(parser)
    parser.add_argument(
        "--source",
        choices=("evaluation", "training"),
        default="evaluation",
        help="team returns of evaluation games (default), or of the games that were trained on",
    )
    parser.add_argument("--title")
    parser.add_argument("-o", "--output", type=Path, required=True, help="a file: .png, .pdf, .svg")
    return parser


def plot(arguments: Sequence[str] | None = None) -> None:
    """Draw a figure and print its path."""
    options = make_parser().parse_args(arguments)
    require("pandas", "matplotlib")
    with user_errors():
        figure = _draw(options)
    path = options.output if options.output.suffix else options.output.with_suffix(".png")  # Matplotlib's ending
    path.parent.mkdir(parents=True, exist_ok=True)
    with user_errors():  # for invalid file formats
        figure.savefig(path)
    print(path)


def _draw(options: argparse.Namespace) -> Figure:
    import pandas as pd

    from sb3_saf.training.figures import TEAM_RETURN, draw_curves

    curves, reasons = {}, []
    for run in find_runs(options.log_folder, options.algos, options.env):
        try:
            curves[run] = run.curve(options.source)
        except ValueError as error:
            reasons.append(str(error))
    if not curves:
        raise ValueError(reasons[0])
    named = describe(list(curves))
    # Curves end where the shortest of a method ends.
    finished = {(one.setting, one.method) for one in named if is_finished(one.run)}
    drawn = [one for one in named if is_finished(one.run) or (one.setting, one.method) not in finished]
    reasons += [f"{one.run.folder} is not finished, others of its method are" for one in named if one not in drawn]
    for reason in reasons:
        print(f"left out: {reason}", file=sys.stderr)
    for method, changes in {one.method: one.changes for one in drawn}.items():
        if changes not in method:
            print(f"{method}: {changes}")
    y_label = "team return" if any(one.run.settings.n_treasures is None for one in drawn) else TEAM_RETURN
    tables = [curves[one.run].assign(method=one.method, seed=one.run.seed, setting=one.setting) for one in drawn]
    return draw_curves(pd.concat(tables), options.title, panel="setting", y_label=y_label)


# --- names of runs ----------------------------------------------------------------------------------------------------


def find_runs(folder: Path, algos: Collection[str] = (), env_ids: Collection[str] = ()) -> list[Run]:
    """Find the runs in a log folder, of the given algorithms and environments, or of all if none are given."""
    if not folder.is_dir():
        raise ValueError(f"there is no folder {folder}; give the -f that sb3_saf.train was given")
    names = {folder_name(env_id) for env_id in env_ids}
    found: dict[str, list[Run]] = {}
    for path in sorted(folder.glob(f"*/*/{RUN_FILE}")):
        run = Run(path.parent)
        if not names or folder_name(str(run.description["settings"].get("env"))) in names:
            found.setdefault(path.parts[-3], []).append(run)
    if not found:
        of = f" of {', '.join(env_ids)}" if env_ids else ""
        raise ValueError(
            f"there are no runs{of} in {folder}; train some: {python_command('sb3_saf.train')} -f {folder}"
        )
    for algo in algos:
        if algo not in found:
            raise unknown_name(f"algorithm among the runs in {folder}:", algo, found)
    runs = [run for algo in (algos or found) for run in found[algo]]
    return sorted(runs, key=lambda run: run.number)


def is_finished(run: Run) -> bool:
    """Return whether a run has reached its end."""
    return (run.folder / FINISHED).is_file()


class Named(NamedTuple):
    """
    A run with its names.

    :param setting: its games: the environment, with the size and the parameters in which runs of it differ; ``default``
        stands for a parameter that only other runs state
    :param method: with its differences from the zoo's settings and from other runs, or a number if these are too many
    :param changes: these differences
    """

    run: Run
    setting: str
    method: str
    changes: str


def describe(runs: Sequence[Run]) -> list[Named]:
    """Name runs; of those that differ only in their number, only the latest, of finished ones if there are any."""
    from_zoo = {run: _different_from_the_zoo(run.settings) | _measured_otherwise(run) for run in runs}
    variants: dict[str, dict[str, int]] = {}
    named = []
    for run, own in from_zoo.items():
        algo, size = run.settings.algo, run.settings.size
        beside = [other for other in runs if other.settings.env_id == run.settings.env_id]
        # What all runs of the algorithm at that size share is not named.
        alike = [other for other in beside if (other.settings.algo, other.settings.size) == (algo, size)]
        differing = [
            f"{key}={value}"
            for key, value in sorted(own.items())
            if any(from_zoo[other].get(key) != value for other in (beside if key in _MEASURED else alike))
        ]
        changes = " ".join(differing)
        method = f"{algo} {changes}".rstrip()
        if len(differing) > _MOST_NAMED:
            numbers = variants.setdefault(algo, {})
            method = f"{algo}, variant {numbers.setdefault(changes, len(numbers) + 1)}"
        named.append(Named(run, _setting_name(run.settings, [other.settings for other in beside]), method, changes))
    latest = {(*one[1:], one.run.seed): one for one in sorted(named, key=lambda one: is_finished(one.run))}
    return [one for one in named if one in latest.values()]


def _setting_name(own: Settings, beside: Sequence[Settings]) -> str:
    """Return the name of the games, see :class:`Named`, beside those of all runs of the environment."""
    name = own.env_id.removesuffix("-v0")
    if any(other.size != own.size for other in beside):
        name += f", size {own.size}"
    for parameter in dict.fromkeys(parameter for other in beside for parameter in other.env_kwargs):
        values = {str(other.env_kwargs.get(parameter, _DEFAULT)) for other in beside}
        if len(values) > 1:
            name += f", {parameter} {own.env_kwargs.get(parameter, _DEFAULT)}"
    return name


def _different_from_the_zoo(settings: Settings) -> dict[str, str]:
    """Return settings that differ from the zoo's present ones for the same game, as text."""
    flat = []
    for one in (settings, load_settings(settings.algo, settings.env_id, settings.size, settings.env_kwargs)):
        own = {"n_envs": one.n_envs, "game_steps": one.game_steps, "time_limit": one.time_limit, **one.plain}
        policy_kwargs = own.pop("policy_kwargs", {})
        flat.append({**own, **one.wrapping, **policy_kwargs})
    ours, theirs = flat
    differing = [key for key in {**theirs, **ours} if repr(ours.get(key)) != repr(theirs.get(key))]
    return {key: str(ours.get(key, _DEFAULT)) for key in differing}  # unrounded: what differs is another method


def _measured_otherwise(run: Run) -> dict[str, str]:
    """Return options of the run that change what its scores mean: where it began, and how it was evaluated."""
    given = run.description["options"]
    level = " ".join(f"{name}:{value}" for name, value in given.get("eval_env_kwargs", {}).items())
    beginning = given.get("initial_model", {}).get("path", "")
    actions = "True" if given.get("deterministic_eval") else ""
    values = {"eval_env_kwargs": level, "trained_agent": beginning, "deterministic_eval": actions}
    return {name: value for name, value in values.items() if value}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command, with the arguments of this process by default."""
    run_command(PROGRAM, lambda: plot(arguments))
