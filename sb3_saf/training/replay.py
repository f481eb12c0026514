"""``python -m sb3_saf.replay``: write a browser page that plays episodes of trained teams."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

from stable_baselines3.common.vec_env import unwrap_vec_normalize

from sb3_saf.inspection.replay import replay
from sb3_saf.teams.checks import check_seed, evaluation_seed
from sb3_saf.teams.files import differences
from sb3_saf.training.commands import (
    CommandError,
    DefaultsFormatter,
    OneLineParser,
    add_environment_options,
    at_least,
    run_command,
    user_errors,
)
from sb3_saf.training.enjoy import make_policy
from sb3_saf.training.folders import RUN_FILE, WEIGHTS, Run, published_run
from sb3_saf.training.settings import ALGOS, Settings, load_settings, saved_settings
from sb3_saf.training.wrappers import load_normalization

PROGRAM: Final = "python -m sb3_saf.replay"


def make_parser() -> argparse.ArgumentParser:
    """Make the parser."""
    parser = OneLineParser(
        prog=PROGRAM, description="Write a page that plays episodes of a team.", formatter_class=DefaultsFormatter
    )
    parser.add_argument(
        "--model",
        type=Path,
        nargs="+",
        required=True,
        metavar="FILE",
        help="a model (.zip), or the folder of a published team; several are shown side by side",
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("replay.html"), help="the page")
    add_environment_options(parser, "another level than was trained on, such as coordination:3")
    parser.set_defaults(env=None)
    parser.add_argument("--algo", default="saf", help=f"of models without the files of their run: {', '.join(ALGOS)}")
    parser.add_argument("--size", default="small", help="of models without the files of their run")
    parser.add_argument("--episodes", type=at_least(1), default=1, help="games to show")
    parser.add_argument("--deterministic", action="store_true", help="most likely actions; else they are drawn")
    parser.add_argument("--seed", type=int, default=0, help="of the games, none of which was trained on")
    return parser


def write_page(arguments: Sequence[str] | None = None) -> Path:
    """Write the page and return its path."""
    options = make_parser().parse_args(arguments)
    with user_errors(ValueError, RuntimeError, ImportError):
        seed = evaluation_seed(check_seed(options.seed))
        models = list(dict.fromkeys(options.model))
        paths = [path / WEIGHTS if (path / WEIGHTS).is_file() else path for path in models]
        all_trained = [_settings_of(path, options) for path in paths]
        settings = [saved_settings(trained.as_dict(), options.env_kwargs) for trained in all_trained]
        suite = settings[0].environment.suite
        levels = [
            {"env": own.env_id, **own.environment.of_evaluation(own.env_kwargs)}
            | {key: own.wrapping.get(key) for key in ("env_wrapper", "vec_env_wrapper", "frame_stack")}
            for own in settings
        ]
        if changed := next(filter(None, (differences(levels[0], level) for level in levels)), ""):
            raise ValueError(
                f"models side by side play one game, but {changed}; choose models of one task with equal wrappers, and "
                "a level with --env-kwargs"
            )
        render_mode = None if suite is not None and suite.is_drawn_from_state else "rgb_array"
        with closing(
            settings[0].make_env(options.seed, evaluation=True, n_envs=options.episodes, render_mode=render_mode)
        ) as games:
            players: dict[str, Any] = {
                name: make_policy(trained, path, games if own.env_kwargs == trained.env_kwargs else None)
                for name, path, trained, own in zip(_names(models), paths, all_trained, settings, strict=True)
            }
            if any("normalize" in own.wrapping for own in settings) and len(settings) > 1:
                raise ValueError("a model with normalize is shown alone: its games are normalised with its statistics")
            load_normalization(games, paths[0])
            normalizer, given = unwrap_vec_normalize(games), settings[0].wrapping.get("normalize")
            if normalizer is not None:  # values are of normalised rewards, as in training
                normalizer.norm_reward = not isinstance(given, Mapping) or given.get("norm_reward", True)
            gamma = {name: own.hyperparams.get("gamma", 0.99) for name, own in zip(players, settings, strict=True)}
            return replay(
                players, games, options.output, options.episodes, seed, options.deterministic, gamma, normalizer
            )


def _settings_of(path: Path, options: argparse.Namespace) -> Settings:
    """Return the settings of a model's training, or those of the command line."""
    if not path.exists():
        raise CommandError(f"--model {path} is not there")
    if path.is_dir():
        raise CommandError(
            f"--model {path} is a folder without {WEIGHTS}: name a model (.zip), or a published team's folder"
        )
    if not (path.is_file() and (path.parent / RUN_FILE).is_file()):
        return load_settings(options.algo, options.env or "TeamSupport-v0", options.size, options.env_kwargs)
    run = published_run(path.parent) if path.name == WEIGHTS else Run(path.parent)
    trained = run.settings
    if options.env not in (None, trained.env_id):
        raise CommandError(f"{path} was trained on {trained.env_id}, got --env {options.env}; leave --env out")
    return trained


def _names(paths: Sequence[Path]) -> list[str]:
    """Return distinct names of models: file names, or paths where these are equal."""
    stems = [path.stem for path in paths]
    return [stem if stems.count(stem) == 1 else str(path) for path, stem in zip(paths, stems, strict=True)]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command, with the arguments of this process by default."""
    run_command(PROGRAM, lambda: print(write_page(arguments)))
