"""``python -m sb3_saf.suites [NAME]``: the suites, whether they are installed, and their tasks."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from typing import Any, Final

from sb3_saf.make import make_team_env
from sb3_saf.suites.registry import suites
from sb3_saf.suites.suite import Suite
from sb3_saf.teams.checks import unknown_name
from sb3_saf.teams.rows import TeamSpaces
from sb3_saf.training.commands import USAGE_ERROR, OneLineParser

PROGRAM: Final = "python -m sb3_saf.suites"


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run the command line.

    :return: 0, or 2 if the command was invalid
    """
    parser = OneLineParser(prog=PROGRAM, description="Suites of cooperative games, and the tasks of one of them.")
    parser.add_argument("name", nargs="?", help=f"one of {', '.join(suites())}: list all of its tasks")
    name = parser.parse_args(arguments).name
    try:
        if name is None:
            for suite in suites().values():
                print(summary(suite), end="\n\n")
            print(f"{PROGRAM} NAME lists all tasks of one")
        elif name not in suites():
            raise unknown_name("suite", name, suites())
        else:
            print("\n".join(f"{name}/{task}" for task in suites()[name].tasks))
    except ValueError as error:
        print(f"{PROGRAM}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return USAGE_ERROR
    return 0


def summary(suite: Suite) -> str:
    """Return a suite's package, version and number of tasks, and its examples with their agents and spaces."""
    lines = [f"{suite.name}  {suite.title}", f"  {suite.page}"]
    if (problem := suite.problem()) is not None:
        return "\n".join([*lines, f"  {problem}"])
    package = suite.requirements[0].name
    lines.append(f"  {package} {suite.installed_version()} is installed, {len(suite.tasks)} tasks")
    return "\n".join([*lines, *(f"  {example(suite, task)}" for task in suite.examples)])


def example(suite: Suite, task: str) -> str:
    """Return the id of a task with its agents, observations and actions."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about opponents, which the line names
        env = make_team_env(f"{suite.name}/{task}")
    spaces = TeamSpaces.from_observation_space(env.observation_space)
    env.close()
    masked = ", masked" if spaces.action_mask is not None else ""
    opponents = ", opponents among them" if suite.is_competitive(task) else ""
    seen, acted = _short(spaces.own), _short(env.action_space)
    return f"{suite.name}/{task}: {spaces.n_agents} agents{opponents}, sees {seen}, acts {acted}{masked}"


def _short(space: Any) -> str:
    if hasattr(space, "n"):
        return f"Discrete({space.n})"
    return f"{type(space).__name__}{tuple(space.shape)} {space.dtype}"


if __name__ == "__main__":
    sys.exit(main())
