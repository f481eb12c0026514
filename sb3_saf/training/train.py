"""``python -m sb3_saf.train``: train or tune by name, with RL-Zoo3's options, in game steps."""

from __future__ import annotations

import argparse
import importlib
import os
import secrets
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import yaml

from sb3_saf.teams.checks import MAX_SEED, CheckpointError, NonFiniteError, SettingsError, check_seed
from sb3_saf.teams.files import digest, plain, write_text
from sb3_saf.training.commands import (
    CommandError,
    DefaultsFormatter,
    OneLineParser,
    add_environment_options,
    add_key_values,
    at_least,
    check_device,
    require,
    run_command,
    user_errors,
)
from sb3_saf.training.folders import RUN_FILE, find_unfinished, make_run_folder, python_command, write_run
from sb3_saf.training.run import ProgressLines, RunOptions, Training
from sb3_saf.training.settings import ALGOS, Settings, load_settings
from sb3_saf.training.yaml_files import SIZES, merge

if TYPE_CHECKING:
    import optuna

PROGRAM: Final = "python -m sb3_saf.train"
#: Options that affect a run's results but are not in its settings.
_DECIDING: Final = ("eval_freq", "eval_episodes", "n_eval_envs", "eval_env_kwargs", "deterministic_eval", "save_freq")
#: Options with the same name and value in RunOptions.
_SAME_NAMES: Final = (
    *("eval_freq", "eval_episodes", "n_eval_envs", "deterministic_eval", "save_freq"),
    *("inspect_freq", "checkpoint_freq", "device", "progress"),
)


def make_parser() -> argparse.ArgumentParser:
    """Make the parser: RL-Zoo3's options, with steps in game steps."""
    parser = OneLineParser(
        prog=PROGRAM,
        description="Train or tune a team by name. All steps are game steps, summed over all parallel games; agent "
        "steps, which SB3 counts as timesteps, are game steps x agents.",
        formatter_class=DefaultsFormatter,
        allow_abbrev=False,
    )
    _add_what(parser.add_argument_group("what to train"))
    _add_run(parser.add_argument_group("the run"))
    _add_evaluation(parser.add_argument_group("evaluation, saved models, logs"))
    _add_tuning(parser.add_argument_group("tuning with Optuna"))
    return parser


def _add_what(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--algo", default="saf", help=", ".join(ALGOS))
    add_environment_options(group, "parameters of the game, such as coordination:2")
    group.add_argument("--size", default="small", help=f"{', '.join(SIZES)}: games and hyperparameters of a size")
    group.add_argument(
        "-n",
        "--n-timesteps",
        "--game-steps",
        dest="game_steps",
        type=at_least(1),
        help="game steps to train for (SB3's total_timesteps, in agent steps, are game steps x agents); by default the "
        "size's",
    )
    add_key_values(
        group,
        "-params",
        "--hyperparams",
        help="settings that win over the file's: learning_rate:lin_7e-4 policy_kwargs:'{n_slots: 8}'",
    )
    group.add_argument("-conf", "--conf-file", type=Path, help="a YAML file in place of zoo_configs/ALGO.yml")
    group.add_argument(
        "-i", "--trained-agent", type=Path, help="a model (.zip) to train on: its weights and optimiser, no code"
    )


def _add_run(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--seed", type=int, default=-1, help="0 or larger; -1 draws one")
    group.add_argument("-f", "--log-folder", type=Path, default=Path("logs"), help="runs are in FOLDER/ALGO/ENV_NUMBER")
    group.add_argument(
        "--checkpoint-freq", type=int, help="game steps between checkpoints for --resume, -1 for none; 10 a run"
    )
    group.add_argument(
        "--resume",
        action="store_true",
        help="go on, exactly, with the latest run of this command that did not reach its end; without one, begin",
    )
    group.add_argument("--device", default="auto", help="cpu, cuda, ...")
    group.add_argument("--num-threads", type=at_least(1, -1), default=-1, help="threads of torch, -1 for its own")
    group.add_argument(
        "--vec-env",
        choices=["dummy", "subproc"],
        default="dummy",
        help="subproc steps the games in one process per core; for environments other than HECOGrid, which is compiled",
    )
    group.add_argument("--verbose", type=at_least(0), help="0 or 1; by default 0 with a progress bar, else 1")
    group.add_argument(
        "-P",
        "--progress",
        action=argparse.BooleanOptionalAction,
        help="a progress bar in game steps; by default on a terminal",
    )


def _add_evaluation(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--eval-freq",
        type=int,
        help="game steps between evaluations, -1 for none; by default 20 a run, 1 for the size smoke",
    )
    group.add_argument(
        "--eval-episodes", type=at_least(1), help="team episodes of an evaluation; by default 32, 2 for the size smoke"
    )
    group.add_argument("--n-eval-envs", type=at_least(1), default=32, help="parallel games of an evaluation")
    add_key_values(group, "--eval-env-kwargs", help="parameters of the game that evaluation changes")
    group.add_argument("--deterministic-eval", action="store_true", help="evaluate the most likely actions")
    group.add_argument("--save-freq", type=int, default=-1, help="game steps between saved models, -1 for none")
    group.add_argument("-tb", "--tensorboard-log", type=Path, help="folder for TensorBoard; none by default")
    group.add_argument(
        "--inspect-freq",
        type=int,
        help="game steps between looks into the policy for TensorBoard, -1 for none; by default 10 a run",
    )
    group.add_argument("--log-interval", type=int, default=-1, help="rollouts between logs, -1 for SB3's, -2 for none")
    group.add_argument("--track", action="store_true", help="log to Weights and Biases, which needs wandb")
    group.add_argument("--wandb-project-name", default="sb3", help="project of --track")
    group.add_argument("--wandb-entity", help="user or team of --track")
    group.add_argument("--wandb-group", help="group of runs of --track")
    group.add_argument("-tags", "--wandb-tags", nargs="+", default=[], help="tags of --track")


def _add_tuning(group: argparse._ArgumentGroup) -> None:
    group.add_argument("-optimize", "--optimize-hyperparameters", action="store_true", help="tune instead of training")
    group.add_argument("--storage", help="sqlite:///FILE.db or journal FILE.log that several processes may share")
    group.add_argument("--study-name", help="name of the study in the storage")
    group.add_argument("--trial-id", help="train with the settings of this trial of the study, a number or 'best'")
    group.add_argument("--n-trials", type=at_least(1), default=100, help="trials of this process")
    group.add_argument(
        "--n-startup-trials", type=at_least(0), default=10, help="random trials before the sampler learns"
    )
    group.add_argument("--n-evaluations", type=at_least(1), default=5, help="evaluations of a trial")
    group.add_argument("--sampler", choices=["random", "tpe"], default="tpe", help="Optuna's sampler")
    group.add_argument("--pruner", choices=["halving", "median", "none"], default="median", help="Optuna's pruner")


def train(arguments: Sequence[str] | None = None) -> None:
    """Train or tune; raise :class:`CommandError` for errors that the user can fix."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = make_parser().parse_args(given)
    _check(options)
    command = shlex.join([*PROGRAM.split(), *given])
    if options.optimize_hyperparameters:
        _tune(options, command)
    else:
        _train(options, command)


# --- options ----------------------------------------------------------------------------------------------------------


def _check(options: argparse.Namespace) -> None:
    """Check the options before anything is made, and fill in the defaults that depend on the platform."""
    with user_errors():
        if options.seed != -1:
            check_seed(options.seed)
        check_device(options.device)
    if options.resume and (options.optimize_hyperparameters or options.trial_id is not None):
        raise CommandError(
            "--resume is for training with settings, without -optimize and --trial-id; a study goes on by itself when "
            "it is called again, and a trial's settings can be given with -params"
        )
    of_training = {"--track": options.track, "-tb": options.tensorboard_log, "--save-freq": options.save_freq > 0}
    if options.optimize_hyperparameters and any(of_training.values()):
        flags = ", ".join(flag for flag, is_given in of_training.items() if is_given)
        raise CommandError(f"-optimize keeps its trials in the study; leave out {flags}, which training takes")
    model = options.trained_agent
    if model is not None and not (model.suffix == ".zip" and model.is_file()):
        raise CommandError(f"--trained-agent must be a .zip that is there, got {str(model)!r}")
    if options.trial_id is not None:
        if options.storage is None or options.study_name is None:
            raise CommandError("--trial-id needs the --storage and --study-name of the tuning")
        if options.trial_id != "best" and not options.trial_id.isdecimal():
            raise CommandError(f"--trial-id must be a trial's number or 'best', got {options.trial_id!r}")
    if options.eval_episodes is None:
        options.eval_episodes = 2 if options.size == "smoke" else RunOptions.eval_episodes
    if options.progress is None:
        options.progress = sys.stdout.isatty()
    if options.verbose is None:
        options.verbose = int(not options.progress)


def _settings(
    options: argparse.Namespace, sampled: Mapping[str, Any] | None = None
) -> tuple[Settings, Settings | None]:
    """
    Return the settings of training and, if they differ, of evaluation.

    The user's options take precedence over those sampled for a trial.
    """
    overrides = merge(sampled or {}, _fixed(options))

    def load(env_kwargs: Mapping[str, Any]) -> Settings:
        return load_settings(options.algo, options.env, options.size, env_kwargs, overrides, options.conf_file)

    given, of_evaluation = options.env_kwargs, options.eval_env_kwargs
    return load(given), load({**given, **of_evaluation}) if of_evaluation else None


def _fixed(options: argparse.Namespace) -> dict[str, Any]:
    return options.hyperparams | ({} if options.game_steps is None else {"game_steps": options.game_steps})


def _run_options(options: argparse.Namespace, settings: Settings, **more: Any) -> RunOptions:
    log, folder_name = options.tensorboard_log, settings.environment.folder_name
    same = {name: getattr(options, name) for name in _SAME_NAMES}
    if options.size == "smoke" and options.eval_freq is None:
        same["eval_freq"] = settings.game_steps  # at the end only: episodes may be longer than the whole training
    return RunOptions(
        **same,
        tensorboard_log=None if log is None else log / folder_name,
        model_name=folder_name,
        initial_model=options.trained_agent,
        log_interval=None if options.log_interval == -1 else max(0, options.log_interval),
        n_cpus=min(os.cpu_count() or 1, settings.n_envs) if options.vec_env == "subproc" else 1,
        num_threads=None if options.num_threads == -1 else options.num_threads,
        verbose=min(1, options.verbose),
        **more,
    )


# --- one run ----------------------------------------------------------------------------------------------------------


def _train(options: argparse.Namespace, command: str) -> None:
    with user_errors():
        sampled = None
        if options.trial_id is not None:
            require("optuna")
            from sb3_saf.training.tune import trial_overrides

            number = None if options.trial_id == "best" else int(options.trial_id)
            sampled = trial_overrides(options.storage, options.study_name, number)
        settings, eval_settings = _settings(options, sampled)
    if options.verbose > 0:
        print(yaml.safe_dump(settings.as_dict(), sort_keys=False), end="")
    seed = None if options.seed == -1 else options.seed
    deciding = {name: getattr(options, name) for name in _DECIDING}
    if (model := options.trained_agent) is not None:
        deciding["initial_model"] = {"path": str(model), "sha256": digest(model)}
    folder = None
    if options.resume:
        with user_errors():
            unfinished = find_unfinished(settings, seed, deciding, options.log_folder)
        if unfinished is None:
            print(f"No run of this command in {options.log_folder} is unfinished: a new one begins")
        else:
            folder, seed = unfinished
            print(f"Going on with {folder}")
    seed = secrets.randbelow(MAX_SEED) if seed is None else seed
    again = command.replace(PROGRAM, python_command("sb3_saf.train"), 1) + ("" if options.resume else " --resume")
    with ExitStack() as stack:
        with user_errors(ValueError, OSError):
            if folder is None:
                folder = make_run_folder(options.log_folder, settings.algo, settings.environment.folder_name)
                stack.callback(_remove_unbegun, folder)
                write_run(folder, settings.as_dict(), seed, command, deciding)
            if options.track:
                _track(options, settings, seed)
            run_options = _run_options(
                options, settings, eval_settings=eval_settings, resume_hint=f"go on from there with: {again}"
            )
            lines = ProgressLines(verbose=int(not options.progress))
            training = stack.enter_context(closing(Training(settings, seed, folder, run_options, [lines])))
        print(
            f"{settings.algo} on {settings.env_id}, size {settings.size}, seed {seed}: {settings.game_steps:,} game "
            f"steps in {settings.n_envs} games of {settings.n_agents} agents on {training.model.device.type}; {folder}",
            flush=True,
        )
        if model is not None:
            print(f"It begins with the weights and the optimiser of {model}; no code is loaded")
        with user_errors(CheckpointError, NonFiniteError, SettingsError):
            training.learn()
    if training.evaluation is not None:
        seconds, whole = training.evaluation.seconds, training.clock.cost()["wall_seconds"]
        print(f"Evaluation took {seconds / whole:.0%} of {whole:.0f} s (--eval-freq, --eval-episodes)")
        if training.evaluation.standing is not None:
            print(training.evaluation.standing.text)
    print(f"Saved to {folder}")


def _remove_unbegun(folder: Path) -> None:
    """Remove the folder of a run that has left nothing but its description: it would count as the latest run."""
    if [path.name for path in folder.iterdir()] == [RUN_FILE]:
        (folder / RUN_FILE).unlink()
        folder.rmdir()


def _track(options: argparse.Namespace, settings: Settings, seed: int) -> None:
    """Start Weights and Biases, synchronised with the run's TensorBoard logs."""
    try:
        wandb = importlib.import_module("wandb")
    except ImportError:
        raise CommandError("--track needs Weights and Biases, which is not installed: pip install wandb") from None
    name = f"{settings.environment.folder_name}__{settings.algo}__{seed}__{int(time.time())}"
    options.tensorboard_log = Path("runs") / name
    wandb.init(
        name=name,
        project=options.wandb_project_name,
        entity=options.wandb_entity,
        group=options.wandb_group,
        tags=options.wandb_tags,
        config={**settings.as_dict(), "seed": seed},
        sync_tensorboard=True,
    )


# --- tuning -----------------------------------------------------------------------------------------------------------


def _tune(options: argparse.Namespace, command: str) -> None:
    """Run trials, print the best one, and write all of them to ``report_*.csv``."""
    require("optuna", "pandas")
    from sb3_saf.training.tune import Tuning, is_any_complete, open_study, optimize, sample_overrides

    with user_errors():
        settings, eval_settings = _settings(options)
        run_options = _run_options(options, settings, eval_settings=eval_settings)
    quiet = replace(run_options, eval_freq=0, tensorboard_log=None, progress=False, verbose=0)
    keys = ("storage", "study_name", "n_trials", "sampler", "pruner", "n_startup_trials", "n_evaluations")
    tuning = Tuning(
        seed=secrets.randbelow(MAX_SEED) if options.seed == -1 else options.seed,
        options=quiet,
        **{key: getattr(options, key) for key in keys},
    )
    names = ("eval_env_kwargs", "eval_episodes", "deterministic_eval", "n_evaluations")  # the k-th ones are compared
    evaluated = {name: getattr(options, name) for name in names}
    beginning = None if options.trained_agent is None else digest(options.trained_agent)
    goal = plain({**settings.as_dict(), **evaluated, "initial_model": beginning})
    print(f"Tuning {settings.algo} on {settings.env_id}: {settings.game_steps:,} game steps a trial")

    def settings_of(trial: optuna.Trial) -> Settings:
        sampled = sample_overrides(trial, settings.spec, _fixed(options), with_shapes=beginning is None)
        return _settings(options, sampled)[0]

    with user_errors():
        study = open_study(tuning, command, goal)
        try:
            optimize(study, settings_of, tuning)
        finally:  # also of trials before an interruption
            if is_any_complete(study):
                report = f"report_{settings.environment.folder_name}_{int(time.time())}.csv"
                _write_report(study, options.log_folder / settings.algo / report)


def _write_report(study: optuna.Study, path: Path) -> None:
    write_text(path, study.trials_dataframe().to_csv())
    best = study.best_trial
    print(f"{len(study.trials)} trials, in {path}\nBest: trial {best.number} with a team return of {best.value:.2f}")
    for key, value in best.params.items():
        print(f"    {key}: {value}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command, with the arguments of this process by default."""
    run_command(PROGRAM, lambda: train(arguments))
