"""
Train SAF on a HECOGrid task in minutes on a laptop (``make train``): a model, a learning curve, a GIF and a replay.

The settings are those of ``python -m sb3_saf.train --size small``; ``sb3_saf.training.run.train`` does the work.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from hecogrid_envs import TASK_NAMES
from sb3_saf import EvaluationResult, RandomPolicy, evaluate_team, replay
from sb3_saf.teams.checks import check_seed, evaluation_seed
from sb3_saf.training.enjoy import Film, write_video
from sb3_saf.training.figures import draw_curves
from sb3_saf.training.folders import python_command, read_curve, write_run
from sb3_saf.training.run import ProgressLines, RunOptions, train
from sb3_saf.training.settings import Settings, load_settings

N_EPISODES = 64
#: Number of pictures in TensorBoard, which take a few seconds each.
N_INSPECTIONS = 2


def make_parser() -> argparse.ArgumentParser:
    """Make the parser."""
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
    return parser


def evaluate(settings: Settings, seed: int, model: Any, film: Path | None = None) -> EvaluationResult:
    """
    Return team returns of games not used in training, the same for every model.

    :param film: GIF of the first game to write; None for none
    """
    mode = None if film is None else "rgb_array"
    frames: list[Any] = []
    with closing(settings.make_env(seed, evaluation=True, n_envs=N_EPISODES, render_mode=mode)) as games:
        env = games if film is None else Film(games, frames.append)
        result = evaluate_team(model, env, n_eval_episodes=N_EPISODES, deterministic=False)
    if film is not None:
        write_video(film, frames)
    return result


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, compare with a random team, and print the paths of the results."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    level = {"coordination": options.coordination, "heterogeneity": options.heterogeneity}
    try:
        check_seed(options.seed)
        settings = load_settings("saf", f"{options.task}-v0", "small", level, {"game_steps": options.game_steps})
    except ValueError as error:
        parser.error(str(error))
    seed, output = options.seed, options.output
    words = sys.argv[1:] if arguments is None else arguments
    write_run(output, settings.as_dict(), seed, shlex.join(["python", "-m", "sb3_saf.quickstart", *words]))
    title = f"{options.task}, coordination {options.coordination}, heterogeneity {options.heterogeneity}"
    print(
        f"Training SAF on {title}: {settings.game_steps:,} game steps with {settings.n_agents} agents in "
        f"{settings.n_envs} games, in a few minutes"
    )
    run = RunOptions(
        tensorboard_log=output / "tb",
        inspect_freq=max(1, settings.game_steps // N_INSPECTIONS),
        progress=options.progress_bar,
        num_threads=1,  # more threads do not help small networks, and slow down on a busy machine
    )
    model = train(settings, seed, output, run, [ProgressLines(verbose=int(not options.progress_bar))])
    gif, curve, page = (output / name for name in ("episode.gif", "learning_curve.png", "replay.html"))
    trained = evaluate(settings, seed, model, gif)
    random = evaluate(settings, seed, RandomPolicy(model.action_space, seed=seed))
    points = read_curve(output).assign(method=settings.algo, seed=seed)
    draw_curves(points, title, references={"random team": random.mean}).savefig(curve)
    with closing(settings.make_env(seed, evaluation=True, n_envs=1)) as games:
        replay({"SAF": model}, games, page, seed=evaluation_seed(seed))
    print(f"\nTeam return (treasures collected), {N_EPISODES} fresh games, mean and 95 % interval")
    print(f"  SAF     {trained}")
    print(f"  random  {random}")
    print(f"\nmodel           {output / 'model.zip'}")
    print(f"learning curve  {curve}")
    print(f"episode         {gif}")
    print(f"replay          {page} (open it in a browser)")
    print(f"TensorBoard     {python_command('tensorboard.main')} --logdir {output / 'tb'}")


if __name__ == "__main__":
    main()
