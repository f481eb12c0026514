"""Gymnasium environments whose observations, actions and rewards are lists with one entry per agent."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_saf.teams.rows import IS_SUCCESS


class GymnasiumTeam(ParallelEnv[str, Any, Any]):
    """
    PettingZoo ParallelEnv around a Gymnasium environment of several agents (``spaces.Tuple`` of observations and of
    actions, one reward per agent), such as level-based foraging and the multi-robot warehouse.

    Agents are ``"agent_0"``, ``"agent_1"``, ... and end together. Each gets a copy of the environment's info, where a
    list of N masks in ``info["action_mask"]`` becomes the agent's own mask.

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
        check_is_team(env)
        self.env = env
        self._is_ended = is_ended
        self._is_success = is_success
        self.metadata = dict(env.metadata)
        self.render_mode = env.render_mode
        observations, actions = env.observation_space, env.action_space
        assert isinstance(observations, spaces.Tuple) and isinstance(actions, spaces.Tuple)
        self.possible_agents = [f"agent_{i}" for i in range(len(actions.spaces))]
        self.agents: list[str] = []
        self.observation_spaces = dict(zip(self.possible_agents, observations.spaces, strict=True))
        self.action_spaces = dict(zip(self.possible_agents, actions.spaces, strict=True))

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
        observations, info = self.env.reset(seed=seed, options=options)
        self.agents = list(self.possible_agents)
        return self._by_agent("observations", observations), self._infos(info)

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Play one step with the actions of all agents (see PettingZoo)."""
        observations, rewards, terminated, truncated, info = self.env.step([actions[a] for a in self.possible_agents])
        is_over = bool(np.all(terminated)) or bool(np.all(truncated))
        is_ended = bool(np.all(terminated)) if self._is_ended is None else is_over and self._is_ended(self.env)
        infos = self._infos(info)
        if is_over:
            self.agents = []
            if self._is_success is not None:
                infos[self.possible_agents[0]][IS_SUCCESS] = self._is_success(self.env)
        given = {agent: float(reward) for agent, reward in self._by_agent("rewards", rewards).items()}
        return (
            self._by_agent("observations", observations),
            given,
            dict.fromkeys(self.possible_agents, is_ended),
            dict.fromkeys(self.possible_agents, is_over and not is_ended),
            infos,
        )

    def render(self) -> Any:
        """Return the environment's rendering."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def _by_agent(self, what: str, values: Any) -> dict[str, Any]:
        if not isinstance(values, (Sequence, np.ndarray)) or len(values) != len(self.possible_agents):
            raise ValueError(
                f"expected {what} of {len(self.possible_agents)} agents from {self.env}, got {values!r:.200}; an "
                "environment with one reward for all agents must give it to each: [reward] * n_agents"
            )
        return dict(zip(self.possible_agents, values, strict=True))

    def _infos(self, info: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        infos = {agent: dict(info) for agent in self.possible_agents}
        if "action_mask" in info:
            for agent, mask in self._by_agent("action masks", info["action_mask"]).items():
                infos[agent]["action_mask"] = mask
        return infos


def is_gymnasium_team(env: object) -> bool:
    """Return whether an object is a Gymnasium environment with one action per agent."""
    return isinstance(env, gym.Env) and isinstance(getattr(env, "action_space", None), spaces.Tuple)


def check_is_team(env: gym.Env[Any, Any]) -> None:
    """Raise ValueError unless observations and actions are Tuples of one entry per agent."""
    observations, actions = env.observation_space, env.action_space
    if (
        not isinstance(observations, spaces.Tuple)
        or not isinstance(actions, spaces.Tuple)
        or len(observations.spaces) != len(actions.spaces)
        or not actions.spaces
    ):
        raise ValueError(
            "expected a Gymnasium environment of several agents, whose observation_space and action_space are Tuples "
            f"with one entry per agent, got {observations} and {actions}; for one agent use Stable-Baselines3 itself"
        )


def make_gymnasium(env_id: str, render_mode: str | None, params: Mapping[str, Any]) -> gym.Env[Any, Any]:
    """Make an environment of Gymnasium's registry without the checks and wrappers for a single agent."""
    return gym.make(env_id, render_mode=render_mode, disable_env_checker=True, **params)
