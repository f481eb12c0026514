"""``python -m sb3_saf.suites [NAME]``: the suites, whether they are installed, and their tasks."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from typing import Any, Final

from sb3_saf.envs.supersuit_vec_env import SuperSuitVecEnv
from sb3_saf.suites.registry import HOME, Suite, find_environment, installed_version, references, suites
from sb3_saf.teams.checks import unknown_name
from sb3_saf.teams.rows import TeamSpaces

PROGRAM: Final = "python -m sb3_saf.suites"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return 0; SystemExit with 2 if the command was invalid."""
    parser = argparse.ArgumentParser(prog=PROGRAM, description="Suites of cooperative games, and the tasks of one.")
    parser.add_argument(
        "name", nargs="?", help=f"one of {', '.join(suites())}: list all of its tasks; or a task, such as smax/2s3z"
    )
    name = parser.parse_args(arguments).name
    try:
        if name is None:
            for suite in suites().values():
                print(summary(suite), end="\n\n")
            print(f"{PROGRAM} NAME lists all tasks of one, {PROGRAM} SUITE/TASK what is known of a task")
        elif "/" in name or suites()[HOME].find_task(name):
            print("\n".join(known(name)))
        elif name not in suites():
            short = (task.removesuffix("-v0") for task in suites()[HOME].tasks)
            raise unknown_name("suite or task", name, [*suites(), *short])
        else:
            print("\n".join(f"{name}/{task}" for task in suites()[name].tasks))
    except ValueError as error:
        parser.error(str(error))
    return 0


def known(name: str) -> list[str]:
    """Return agents and spaces of a task, and its references, which are known without the suite's package."""
    lines = []
    for one in references(name):
        params = "".join(f", {key} {value}" for key, value in one.params.items())
        lines.append(f"  {one}{params}: {one.source}")
    try:
        environment = find_environment(name)
    except ValueError as error:
        if not lines:
            raise
        return [str(error), *lines]
    if environment.suite is None:
        raise ValueError(f"{name} belongs to no suite; expected a task of {', '.join(suites())}")
    return [example(environment.suite, environment.task), *(lines or ["  no result is known"])]


def summary(suite: Suite) -> str:
    """Return a suite's package, version and number of tasks, and its examples with their agents and spaces."""
    lines = [f"{suite.name}  {suite.title}", f"  {suite.page}"]
    if (problem := suite.problem()) is not None:
        return "\n".join([*lines, f"  {problem}"])
    package = suite.requirements[0].name
    version = installed_version(package) or "of a source folder"
    lines.append(f"  {package} {version} is installed, {len(suite.tasks)} tasks")
    return "\n".join([*lines, *(f"  {example(suite, task)}" for task in suite.examples)])


def example(suite: Suite, task: str) -> str:
    """Return the id of a task with its agents, observations and actions."""
    env_id = f"{suite.name}/{task}"
    if suite.vec_env is not None:
        venv = suite.vec_env(task, 1, None, **suite.defaults)
    else:
        venv = SuperSuitVecEnv(partial(find_environment(env_id).make_game, {}), 1)
    row = TeamSpaces.of_rows(venv.observation_space, venv.action_space, venv.n_agents)
    venv.close()
    masked = ", masked" if row.action_mask is not None else ""
    opponents = ", opponents among them" if suite.is_competitive(task) else ""
    return (
        f"{env_id}: {row.n_agents} agents{opponents}, sees {_short(row.own)}, acts {_short(venv.action_space)}{masked}"
    )


def _short(space: Any) -> str:
    if hasattr(space, "n"):
        return f"Discrete({space.n})"
    return f"{type(space).__name__}{tuple(space.shape)} {space.dtype}"


if __name__ == "__main__":
    sys.exit(main())
