"""Display of one game of a team in a window, as GIF or MP4, or as text. N agents."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TextIO

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize, unwrap_vec_normalize

from sb3_saf.envs.audit import mask_key_of
from sb3_saf.envs.space_reader import FlatReader, can_be_flattened
from sb3_saf.teams.checks import evaluation_seed
from sb3_saf.teams.randomness import game_seeds
from sb3_saf.teams.rows import ACTION_MASK_KEY, AGENT_KEY, OBS_KEY, TeamSpaces
from sb3_saf.training.enjoy import TrainedTeam
from sb3_saf.training.wrappers import load_normalization

Mode = Literal["human", "rgb_array", "ansi"]
Frame = npt.NDArray[np.uint8]

#: Game steps per second.
FPS: Final = 8
#: Environment variables of which one is set if windows can be opened.
_DISPLAYS: Final = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")


class Screen(NamedTuple):
    """A game to show (None shows nothing), and the GIF or MP4 to write (None for window or text)."""

    env: Any
    file: Path | None


@contextmanager
def open_screen(team: TrainedTeam, options: argparse.Namespace) -> Iterator[Screen]:
    """Open the screen of the options; a window fails immediately without a display."""
    if options.no_render:
        yield Screen(None, None)
        return
    file = _checked_file(options)
    mode: Mode = "rgb_array" if file is not None else "ansi" if options.text else "human"
    env = team.settings.make_game(mode)
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


def _open_window(env: Any) -> None:
    try:
        # Checked here, because SDL would print its own errors.
        if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in _DISPLAYS):
            raise RuntimeError("no window can be opened (there is no display)")
        env.reset(seed=0)
    except (ImportError, RuntimeError) as error:
        reason = str(error).partition(";")[0]
        raise RuntimeError(f"{reason}; use --gif FILE, --mp4 FILE, --text, or --no-render") from None


def show_game(screen: Screen, team: TrainedTeam, seed: int, deterministic: bool) -> None:
    """Play the first of the measured games on a screen, with decentralised execution."""
    if screen.env is None:
        return
    if screen.file is not None:
        # A new game: some packages (mpe2) quit pygame for all games when one is closed, as after the measurement.
        with closing(team.settings.make_game(screen.env.render_mode)) as env:
            frames = list(play(env, team, seed, deterministic))
        metadata = getattr(screen.env, "metadata", None) or {}
        write_video(screen.file, frames, int(metadata.get("render_fps", FPS)))
        print(screen.file)
    elif screen.env.render_mode == "ansi":
        print_frames(play(screen.env, team, seed, deterministic), sys.stdout)
    else:
        for _ in play(screen.env, team, seed, deterministic):
            pass  # the environment draws


def play(env: Any, team: TrainedTeam, seed: int, deterministic: bool) -> Iterator[Any]:
    """Play a game, a ParallelEnv; yield ``env.render()`` at the start and after every step."""
    set_random_seed(seed)
    read = _Reader(team, env)
    observations, infos = env.reset(seed=game_seeds(evaluation_seed(seed), 1)[0])
    state, starts = None, np.ones(len(env.possible_agents), dtype=bool)
    yield env.render()
    while env.agents:
        rows = read.rows(env.possible_agents, observations, infos)
        actions, state = team.policy.predict(rows, state, starts, deterministic)
        starts[:] = False
        plain = actions.tolist() if actions.ndim == 1 else actions
        taken = dict(zip(env.possible_agents, plain, strict=True))
        observations, _, _, _, infos = env.step({agent: taken[agent] for agent in env.agents})
        yield env.render()


def _normalization_of(team: TrainedTeam) -> VecNormalize | None:
    games = team.settings.make_env(0, evaluation=True, n_envs=1)
    load_normalization(games, team.path.parent)
    games.close()
    return unwrap_vec_normalize(games)


class _Reader:
    """Converter from a ParallelEnv's results to rows for the policy: one row per agent, absent ones included."""

    def __init__(self, team: TrainedTeam, env: Any) -> None:
        space = env.observation_space(env.possible_agents[0])
        has_masks = mask_key_of(space, env.action_space(env.possible_agents[0]))[0] is not None
        self._flat = FlatReader(space) if can_be_flattened(space) and not has_masks else None
        self._spaces = TeamSpaces.from_observation_space(team.policy.observation_space)
        self._normalization = _normalization_of(team) if team.settings.wrapping.get("normalize") else None

    def rows(self, agents: Sequence[Any], observations: Mapping[Any, Any], infos: Mapping[Any, Any]) -> dict[str, Any]:
        """Stack the own observations of all agents in order, and their masks if there are any."""
        space, n_actions = self._spaces.own, self._spaces.action_mask
        own = np.zeros((len(agents), *(space.shape or ())), dtype=space.dtype)
        masks = np.ones((len(agents), *(() if n_actions is None else n_actions.shape)), dtype=np.int8)
        for index, agent in enumerate(agents):
            if agent not in observations:
                continue
            seen = observations[agent]
            told = seen if isinstance(seen, Mapping) else infos.get(agent, {})
            if n_actions is not None and ACTION_MASK_KEY in told:
                masks[index] = told[ACTION_MASK_KEY]
            if self._flat is not None:
                seen = self._flat.read(seen, str(agent))
            seen = np.asarray(seen["observation"] if isinstance(seen, Mapping) else seen)
            own[index] = seen if seen.shape == own.shape[1:] else np.moveaxis(seen, -1, 0)
        rows = {OBS_KEY: self._normalized(own), AGENT_KEY: np.arange(len(agents))}
        return rows if n_actions is None else {**rows, ACTION_MASK_KEY: masks}

    def _normalized(self, own: npt.NDArray[Any]) -> Any:
        layer = self._normalization
        if layer is None or not layer.norm_obs:
            return own
        if isinstance(layer.observation_space, spaces.Dict):
            normal = layer.normalize_obs({OBS_KEY: own})
            assert isinstance(normal, dict)
            return normal[OBS_KEY]
        return layer.normalize_obs(own)


def write_video(path: Path, frames: list[Frame], fps: int = FPS) -> None:
    """Write frames, (height, width, 3) each, as GIF or MP4, by the path's ending."""
    import imageio.v3 as imageio

    if not isinstance(frames[0], np.ndarray):
        raise ValueError(f"expected pictures from render() with render_mode='rgb_array', got {frames[0]!r}")
    pictures = np.stack(frames)
    if path.suffix.lower() == ".gif":
        imageio.imwrite(path, pictures, duration=1000 // fps, loop=0)
        return
    height, width = pictures.shape[1:3]
    even = np.pad(pictures, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)))  # H.264 needs even sizes
    imageio.imwrite(path, even, plugin="FFMPEG", fps=fps, macro_block_size=1)


def print_frames(frames: Iterator[str], stdout: TextIO) -> None:
    """Print a game: in place on a terminal, else one page after the other."""
    import time

    on_terminal = stdout.isatty() and os.environ.get("TERM", "dumb") != "dumb"
    for frame in frames:
        print(("\x1b[2J\x1b[H" if on_terminal else "") + frame, end="\n\n", file=stdout, flush=True)
        if on_terminal:
            time.sleep(1 / FPS)
