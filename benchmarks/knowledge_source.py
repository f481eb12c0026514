"""
Measure whether the cost of the knowledge source is linear in the number of agents: ``python -m
benchmarks.knowledge_source``.

Writing and reading, forward and backward, for N = 5 to 320 agents, compared with plain attention, where every agent
attends to every agent. Two measures: multiply-adds (counted by PyTorch, exact) and processor seconds of one core (which
exclude other programs). Letters: G teams, N agents, d = 64 features.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
import torch as th
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from sb3_saf.networks.attention import Attention
from sb3_saf.networks.knowledge_source import KnowledgeSource

SIZES: Final = (5, 10, 20, 40, 80, 160, 320)
FEATURES: Final = 64


class AllToAll(nn.Module):
    """Attention of every agent to the messages of all agents, without slots."""

    def __init__(self) -> None:
        super().__init__()
        self.attention = Attention(FEATURES)

    def forward(self, messages: th.Tensor, states: th.Tensor) -> th.Tensor:
        """Map (G, N, d) and (G, N, d) to (G, N, d)."""
        return self.attention(states, messages).values


def one_pass(module: nn.Module, n_teams: int, n_agents: int) -> Callable[[], None]:
    """Run forward and backward on random messages and states, which need gradients as in training."""
    messages, states = (th.randn(n_teams, n_agents, FEATURES, requires_grad=True) for _ in range(2))

    def work() -> None:
        module(messages, states).square().mean().backward()

    return work


def mega_multiply_adds(n_agents: int, make: Callable[[int], nn.Module]) -> float:
    """Count the multiply-adds of one team, in millions."""
    with FlopCounterMode(display=False) as counter:
        one_pass(make(n_agents), 1, n_agents)()
    return counter.get_total_flops() / 2e6


def seconds(works: Sequence[Callable[[], None]], repetitions: int) -> list[float]:
    """Return the shortest processor time of each program, in turns, after a warm-up."""
    times = np.zeros((repetitions + 1, len(works)))
    for turn in times:
        for index, work in enumerate(works):
            start = time.process_time()
            work()
            turn[index] = time.process_time() - start
    return [float(shortest) for shortest in times[1:].min(axis=0)]


def line(sizes: Sequence[int], costs: Sequence[float]) -> str:
    """Fit a straight line to the costs by relative error; also return the largest error."""
    n, cost = np.array(sizes, dtype=float), np.array(costs)
    design = np.stack([np.ones_like(n), n], axis=1) / cost[:, np.newaxis]
    fixed, slope = np.linalg.lstsq(design, np.ones_like(n), rcond=None)[0]
    off = np.abs((fixed + slope * n) / cost - 1.0).max()
    return f"{fixed:.3g} + {slope:.3g} N, off by {off:.1%} at most"


def main() -> None:
    """Print the table and the fits of its columns."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--teams", type=int, default=16, help="G, teams per pass")
    parser.add_argument("--repetitions", type=int, default=20)
    args = parser.parse_args()
    th.set_num_threads(1)
    th.manual_seed(0)
    kinds: dict[str, Callable[[int], nn.Module]] = {
        "knowledge source": lambda n: KnowledgeSource(n, FEATURES),
        "all to all": lambda n: AllToAll(),
    }
    columns: dict[str, list[float]] = {}
    for name, make in kinds.items():
        columns[f"{name}, M multiply-adds per team"] = [mega_multiply_adds(n, make) for n in SIZES]
        works = [one_pass(make(n), args.teams, n) for n in SIZES]
        columns[f"{name}, ms per {args.teams} teams"] = [1e3 * s for s in seconds(works, args.repetitions)]
    print("| N |", " | ".join(columns), "|")
    print("| --: |" + " --: |" * len(columns))
    for row, n_agents in enumerate(SIZES):
        print(f"| {n_agents} |", " | ".join(f"{column[row]:.2f}" for column in columns.values()), "|")
    print()
    for name, column in columns.items():
        print(f"{name}: {line(SIZES, column)}")


if __name__ == "__main__":
    main()
