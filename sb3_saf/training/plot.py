"""``python -m sb3_saf.plot``: learning curves of the runs in a log folder."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from sb3_saf.suites.registry import folder_name
from sb3_saf.teams.checks import unknown_name
from sb3_saf.training.commands import (
    OneLineParser,
    add_gym_packages,
    import_packages,
    require,
    run_command,
    user_errors,
)
from sb3_saf.training.folders import FINISHED, RUN_FILE, Run, python_command
from sb3_saf.training.settings import Settings, load_settings

if TYPE_CHECKING:
    import pandas as pd
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
    import_packages(options.gym_packages)
    with user_errors():
        figure = _draw(options)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    with user_errors():  # for invalid file formats
        figure.savefig(options.output)
    print(options.output)


def _draw(options: argparse.Namespace) -> Figure:
    import pandas as pd

    from sb3_saf.training.figures import TEAM_RETURN, draw_curves

    runs, reasons = [], []
    for run in find_runs(options.log_folder, options.algos, options.env):
        try:
            run.curve(options.source)
            runs.append(run)
        except ValueError as error:
            reasons.append(str(error))
    if not runs:
        raise ValueError(reasons[0])
    for reason in reasons:
        print(f"left out: {reason}", file=sys.stderr)
    table = describe(runs)
    table["setting"] = setting_names(table)
    table["finished"] = [(run.folder / FINISHED).is_file() for run in table["run"]]
    # Curves end where the shortest of a method ends.
    is_cut = ~table["finished"] & table.groupby(["setting", "method"])["finished"].transform("any")
    for run in table["run"][is_cut]:
        print(f"left out: {run.folder} is not finished, others of its method are", file=sys.stderr)
    table = table[~is_cut]
    for method, changes in dict(zip(table["method"], table["changes"], strict=True)).items():
        if changes not in method:
            print(f"{method}: {changes}")
    are_treasures = all(run.settings.n_treasures is not None for run in table["run"])
    y_label = TEAM_RETURN if are_treasures else "team return"
    names = ("method", "seed", "setting")
    curves = [row.run.curve(options.source).assign(**{k: getattr(row, k) for k in names}) for row in table.itertuples()]
    return draw_curves(pd.concat(curves), options.title, panel="setting", y_label=y_label)


# --- runs as a table --------------------------------------------------------------------------------------------------


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


def describe(runs: Sequence[Run]) -> pd.DataFrame:
    """
    Describe runs in a table.

    :return: columns ``run``, ``method``, ``changes``, ``seed``, ``env``, ``size`` and the parameters of the game;
        ``default`` stands for those that only other runs of the game state. A method's name contains its differences
        from the zoo's settings and from other runs, or a number if these are too many; ``changes`` lists them. Of runs
        that differ only in their number, the table has the latest, of finished ones if there are any
    """
    import pandas as pd

    stated: dict[str, dict[str, str]] = {}
    for run in runs:
        stated.setdefault(run.settings.env_id, {}).update(dict.fromkeys(run.settings.env_kwargs, _DEFAULT))
    from_zoo = [_different_from_the_zoo(run.settings) | _measured_otherwise(run) for run in runs]
    kinds = [(run.settings.algo, run.settings.size, run.settings.env_id) for run in runs]
    variants: dict[str, dict[str, int]] = {}
    rows = []
    for run, kind, own in zip(runs, kinds, from_zoo, strict=True):
        # What all runs of the algorithm at that size share is not named.
        alike = [other for of, other in zip(kinds, from_zoo, strict=True) if of == kind]
        beside = [other for of, other in zip(kinds, from_zoo, strict=True) if of[2] == kind[2]]
        others = {key: beside if key in _MEASURED else alike for key in own}
        named = sorted(key for key, value in own.items() if any(other.get(key) != value for other in others[key]))
        changes = " ".join(f"{key}={own[key]}" for key in named)
        method = f"{kind[0]} {changes}".rstrip()
        if len(named) > _MOST_NAMED:
            numbers = variants.setdefault(kind[0], {})
            method = f"{kind[0]}, variant {numbers.setdefault(changes, len(numbers) + 1)}"
        identity = {"env": run.settings.env_id, "size": run.settings.size, "seed": run.seed}
        level = {**stated[run.settings.env_id], **run.settings.env_kwargs}
        taken = {*identity, "run", "changes", "method"}
        level = {f"{name} of the game" if name in taken else name: value for name, value in level.items()}
        rows.append({**identity, **level, "run": run, "changes": changes, "method": method})
    table = pd.DataFrame(rows)
    is_finished = np.array([(run.folder / FINISHED).is_file() for run in runs])
    last = table.drop(columns="run").astype(str).iloc[np.argsort(is_finished, kind="stable")]
    return table[~last.duplicated(keep="last").sort_index()].reset_index(drop=True)


def _different_from_the_zoo(settings: Settings) -> dict[str, str]:
    """Return settings that differ from the zoo's present ones for the same game, as text."""
    flat = []
    for one in (settings, load_settings(settings.algo, settings.env_id, settings.size, settings.env_kwargs)):
        own = {"n_envs": one.n_envs, "game_steps": one.game_steps, "time_limit": one.time_limit, **one.plain}
        own |= one.wrapping
        flat.append({**own, **own.pop("policy_kwargs", {})})
    ours, theirs = flat
    values = {
        key: ours.get(key, "default")
        for key in {**theirs, **ours}
        if repr(ours.get(key)) != repr(theirs.get(key)) and key != "policy_kwargs"
    }
    return {key: str(value) for key, value in values.items()}  # unrounded: what differs is another method


def _measured_otherwise(run: Run) -> dict[str, str]:
    """Return options of the run that change what its scores mean: where it began, and how it was evaluated."""
    given = run.description["options"]
    level = " ".join(f"{name}:{value}" for name, value in given.get("eval_env_kwargs", {}).items())
    beginning = given.get("initial_model", {}).get("path", "")
    actions = "True" if given.get("deterministic_eval") else ""
    values = {"eval_env_kwargs": level, "trained_agent": beginning, "deterministic_eval": actions}
    return {name: value for name, value in values.items() if value}


def setting_names(table: pd.DataFrame) -> list[str]:
    """Name the games of each row of :func:`describe`: the environment, and the parameters in which its rows differ."""
    named = {"method", "changes", "seed", "env", "run"}
    columns = [column for column in table.columns if column not in named]
    names: dict[Any, str] = {}
    for env, rows in table.groupby("env", sort=False):
        varying = [column for column in columns if rows[column].astype(str).nunique() > 1]
        for index, row in rows[varying].iterrows():
            parameters = [f"{name} {value}" for name, value in row.items()]
            names[index] = ", ".join([str(env).removesuffix("-v0"), *parameters])
    return [names[index] for index in table.index]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command, with the arguments of this process by default."""
    run_command(PROGRAM, lambda: plot(arguments))
