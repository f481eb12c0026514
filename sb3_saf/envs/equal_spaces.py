"""Conversion of games to ParallelEnvs whose agents have equal spaces, as rows need."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from sb3_saf.envs.audit import (
    Trial,
    agents_of,
    mask_key_of,
    mask_of,
    own_part,
    reset,
    space_of,
    step_results,
    without_mask,
)
from sb3_saf.envs.gymnasium_team import INFO_MASKS, GymnasiumTeam, is_gymnasium_team
from sb3_saf.envs.space_reader import FlatReader, SpaceReader
from sb3_saf.teams.rows import ACTION_MASK_KEY, Array, n_mask_entries


def team_game(env: Any) -> Any:
    """
    Convert an environment to the form that rows need; return it unchanged if no conversion is necessary or known.

    Gymnasium environments of several agents become ParallelEnvs (:class:`GymnasiumTeam`), agents with different spaces
    get equal ones (:class:`EqualSpaces`).

    :param env: any object
    """
    if is_gymnasium_team(env):
        env = GymnasiumTeam(env)
    agents = agents_of(env) if isinstance(env, ParallelEnv) else []
    kinds = (getattr(env, "observation_space", None), getattr(env, "action_space", None))
    differ = all(map(callable, kinds)) and any(kind(one) != kind(agents[0]) for kind in kinds for one in agents)  # type: ignore[misc]
    return EqualSpaces(env) if differ else env


def make_team_game(make: Callable[[], Any]) -> Any:
    """Call a factory and convert its result by :func:`team_game`."""
    return team_game(make())


def masks_are_inside(env: Any) -> bool:
    """Return whether observations of a ParallelEnv hold action masks."""
    agents = agents_of(env)
    return any(mask_key_of(env.observation_space(one), env.action_space(one))[0] is not None for one in agents)


def trial_of(game: Any) -> Trial:
    """Play a trial episode of a game; agents with different spaces are checked against their own."""
    trial = Trial(game.env if isinstance(game, EqualSpaces) else game)
    trial.play()
    if isinstance(game, EqualSpaces) and n_mask_entries(game.action_space(trial.agents[0])) is not None:
        trial.n_masks = {ACTION_MASK_KEY: trial.n_turns}
    return trial


class EqualSpaces(BaseParallelWrapper[Any, Any, Any]):
    """
    Wrapper that gives agents with different spaces equal ones.

    Observations: Boxes with equal numbers of axes are padded with zeros at the end of each axis; other spaces are
    flattened to vectors by ``gymnasium.spaces.flatten`` and then padded.

    Actions: Discrete spaces are extended to the largest one; MultiDiscrete spaces, also beside Discrete ones, to the
    largest number of choices of each dimension. What an agent lacks is masked (``infos[agent]["action_mask"]``,
    combined with the game's own masks) and refused. Boxes are padded; only the agent's own entries reach the game,
    clipped to its bounds.

    :param env: the game
    :raises ValueError: if actions are neither all discrete nor all vectors
    """

    def __init__(self, env: ParallelEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        agents = agents_of(env)
        self.possible_agents = agents
        self._actions = {agent: space_of(env, "action", agent) for agent in agents}
        self._observed = {agent: space_of(env, "observation", agent) for agent in agents}
        self._mask_keys = {agent: mask_key_of(self._observed[agent], self._actions[agent])[0] for agent in agents}
        own = {
            agent: space if self._mask_keys[agent] is None else without_mask(space, self._mask_keys[agent])
            for agent, space in self._observed.items()
        }
        n_axes = {len(space.shape) if isinstance(space, spaces.Box) else None for space in own.values()}
        reader = SpaceReader if len(n_axes) == 1 and None not in n_axes else FlatReader
        self._readers = {agent: reader(space) for agent, space in own.items()}
        self._observation_space = _common_box([one.rows for one in self._readers.values()])
        self._action_space = _common_actions(self._actions)
        self._n_steps = 0

    def observation_space(self, agent: Any) -> spaces.Space[Any]:
        """Return the space of all agents' observations."""
        return self._observation_space

    def action_space(self, agent: Any) -> spaces.Space[Any]:
        """Return the space of all agents' actions."""
        return self._action_space

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Begin an episode (see PettingZoo)."""
        observations, infos = reset(self.env, seed, options)
        self._n_steps = 0
        return self._padded(observations), self._with_masks(observations, infos)

    def step(self, actions: Mapping[Any, Any]) -> tuple[Any, Any, Any, Any, Any]:
        """Play one step (see PettingZoo)."""
        own = {agent: self._own_action(agent, action) for agent, action in actions.items()}
        observations, rewards, terminations, truncations, infos = step_results(self.env, self.env.step(own))
        self._n_steps += 1
        return (
            self._padded(observations),
            rewards,
            terminations,
            truncations,
            self._with_masks(observations, infos),
        )

    def _padded(self, observations: Mapping[Any, Any]) -> dict[Any, Any]:
        shape, dtype = self._observation_space.shape, self._observation_space.dtype
        padded = {}
        for agent, observation in observations.items():
            if observation is not None and agent in self._readers:
                key = self._mask_keys[agent]
                own = observation if key is None else own_part(observation, self._observed[agent], key)
                read = self._readers[agent].read(own, f"{agent} at step {self._n_steps} of its episode")
                padded[agent] = _padded(read, shape, dtype)
        return padded

    def _with_masks(self, observations: Mapping[Any, Any], infos: Mapping[Any, Any]) -> dict[Any, Any]:
        """Add masks to the infos of observed agents, if there are any masks."""
        shown = {agent: dict(info or {}) for agent, info in infos.items()}
        for agent in self._readers if n_mask_entries(self._action_space) is not None else ():
            observation = observations.get(agent)
            if observation is None:
                continue
            info, key = shown.setdefault(agent, {}), self._mask_keys[agent]
            masks = [observation[key]] if key is not None else [info[name] for name in INFO_MASKS if name in info]
            info[ACTION_MASK_KEY] = self.padded_mask(agent, masks[0] if masks else None)
        return shown

    def padded_mask(self, agent: Any, mask: Any = None) -> Array:
        """
        Return the mask of all agents' actions for one agent, int8.

        :param agent: its name
        :param mask: of its own actions; None if all are legal
        """
        space = self._actions[agent]
        n_entries = n_mask_entries(space)
        own = np.ones(n_entries or 0, np.int8)
        if mask is not None:
            own = mask_of(mask, space, f"the masks of {agent} at step {self._n_steps} of its episode")
        if space == self._action_space:
            return own
        ends, sizes = np.cumsum(_choices(space)).tolist(), _choices(self._action_space)
        parts = np.split(own, ends[:-1]) + [np.ones(1, np.int8)] * (len(sizes) - len(ends))
        return np.concatenate([_padded(part, (size,), np.int8) for part, size in zip(parts, sizes, strict=True)])

    def _own_action(self, agent: Any, action: Any) -> Any:
        space = self._actions[agent]
        if space == self._action_space:
            return action
        if isinstance(space, spaces.Box):
            own = np.asarray(action)[: space.shape[0]]
            return np.clip(own, space.low, space.high).astype(space.dtype)
        choices = _choices(space)
        own = np.atleast_1d(action)
        if ((own < 0) | (own >= choices + [1] * (len(own) - len(choices)))).any():
            raise ValueError(
                f"{agent} has {space}, got action {action}, which is masked; use a policy that takes legal actions "
                "only (those of sb3_saf do, with action_masks='auto' of make_team_env)"
            )
        if isinstance(space, spaces.Discrete):
            return int(own[0]) + int(space.start)
        return (own[: len(choices)] + space.start).astype(space.dtype)  # type: ignore[attr-defined]


def _choices(space: spaces.Space[Any]) -> list[int]:
    """Return the number of choices of each dimension of Discrete or MultiDiscrete."""
    return [int(space.n)] if isinstance(space, spaces.Discrete) else space.nvec.tolist()  # type: ignore[attr-defined]


def _common_box(own: list[spaces.Space[Any]]) -> spaces.Box:
    boxes = [space for space in own if isinstance(space, spaces.Box)]
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
    if all(isinstance(space, spaces.Discrete) or _is_vector(space, spaces.MultiDiscrete) for space in own.values()):
        choices = [_choices(space) for space in own.values()]
        return spaces.MultiDiscrete(
            np.max([_padded(one, (max(map(len, choices)),), np.int64) for one in choices], axis=0)
        )
    if all(_is_vector(space, spaces.Box) for space in own.values()):
        boxes: list[spaces.Box] = list(own.values())  # type: ignore[arg-type]
        shape = (max(box.shape[0] for box in boxes),)
        # The padding of an agent that lacks an entry does not widen the bounds of that entry.
        low = np.min([_padded(box.low, shape, np.float32, np.inf) for box in boxes], axis=0)
        high = np.max([_padded(box.high, shape, np.float32, -np.inf) for box in boxes], axis=0)
        return spaces.Box(low, high, dtype=np.float32)
    raise ValueError(
        "expected actions that are discrete for all agents (Discrete or MultiDiscrete), or vectors for all (Box of one "
        f"axis), where agents differ; got {', '.join(f'{agent}: {space}' for agent, space in own.items())}. A policy "
        "has one kind of actions: in a wrapper of the environment, give the agents with Box actions a table of vectors "
        "to choose from (Discrete), or take the largest entry of a Box for the agents with Discrete actions"
    )


def _is_vector(space: spaces.Space[Any], kind: type[spaces.Space[Any]]) -> bool:
    return isinstance(space, kind) and len(space.shape or ()) == 1


def _padded(array: Any, shape: tuple[int, ...], dtype: Any, fill: float = 0) -> Any:
    result = np.full(shape, fill, dtype=dtype)
    result[tuple(slice(size) for size in np.shape(array))] = array
    return result
