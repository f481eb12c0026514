"""Static description of a PettingZoo game: agents, spaces, and the signals it gives besides rewards."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final, Literal, NamedTuple, TypeAlias

from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv

from sb3_saf.envs import parallel_calls
from sb3_saf.envs.space_reader import (
    FlatReader,
    SpaceReader,
    can_be_flattened,
    counted_from_zero,
    leaves_of,
)
from sb3_saf.teams.rows import ACTION_MASK_KEY, FIXED_SHAPE, TeamSpaces

AnyParallelEnv: TypeAlias = "ParallelEnv[Any, Any, Any]"
MakeEnv: TypeAlias = "Callable[[], AnyParallelEnv] | AnyParallelEnv"

#: Where a game gives action masks: in observations of the form {"observation", "action_mask"}, or in infos.
MaskSource = Literal["observation", "info"]
#: Whether to use action masks: if there are any, always (required), never.
AskMasks: TypeAlias = Literal["auto"] | bool

#: Key of the agent's own observation in PettingZoo's form for masks.
OBSERVATION: Final = "observation"


class Signals(NamedTuple):
    """
    Signals requested besides own observations; see :class:`~sb3_saf.envs.supersuit_vec_env.SuperSuitVecEnv`.

    :param active: whether agents take part
    :param action_masks: ``"auto"`` for masks if any, True to require them, False for none; None keeps observations
        unchanged
    :param state: the game's state
    """

    active: bool = False
    action_masks: AskMasks | None = None
    state: bool = False


class GameForm(NamedTuple):
    """
    Properties that all copies of a game share.

    :param agents: N names, in the order of the rows
    :param own: the game's space of an agent's own observation, without masks
    :param action_space: of every agent
    :param rows: parts of a row's observation
    :param has_masks_inside: whether observations have the form {"observation", "action_mask"} and must be split
    :param masks: source of the masks, None for no masks
    :param state: the game's space of ``state()``, None if rows have no state
    :param is_flattened: whether a Dict or Tuple becomes a vector
    """

    agents: tuple[Any, ...]
    own: spaces.Space[Any]
    action_space: spaces.Space[Any]
    rows: TeamSpaces
    has_masks_inside: bool = False
    masks: MaskSource | None = None
    state: spaces.Space[Any] | None = None
    is_flattened: bool = False

    def own_reader(self, notes: list[str]) -> SpaceReader:
        """Return the reader that checks own observations."""
        return (FlatReader if self.is_flattened else SpaceReader)(self.own, notes)


def game_form(example: Any, first_infos: Callable[[], Mapping[Any, Any]], signals: Signals) -> GameForm:
    """
    Determine the form of a game.

    :param example: the game
    :param first_infos: returns the infos of a reset of a copy; called only if these may hold masks
    :param signals: requested signals
    :raises ValueError: if agents differ in their spaces, a space cannot be in rows, or a signal is missing
    """
    active, action_masks, state = signals
    agents = tuple(example.possible_agents)
    observation_space = _common_space("observation", agents, example.observation_space)
    action_space = _common_space("action", agents, example.action_space)
    own, inside = observation_space, action_masks is not None and has_masks_inside(observation_space)
    if inside:
        own = observation_space[OBSERVATION]  # type: ignore[index]
    masks = _mask_source(inside, action_masks, action_space, first_infos)
    state_space = _state_space(example) if state else None
    is_flattened = action_masks is not None and can_be_flattened(own)
    rows = TeamSpaces(
        (FlatReader if is_flattened else SpaceReader)(own, []).rows,
        len(agents),
        active,
        _n_actions(action_space) if masks else None,
        None if state_space is None else counted_from_zero(state_space),
        agents,
        is_dict=active or masks is not None or state,
    )
    return GameForm(agents, own, action_space, rows, inside, masks, state_space, is_flattened)


def check_is_parallel(env: Any, is_factory: bool) -> None:
    """
    Check that an object is a ParallelEnv with named agents.

    :param env: the argument of the user, or what a factory returned
    :param is_factory: whether a factory returned it
    :raises ValueError: if it is not, with a fix
    """
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
    agents = getattr(env, "possible_agents", None)
    if not agents:
        raise ValueError(f"expected {env} to list its agents in possible_agents (each gets a row), got none")
    doubles = [agent for i, agent in enumerate(agents) if agent in agents[:i]]
    if doubles:
        raise ValueError(
            f"expected different names in possible_agents of {env}, got {doubles[0]!r} more than once in {list(agents)}"
        )


def _common_space(kind: str, agents: Sequence[Any], space_of: Callable[[Any], spaces.Space[Any]]) -> spaces.Space[Any]:
    """Return the space of all agents; raise ValueError if they differ."""
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
    parts = leaves_of(first) if kind == "observation" else [first]
    if not all(isinstance(part, FIXED_SHAPE) for part in parts):
        names = ", ".join(part.__name__ for part in FIXED_SHAPE)
        containers = ", or a Dict or Tuple of those" if kind == "observation" else ""
        raise ValueError(f"expected an {kind} space that is one of {names}{containers}, got {first}")
    if not parts or any(0 in (part.shape or ()) for part in parts):
        raise ValueError(
            f"expected an {kind} space with at least one entry, got {first}; give agents without "
            f"{'anything to see' if kind == 'observation' else 'a choice'} one constant entry"
        )
    return first


def has_masks_inside(space: spaces.Space[Any]) -> bool:
    """Return whether observations have PettingZoo's form for masks."""
    return isinstance(space, spaces.Dict) and set(space.spaces) == {OBSERVATION, ACTION_MASK_KEY}


def _mask_source(
    inside: bool,
    action_masks: AskMasks | None,
    action_space: spaces.Space[Any],
    first_infos: Callable[[], Mapping[Any, Any]],
) -> MaskSource | None:
    if not action_masks:
        return None
    if inside:
        return "observation"
    if action_masks is True:
        return "info"
    if not isinstance(action_space, spaces.Discrete):
        return None
    infos = first_infos().values()
    return "info" if any(isinstance(info, Mapping) and ACTION_MASK_KEY in info for info in infos) else None


def _n_actions(action_space: spaces.Space[Any]) -> int:
    if not isinstance(action_space, spaces.Discrete):
        raise ValueError(
            f"action masks are for Discrete actions, got the action space {action_space}; pass action_masks=False, or "
            "make the actions Discrete in a wrapper of the environment"
        )
    return int(action_space.n)


def _state_space(example: Any) -> spaces.Space[Any]:
    for env in (example, getattr(example, "unwrapped", None)):
        space = None
        with suppress(AttributeError, NotImplementedError):
            space = env.state_space  # type: ignore[union-attr]
        if isinstance(space, FIXED_SHAPE):
            return space
    raise ValueError(
        f"state=True needs an environment with state() and a state_space of Box, Discrete, MultiDiscrete or "
        f"MultiBinary, got {example} with {getattr(example, 'state_space', 'no state_space')}; leave state out, or "
        "give the environment both"
    )


def first_infos_of(build: Callable[[], Any]) -> Mapping[Any, Any]:
    """Return the infos of a reset of a temporary copy made by ``build``."""
    env = build()
    try:
        return parallel_calls.reset(env, seed=0, options=None)[1]
    finally:
        env.close()
