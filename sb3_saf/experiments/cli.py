"""The command line: ``list``, ``plan``, ``run``, ``report``."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Final, NoReturn

from sb3_saf.experiments.cells import Shard
from sb3_saf.experiments.definitions import EXPERIMENTS, Experiment, find_experiment
from sb3_saf.experiments.options import (
    PROGRAM,
    add_choice,
    add_engine,
    add_machine,
    add_protocol,
    add_rate,
    choice_of,
    engine_of,
    existing_results_of,
    machine_of,
    positive,
    protocol_of,
    results_of,
    wanted_of,
    workers_of,
)
from sb3_saf.training.commands import USAGE_ERROR, OneLineParser

#: What a shell reports for a process that Ctrl-C has ended.
_INTERRUPTED: Final = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run the command line.

    :return: 0 if all went well, 1 if cells failed, 2 if the command was wrong, 130 if it was interrupted
    """
    options = _parser().parse_args(arguments)
    try:
        code: int = options.function(options)
    except (ValueError, OSError) as error:
        print(f"{PROGRAM} {options.command}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return _INTERRUPTED
    return code


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(prog=PROGRAM, description="The paper's experiments by name.")
    commands = parser.add_subparsers(dest="command", required=True, parser_class=OneLineParser)
    commands.add_parser("list", help="the experiments").set_defaults(function=_list)
    for name, function, groups, text in (
        ("plan", _plan, (add_protocol, add_machine, add_rate), "cells, game steps, time and memory, before it runs"),
        ("run", _run, (add_protocol, add_machine, add_engine), "run what is missing"),
        ("report", _report, (), "figures and a page of tables, of whatever is there"),
    ):
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument("name", metavar="NAME", help=f"one of {', '.join(EXPERIMENTS)}")
        command.set_defaults(function=function)
        for add_group in (add_choice, *groups):
            add_group(command)
    return parser


def _list(options: argparse.Namespace) -> int:
    for experiment in EXPERIMENTS.values():
        print(f"{experiment.name:<19}{experiment.question}")
        for line in _details(experiment):
            print(f"{'':<19}  {line}")
    return 0


def _details(experiment: Experiment) -> list[str]:
    if not experiment.is_grid:
        return []
    agents = "" if experiment.n_agents is None else f", {experiment.n_agents} agents"
    return [f"{', '.join(experiment.methods)} on {', '.join(experiment.tasks)}{agents}", *map(str, experiment.views)]


def _run(options: argparse.Namespace) -> int:
    from sb3_saf.experiments.run import run

    experiment = find_experiment(options.name)
    if not experiment.is_grid:
        return _print_parameters()
    results, machine = results_of(options), machine_of(options)
    choice, protocol, shard = choice_of(options), protocol_of(options), Shard.parse(options.shard)
    engine = engine_of(options)
    try:
        with _ending_like_interrupted(signal.SIGTERM):
            summary = run(experiment, choice, protocol, results, engine, machine, shard)
    except KeyboardInterrupt:
        print(
            "\ninterrupted: workers have ended, finished cells and checkpoints are kept; the same command continues",
            file=sys.stderr,
        )
        return _INTERRUPTED
    print(f"table: {results.folder / experiment.name / 'table.csv'}")
    if summary.failed:
        print(f"{len(summary.failed)} cells failed; the same command tries them again", file=sys.stderr)
        return 1
    print(f"next: {PROGRAM} report {experiment.name} -f {results.folder}")
    return 0


@contextmanager
def _ending_like_interrupted(number: int) -> Iterator[None]:
    """Batch systems send SIGTERM before they kill: end as after Ctrl-C."""

    def interrupt(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    before = signal.signal(number, interrupt)
    try:
        yield
    finally:
        signal.signal(number, before)


def _plan(options: argparse.Namespace) -> int:
    from sb3_saf.experiments.plan import make_plan

    experiment = find_experiment(options.name)
    if not experiment.is_grid:
        print(f"{experiment.name}: counts weights, trains nothing")
        return 0
    plan = make_plan(
        experiment,
        choice_of(options),
        protocol_of(options),
        results_of(options),
        workers=workers_of(options),
        threads=options.threads,
        device=options.device,
        rate=positive("--rate", options.rate),
    )
    print(plan)
    return 0


def _report(options: argparse.Namespace) -> int:
    experiment = find_experiment(options.name)
    if not experiment.is_grid:
        return _print_parameters()
    from sb3_saf.experiments.report import write_report

    report = write_report(experiment, existing_results_of(options), wanted_of(options))
    print(f"page: {report.page}")
    print(f"figures: {', '.join(path.name for path in report.figures)}")
    if report.missing:
        print(f"{len(report.missing)} of {report.n_cells} cells are missing; the page names them", file=sys.stderr)
    return 0


def _print_parameters() -> int:
    from sb3_saf.parameters import format_table, parameter_table

    print(format_table(parameter_table()))
    return 0
