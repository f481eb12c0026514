"""Batches of games for benchmarks."""

from __future__ import annotations

from typing import Any

from benchmarks.rates import Work, random_actions
from hecogrid_envs import GameBatch, HECOGridParams
from sb3_saf import game_seeds

N_GAMES = 128


def batch_work(task: str, observation: str, n_threads: int = 1, n_games: int = N_GAMES, **params: Any) -> Work:
    """Step and observe a batch, games resetting at their time limit."""
    all_params = HECOGridParams.from_kwargs({"observation": observation, **params})
    batch = GameBatch(task, all_params, n_games, n_threads)
    batch.reset(seeds=game_seeds(0, n_games))
    out = batch.observe()
    actions = random_actions((64, n_games, all_params.n_agents))

    def work() -> int:
        batch.advance(next(actions), out)
        return n_games * all_params.n_agents

    return work
