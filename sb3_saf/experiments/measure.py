"""How fast and how large a training is, found out by training for some seconds."""

from __future__ import annotations

import multiprocessing as mp
import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Final, NamedTuple

import torch as th

from sb3_saf.experiments.cells import Cell, Protocol
from sb3_saf.experiments.local import pinned

#: Games of the first, short rollouts: compile, warm up, and tell how many games fit the time.
_FEW_GAMES: Final = 2
#: Games of the longer burst at least, where the settings have so many.
_FEWEST_GAMES: Final = 8
#: Seconds that the measured training should take.
_SECONDS: Final = 5.0
_MEGABYTE: Final = 1e6


class Measurement(NamedTuple):
    """
    A burst of training with a cell's own settings.

    :param method: name of the algorithm
    :param rate: game steps per second of a training with all games, rollouts and updates together
    :param n_games: games that were played at once
    :param of_games: games of the settings
    :param game_steps: game steps that were measured
    :param seconds: that they took
    :param megabytes: memory of a worker, extrapolated to the games of the settings
    :param device: that it ran on
    """

    method: str
    rate: float
    n_games: int
    of_games: int
    game_steps: int
    seconds: float
    megabytes: float
    device: str

    def __str__(self) -> str:
        extrapolated = "" if self.n_games == self.of_games else f", extrapolated to {self.of_games}"
        return (
            f"{self.method}: {self.rate:,.0f} game steps/s ({self.game_steps:,} game steps of {self.n_games} games at "
            f"once in {self.seconds:.1f} s on {self.device}{extrapolated})"
        )


class Burst(NamedTuple):
    """
    One rollout and its updates.

    :param n_games: games that were played at once
    :param game_steps: of all of them
    :param seconds: that it took
    :param device: that it ran on
    """

    n_games: int
    game_steps: int
    seconds: float
    device: str


def measure(cell: Cell, protocol: Protocol, threads: int, device: str) -> Measurement:
    """
    Train for some seconds in a process of its own, whose memory is the training's alone.

    :param cell: whose settings to take
    :param protocol: how it is trained
    :param threads: of the process
    :param device: as SB3 takes it
    """
    with pinned(threads), ProcessPoolExecutor(1, mp.get_context("spawn")) as pool:
        return pool.submit(_measure, cell, protocol, threads, device).result()


def _measure(cell: Cell, protocol: Protocol, threads: int, device: str) -> Measurement:
    th.set_num_threads(threads)
    n_envs = protocol.settings(cell).n_envs
    _burst(cell, protocol, _FEW_GAMES, device)
    used_by_few = _peak_megabytes()
    few = _burst(cell, protocol, _FEW_GAMES, device)
    # A GPU is only busy with all games.
    n_games = n_envs
    if few.device == "cpu":
        n_games = min(n_envs, max(_FEWEST_GAMES, int(_SECONDS / few.seconds * _FEW_GAMES)))
    n_games = max(_FEW_GAMES + 1, n_games)
    many = _burst(cell, protocol, n_games, device)
    used = _peak_megabytes()
    per_game = max(0.0, used - used_by_few) / (n_games - _FEW_GAMES)
    megabytes = used + per_game * max(0, n_envs - n_games)
    rate = full_rate(few, many, n_envs)
    return Measurement(cell.method, rate, n_games, n_envs, many.game_steps, many.seconds, megabytes, many.device)


def full_rate(few: Burst, many: Burst, n_games: int) -> float:
    """
    Game steps per second with all games, from bursts with fewer: what a rollout and its updates cost grows by as much
    with every game, but not from nothing.

    :param few: with the fewest games
    :param many: with more
    :param n_games: all games
    """
    each = max(0.0, many.seconds - few.seconds) / (many.n_games - few.n_games)
    seconds = many.seconds + each * (n_games - many.n_games)
    return many.game_steps / many.n_games * n_games / seconds


def _burst(cell: Cell, protocol: Protocol, n_games: int, device: str) -> Burst:
    """Train on one rollout of some games, with as many minibatches as the settings have."""
    few = replace(protocol, overrides={**protocol.overrides, "n_envs": n_games})
    settings = few.settings(cell)
    env = settings.make_env(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of minibatches that few games do not fill
        model = settings.make_model(env, 0, device=device)
    # Off-policy algorithms only collect at first.
    if hasattr(model, "learning_starts"):
        model.learning_starts = 0
    game_steps = int(settings.hyperparams.get("n_steps", settings.env_kwargs["max_cycles"])) * n_games
    clock = time.perf_counter()
    model.learn(game_steps * settings.n_agents)
    if model.device.type == "cuda":
        th.cuda.synchronize()
    seconds = time.perf_counter() - clock
    env.close()
    return Burst(n_games, game_steps, seconds, model.device.type)


def _peak_megabytes() -> float:
    """The most memory that this process has had."""
    try:
        import resource
    except ImportError:  # Windows
        return float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / _MEGABYTE if sys.platform == "darwin" else peak * 1024 / _MEGABYTE
