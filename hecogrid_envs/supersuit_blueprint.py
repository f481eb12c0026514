"""How to build a game for SuperSuit, and whether SuperSuit can carry it at all."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv

from hecogrid_envs import supersuit_calls
from hecogrid_envs.supersuit_copies import LocalOriginal, Original, original_of
from hecogrid_envs.supersuit_signals import AskMasks, Signals, find_signals

AnyParallelEnv: TypeAlias = "ParallelEnv[Any, Any, Any]"
MakeEnv: TypeAlias = "Callable[[], AnyParallelEnv] | AnyParallelEnv"

_FIXED_SHAPE = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Box)


@dataclass(frozen=True)
class Blueprint:
    """
    What it takes to build a game anywhere, and what is known of it before it is built.

    :param original: the environment, or the function that makes it
    :param agents: N names, in the order of the rows
    :param observation_space: of every agent
    :param action_space: of every agent
    :param metadata: of the environment
    :param render_mode: of the environment
    :param signals: what rows show beside observations
    """

    original: Original | LocalOriginal
    agents: tuple[Any, ...]
    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    metadata: dict[str, Any]
    render_mode: str | None
    signals: Signals

    @property
    def row_space(self) -> spaces.Space[Any]:
        """Observation space of a row."""
        return self.signals.row_space()

    @classmethod
    def of(
        cls,
        make_env: MakeEnv,
        active: bool = False,
        action_masks: AskMasks | None = None,
        state: bool = False,
        n_cpus: int = 1,
    ) -> Blueprint:
        """
        Draw the blueprint of an environment.

        :param make_env: an environment, or a function that makes one
        :param active: whether rows tell who is active
        :param action_masks: whether rows show action masks; None for observations as they are, masks and all
        :param state: whether rows show the game's state
        :param n_cpus: number of processes in which games will be built
        :raises ValueError: if it is no ParallelEnv, cannot be copied, or its agents differ in their spaces
        """
        is_factory = not isinstance(make_env, (ParallelEnv, AECEnv)) and callable(make_env)
        example: Any = make_env() if is_factory else make_env
        _check_is_parallel(example, is_factory)
        try:
            agents = tuple(example.possible_agents)
            original = original_of(make_env, is_factory, n_cpus)
            observation_space = _checked_space("observation", agents, example.observation_space)
            action_space = _checked_space("action", agents, example.action_space)
            signals = Signals(observation_space, observation_space)
            if active or action_masks is not None or state:
                first_infos = partial(_first_infos, original)
                signals = find_signals(
                    example, observation_space, action_space, active, action_masks, state, first_infos
                )
            return cls(
                original,
                agents,
                observation_space,
                action_space,
                metadata=dict(getattr(example, "metadata", None) or {}),
                render_mode=getattr(example, "render_mode", None),
                signals=signals,
            )
        finally:
            if is_factory:
                # Games may rely on having been reset before they are closed; this one has only been looked at.
                with suppress(Exception):
                    example.close()

    def build(self) -> AnyParallelEnv:
        """Build a game."""
        env: AnyParallelEnv = self.original.build()
        return env


def _first_infos(original: Original | LocalOriginal) -> Mapping[Any, dict[str, Any]]:
    """Infos of a reset, of a copy that is closed again."""
    env = original.build()
    try:
        return supersuit_calls.reset(env, seed=0, options=None)[1]
    finally:
        env.close()


def _check_is_parallel(env: Any, is_factory: bool) -> None:
    origin = "a function that returned " if is_factory else ""
    if isinstance(env, AECEnv):
        raise ValueError(
            f"expected a PettingZoo ParallelEnv, got {origin}the AECEnv {env}; "
            "convert it with pettingzoo.utils.conversions.aec_to_parallel, or, where agents take turns, with "
            "sb3_saf.TurnsInParallel"
        )
    if not isinstance(env, ParallelEnv):
        hint = f"; pass {env.__name__}.parallel_env(...)" if hasattr(env, "parallel_env") else ""
        raise ValueError(
            "expected a PettingZoo ParallelEnv or a function that makes one, "
            f"got {origin}an object of type {type(env).__name__}{hint}"
        )
    if not getattr(env, "possible_agents", None):
        raise ValueError(f"expected {env} to list its agents in possible_agents (each gets a row), got none")


def _checked_space(kind: str, agents: Sequence[Any], space_of: Callable[[Any], spaces.Space[Any]]) -> spaces.Space[Any]:
    """The one space of all agents."""
    if not callable(space_of):
        raise ValueError(
            f"expected {kind}_space(agent) to be a method that gives an agent's space, got {type(space_of).__name__}; "
            f"write it as: def {kind}_space(self, agent): return self.{kind}_spaces[agent]"
        )
    space_by_agent = {agent: space_of(agent) for agent in agents}
    first = space_by_agent[agents[0]]
    others = [f"{agent} has {space}" for agent, space in space_by_agent.items() if space != first]
    if others:
        repair = "with supersuit." + ("pad_observations_v0" if kind == "observation" else "pad_action_space_v0")
        if not all(isinstance(space, (spaces.Box, spaces.Discrete)) for space in space_by_agent.values()):
            repair = "in a wrapper of your own (SuperSuit pads Box and Discrete only)"
        raise ValueError(
            f"expected one {kind} space for all agents, got: {agents[0]} has {first}, {', '.join(others)}; "
            f"make them equal {repair}"
        )
    parts = _leaves(first) if kind == "observation" else [first]
    if not all(isinstance(part, _FIXED_SHAPE) for part in parts):
        names = ", ".join(part.__name__ for part in _FIXED_SHAPE)
        containers = ", or a Dict or Tuple of those" if kind == "observation" else ""
        raise ValueError(f"expected an {kind} space that is one of {names}{containers}, got {first}")
    return first


def _leaves(space: spaces.Space[Any]) -> list[spaces.Space[Any]]:
    if isinstance(space, spaces.Dict):
        return [leaf for part in space.spaces.values() for leaf in _leaves(part)]
    if isinstance(space, spaces.Tuple):
        return [leaf for part in space.spaces for leaf in _leaves(part)]
    return [space]


def blank(space: spaces.Space[Any]) -> Any:
    """
    Build an observation of zeros.

    :param space: observation space of one agent
    """
    if isinstance(space, spaces.Dict):
        return {key: blank(part) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(blank(part) for part in space.spaces)
    assert space.shape is not None
    return np.zeros(space.shape, space.dtype)


def fitted(space: spaces.Space[Any], observation: Any, owner: str) -> Any:
    """
    Bring an observation into the shape and dtype of its space.

    What does not fit would otherwise stop SuperSuit somewhere inside NumPy, and a worker process for good.

    :param space: observation space of one agent
    :param observation: the agent's observation
    :param owner: the agent, for the message
    :raises ValueError: if it does not fit
    """
    if isinstance(space, spaces.Dict):
        if not isinstance(observation, Mapping) or set(observation) != set(space.spaces):
            got = list(observation) if isinstance(observation, Mapping) else type(observation).__name__
            raise ValueError(f"observation of {owner}: expected a dict with {list(space.spaces)}, got {got}")
        return {key: fitted(part, observation[key], f"{owner}, {key!r}") for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        if not isinstance(observation, (tuple, list)) or len(observation) != len(space.spaces):
            raise ValueError(f"observation of {owner}: expected {len(space.spaces)} parts, got {observation!r}")
        parts = zip(space.spaces, observation, strict=True)
        return tuple(fitted(part, value, f"{owner}, part {i}") for i, (part, value) in enumerate(parts))
    assert space.dtype is not None
    array = np.asarray(observation)
    if array.shape == space.shape and array.dtype == space.dtype:  # as nearly always
        return array
    if array.shape != space.shape or not np.can_cast(array.dtype, space.dtype, "same_kind"):
        raise ValueError(
            f"observation of {owner}: expected {space.dtype} of shape {space.shape}, "
            f"got {array.dtype} of shape {array.shape}"
        )
    return array.astype(space.dtype)
