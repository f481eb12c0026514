"""``python -m sb3_saf.enjoy``: measure the return of a trained team, and show the first of its games."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_saf.evaluation import EvaluationResult, evaluate_team
from sb3_saf.export.writer import load_weights
from sb3_saf.inspection.figures import gif
from sb3_saf.inspection.recording import Picture, picture
from sb3_saf.suites.registry import find_environment
from sb3_saf.teams.checks import check_seed, evaluation_seed
from sb3_saf.teams.vec_env import TeamVecEnvWrapper
from sb3_saf.training.commands import (
    DefaultsFormatter,
    OneLineParser,
    add_environment_options,
    at_least,
    run_command,
    user_errors,
)
from sb3_saf.training.folders import FINISHED, SAVED_MODEL, WEIGHTS, find_model, find_team, version_in_errors
from sb3_saf.training.settings import ALGOS, Settings, find_algorithm, saved_settings
from sb3_saf.training.wrappers import load_normalization

PROGRAM: Final = "python -m sb3_saf.enjoy"
#: Game steps per second, of games that name no other speed.
FPS: Final = 8

Frame = Any
Show = Callable[[Frame], object]


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
    which.add_argument(
        "--team", metavar="ENV/METHOD", help="a published team, such as TeamSupport-c2-h1/saf, in the place of a run"
    )
    which.add_argument("--load-best", action="store_true", help="the model with the best evaluation")
    which.add_argument("--load-checkpoint", metavar="STEPS", type=int, help="the model saved after these game steps")
    parser.add_argument("--episodes", type=at_least(1), default=32, help="team episodes to measure")
    parser.add_argument("--deterministic", action="store_true", help="most likely actions; else they are drawn")
    parser.add_argument(
        "--seed", type=int, default=0, help="of the games, which neither training nor its evaluations have"
    )
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument("--gif", type=Path, metavar="FILE", help="record a game")
    shown.add_argument("--mp4", type=Path, metavar="FILE", help="record a game")
    shown.add_argument("--text", action="store_true", help="print a game; otherwise it is shown in a window")
    shown.add_argument("--no-render", action="store_true", help="only measure")
    return parser


def enjoy(arguments: Sequence[str] | None = None) -> EvaluationResult:
    """Measure, and show the first game meanwhile; return the team returns."""
    parser = make_parser()
    options = parser.parse_args(arguments, argparse.Namespace(env=None, algo=None))
    with user_errors(ValueError, RuntimeError, ImportError):
        seed = check_seed(options.seed)
        given = {"--env": options.env, "--algo": options.algo}
        if options.team is None:
            options.env, options.algo = (given[f"--{name}"] or parser.get_default(name) for name in ("env", "algo"))
            find_algorithm(options.algo)
            which = "best" if options.load_best else options.load_checkpoint
            run, path = find_model(
                options.log_folder, options.algo, find_environment(options.env), options.exp_id, which
            )
        else:
            run = find_team(options.team)
            path = run.folder / WEIGHTS
        with version_in_errors(run):
            trained = run.settings
        for name, value in zip(given, (trained.env_id, trained.algo), strict=True):
            if options.team is not None and given[name] not in (None, value):
                raise ValueError(f"the team {options.team} has {name} {value}, got {given[name]}; leave {name} out")
        options.env = trained.env_id
        settings = saved_settings(trained.as_dict(), options.env_kwargs)
        mode = None if options.no_render else "ansi" if options.text else "rgb_array"
        games = settings.make_env(seed, evaluation=True, n_envs=options.episodes, render_mode=mode)
        with closing(games):
            with version_in_errors(run):
                policy = make_policy(trained, path, games if settings.env_kwargs == trained.env_kwargs else None)
            games.seed(evaluation_seed(seed, test=0))  # the best model is the best one on the games of evaluations
            load_normalization(games, path)
            set_random_seed(seed)
            with open_screen(options, games) as show:
                env = games if show is None else Film(games, show)
                result = evaluate_team(policy, env, options.episodes, deterministic=options.deterministic)
                # Before a recording is written, which may fail.
                print(f"{trained.algo} on {trained.env_id}, weights of {path}")
                print(f"team return {result}")
                saved = SAVED_MODEL.fullmatch(path.name)
                if saved or options.team is not None or (run.folder / FINISHED).exists():
                    game_steps = int(saved[1]) if saved else trained.game_steps
                    known = settings.standing(result.scores, game_steps)
                    if known is not None:
                        print(known.text)
    return result


def make_policy(settings: Settings, path: Path, games: VecEnv | None = None) -> BasePolicy:
    """
    Make the policy of the settings with the weights of a model's file, read as numbers only.

    :param games: like those of its training; None to make some, for a policy that is to play others
    """
    if games is None:
        with closing(settings.make_env(0, n_envs=1)) as own_games:
            return make_policy(settings, path, own_games)
    kwargs = settings.hyperparams.get("policy_kwargs", {})
    policy = settings.spec.policy_class(
        games.observation_space, games.action_space, lr_schedule=lambda progress: 0.0, **kwargs
    )
    load_weights(policy, path)
    policy.set_training_mode(False)
    return policy


class Film(TeamVecEnvWrapper):
    """
    Show the first game of a vector environment until its first episode ends.

    :param venv: the games, made with a render mode
    :param show: called with what ``render`` of the first game returns, a picture or text, after each step but the last
    """

    def __init__(self, venv: VecEnv, show: Show) -> None:
        super().__init__(venv)
        self._show = show
        self._is_over = False

    def reset(self) -> VecEnvObs:
        """Start new episodes, and show the first game."""
        observations = self.venv.reset()
        self._is_over = False
        self._show_first()
        return observations

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for the step, and show the first game."""
        results = self.venv.step_wait()
        self._is_over = self._is_over or bool(np.all(results[2][: self.n_agents]))
        if not self._is_over:
            self._show_first()
        return results

    def _show_first(self) -> None:
        self._show(self.venv.env_method("render", indices=[0])[0])


@contextmanager
def open_screen(options: argparse.Namespace, games: VecEnv) -> Iterator[Show | None]:
    """Yield the function that shows pictures or text as the options say; None for nothing."""
    metadata = games.get_attr("metadata", [0])[0] if games.has_attr("metadata") else None
    fps = (metadata or {}).get("render_fps") or FPS
    if options.no_render:
        yield None
    elif options.text:
        yield _print_in_place
    elif options.gif is not None or options.mp4 is not None:
        ending, path = (".gif", options.gif) if options.gif is not None else (".mp4", options.mp4)
        if path.suffix.lower() != ending:
            raise ValueError(f"--{ending[1:]} needs a file that ends with {ending}, got {str(path)!r}")
        path.parent.mkdir(parents=True, exist_ok=True)
        frames: list[Picture] = []
        yield lambda frame: frames.append(picture(frame))
        write_video(path, frames, fps)
        print(path)
    else:
        from hecogrid_envs.play import HumanWindow

        window = HumanWindow(options.env, fps)
        try:
            yield lambda frame: window.show(picture(frame))
        except (ImportError, RuntimeError) as error:
            reason = str(error).partition(";")[0]
            raise RuntimeError(f"{reason}; use --gif FILE, --mp4 FILE, --text, or --no-render") from None
        finally:
            window.close()


def write_video(path: Path, pictures: Sequence[Picture], fps: float = FPS) -> None:
    """Write pictures, (height, width, 3) each, as GIF or MP4, by the path's ending."""
    if path.suffix.lower() == ".gif":
        path.write_bytes(gif(pictures, 1 / fps))
        return
    import imageio.v3 as imageio

    height, width, _ = pictures[0].shape  # H.264 needs even sizes
    even = np.pad(np.stack(pictures), ((0, 0), (0, height % 2), (0, width % 2), (0, 0)))
    imageio.imwrite(path, even, plugin="FFMPEG", fps=fps, macro_block_size=1)


def _print_in_place(frame: Frame) -> None:
    """Print a game: in place on a terminal, else one page after the other."""
    if not isinstance(frame, str):
        raise ValueError(
            f"expected text from render() with render_mode='ansi', got {type(frame).__name__}; leave out --text"
        )
    on_terminal = sys.stdout.isatty() and os.environ.get("TERM", "dumb") != "dumb"
    print(("\x1b[2J\x1b[H" if on_terminal else "") + frame, end="\n\n", flush=True)
    if on_terminal:
        time.sleep(1 / FPS)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command, with the arguments of this process by default."""
    run_command(PROGRAM, lambda: enjoy(arguments))
