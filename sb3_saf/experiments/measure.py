"""How fast and how large a training is, found out by training for some seconds."""

from __future__ import annotations

import multiprocessing as mp
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Final, NamedTuple

import torch as th

from sb3_saf.experiments.cells import Cell, Protocol
from sb3_saf.experiments.local import pinned

#: Games of the first, short rollouts: compile, warm up, and tell how many games fit the time.
_FEW_GAMES: Final = 2
#: Seconds that the measured training should take.
_SECONDS: Final = 5.0
_MEGABYTE: Final = 1e6


class Measurement(NamedTuple):
    """
    A burst of training with a cell's own settings.

    :param method: name of the algorithm
    :param rate: game steps per second, rollouts and updates together
    :param n_games: games that were played at once
    :param game_steps: game steps that were measured
    :param seconds: that they took
    :param megabytes: memory of a worker, extrapolated to the games of the settings
    :param device: that it ran on
    """

    method: str
    rate: float
    n_games: int
    game_steps: int
    seconds: float
    megabytes: float
    device: str

    def __str__(self) -> str:
        return (
            f"{self.method}: {self.rate:,.0f} game steps/s ({self.game_steps:,} game steps of {self.n_games} games at "
            f"once in {self.seconds:.1f} s on {self.device})"
        )


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
    seconds, game_steps, found = _burst(cell, protocol, _FEW_GAMES, device)
    # A GPU is only busy with all games.
    n_games = n_envs
    if found == "cpu":
        n_games = max(_FEW_GAMES + 1, min(n_games, int(_SECONDS / seconds * _FEW_GAMES)))
    seconds, game_steps, found = _burst(cell, protocol, n_games, device)
    used = _peak_megabytes()
    per_game = max(0.0, used - used_by_few) / (n_games - _FEW_GAMES)
    megabytes = used + per_game * max(0, n_envs - n_games)
    return Measurement(cell.method, game_steps / seconds, n_games, game_steps, seconds, megabytes, found)


def _burst(cell: Cell, protocol: Protocol, n_games: int, device: str) -> tuple[float, int, str]:
    """
    Train on one rollout of some games, with as many minibatches as the settings have.

    :return: seconds, game steps, device
    """
    few = replace(protocol, overrides={**protocol.overrides, "n_envs": n_games})
    settings = few.settings(cell)
    env = settings.make_env(0)
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
    return seconds, game_steps, model.device.type


def _peak_megabytes() -> float:
    """The most memory that this process has had."""
    try:
        import resource
    except ImportError:  # Windows
        return float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / _MEGABYTE if sys.platform == "darwin" else peak * 1024 / _MEGABYTE
