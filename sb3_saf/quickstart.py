"""
``make train``: SAF on a HECOGrid task, from nothing to a model, a learning curve, a GIF and a replay in minutes on a
laptop.

The settings are those of ``python -m sb3_saf.train --size small``; ``sb3_saf.training.run.train`` does the work.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from stable_baselines3.common.base_class import BaseAlgorithm

from hecogrid_envs import TASK_NAMES
from sb3_saf import EvaluationResult, RandomPolicy, evaluate_team, replay
from sb3_saf.teams.checks import evaluation_seed
from sb3_saf.training.callbacks import ProgressLines
from sb3_saf.training.enjoy import Film, write_video
from sb3_saf.training.figures import draw_curves
from sb3_saf.training.folders import python_command, read_curve, write_run
from sb3_saf.training.run import RunOptions, train
from sb3_saf.training.settings import Settings, load_settings

N_EPISODES = 64
#: Number of pictures in TensorBoard, which take a few seconds each.
N_INSPECTIONS = 2


class Options(NamedTuple):
    """
    Options of the command line.

    :param settings: settings of the training
    :param seed: seed of the run
    :param output: folder for all results
    :param progress_bar: whether to draw a progress bar
    """

    settings: Settings
    seed: int
    output: Path
    progress_bar: bool


def parse(arguments: list[str] | None = None) -> Options:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="python -m sb3_saf.quickstart", description=__doc__.strip().splitlines()[0])
    parser.add_argument("--task", choices=TASK_NAMES, default="TeamSupport")
    parser.add_argument("--coordination", type=int, default=2, help="agents that one treasure needs")
    parser.add_argument("--heterogeneity", type=int, default=1, help="zones with different dynamics")
    parser.add_argument("--game-steps", type=int, default=200_000, help="steps of the game, not of its agents")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("runs/quickstart"))
    parser.add_argument(
        "--no-progress-bar",
        dest="progress_bar",
        action="store_false",
        default=sys.stdout.isatty(),
        help="a line for every tenth of the training instead, as without a terminal",
    )
    given = parser.parse_args(arguments)
    level = {"coordination": given.coordination, "heterogeneity": given.heterogeneity}
    try:
        settings = load_settings("saf", f"{given.task}-v0", "small", level, {"game_steps": given.game_steps})
    except ValueError as error:
        parser.error(str(error))
    return Options(settings, given.seed, given.output, given.progress_bar)


def train_team(options: Options) -> BaseAlgorithm:
    """Train; write TensorBoard logs, ``monitor.csv`` and the model to the output folder."""
    run = RunOptions(
        tensorboard_log=options.output / "tb",
        inspect_freq=max(1, options.settings.game_steps // N_INSPECTIONS),
        progress=options.progress_bar,
        num_threads=1,  # more threads do not help small networks, and slow down on a busy machine
    )
    lines = ProgressLines(verbose=int(not options.progress_bar))
    return train(options.settings, options.seed, options.output, run, [lines])


def evaluate(options: Options, model: Any, film: Path | None = None) -> EvaluationResult:
    """
    Return team returns of games not used in training, the same for every model.

    :param film: GIF of the first game to write; None for none
    """
    games = options.settings.make_env(
        options.seed, evaluation=True, n_envs=N_EPISODES, render_mode=None if film is None else "rgb_array"
    )
    frames: list[Any] = []
    with closing(games):
        env = games if film is None else Film(games, frames.append)
        result = evaluate_team(model, env, n_eval_episodes=N_EPISODES, deterministic=False)
    if film is not None:
        write_video(film, frames)
    return result


def describe(settings: Settings) -> str:
    """Return the game's name and level."""
    level = settings.env_kwargs
    return f"{settings.task}, coordination {level['coordination']}, heterogeneity {level['heterogeneity']}"


def draw_curve(options: Options, random: EvaluationResult) -> Path:
    """Draw the team return of the training episodes against game steps."""
    curve = read_curve(options.output).assign(method=options.settings.algo, seed=options.seed)
    figure = draw_curves(curve, describe(options.settings), references={"random team": random.mean})
    path = options.output / "learning_curve.png"
    figure.savefig(path)
    return path


def write_replay(options: Options, model: BaseAlgorithm) -> Path:
    """Write a replay page of the first evaluation game."""
    seed = evaluation_seed(options.seed)
    with closing(options.settings.make_env(options.seed, evaluation=True, n_envs=1)) as games:
        return replay({"SAF": model}, games, options.output / "replay.html", seed=seed)


def main(arguments: list[str] | None = None) -> None:
    """Train, compare with a random team, and print the paths of the results."""
    options = parse(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    settings = options.settings
    given = sys.argv[1:] if arguments is None else arguments
    command = shlex.join(["python", "-m", "sb3_saf.quickstart", *given])
    write_run(options.output, settings.as_dict(), options.seed, command)
    print(
        f"Training SAF on {describe(settings)}: {settings.game_steps:,} game steps with {settings.n_agents} agents in "
        f"{settings.n_envs} games, in a few minutes"
    )
    model = train_team(options)
    gif = options.output / "episode.gif"
    trained = evaluate(options, model, gif)
    random = evaluate(options, RandomPolicy(model.action_space, seed=options.seed))
    curve, page = draw_curve(options, random), write_replay(options, model)
    print(f"\nTeam return (treasures collected), {N_EPISODES} fresh games, mean and 95 % interval")
    print(f"  SAF     {trained}")
    print(f"  random  {random}")
    print(f"\nmodel           {options.output / 'model.zip'}")
    print(f"learning curve  {curve}")
    print(f"episode         {gif}")
    print(f"replay          {page} (open it in a browser)")
    print(f"TensorBoard     {python_command('tensorboard.main')} --logdir {options.output / 'tb'}")


if __name__ == "__main__":
    main()
