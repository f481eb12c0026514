"""One game of a VecEnv of teams as a PettingZoo ParallelEnv, for watching and playing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.teams.rows import (
    ACTION_MASK_KEY,
    ACTIVE_KEY,
    OBS_KEY,
    STATE_KEY,
    TERMINAL_OBSERVATION,
    TRUNCATED,
    TeamSpaces,
)


class VecGame(ParallelEnv[Any, Any, Any]):
    """
    ParallelEnv around the single game of a VecEnv whose rows are the agents of a team.

    Masks are in ``infos[agent]["action_mask"]``; agents with an inactive row leave ``agents``.

    :param venv: VecEnv of one game, as described in :mod:`sb3_saf.suites`
    """

    def __init__(self, venv: VecEnv) -> None:
        self.venv = venv
        self.render_mode = venv.render_mode
        self.metadata: dict[str, Any] = dict(getattr(venv, "metadata", None) or {})
        self.possible_agents = list(venv.possible_agents)  # type: ignore[attr-defined]
        if venv.num_envs != len(self.possible_agents):
            raise ValueError(f"expected one game of {len(self.possible_agents)} agents, got {venv.num_envs} rows")
        self.agents: list[Any] = []
        self._rows = TeamSpaces.of_rows(
            venv.observation_space, venv.action_space, len(self.possible_agents), self.possible_agents
        )
        self._state: Any = None

    def observation_space(self, agent: Any) -> spaces.Space[Any]:
        """Return the space of an agent's own observation."""
        return self._rows.own

    def action_space(self, agent: Any) -> spaces.Space[Any]:
        """Return the space of an agent's actions."""
        return self.venv.action_space

    @property
    def state_space(self) -> spaces.Space[Any]:
        """Space of :meth:`state`."""
        if self._rows.state is None:
            raise AttributeError("the games were made without state=True")
        return self._rows.state

    def state(self) -> Any:
        """Return the game's state."""
        return self._state

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Begin an episode (see PettingZoo)."""
        if seed is not None:
            self.venv.seed(seed)
        self.agents = list(self.possible_agents)
        return self._shown(self.venv.reset(), [{} for _ in self.possible_agents])

    def step(self, actions: Mapping[Any, Any]) -> tuple[Any, Any, Any, Any, Any]:
        """Play one step (see PettingZoo)."""
        acted = list(self.agents)
        idle = np.zeros_like(self.venv.action_space.sample())
        rows = np.stack([np.asarray(actions.get(agent, idle)) for agent in self.possible_agents])
        self.venv.step_async(rows)
        obs, rewards, dones, infos = self.venv.step_wait()
        is_over = bool(dones[0])
        last: Any = obs
        if is_over:
            last = _stacked([info[TERMINAL_OBSERVATION] for info in infos])
        observations, shown_infos = self._shown(last, infos)
        row = dict(zip(self.possible_agents, range(len(self.possible_agents)), strict=True))
        truncated = {agent: is_over and bool(infos[row[agent]].get(TRUNCATED)) for agent in acted}
        if is_over:
            self.agents = []
        return (
            {agent: observations[agent] for agent in acted},
            {agent: float(rewards[row[agent]]) for agent in acted},
            {agent: agent not in self.agents and not truncated[agent] for agent in acted},
            truncated,
            {agent: shown_infos[agent] for agent in acted},
        )

    def render(self) -> Any:
        """Return the picture of the game."""
        return self.venv.get_images()[0]

    def close(self) -> None:
        """Close the engine."""
        self.venv.close()

    def _shown(self, obs: Any, infos: list[dict[str, Any]]) -> tuple[dict[Any, Any], dict[Any, dict[str, Any]]]:
        """Split rows into observations and infos by agent, and update ``agents``."""
        parts = self._rows.entries(obs, "observations")
        if STATE_KEY in parts:
            self._state = np.array(parts[STATE_KEY][0])
        shown = {
            agent: {key: value for key, value in info.items() if key not in (TERMINAL_OBSERVATION, TRUNCATED)}
            for agent, info in zip(self.possible_agents, infos, strict=True)
        }
        if ACTION_MASK_KEY in parts:
            for agent, mask in zip(self.possible_agents, parts[ACTION_MASK_KEY], strict=True):
                shown[agent][ACTION_MASK_KEY] = np.array(mask)
        if ACTIVE_KEY in parts:
            playing = dict(zip(self.possible_agents, parts[ACTIVE_KEY], strict=True))
            self.agents = [agent for agent in self.agents if playing[agent]]
        own = dict(zip(self.possible_agents, np.array(parts[OBS_KEY]), strict=True))
        return own, shown


def _stacked(observations: list[Any]) -> Any:
    if isinstance(observations[0], Mapping):
        return {key: np.stack([one[key] for one in observations]) for key in observations[0]}
    return np.stack(observations)
