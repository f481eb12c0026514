"""``python -m sb3_saf.train``: RL-Zoo3's ``train()`` with a manager for teams, and options in game steps."""

from __future__ import annotations

import argparse
import secrets
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from sb3_saf.training.algorithms import ALGOS
from sb3_saf.training.commands import (
    CommandError,
    DefaultsFormatter,
    KeyValues,
    OneLineParser,
    replaced,
    require_zoo,
    run_command,
    user_errors,
)
from sb3_saf.training.devices import check_device
from sb3_saf.training.request import Request
from sb3_saf.training.seeds import MAX_SEED, check_seed
from sb3_saf.training.settings import ENV_IDS
from sb3_saf.training.yaml_files import SIZES, merge

PROGRAM: Final = "python -m sb3_saf.train"

#: Options that RL-Zoo3 takes as they are.
_PASSED_ON: Final = (
    "tensorboard_log",
    "trained_agent",
    "num_threads",
    "log_interval",
    "eval_episodes",
    "n_eval_envs",
    "log_folder",
    "device",
    "verbose",
    "n_trials",
    "max_total_trials",
    "n_jobs",
    "sampler",
    "pruner",
    "n_startup_trials",
    "n_evaluations",
    "optimization_log_path",
    "storage",
    "study_name",
)


def make_parser() -> argparse.ArgumentParser:
    """Options as RL-Zoo3 has them, with game steps for timesteps."""
    parser = OneLineParser(
        prog=PROGRAM,
        description="Train or tune a team by name, on RL-Zoo3. Steps are steps of the game, summed over all games.",
        formatter_class=DefaultsFormatter,
        allow_abbrev=False,
    )
    _add_what(parser)
    _add_run(parser)
    _add_tuning(parser)
    return parser


def _add_what(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("what to train")
    group.add_argument("--algo", default="saf", help=", ".join(ALGOS))
    group.add_argument("--env", default="TeamTogether-v0", help=", ".join(ENV_IDS))
    group.add_argument("--size", default="paper", help=f"{', '.join(SIZES)}: games and hyperparameters of a size")
    group.add_argument("-n", "--game-steps", type=int, help="steps of the game; the size's by default")
    group.add_argument(
        "--env-kwargs", nargs="+", action=KeyValues, default={}, metavar="KEY:VALUE", help="the level: coordination:2"
    )
    group.add_argument(
        "--eval-env-kwargs",
        nargs="+",
        action=KeyValues,
        default={},
        metavar="KEY:VALUE",
        help="what evaluation changes",
    )
    group.add_argument(
        "-params",
        "--hyperparams",
        nargs="+",
        action=KeyValues,
        default={},
        metavar="KEY:VALUE",
        help="settings that win over the file's: learning_rate:lin_7e-4 policy_kwargs:'{n_slots: 8}'",
    )
    group.add_argument("-conf", "--conf-file", type=Path, help="a YAML file in place of zoo_configs/ALGO.yml")
    group.add_argument("-i", "--trained-agent", default="", help="a model (.zip) to train on")


def _add_run(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("the run")
    group.add_argument("--seed", type=int, default=-1, help="0 or larger; -1 draws one")
    group.add_argument("-f", "--log-folder", default="logs", help="runs are in FOLDER/ALGO/ENV_NUMBER")
    group.add_argument("-tb", "--tensorboard-log", default="", help="folder for TensorBoard; none by default")
    group.add_argument("--eval-freq", type=int, help="game steps between evaluations, -1 for none; by default 20 a run")
    group.add_argument("--eval-episodes", type=int, default=32, help="team episodes of an evaluation")
    group.add_argument("--n-eval-envs", type=int, default=32, help="games of an evaluation")
    group.add_argument("--deterministic-eval", action="store_true", help="evaluate the most likely actions")
    group.add_argument("--save-freq", type=int, default=-1, help="game steps between saved models, -1 for none")
    group.add_argument(
        "--inspect-freq",
        type=int,
        help="game steps between looks into the policy for TensorBoard, -1 for none; by default 10 a run",
    )
    group.add_argument(
        "--checkpoint-freq", type=int, help="game steps between checkpoints for --resume, -1 for none; 10 a run"
    )
    group.add_argument(
        "--resume",
        action="store_true",
        help="go on, exactly, with the latest run of this command that did not reach its end; without one, begin",
    )
    group.add_argument("--log-interval", type=int, default=-1, help="rollouts between logs, -1 for SB3's")
    group.add_argument("--num-threads", type=int, default=-1, help="threads of torch, -1 for its own choice")
    group.add_argument("--device", default="auto", help="cpu, cuda, ...")
    group.add_argument("--verbose", type=int, help="0 or 1; by default 0 with a progress bar, else 1")
    group.add_argument(
        "-P", "--progress", action=argparse.BooleanOptionalAction, help="a progress bar; by default on a terminal"
    )


def _add_tuning(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("tuning with Optuna")
    group.add_argument("-optimize", "--optimize-hyperparameters", action="store_true", help="tune instead of training")
    group.add_argument("--storage", help="sqlite:///FILE.db or journal FILE.log that several processes may share")
    group.add_argument("--study-name", help="of the study in the storage")
    group.add_argument("--trial-id", help="train with the settings of this trial of the study, a number or 'best'")
    group.add_argument("--n-trials", type=int, default=100, help="trials of this process")
    group.add_argument("--max-total-trials", type=int, help="trials of all processes together")
    group.add_argument("--n-startup-trials", type=int, default=10, help="random trials before the sampler learns")
    group.add_argument("--n-evaluations", type=int, default=5, help="evaluations of a trial")
    group.add_argument("--n-jobs", type=int, default=1, help="trials at once in threads; processes scale better")
    group.add_argument("--sampler", choices=["random", "tpe", "auto"], default="tpe", help="Optuna's sampler")
    group.add_argument("--pruner", choices=["halving", "median", "none"], default="median", help="Optuna's pruner")
    group.add_argument("--optimization-log-path", help="folder for the evaluations of every trial")


def train(arguments: Sequence[str] | None = None) -> None:
    """
    Train or tune.

    :param arguments: of the command line; None for those of this process
    :raises CommandError: for what the user can put right
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = make_parser().parse_args(given)
    _check(options)
    _complete(options)
    overrides = options.hyperparams
    if options.game_steps is not None:
        overrides = merge(overrides, {"game_steps": options.game_steps})
    require_zoo()
    from sb3_saf.training.carriers import register_carriers
    from sb3_saf.training.manager import install_algorithm

    request = Request(
        algo=options.algo,
        env_id=options.env,
        size=options.size,
        env_kwargs=options.env_kwargs,
        eval_env_kwargs=options.eval_env_kwargs,
        overrides=overrides,
        config=options.conf_file,
        eval_freq=options.eval_freq,
        save_freq=options.save_freq,
        inspect_freq=options.inspect_freq,
        checkpoint_freq=options.checkpoint_freq,
        seed=options.seed,
        deterministic_eval=options.deterministic_eval,
        trial=options.trial_id,
        options={key: str(value) if isinstance(value, Path) else value for key, value in vars(options).items()},
        command=shlex.join([*PROGRAM.split(), *given]),
    )
    with user_errors():
        request.settings()
        request.settings(evaluation=True)
    register_carriers()
    install_algorithm(options.algo)
    request = _continued(request, options) if options.resume else request
    if options.seed is None:
        options.seed = secrets.randbelow(MAX_SEED)
    request = replace(request, options={**request.options, "seed": options.seed})
    _run_rl_zoo(request, _zoo_arguments(options))


def _continued(request: Request, options: argparse.Namespace) -> Request:
    """The request, with the run to go on with if there is one."""
    from sb3_saf.training.resuming import find_unfinished

    found = find_unfinished(request, options.log_folder)
    if found is None:
        print(f"No run of this command in {options.log_folder} is unfinished: a new one begins")
        return request
    folder, options.seed = found
    print(f"Going on with {folder}")
    return replace(request, resume=folder)


def _check(options: argparse.Namespace) -> None:
    """What can be said before anything is made."""
    if options.seed == -1:
        options.seed = None
    else:
        with user_errors():
            check_seed(options.seed)
    if options.resume and (options.optimize_hyperparameters or options.trial_id is not None):
        raise CommandError(
            "--resume is for training with settings, without -optimize and --trial-id; a study goes on by itself when "
            "it is called again, and a trial's settings can be given with -params"
        )
    with user_errors():
        check_device(options.device)
    for name in ("eval_episodes", "n_eval_envs", "n_trials", "n_evaluations"):
        if getattr(options, name) < 1:
            raise CommandError(f"--{name.replace('_', '-')} must be at least 1, got {getattr(options, name)}")
    if options.trained_agent and not (options.trained_agent.endswith(".zip") and Path(options.trained_agent).is_file()):
        raise CommandError(f"--trained-agent must be a .zip that is there, got {options.trained_agent!r}")
    if options.trained_agent:
        print(
            f"{options.trained_agent} is unpickled, which can run code from it; from a file that you do not trust take "
            "the weights alone: sb3_saf.load_weights",
            file=sys.stderr,
        )
    if options.trial_id is None:
        return
    if options.storage is None or options.study_name is None:
        raise CommandError("--trial-id needs the --storage and --study-name of the tuning")
    if options.trial_id != "best":
        if not options.trial_id.isdigit():
            raise CommandError(f"--trial-id must be a trial's number or 'best', got {options.trial_id!r}")
        options.trial_id = int(options.trial_id)


def _complete(options: argparse.Namespace) -> None:
    """Defaults that depend on where we are."""
    if options.progress is None:
        options.progress = sys.stdout.isatty()
    if options.verbose is None:
        options.verbose = int(not options.progress)
    options.n_eval_envs = min(options.n_eval_envs, options.eval_episodes)


def _zoo_arguments(options: argparse.Namespace) -> list[str]:
    """RL-Zoo3's command line. What it would evaluate as Python is not on it: that goes by the request."""
    arguments = ["--algo", options.algo, "--env", options.env, "--seed", str(options.seed), "--no-optim-plots"]
    for name in _PASSED_ON:
        value = getattr(options, name)
        if value is not None and value != "":
            arguments.append(f"--{name.replace('_', '-')}={value}")
    if options.optimize_hyperparameters:
        arguments.append("--optimize-hyperparameters")
    if options.progress:
        arguments.append("--progress")
    return arguments


def _run_rl_zoo(request: Request, arguments: list[str]) -> None:
    """RL-Zoo3's ``train``, which reads the process's arguments and takes its manager from its module."""
    import rl_zoo3.train

    from sb3_saf.training.manager import TeamExperimentManager

    manager = partial(TeamExperimentManager, request=request)
    with replaced(sys, "argv", [PROGRAM, *arguments]), replaced(rl_zoo3.train, "ExperimentManager", manager):
        rl_zoo3.train.train()


def main(arguments: Sequence[str] | None = None) -> None:
    """
    The command.

    :param arguments: of the command line; None for those of this process
    """
    run_command(PROGRAM, lambda: train(arguments))
