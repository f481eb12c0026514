"""
Probes: tiny PettingZoo games with a known answer, in order of difficulty.

A failing probe shows what is broken: the value loss, the encoding of observations, discounting and bootstrapping, the
policy's gradient, the joint baseline, the pool, or the path from one agent's view to another agent's value.

In every probe an agent sees a few numbers and has two actions; rewards are functions of what all agents see and do
(:meth:`Probe.rewards`), so tests can enumerate every situation. Letters: N agents, C contexts.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import product
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from pettingzoo import ParallelEnv

Floats = npt.NDArray[np.float64]


class Probe(ParallelEnv[str, Any, Any], ABC):
    """
    One context is drawn per episode and does not change; agents see parts of it at every step.

    :param n_agents: N
    :param length: steps until the episode is truncated
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "probe_v0", "render_modes": [], "is_parallelizable": True}
    #: Numbers, each -1 or 1, that each agent sees; actions of each agent.
    n_bits: ClassVar[int] = 1
    n_actions: ClassVar[int] = 2

    def __init__(self, n_agents: int = 2, length: int = 1):
        self.possible_agents = [f"agent_{i}" for i in range(n_agents)]
        self.agents: list[str] = []
        self.render_mode = None
        self.length = length
        self.time = 0
        self.bits: Floats = np.zeros((n_agents, self.n_bits))
        self._rng: np.random.Generator | None = None
        self._observation_space = spaces.Box(-1.0, 1.0, (self._n_numbers(),), np.float32)
        self._action_space = spaces.Discrete(self.n_actions)

    def _n_numbers(self) -> int:
        return self.n_bits + self.length - 1

    @abstractmethod
    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        """
        Compute the rewards.

        :param bits: (N, n_bits) what each agent sees
        :param actions: (N,)
        :param time: steps before this one
        :return: (N,)
        """

    def observe(self, bits: Floats, time: int) -> npt.NDArray[np.float32]:
        """Return (N, n_bits + length - 1): the bits, and the step (one-hot; all zeros at the first step)."""
        clock = np.zeros((len(bits), self.length))
        clock[:, time % self.length] = 1.0
        return np.concatenate([bits, clock[:, 1:]], axis=1).astype(np.float32)

    def contexts(self) -> Floats:
        """Return (C, N, n_bits): all contexts, which are equally likely."""
        shape = len(self.possible_agents), self.n_bits
        return np.array(list(product((-1.0, 1.0), repeat=shape[0] * shape[1]))).reshape(-1, *shape)

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return self._observation_space

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return self._action_space

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Draw a context."""
        if seed is not None or self._rng is None:
            self._rng = np.random.default_rng(seed)
        self.agents = self.possible_agents[:]
        self.time = 0
        self.bits = np.where(self._rng.integers(2, size=(len(self.agents), self.n_bits)) == 1, 1.0, -1.0)
        observations = dict(zip(self.agents, self.observe(self.bits, 0), strict=True))
        return observations, {agent: {} for agent in self.agents}

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Reward the actions; the episode is truncated after the last step."""
        chosen = np.array([int(actions[agent]) for agent in self.agents])
        rewards = self.rewards(self.bits, chosen, self.time)
        self.time += 1
        done = self.time == self.length
        agents = self.agents
        self.agents = [] if done else agents
        return (
            dict(zip(agents, self.observe(self.bits, self.time), strict=True)),
            {agent: float(reward) for agent, reward in zip(agents, rewards, strict=True)},
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, done),
            {agent: {} for agent in agents},
        )


class ConstantReward(Probe):
    """
    Reward 1 at every step. If steps are indistinguishable and time limits do not terminate, the value is
    ``1 / (1 - gamma)``; with one step that terminates, it is 1.
    """

    def observe(self, bits: Floats, time: int) -> npt.NDArray[np.float32]:
        """Return nothing."""
        return np.zeros((len(bits), *(self._observation_space.shape or ())), dtype=np.float32)

    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        return np.ones(len(bits))


class DelayedReward(Probe):
    """
    The reward is the number that the agent sees, but only after the last step: the value is ``gamma ** steps_left``
    times the number.
    """

    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        return bits[:, 0] * (time == self.length - 1)


class OwnAction(Probe):
    """Reward 1 for action 1 if the agent sees 1 and for action 0 if it sees -1, else 0."""

    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        return (actions == (bits[:, 0] > 0)).astype(np.float64)


class JointAction(Probe):
    """
    A team reward: 1 if *all* agents chose as in :class:`OwnAction`, plus ``noise`` times the sum of second numbers, of
    which an agent sees only its own.

    A critic of the whole team predicts the sum, which leaves the effect of the actions. For a critic of one agent's
    view, the others' numbers are noise of standard deviation ``noise * sqrt(N - 1)``.
    """

    n_bits: ClassVar[int] = 2
    noise: ClassVar[float] = 10.0

    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        solved = float((actions == (bits[:, 0] > 0)).all())
        return np.full(len(bits), solved + self.noise * bits[:, 1].sum())


class ZoneAction(Probe):
    """
    Reward 1 for the right action, else 0. The right action depends on the zone: in zone 1 it is action 1 if the second
    number is 1, in zone -1 action 1 if it is -1. A policy whose logits are linear in (zone, number) is right in at most
    three of the four situations. Two linear policies and a choice by zone are right in all.
    """

    n_bits: ClassVar[int] = 2

    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        return (actions == (bits.prod(axis=1) > 0)).astype(np.float64)


class Message(Probe):
    """
    The reward is the number that the *next* agent sees (the first agent's for the last). With the next agent's view the
    value is that number; without it, the best guess is 0, and no guess has a root mean square error below 1.

    Besides their number, agents see their place in the team, so the views of all agents show which of them is next.
    """

    def _n_numbers(self) -> int:
        return super()._n_numbers() + len(self.possible_agents)

    def observe(self, bits: Floats, time: int) -> npt.NDArray[np.float32]:
        """Return the base class's numbers, then the place (one-hot)."""
        return np.concatenate([super().observe(bits, time), np.eye(len(bits), dtype=np.float32)], axis=1)

    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        return np.roll(bits[:, 0], -1)


class MessageWithoutPlace(Message):
    """
    The same, but agents do not see their place. The views of all agents in order still contain everything; one agent's
    view with those of the team does not, if teammates see the same: of three agents, all can identify the next one in 2
    of 8 situations, and one of the three in the other 6. So the smallest root mean square error is ``sqrt(6/8 * 2/3) =
    0.7071``.
    """

    def _n_numbers(self) -> int:
        return Probe._n_numbers(self)

    def observe(self, bits: Floats, time: int) -> npt.NDArray[np.float32]:
        """Return only the base class's numbers."""
        return Probe.observe(self, bits, time)


#: QPLEX's and QTRAN's example: only the joint action (0, 0) has a positive payoff.
ONE_STEP: Final = np.array([[8.0, -12.0, -12.0], [-12.0, 0.0, 0.0], [-12.0, 0.0, 0.0]])


class MatrixGame(Probe):
    """Two agents that see their index; the team's reward is the payoff (A, A) of the joint action, divided equally."""

    payoffs: ClassVar[Floats] = ONE_STEP
    n_actions: ClassVar[int] = 3

    def _n_numbers(self) -> int:
        return 2

    def observe(self, bits: Floats, time: int) -> npt.NDArray[np.float32]:
        """Return the agents' indices, one-hot."""
        return np.eye(2, dtype=np.float32)

    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        return np.full(2, self.payoffs[tuple(actions)] / 2)


class TwoStates(MatrixGame):
    """
    Two states (Wang et al. 2021, arXiv 2006.00587): in state 1 the joint action (0, 0) is rewarded with 1 and stays,
    (0, 1) and (1, 0) stay, (1, 1) leads to state 0, which has no rewards and no way out. Agents see the state. The time
    limit does not terminate: the value of state 1 is 1 / (1 - gamma).

    With uniform data, additive factorisation fits (0, 0) with 3/4 + 5/4 gamma V, so its values diverge for gamma > 4/5.
    """

    payoffs: ClassVar[Floats] = np.array([[1.0, 0.0], [0.0, 0.0]])
    n_actions: ClassVar[int] = 2
    state_now = 1

    def observe(self, bits: Floats, time: int) -> npt.NDArray[np.float32]:
        """Return the state, one-hot."""
        self.state_now = 1 if time == 0 else self.state_now
        return np.eye(2, dtype=np.float32)[[self.state_now] * 2]

    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        paid = super().rewards(bits, actions, time) * self.state_now
        self.state_now = int(self.state_now and not actions.all())
        return paid


class Buttons(Probe):
    """Agents with roles: all see the same, and agent i is rewarded for pressing button i."""

    n_actions: ClassVar[int] = 3

    def observe(self, bits: Floats, time: int) -> npt.NDArray[np.float32]:
        """Return ones."""
        return np.ones((len(bits), *(self._observation_space.shape or ())), dtype=np.float32)

    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        return (actions == np.arange(len(bits))).astype(np.float64)


class Arms(Probe):
    """
    Agent i sees its index and is paid its scale for arm i; episodes of four steps.

    :param scales: pay of each agent
    :param shared: whether all agents are paid the sum
    """

    n_actions: ClassVar[int] = 4

    def __init__(self, scales: Sequence[float] = (1.0, 1000.0), shared: bool = False) -> None:
        self.scales, self.shared = np.array(scales), shared
        super().__init__(len(scales), length=4)

    def _n_numbers(self) -> int:
        return len(self.scales)

    def observe(self, bits: Floats, time: int) -> npt.NDArray[np.float32]:
        """Return the agents' indices, one-hot."""
        return np.eye(len(bits), dtype=np.float32)

    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        paid = self.scales * (actions == np.arange(len(bits)))
        return np.full(len(bits), paid.sum()) if self.shared else paid
