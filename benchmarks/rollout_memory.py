"""
Compute the memory of a rollout at the paper's size (128 games of 10 agents, 50 steps): ``python -m
benchmarks.rollout_memory``.

Bytes per agent-step, compared with Stable-Baselines3's buffer for the same observations, computed from the arrays.
"""

from __future__ import annotations

from typing import Final

from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer

from sb3_saf import TeamRolloutBuffer, make_team_env

N_GAMES: Final = 128
N_STEPS: Final = 50


def bytes_per_row(observation: str) -> tuple[float, float, float]:
    """
    Compute bytes per agent-step.

    :param observation: ``"tiles"`` or ``"rgb"``
    :return: views, everything else, and the total of SB3's buffer
    """
    env = make_team_env("TeamSupport", n_envs=N_GAMES, seed=0, observation=observation)
    rows = env.num_envs
    space = env.observation_space
    assert isinstance(space, spaces.Dict)
    ours = TeamRolloutBuffer(N_STEPS, space, env.action_space, "cpu", n_envs=rows)
    stock = DictRolloutBuffer(N_STEPS, space, env.action_space, "cpu", n_envs=rows)
    env.close()
    views = sum(array.nbytes for array in ours.observations.values())
    # Untouched zeros are counted but take no memory.
    theirs = sum(array.nbytes for array in stock.observations.values())
    theirs += sum(
        getattr(stock, name).nbytes
        for name in ("actions", "rewards", "returns", "episode_starts", "values", "log_probs", "advantages")
    )
    steps = N_STEPS * rows
    return views / steps, (ours.nbytes - views) / steps, theirs / steps


def memory_table() -> str:
    """Format the table as Markdown; views are stored once per agent, joint observations are composed of them."""
    heads = ["rollout of", "views", "actions, rewards, values, ...", "together", "SB3's buffer", "whole rollout"]
    lines = ["| " + " | ".join(heads) + " |", "|" + " --- |" * len(heads)]
    for observation in ("tiles", "rgb"):
        views, rest, stock = bytes_per_row(observation)
        whole = (views + rest) * N_STEPS * N_GAMES * 10 / 1e6
        lines.append(
            f"| {observation} | {views:,.0f} | {rest:,.0f} | {views + rest:,.0f} | {stock:,.0f} | {whole:,.1f} MB |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    print(memory_table())
