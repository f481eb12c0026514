"""Gymnasium environments whose observations, actions and rewards are lists with one entry per agent."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_saf.teams.conversion import MASK_NAMES
from sb3_saf.teams.rows import IS_SUCCESS

#: Key by which some games say that all agents have ended.
ALL: Final = "__all__"


class GymnasiumTeam(ParallelEnv[str, Any, Any]):
    """
    PettingZoo ParallelEnv around a Gymnasium environment of several agents (``spaces.Tuple`` of observations and of
    actions, one reward per agent), such as level-based foraging and the multi-robot warehouse.

    Agents are ``"agent_0"``, ``"agent_1"``, ... They end together where the environment has one flag for all, or each
    by its own flag where ``terminated`` and ``truncated`` are lists, arrays or dicts (also with ``"__all__"``). Each
    gets a copy of the environment's info, where a list of N masks in ``info["action_mask"]`` becomes its own mask.

    :param env: the environment; ``make_team_env`` wraps such environments automatically
    :param is_ended: for an environment that reports its time limit as termination: returns whether the episode has
        truly terminated; None uses what the environment reports
    :param is_success: returns at the end of an episode whether the team has won; None if success is not defined
    :raises ValueError: if its spaces are not Tuples of one entry per agent
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        is_ended: Callable[[gym.Env[Any, Any]], bool] | None = None,
        is_success: Callable[[gym.Env[Any, Any]], bool] | None = None,
    ) -> None:
        observations, actions = env.observation_space, env.action_space
        if (
            not isinstance(observations, spaces.Tuple)
            or not isinstance(actions, spaces.Tuple)
            or len(observations.spaces) != len(actions.spaces)
            or not actions.spaces
        ):
            raise ValueError(
                "expected a Gymnasium environment of several agents, whose observation_space and action_space are "
                f"Tuples with one entry per agent, got {observations} and {actions}; for one agent use "
                "Stable-Baselines3 itself"
            )
        self.env = env
        self._is_ended = is_ended
        self._is_success = is_success
        self.metadata = dict(env.metadata)
        self.render_mode = env.render_mode
        self.possible_agents = [f"agent_{i}" for i in range(len(actions.spaces))]
        self.agents: list[str] = []
        self.observation_spaces = dict(zip(self.possible_agents, observations.spaces, strict=True))
        self.action_spaces = dict(zip(self.possible_agents, actions.spaces, strict=True))
        self._idle = {agent: _first_action(space) for agent, space in self.action_spaces.items()}

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return the space of an agent's observation."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return the space of an agent's actions."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Begin an episode (see PettingZoo)."""
        result = self.env.reset(seed=seed, options=options)
        if not isinstance(result, tuple) or len(result) != 2 or not isinstance(result[1], (Mapping, list, tuple)):
            raise ValueError(
                f"expected reset of {self.env} to return (observations, info), as Gymnasium does, got {result!r:.200}; "
                "wrap an environment of the older gym, for instance by shimmy.GymV21CompatibilityV0"
            )
        self.agents = list(self.possible_agents)
        return self._by_agent("observations", result[0]), self._infos(result[1])

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Play one step with the actions of the agents that take part (see PettingZoo); others get action 0."""
        result = self.env.step([actions.get(agent, self._idle[agent]) for agent in self.possible_agents])
        if not isinstance(result, tuple) or len(result) != 5:
            raise ValueError(
                f"expected step of {self.env} to return (observations, rewards, terminated, truncated, info), as "
                f"Gymnasium does, got {result!r:.200}; wrap an environment of the older gym, for instance by "
                "shimmy.GymV21CompatibilityV0"
            )
        observations, rewards, terminated, truncated, info = result
        terminations, truncations = self._ends("terminated", terminated), self._ends("truncated", truncated)
        infos = self._infos(info)
        self.agents = [agent for agent in self.agents if not (terminations[agent] or truncations[agent])]
        if not self.agents:
            if self._is_ended is not None:
                is_ended = self._is_ended(self.env)
                terminations = dict.fromkeys(self.possible_agents, is_ended)
                truncations = dict.fromkeys(self.possible_agents, not is_ended)
            if self._is_success is not None:
                infos[self.possible_agents[0]][IS_SUCCESS] = self._is_success(self.env)
        given = {agent: float(reward) for agent, reward in self._by_agent("rewards", rewards).items()}
        return self._by_agent("observations", observations), given, terminations, truncations, infos

    def render(self) -> Any:
        """Return the environment's rendering."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def _by_agent(self, what: str, values: Any) -> dict[str, Any]:
        """Return values by agent, from one for each agent in order, or a dict by the agents' names or indices."""
        agents = self.possible_agents
        if isinstance(values, Mapping) and (names := self._names_in(values)) is not None:
            return {agent: values[name] for agent, name in zip(agents, names, strict=True)}
        if not isinstance(values, (Sequence, np.ndarray)) or len(values) != len(agents):
            raise ValueError(
                f"expected {what} of {len(agents)} agents from {self.env}, got {values!r:.200}; an environment with "
                "one value for all agents must give it to each: [value] * n_agents"
            )
        return dict(zip(agents, values, strict=True))

    def _names_in(self, values: Mapping[Any, Any]) -> Sequence[Any] | None:
        """Return the names or indices of the agents by which a dict has values; None if it has other keys."""
        indices = range(len(self.possible_agents))
        kinds: tuple[Sequence[Any], ...] = (self.possible_agents, indices, list(map(str, indices)))
        return next((names for names in kinds if set(names) <= set(values)), None)

    def _ends(self, what: str, value: Any) -> dict[str, bool]:
        """Return which agents have ended: one flag for all, one for each, or a dict, also with ``"__all__"``."""
        if isinstance(value, Mapping) and ALL in value:
            others = {name: flag for name, flag in value.items() if name != ALL}
            if value[ALL] or not others:
                return dict.fromkeys(self.possible_agents, bool(value[ALL]))
            value = others
        flags = self._by_agent(what, value) if np.ndim(value) or isinstance(value, Mapping) else None
        flags = dict.fromkeys(self.possible_agents, value) if flags is None else flags
        wrong = [flag for flag in flags.values() if np.size(flag) != 1 or flag not in (0, 1)]
        if wrong:
            raise ValueError(f"expected True or False in {what} of {self.env}, got {wrong[0]!r}")
        return {agent: bool(np.all(flag)) for agent, flag in flags.items()}

    def _infos(self, info: Any) -> dict[str, dict[str, Any]]:
        """Copy the info of all agents, or a list of one for each; lists of masks become each agent's own."""
        names = self._names_in(info) if isinstance(info, Mapping) else None
        if not isinstance(info, Mapping) or (
            names is not None and all(isinstance(info[one], Mapping) for one in names)
        ):
            return {agent: dict(own) for agent, own in self._by_agent("infos", info).items()}
        infos = {agent: dict(info) for agent in self.possible_agents}
        for key in MASK_NAMES:
            if key in info:
                for agent, mask in self._by_agent("action masks", info[key]).items():
                    infos[agent][key] = mask
        return infos


def as_parallel(env: Any) -> Any:
    """Return a Gymnasium environment with one action per agent as a ParallelEnv; any other object as it is."""
    is_team = isinstance(env, gym.Env) and isinstance(getattr(env, "action_space", None), spaces.Tuple)
    return GymnasiumTeam(env) if is_team else env


def make_gymnasium(env_id: str, render_mode: str | None, params: Mapping[str, Any]) -> gym.Env[Any, Any]:
    """Make an environment of Gymnasium's registry without the checks and wrappers for a single agent."""
    spec = deepcopy(gym.spec(env_id))
    # A parameter of both the game and of `make`, such as `max_episode_steps`, is the game's.
    spec.kwargs.update({name: value for name, value in params.items() if name in spec.kwargs})
    others = {name: value for name, value in params.items() if name not in spec.kwargs}
    return gym.make(spec, render_mode=render_mode, disable_env_checker=True, **others)


def _first_action(space: spaces.Space[Any]) -> Any:
    """Return an action for agents that have ended: 0, or the value nearest to it."""
    if isinstance(space, spaces.Box):
        return np.clip(np.zeros(space.shape, space.dtype), space.low, space.high)
    start = space.start if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)) else np.zeros(space.shape or ())
    return np.asarray(start, dtype=space.dtype)[()]
