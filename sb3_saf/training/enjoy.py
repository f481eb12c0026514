"""``python -m sb3_saf.enjoy``: the team return of a trained team, and one of its games to watch."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import set_random_seed

from sb3_saf.evaluation import EvaluationResult, evaluate_team
from sb3_saf.export.errors import ExportError
from sb3_saf.export.weights import load_weights
from sb3_saf.training.algorithms import ALGOS, find_algorithm
from sb3_saf.training.commands import (
    CommandError,
    DefaultsFormatter,
    KeyValues,
    OneLineParser,
    require_zoo,
    run_command,
    user_errors,
)
from sb3_saf.training.names import unknown_name
from sb3_saf.training.seeds import check_seed
from sb3_saf.training.settings import ENV_IDS, Settings, saved_settings

PROGRAM: Final = "python -m sb3_saf.enjoy"


class TrainedTeam(NamedTuple):
    """
    A policy with the games that it plays.

    :param settings: of the run, with the level to play
    :param policy: with the weights of the run
    :param model_path: where they came from
    """

    settings: Settings
    policy: BasePolicy
    model_path: Path


def make_parser() -> argparse.ArgumentParser:
    """The options."""
    parser = OneLineParser(
        prog=PROGRAM,
        description="Measure and watch a trained team.",
        formatter_class=DefaultsFormatter,
    )
    parser.add_argument("--algo", default="saf", help=", ".join(ALGOS))
    parser.add_argument("--env", default="TeamTogether-v0", help=", ".join(ENV_IDS))
    parser.add_argument("-f", "--log-folder", default="logs", help="the folder of the training")
    parser.add_argument("--exp-id", type=int, default=0, help="number of the run, 0 for the latest")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--load-best", action="store_true", help="the model with the best evaluation")
    which.add_argument("--load-checkpoint", metavar="STEPS", help="the checkpoint after these game steps")
    which.add_argument("--load-last-checkpoint", action="store_true", help="the last checkpoint")
    parser.add_argument("--episodes", type=int, default=32, help="team episodes to measure")
    parser.add_argument("--deterministic", action="store_true", help="most likely actions; else they are drawn")
    parser.add_argument("--seed", type=int, default=0, help="of the games, none of which was trained on")
    parser.add_argument(
        "--env-kwargs",
        nargs="+",
        action=KeyValues,
        default={},
        metavar="KEY:VALUE",
        help="another level: coordination:3",
    )
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument("--gif", type=Path, metavar="FILE", help="record a game")
    shown.add_argument("--mp4", type=Path, metavar="FILE", help="record a game")
    shown.add_argument("--text", action="store_true", help="print a game; otherwise it is shown in a window")
    shown.add_argument("--no-render", action="store_true", help="only measure")
    return parser


def enjoy(arguments: Sequence[str] | None = None) -> EvaluationResult:
    """
    Measure and show.

    :param arguments: of the command line; None for those of this process
    :return: the team returns
    :raises CommandError: for what the user can put right
    """
    options = make_parser().parse_args(arguments)
    with user_errors():
        find_algorithm(options.algo)
        check_seed(options.seed)
        if options.env not in ENV_IDS:
            raise unknown_name("environment", options.env, ENV_IDS)
    if options.episodes < 1:
        raise CommandError(f"--episodes must be at least 1, got {options.episodes}")
    team = load_team(options)
    from sb3_saf.training import watching

    # Before the measurement, which nobody should wait for in vain.
    with user_errors(RuntimeError, ImportError), watching.open_screen(team.settings, options) as screen:
        result = measure(team, options.episodes, options.seed, options.deterministic)
        print(f"{options.algo} on {options.env}, {team.model_path}")
        print(f"team return {result}")
        watching.show_game(screen, team.policy, options.seed, options.deterministic)
    return result


def load_team(options: argparse.Namespace) -> TrainedTeam:
    """
    Find a run with RL-Zoo3's helpers, and make its policy.

    Weights are read as numbers: a model's zip can hold code, which SB3's own loading would run.

    :param options: of the command line
    """
    require_zoo()
    from rl_zoo3.utils import EnvironmentName, get_model_path  # type: ignore[attr-defined]  # its own import

    from sb3_saf.training.runs import Run

    env_name = EnvironmentName(options.env)
    if not Path(options.log_folder, options.algo).is_dir():
        raise CommandError(
            f"there is no folder {Path(options.log_folder, options.algo)}; train first: python -m sb3_saf.train "
            f"--algo {options.algo} --env {options.env} -f {options.log_folder}"
        )
    with user_errors(AssertionError, ExportError):
        _, path, folder = get_model_path(
            options.exp_id,
            options.log_folder,
            options.algo,
            env_name,
            options.load_best,
            options.load_checkpoint,
            options.load_last_checkpoint,
        )
        run = Run(Path(folder), options.env, options.exp_id)
        settings = saved_settings(run.config, options.env_kwargs)
        if settings.n_agents != run.settings.n_agents:
            raise ValueError(
                f"the team was trained with {run.settings.n_agents} agents, got n_agents={settings.n_agents}; leave "
                "n_agents out of --env-kwargs"
            )
        return TrainedTeam(settings, _policy(settings, path), Path(path))


def _policy(settings: Settings, path: str) -> BasePolicy:
    env = settings.make_env(0, n_envs=1)
    kwargs = settings.hyperparams.get("policy_kwargs", {})
    policy = settings.spec.policy_class(env.observation_space, env.action_space, lr_schedule=_no_learning, **kwargs)
    env.close()
    load_weights(policy, path)
    policy.set_training_mode(False)
    return policy


def _no_learning(progress_remaining: float) -> float:
    return 0.0


def measure(team: TrainedTeam, n_episodes: int, seed: int, deterministic: bool) -> EvaluationResult:
    """
    Team returns over games that no run was trained on.

    :param team: who plays
    :param n_episodes: team episodes, each in a game of its own
    :param seed: of games and actions
    :param deterministic: whether to take the most likely actions
    """
    set_random_seed(seed)
    env = team.settings.make_env(seed, evaluation=True, n_envs=n_episodes)
    result = evaluate_team(team.policy, env, n_episodes, deterministic=deterministic)
    env.close()
    return result


def main(arguments: Sequence[str] | None = None) -> None:
    """
    The command.

    :param arguments: of the command line; None for those of this process
    """

    def command() -> None:
        enjoy(arguments)

    run_command(PROGRAM, command)
