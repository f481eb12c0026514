"""Tiny PettingZoo games whose every number is known, for tests of wrappers and vector environments."""

from __future__ import annotations

import os
import random
import threading
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

BOX = spaces.Box(-1, 1, (2,), np.float32)
ZEROS = np.zeros(2, np.float32)


class Game(ParallelEnv[str, Any, Any]):
    """Two agents, four steps, reward 1 for each agent and step; subclasses change what a step returns."""

    metadata: ClassVar[dict[str, Any]] = {"name": "game"}
    possible_agents: Any = ["a", "b"]
    length = 4

    def observation_space(self, agent: Any) -> spaces.Space[Any]:
        return BOX

    def action_space(self, agent: Any) -> spaces.Space[Any]:
        return spaces.Discrete(3)

    def see(self, agent: Any) -> Any:
        return ZEROS

    def info(self, agent: Any) -> dict[str, Any]:
        return {}

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.agents, self.t = list(self.possible_agents), 0
        return {a: self.see(a) for a in self.agents}, {a: self.info(a) for a in self.agents}

    def step(self, actions: dict[str, Any]) -> Any:
        self.t += 1
        self.actions = actions
        over, team = self.t == self.length, list(self.agents)
        out: list[Any] = [
            {a: self.see(a) for a in team},
            dict.fromkeys(team, 1.0),
            dict.fromkeys(team, False),
            dict.fromkeys(team, over),
            {a: self.info(a) for a in team},
        ]
        self.change(out)
        if over:
            self.agents = []
        return tuple(out)

    def change(self, out: list[Any]) -> None:
        pass


class CounterEnv(ParallelEnv[str, Any, Any]):
    """
    Counts its steps.

    - Observation of agent ``i``: ``[step, i, draw]``, the draw from the game's own generator (made in ``reset``).
    - Reward of agent ``i``: ``10 * step + i + action``, the step counted after it was taken.
    - Infos: ``{"step": step}``; reset infos ``{"episode": number, "options": options}``.
    - End: all agents truncated after ``max_cycles`` steps; an agent in ``deaths`` is terminated at the step given.

    :param n_agents: N
    :param max_cycles: steps per episode
    :param deaths: agent's index to the step at which it is terminated
    :param cuts: agent's index to the step at which it is truncated
    :param render_mode: None or "rgb_array"
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "counter_v0",
        "render_modes": ["rgb_array"],
        "is_parallelizable": True,
    }

    def __init__(
        self,
        n_agents: int = 2,
        max_cycles: int = 3,
        deaths: Mapping[int, int] | None = None,
        cuts: Mapping[int, int] | None = None,
        render_mode: str | None = None,
    ):
        self.possible_agents = [f"agent_{i}" for i in range(n_agents)]
        self.agents: list[str] = []
        self.max_cycles = max_cycles
        self.deaths = dict(deaths or {})
        self.cuts = dict(cuts or {})
        self.render_mode = render_mode
        self.level = 1
        self.pokes = 0
        self.episode = 0
        self.last_seed: int | None = None
        self.last_actions: dict[str, Any] = {}
        self.closed = False
        self._rng: np.random.Generator | None = None
        self._observation_space: spaces.Space[Any] = self._make_observation_space()
        self._action_space: spaces.Space[Any] = self._make_action_space()

    def _make_observation_space(self) -> spaces.Space[Any]:
        return spaces.Box(0.0, np.inf, (3,), np.float32)

    def _make_action_space(self) -> spaces.Space[Any]:
        return spaces.Discrete(4)

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return self._observation_space

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return self._action_space

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        if seed is not None or self._rng is None:
            self._rng = np.random.default_rng(seed)
            self.last_seed = seed
        self.agents = self.possible_agents[:]
        self.steps = 0
        self.episode += 1
        infos: dict[str, dict[str, Any]] = {a: {"episode": self.episode, "options": options} for a in self.agents}
        return self._observe(), infos

    def step(self, actions: dict[str, Any]) -> Any:
        assert set(actions) == set(self.agents), (actions, self.agents)
        self.last_actions = dict(actions)
        self.steps += 1
        acted = self.agents
        observations = self._observe()
        rewards = {a: 10.0 * self.steps + self._index(a) + float(np.sum(actions[a])) for a in acted}
        terminations = {a: self.deaths.get(self._index(a)) == self.steps for a in acted}
        truncations = {a: self.cuts.get(self._index(a), self.max_cycles) == self.steps for a in acted}
        infos = {a: {"step": self.steps} for a in acted}
        self.agents = [a for a in acted if not (terminations[a] or truncations[a])]
        return observations, rewards, terminations, truncations, infos

    def _index(self, agent: str) -> int:
        return self.possible_agents.index(agent)

    def _observe(self) -> dict[str, Any]:
        assert self._rng is not None
        draws = self._rng.random(len(self.possible_agents), dtype=np.float32)
        return {a: self._observation(self._index(a), draws[self._index(a)]) for a in self.agents}

    def _observation(self, index: int, draw: np.float32) -> Any:
        return np.array([self.steps, index, draw], np.float32)

    def render(self) -> npt.NDArray[np.uint8]:
        return np.full((4, 6, 3), self.steps, np.uint8)

    def close(self) -> None:
        self.closed = True

    # Called through get_attr, env_method, ...

    def poke(self, amount: int = 1) -> int:
        self.pokes += amount
        return self.pokes

    def fail(self) -> None:
        raise LookupError("this method always fails")

    def apply(self, function: Callable[[int], Any]) -> Any:
        return function(self.level)

    def action_masks(self) -> dict[str, npt.NDArray[np.bool_]]:
        """Agent ``i`` may only take action ``i``."""
        return {a: np.arange(4) == self._index(a) for a in self.agents}

    @property
    def pid(self) -> int:
        return os.getpid()


class DictEnv(CounterEnv):
    """The same with a dict observation and continuous actions."""

    def _make_observation_space(self) -> spaces.Space[Any]:
        return spaces.Dict(
            {"numbers": spaces.Box(0.0, np.inf, (2,), np.float32), "step": spaces.Discrete(100)},
        )

    def _make_action_space(self) -> spaces.Space[Any]:
        return spaces.Box(-1.0, 1.0, (2,), np.float32)

    def _observation(self, index: int, draw: np.float32) -> Any:
        return {"numbers": np.array([index, draw], np.float32), "step": self.steps}


class EagerEnv(CounterEnv):
    """Faulty: creates its generator before the first reset, so copies of it play the same game."""

    def __init__(self, **kwargs: Any):
        super().__init__(**kwargs)
        self._rng = np.random.default_rng()


class ReusingEnv(CounterEnv):
    """Returns the same arrays and infos at every step, which is allowed."""

    def __init__(self, **kwargs: Any):
        super().__init__(**kwargs)
        self._arrays = {i: np.zeros(3, np.float32) for i in range(len(self.possible_agents))}
        self._info: dict[str, Any] = {}

    def _observation(self, index: int, draw: np.float32) -> Any:
        self._arrays[index][:] = self.steps, index, draw
        return self._arrays[index]

    def step(self, actions: dict[str, Any]) -> Any:
        *rest, infos = super().step(actions)
        self._info["steps"] = [self.steps]
        return (*rest, dict.fromkeys(infos, self._info))

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        observations, _ = super().reset(seed, options)
        self._info["steps"] = []
        return observations, dict.fromkeys(self.agents, self._info)


class BareEnv(ParallelEnv[str, Any, Any]):
    """A minimal ParallelEnv: no ``metadata``, no ``render_mode``; ended agents stay in ``agents``."""

    def __init__(self) -> None:
        self.possible_agents = ["left", "right"]
        self.agents = ["left", "right"]

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Discrete(10)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.MultiDiscrete([2, 3])

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.steps = 0
        return dict.fromkeys(self.agents, 0), {}

    def step(self, actions: dict[str, Any]) -> Any:
        self.steps += 1
        terminations = {"left": self.steps >= 2, "right": self.steps >= 3}
        steps = dict.fromkeys(self.agents, self.steps)
        return steps, dict.fromkeys(self.agents, 1.0), terminations, dict.fromkeys(self.agents, False), {}


class TellingEnv(CounterEnv):
    """
    Uses everything that rows can contain: agents that join and die, action masks, and a state.

    Agent ``i`` may take action ``a`` at step ``t`` if ``a + i + t`` is even; other actions end the test. The state is
    ``[step, number of agents]``.

    :param joins: agent's index to the step after which it has joined
    :param masks: where masks are: "observation", "info" or nowhere
    :param stuck: step at which agent 0 has no legal action
    """

    def __init__(
        self,
        joins: Mapping[int, int] | None = None,
        masks: str | None = "observation",
        stuck: int | None = None,
        **kwargs: Any,
    ):
        self.joins = dict(joins or {})
        self.masks = masks
        self.stuck = stuck
        self.state_space = spaces.Box(0.0, 100.0, (2,), np.float32)
        super().__init__(**kwargs)

    def _make_observation_space(self) -> spaces.Space[Any]:
        own = super()._make_observation_space()
        mask = spaces.Box(0, 1, (4,), np.int8)
        return spaces.Dict({"observation": own, "action_mask": mask}) if self.masks == "observation" else own

    def mask(self, index: int) -> npt.NDArray[np.int8]:
        legal = (np.arange(4) + index + self.steps) % 2 == 0
        return (legal & (self.steps != self.stuck or index > 0)).astype(np.int8)

    def _observation(self, index: int, draw: np.float32) -> Any:
        own = super()._observation(index, draw)
        return {"observation": own, "action_mask": self.mask(index)} if self.masks == "observation" else own

    def _with_masks(self, infos: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        if self.masks != "info":
            return infos
        return {a: {**infos.get(a, {}), "action_mask": self.mask(self._index(a))} for a in {*infos, *self.agents}}

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        _, infos = super().reset(seed, options)
        self.agents = [a for a in self.agents if not self.joins.get(self._index(a))]
        return self._observe(), self._with_masks({a: infos[a] for a in self.agents})

    def step(self, actions: dict[str, Any]) -> Any:
        if self.masks is not None:
            assert all(self.mask(self._index(agent))[action] for agent, action in actions.items()), actions
        observations, *rest, infos = super().step(actions)
        joined = [a for a in self.possible_agents if self.joins.get(self._index(a)) == self.steps]
        self.agents = [a for a in self.possible_agents if a in self.agents or a in joined]
        observations |= {a: self._observe()[a] for a in joined}
        return (observations, *rest, self._with_masks(infos))

    def action_masks(self) -> dict[str, npt.NDArray[np.bool_]]:
        return {agent: self.mask(self._index(agent)).astype(bool) for agent in self.agents}

    def state(self) -> npt.NDArray[Any]:
        return np.array([self.steps, len(self.agents)], np.float32)


def late_env() -> TellingEnv:
    """Agent 1 joins with the observation after the first step."""
    return TellingEnv(joins={1: 1}, masks=None)


class FaultyEnv(CounterEnv):
    """
    Fails at the second step if its generator was given the chosen seed.

    :param seed: of the failing game, None for all games
    :param how: "raise", "exit", or "die" (the process ends at once)
    """

    def __init__(self, how: str, seed: int | None = None, **kwargs: Any):
        super().__init__(**kwargs)
        self.how = how
        self.unlucky_seed = seed

    def step(self, actions: dict[str, Any]) -> Any:
        result = super().step(actions)
        if self.steps == 2 and self.unlucky_seed in (None, self.last_seed):
            if self.how == "raise":
                raise ArithmeticError("the game broke")
            if self.how == "exit":
                raise SystemExit(3)
            if self.how == "die":
                os._exit(7)
        return result


class UnpicklableEnv(CounterEnv):
    """Holds a lock."""

    def __init__(self, **kwargs: Any):
        super().__init__(**kwargs)
        self.lock = threading.Lock()


class LazyEnv(CounterEnv):
    """Creates its generator when it first draws, which is after ``reset``; later episodes continue with it."""

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        if seed is not None:
            self.last_seed, self._rng = seed, None
        self.agents = self.possible_agents[:]
        self.steps = 0
        self.episode += 1
        return {a: np.zeros(3, np.float32) for a in self.agents}, {a: {} for a in self.agents}

    def _observe(self) -> dict[str, Any]:
        if self._rng is None:
            self._rng = np.random.default_rng(self.last_seed)
        return super()._observe()


class GlobalEnv(CounterEnv):
    """Draws from the global generators."""

    def _observation(self, index: int, draw: np.float32) -> Any:
        return np.array([random.random(), index, np.random.random()], np.float32)  # noqa: NPY002


class StateEnv(CounterEnv):
    """
    Has its state as plain data.

    :param forgets: whether the state lacks the generator
    """

    def __init__(self, forgets: bool = False, **kwargs: Any):
        super().__init__(**kwargs)
        self.forgets = forgets

    def get_state(self) -> dict[str, Any]:
        assert self._rng is not None
        generator = None if self.forgets else self._rng.bit_generator.state
        return {"steps": self.steps, "episode": self.episode, "agents": self.agents, "generator": generator}

    def set_state(self, state: dict[str, Any]) -> None:
        assert self._rng is not None
        self.steps, self.episode, self.agents = state["steps"], state["episode"], list(state["agents"])
        if state["generator"] is not None:
            self._rng.bit_generator.state = state["generator"]


class StreamEnv(CounterEnv):
    """Draws from an object that cannot be copied."""

    def __init__(self, **kwargs: Any):
        super().__init__(**kwargs)
        self.stream = iter(number / 1000 for number in range(1000))

    def _observation(self, index: int, draw: np.float32) -> Any:
        return np.array([self.steps, index, next(self.stream, 1.0)], np.float32)


class TracingEnv(CounterEnv):
    """Appends a line to a file when it is closed, so that a test can see it across processes."""

    def __init__(self, path: str, **kwargs: Any):
        super().__init__(**kwargs)
        self.path = path

    def close(self) -> None:
        if self.last_seed != 0:  # as the copy has that plays a trial episode
            with open(self.path, "a") as file:
                file.write("closed\n")


class OuterWrapper(BaseParallelWrapper[str, Any, Any]):
    """A wrapper with its own attribute."""

    def __init__(self, env: ParallelEnv[str, Any, Any]):
        super().__init__(env)
        self.colour = "red"
