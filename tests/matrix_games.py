"""Matrix games of two agents for value factorisation: the value of every joint action is known."""

from __future__ import annotations

from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from pettingzoo import ParallelEnv

Floats = npt.NDArray[np.float64]

#: QPLEX's and QTRAN's example: only the joint action (0, 0) has a positive payoff.
ONE_STEP: Final = np.array([[8.0, -12.0, -12.0], [-12.0, 0.0, 0.0], [-12.0, 0.0, 0.0]])
#: The climbing game of Claus and Boutilier (1998).
CLIMBING: Final = np.array([[11.0, -30.0, 0.0], [-30.0, 7.0, 6.0], [0.0, 0.0, 5.0]])


class MatrixGame(ParallelEnv[str, Any, Any]):
    """
    One step; the team's reward is the payoff of the joint action, divided equally.

    :param payoffs: (A, A)
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "matrix_v0", "render_modes": [], "is_parallelizable": True}

    def __init__(self, payoffs: Floats = ONE_STEP) -> None:
        self.payoffs = payoffs
        self.possible_agents = ["row", "column"]
        self.agents: list[str] = []
        self.render_mode = None
        self._observation_space = spaces.Box(0.0, 1.0, (2,), np.float32)
        self._action_space = spaces.Discrete(len(payoffs))

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return the same space for both."""
        return self._observation_space

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return the same space for both."""
        return self._action_space

    def observe(self) -> dict[str, Any]:
        """Each agent observes its own index."""
        return {agent: np.eye(2, dtype=np.float32)[i] for i, agent in enumerate(self.possible_agents)}

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Reset; nothing is random."""
        self.agents = self.possible_agents[:]
        return self.observe(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> Any:
        """Reward the team, and end the episode."""
        payoff = float(self.payoffs[int(actions["row"]), int(actions["column"])])
        agents, self.agents = self.agents, []
        ends = dict.fromkeys(agents, True)
        return (
            self.observe(),
            dict.fromkeys(agents, payoff / 2),
            ends,
            dict.fromkeys(agents, False),
            {a: {} for a in agents},
        )


class TwoStates(MatrixGame):
    """
    Two states (Wang et al. 2021, arXiv 2006.00587): in state 1 the joint action (0, 0) is rewarded with 1 and stays,
    (0, 1) and (1, 0) stay, (1, 1) leads to state 0, which has no rewards and no way out. The time limit does not
    terminate: the value of state 1 is 1 / (1 - gamma).

    With uniform data, additive factorisation fits (0, 0) with 3/4 + 5/4 gamma V, so its values diverge for gamma > 4/5.

    :param length: steps until the episode is truncated
    """

    def __init__(self, length: int = 10) -> None:
        super().__init__(np.array([[1.0, 0.0], [0.0, 0.0]]))
        self.length, self.time, self.state_now = length, 0, 1

    def observe(self) -> dict[str, Any]:
        """Both agents observe the state."""
        return {agent: np.eye(2, dtype=np.float32)[self.state_now] for agent in self.possible_agents}

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start in state 1."""
        self.time, self.state_now = 0, 1
        return super().reset(seed, options)

    def step(self, actions: dict[str, Any]) -> Any:
        """Reward and move."""
        row, column = int(actions["row"]), int(actions["column"])
        payoff = float(self.payoffs[row, column]) * self.state_now
        self.state_now = int(self.state_now and not row & column)
        self.time += 1
        agents = self.agents
        over = self.time == self.length
        self.agents = [] if over else agents
        ends = dict.fromkeys(agents, over)
        return (
            self.observe(),
            dict.fromkeys(agents, payoff / 2),
            dict.fromkeys(agents, False),
            ends,
            {a: {} for a in agents},
        )
