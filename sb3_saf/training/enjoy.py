"""``python -m sb3_saf.enjoy``: measure the return of a trained team, and show one of its games."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import set_random_seed

from sb3_saf.evaluation import EvaluationResult, evaluate_team
from sb3_saf.export.weights import load_weights
from sb3_saf.teams.checks import check_seed
from sb3_saf.training.commands import (
    DefaultsFormatter,
    OneLineParser,
    add_environment_options,
    at_least,
    import_packages,
    run_command,
    user_errors,
)
from sb3_saf.training.environments import find_environment
from sb3_saf.training.folders import find_model
from sb3_saf.training.settings import ALGOS, Settings, find_algorithm, saved_settings
from sb3_saf.training.wrappers import load_normalization

PROGRAM: Final = "python -m sb3_saf.enjoy"


@dataclass(frozen=True)
class TrainedTeam:
    """A policy, the settings of its games, and the file of its weights."""

    settings: Settings
    policy: BasePolicy
    path: Path

    def measure(self, n_episodes: int, seed: int, deterministic: bool) -> EvaluationResult:
        """Measure team returns over games not used in training, each episode in a separate game."""
        set_random_seed(seed)
        with closing(self.settings.make_env(seed, evaluation=True, n_envs=n_episodes)) as games:
            load_normalization(games, self.path.parent)
            return evaluate_team(self.policy, games, n_episodes, deterministic=deterministic)


def make_parser() -> argparse.ArgumentParser:
    """Make the parser."""
    parser = OneLineParser(
        prog=PROGRAM, description="Measure and watch a trained team.", formatter_class=DefaultsFormatter
    )
    parser.add_argument("--algo", default="saf", help=", ".join(ALGOS))
    add_environment_options(parser, "another level than was trained on, such as coordination:3")
    parser.add_argument("-f", "--log-folder", type=Path, default=Path("logs"), help="the folder of the training")
    parser.add_argument("--exp-id", type=int, default=0, help="number of the run, 0 for the latest")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--load-best", action="store_true", help="the model with the best evaluation")
    which.add_argument("--load-checkpoint", metavar="STEPS", type=int, help="the model saved after these game steps")
    which.add_argument("--load-last-checkpoint", action="store_true", help="the model that was saved last on the way")
    parser.add_argument("--episodes", type=at_least(1), default=32, help="team episodes to measure")
    parser.add_argument("--deterministic", action="store_true", help="most likely actions; else they are drawn")
    parser.add_argument("--seed", type=int, default=0, help="of the games, none of which was trained on")
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument("--gif", type=Path, metavar="FILE", help="record a game")
    shown.add_argument("--mp4", type=Path, metavar="FILE", help="record a game")
    shown.add_argument("--text", action="store_true", help="print a game; otherwise it is shown in a window")
    shown.add_argument("--no-render", action="store_true", help="only measure")
    return parser


def enjoy(arguments: Sequence[str] | None = None) -> EvaluationResult:
    """Measure and show; return the team returns."""
    options = make_parser().parse_args(arguments)
    import_packages(options.gym_packages)
    with user_errors():
        check_seed(options.seed)
        team = load_team(options)
    from sb3_saf.training import watching

    # The screen is opened before the measurement, so that display errors occur immediately.
    with user_errors(ValueError, RuntimeError, ImportError), watching.open_screen(team, options) as screen:
        result = team.measure(options.episodes, options.seed, options.deterministic)
        print(f"{options.algo} on {options.env}, weights of {team.path}")
        print(f"team return {result}")
        watching.show_game(screen, team, options.seed, options.deterministic)
    return result


def load_team(options: argparse.Namespace) -> TrainedTeam:
    """Find a run, and make its policy. Weights are read as numbers: no code of the model's file is run."""
    find_algorithm(options.algo)
    environment = find_environment(options.env)
    which = "best" if options.load_best else "last" if options.load_last_checkpoint else options.load_checkpoint
    run, path = find_model(options.log_folder, options.algo, environment, options.exp_id, which)
    trained = run.settings
    if (trained.algo, trained.env_id) != (options.algo, environment.id):
        raise ValueError(f"{run.folder} is a run of {trained.algo} on {trained.env_id}; give its --algo and --env")
    settings = saved_settings(trained.as_dict(), options.env_kwargs)
    if settings.n_agents != trained.n_agents:
        raise ValueError(
            f"the team was trained with {trained.n_agents} agents, got n_agents={settings.n_agents}; leave "
            "n_agents out of --env-kwargs"
        )
    return TrainedTeam(settings, make_policy(settings, path), path)


def make_policy(settings: Settings, path: Path) -> BasePolicy:
    """Make the policy of the settings with the weights of a model's file, read as numbers only."""
    with closing(settings.make_env(0, n_envs=1)) as games:
        kwargs = settings.hyperparams.get("policy_kwargs", {})
        policy = settings.spec.policy_class(
            games.observation_space, games.action_space, lr_schedule=_no_learning, **kwargs
        )
    load_weights(policy, path)
    policy.set_training_mode(False)
    return policy


def _no_learning(progress_remaining: float) -> float:
    return 0.0


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command, with the arguments of this process by default."""
    run_command(PROGRAM, lambda: enjoy(arguments))
