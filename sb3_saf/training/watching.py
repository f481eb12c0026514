"""One game of a team, in a window, as GIF or MP4, or as text. N agents."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TextIO

import numpy as np
import numpy.typing as npt
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import set_random_seed

import hecogrid_envs
from hecogrid_envs.parallel_env import HECOGridEnv
from hecogrid_envs.seeding import game_seeds
from sb3_saf.training.seeds import evaluation_seed
from sb3_saf.training.settings import Settings

Mode = Literal["human", "rgb_array", "ansi"]
Frame = npt.NDArray[np.uint8]

#: Game steps per second.
FPS: Final = 8
#: Variables of which one is set where windows can be opened.
_DISPLAYS: Final = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")


class Screen(NamedTuple):
    """
    Where a game is shown.

    :param env: the game; None shows nothing
    :param file: GIF or MP4 to write; None for window or text
    """

    env: HECOGridEnv | None
    file: Path | None


@contextmanager
def open_screen(settings: Settings, options: argparse.Namespace) -> Iterator[Screen]:
    """
    Open what the options ask for, the window included: it fails at once where there is no display.

    :param settings: of the game
    :param options: with ``gif``, ``mp4``, ``text``, ``no_render``
    :raises RuntimeError: if there is no display
    :raises ValueError: if the file has another ending
    """
    if options.no_render:
        yield Screen(None, None)
        return
    file = _checked_file(options)
    mode: Mode = "rgb_array" if file is not None else "ansi" if options.text else "human"
    env = hecogrid_envs.parallel_env(settings.task, render_mode=mode, **settings.env_kwargs)
    try:
        if mode == "human":
            _open_window(env)
        yield Screen(env, file)
    finally:
        env.close()


def _checked_file(options: argparse.Namespace) -> Path | None:
    for ending, path in ((".gif", options.gif), (".mp4", options.mp4)):
        if path is not None:
            if path.suffix.lower() != ending:
                raise ValueError(f"--{ending[1:]} needs a file that ends with {ending}, got {str(path)!r}")
            path.parent.mkdir(parents=True, exist_ok=True)
            return Path(path)
    return None


def _open_window(env: HECOGridEnv) -> None:
    try:
        # Asked, SDL would print complaints of its own.
        if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in _DISPLAYS):
            raise RuntimeError("no window can be opened (there is no display)")
        env.reset(seed=0)
    except (ImportError, RuntimeError) as error:
        reason = str(error).partition(";")[0]
        raise RuntimeError(f"{reason}; use --gif FILE, --mp4 FILE, --text, or --no-render") from None


def show_game(screen: Screen, policy: BasePolicy, seed: int, deterministic: bool) -> None:
    """
    Play the first of the measured games.

    :param screen: where
    :param policy: who; each agent is given its own observation only
    :param seed: of game and actions
    :param deterministic: whether to take the most likely actions
    """
    if screen.env is None:
        return
    frames = play(screen.env, policy, seed, deterministic)
    if screen.file is not None:
        write_video(screen.file, list(frames))
        print(screen.file)
    elif screen.env.render_mode == "ansi":
        print_frames(frames, sys.stdout)
    else:
        for _ in frames:
            pass  # the environment draws


def play(env: HECOGridEnv, policy: BasePolicy, seed: int, deterministic: bool) -> Iterator[Any]:
    """
    Play a game.

    :param env: the game
    :param policy: the team, with memory or without
    :param seed: of game and actions
    :param deterministic: whether to take the most likely actions
    :return: what ``env.render()`` gives, at the start and after every step
    """
    set_random_seed(seed)
    observations, _ = env.reset(seed=game_seeds(evaluation_seed(seed), 1)[0])
    state, starts = None, np.ones(len(env.agents), dtype=bool)
    yield env.render()
    while env.agents:
        own = np.stack([observations[agent] for agent in env.agents])
        actions, state = policy.predict(own, state, starts, deterministic)
        starts[:] = False
        observations, *_ = env.step(dict(zip(env.agents, actions.tolist(), strict=True)))
        yield env.render()


def write_video(path: Path, frames: list[Frame]) -> None:
    """
    Write a GIF or MP4.

    :param path: by its ending
    :param frames: (height, width, 3) each
    """
    import imageio.v3 as imageio

    pictures = np.stack(frames)
    if path.suffix.lower() == ".gif":
        imageio.imwrite(path, pictures, duration=1000 // FPS, loop=0)
        return
    height, width = pictures.shape[1:3]
    even = np.pad(pictures, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)))  # H.264 halves the colours' resolution
    imageio.imwrite(path, even, plugin="FFMPEG", fps=FPS, macro_block_size=1)


def print_frames(frames: Iterator[str], stdout: TextIO) -> None:
    """
    Print a game: in place on a terminal, else one page after the other.

    :param frames: pages
    :param stdout: where
    """
    import time

    on_terminal = stdout.isatty() and os.environ.get("TERM", "dumb") != "dumb"
    for frame in frames:
        print(("\x1b[2J\x1b[H" if on_terminal else "") + frame, end="\n\n", file=stdout, flush=True)
        if on_terminal:
            time.sleep(1 / FPS)
