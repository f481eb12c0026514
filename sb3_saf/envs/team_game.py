"""Conversion of games to ParallelEnvs whose agents have equal spaces, as rows need."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from sb3_saf.envs.game_form import OBSERVATION, has_masks_inside
from sb3_saf.envs.gymnasium_team import GymnasiumTeam, is_gymnasium_team
from sb3_saf.teams.rows import ACTION_MASK_KEY


def team_game(env: Any) -> Any:
    """
    Convert an environment to the form that rows need; return it unchanged if no conversion is necessary or known.

    Gymnasium environments of several agents become ParallelEnvs (:class:`GymnasiumTeam`), agents with different spaces
    get equal ones (:class:`EqualSpaces`).

    :param env: any object
    """
    if is_gymnasium_team(env):
        env = GymnasiumTeam(env)
    if isinstance(env, ParallelEnv) and _differ(env):
        return EqualSpaces(env)
    return env


def make_team_game(make: Callable[[], Any]) -> Any:
    """Call a factory and convert its result by :func:`team_game`."""
    return team_game(make())


def _differ(env: ParallelEnv[Any, Any, Any]) -> bool:
    agents = getattr(env, "possible_agents", None)
    if not agents or not callable(env.observation_space) or not callable(env.action_space):
        return False
    kinds = (env.observation_space, env.action_space)
    return any(space_of(agent) != space_of(agents[0]) for space_of in kinds for agent in agents)


class EqualSpaces(BaseParallelWrapper[Any, Any, Any]):
    """
    Wrapper that gives agents with different spaces equal ones.

    Observations: Boxes with equal numbers of axes are padded with zeros at the end of each axis; other spaces are
    flattened to vectors by ``gymnasium.spaces.flatten`` and then padded. Actions: Discrete spaces are extended to the
    largest one, and actions that an agent lacks are masked (``infos[agent]["action_mask"]``, combined with the game's
    own masks) and refused; Boxes are padded; only the agent's own entries reach the game, clipped to its bounds.

    :param env: the game
    :raises ValueError: if actions are neither all Discrete nor all vectors
    """

    def __init__(self, env: ParallelEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        #: The game, whose agents have different spaces.
        self.unequal = env
        agents = env.possible_agents
        observed = {agent: env.observation_space(agent) for agent in agents}
        #: Agents whose observations have PettingZoo's form for masks.
        self._inside = {agent for agent in agents if has_masks_inside(observed[agent])}
        self._own = {a: observed[a][OBSERVATION] if a in self._inside else observed[a] for a in agents}
        self._actions = {agent: env.action_space(agent) for agent in agents}
        self._observation_space = _common_observations(list(self._own.values()))
        self._action_space = _common_actions(self._actions)

    def observation_space(self, agent: Any) -> spaces.Space[Any]:
        """Return the space of all agents' observations."""
        return self._observation_space

    def action_space(self, agent: Any) -> spaces.Space[Any]:
        """Return the space of all agents' actions."""
        return self._action_space

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Begin an episode (see PettingZoo)."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._observed(observations), self._with_masks(observations, infos)

    def step(self, actions: Mapping[Any, Any]) -> tuple[Any, Any, Any, Any, Any]:
        """Play one step (see PettingZoo)."""
        own = {agent: self._own_action(agent, action) for agent, action in actions.items()}
        observations, rewards, terminations, truncations, infos = self.env.step(own)
        return (
            self._observed(observations),
            rewards,
            terminations,
            truncations,
            self._with_masks(observations, infos),
        )

    def _observed(self, observations: Mapping[Any, Any]) -> dict[Any, Any]:
        shape, dtype = self._observation_space.shape, self._observation_space.dtype
        padded = {}
        for agent, observation in observations.items():
            if observation is not None:
                own = observation[OBSERVATION] if agent in self._inside else observation
                space = self._own[agent]
                array = np.asarray(own)
                if not isinstance(space, spaces.Box) or len(space.shape) != len(shape):
                    array = np.asarray(spaces.flatten(space, own))
                padded[agent] = _padded(array, shape, dtype)
        return padded

    def _with_masks(self, observations: Mapping[Any, Any], infos: Mapping[Any, Any]) -> dict[Any, Any]:
        """Add masks to the infos of observed agents, if there are any masks."""
        own = {agent: dict(info or {}) for agent, info in infos.items()}
        if not isinstance(self._action_space, spaces.Discrete):
            return own
        for agent, observation in observations.items():
            if observation is None:
                continue
            info = own.setdefault(agent, {})
            found = observation.get(ACTION_MASK_KEY) if agent in self._inside else info.get(ACTION_MASK_KEY)
            n_own = int(self._actions[agent].n)
            mask = np.ones(n_own, dtype=np.int8) if found is None else np.asarray(found, dtype=np.int8)
            info[ACTION_MASK_KEY] = _padded(mask, (int(self._action_space.n),), np.int8)
        return own

    def _own_action(self, agent: Any, action: Any) -> Any:
        space = self._actions[agent]
        if space == self._action_space:
            return action
        if isinstance(space, spaces.Box):
            own = np.asarray(action)[: space.shape[0]]
            return np.clip(own, space.low, space.high).astype(space.dtype)
        assert isinstance(space, spaces.Discrete)
        if not 0 <= int(action) < space.n:
            raise ValueError(
                f"{agent} has {space.n} actions, got action {int(action)}, which is masked; use a policy that takes "
                "legal actions only (those of sb3_saf do, with action_masks='auto' of make_team_env)"
            )
        return int(action) + int(space.start)


def _common_observations(own: list[spaces.Space[Any]]) -> spaces.Box:
    boxes = [space for space in own if isinstance(space, spaces.Box)]
    if len(boxes) < len(own) or len({len(box.shape) for box in boxes}) > 1:
        flat = [spaces.flatten_space(space) for space in own]
        boxes = [space for space in flat if isinstance(space, spaces.Box)]
        if len(boxes) < len(own):
            raise ValueError(f"expected observations that can be flattened, got {own}; flatten them in a wrapper")
    shape = tuple(int(size) for size in np.max([box.shape for box in boxes], axis=0))
    dtype = np.result_type(*(box.dtype for box in boxes))
    low, high = (
        reduce.reduce([_padded(getattr(box, side), shape, dtype) for box in boxes])
        for side, reduce in (("low", np.minimum), ("high", np.maximum))
    )
    return spaces.Box(low, high, dtype=dtype.type)


def _common_actions(own: Mapping[Any, spaces.Space[Any]]) -> spaces.Space[Any]:
    first, *others = own.values()
    if all(space == first for space in others):
        return first
    if all(isinstance(space, spaces.Discrete) for space in own.values()):
        return spaces.Discrete(max(int(space.n) for space in own.values()))  # type: ignore[attr-defined]
    if all(isinstance(space, spaces.Box) and len(space.shape) == 1 for space in own.values()):
        boxes: list[spaces.Box] = list(own.values())  # type: ignore[arg-type]
        shape = (max(box.shape[0] for box in boxes),)
        # The padding of an agent that lacks an entry does not widen the bounds of that entry.
        low = np.min([_padded(box.low, shape, np.float32, np.inf) for box in boxes], axis=0)
        high = np.max([_padded(box.high, shape, np.float32, -np.inf) for box in boxes], axis=0)
        return spaces.Box(low, high, dtype=np.float32)
    raise ValueError(
        "expected actions that are Discrete for all agents, or vectors (Box of one axis) for all, where agents differ; "
        f"got {', '.join(f'{agent}: {space}' for agent, space in own.items())}; make them so in a wrapper"
    )


def _padded(array: Any, shape: tuple[int, ...], dtype: Any, fill: float = 0) -> Any:
    result = np.full(shape, fill, dtype=dtype)
    result[tuple(slice(size) for size in np.shape(array))] = array
    return result
