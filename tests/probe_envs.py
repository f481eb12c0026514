"""
Probes: tiny PettingZoo games with a known answer, in order of difficulty.

A failing probe shows what is broken: the value loss, the encoding of observations, discounting and bootstrapping, the
policy's gradient, the joint baseline, the pool, or the path from one agent's view to another agent's value.

In every probe an agent sees a few numbers and has two actions; rewards are functions of what all agents see and do
(:meth:`Probe.rewards`), so tests can enumerate every situation. Letters: N agents, C contexts.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from itertools import product
from typing import Any, ClassVar

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
    #: Numbers, each -1 or 1, that each agent sees.
    n_bits: ClassVar[int] = 1

    def __init__(self, n_agents: int = 2, length: int = 1):
        self.possible_agents = [f"agent_{i}" for i in range(n_agents)]
        self.agents: list[str] = []
        self.render_mode = None
        self.length = length
        self.time = 0
        self.bits: Floats = np.zeros((n_agents, self.n_bits))
        self._rng: np.random.Generator | None = None
        self._observation_space = spaces.Box(-1.0, 1.0, (self._n_numbers(),), np.float32)
        self._action_space = spaces.Discrete(2)

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
        """Return the same space for all agents."""
        return self._observation_space

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return the same space for all agents."""
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
        """See the class."""
        return np.ones(len(bits))


class OwnObservation(Probe):
    """The reward is the number that the agent sees, and so is the value."""

    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        """See the class."""
        return bits[:, 0]


class DelayedReward(Probe):
    """The same, but only after the last step: the value is ``gamma ** steps_left`` times the number."""

    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        """See the class."""
        return bits[:, 0] * (time == self.length - 1)


class OwnAction(Probe):
    """Reward 1 for action 1 if the agent sees 1 and for action 0 if it sees -1, else 0."""

    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        """See the class."""
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
        """See the class."""
        solved = float((actions == (bits[:, 0] > 0)).all())
        return np.full(len(bits), solved + self.noise * bits[:, 1].sum())


class OwnActionInOthersNoise(JointAction):
    """
    Every agent has its own reward: 1 if it chose as in :class:`OwnAction`, plus ``noise`` times the second number of
    the *next* agent. To predict it, a critic must see the team and know whose value to compute.
    """

    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        """See the class."""
        return (actions == (bits[:, 0] > 0)) + self.noise * np.roll(bits[:, 1], -1)


class ZoneAction(Probe):
    """
    Reward 1 for the right action, else 0. The right action depends on the zone: in zone 1 it is action 1 if the second
    number is 1, in zone -1 action 1 if it is -1. A policy whose logits are linear in (zone, number) is right in at most
    three of the four situations. Two linear policies and a choice by zone are right in all.
    """

    n_bits: ClassVar[int] = 2

    def rewards(self, bits: Floats, actions: npt.NDArray[np.int64], time: int) -> Floats:
        """See the class."""
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
        """See the class."""
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
