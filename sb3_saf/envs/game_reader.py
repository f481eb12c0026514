"""How a PettingZoo game is read: its observations, action masks and state as rows of one form."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from contextlib import suppress
from itertools import accumulate
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_saf.envs.audit import Trial, mask_error, observation_of, without_mask
from sb3_saf.networks.encoders import Part, PartsSpace, has_pictures, picture_of, wide_integers
from sb3_saf.teams.conversion import MASK_NAMES, AgentConversion, Key, Leaf, innermost, padded
from sb3_saf.teams.rows import (
    ACTION_MASK_KEY,
    ACTIVE_KEY,
    FIXED_SHAPE,
    OBS_KEY,
    STATE_KEY,
    Array,
    TeamSpaces,
    check_codes_are_kept,
    fill_idle_rows,
    n_mask_entries,
)

AnyParallelEnv: TypeAlias = "ParallelEnv[Any, Any, Any]"
MakeEnv: TypeAlias = "Callable[[], AnyParallelEnv] | AnyParallelEnv"

#: Whether to use action masks: if there are any, always (required), never.
AskMasks: TypeAlias = Literal["auto"] | bool


#: Ratio of the bounds of agents' observations that is warned of.
_UNEQUAL: Final = 10


class GameReader:
    """
    Reader of a game: what its agents observe and what masks their actions becomes rows of one form.

    :param active: whether rows have ``"active"``
    :param action_masks: ``"auto"`` for masks if any, True to require them, False for none
    :param state: whether rows have the game's state
    :raises ValueError: if actions of different agents cannot be those of one policy, or a requested signal is missing
    """

    def __init__(self, trial: Trial, active: bool, action_masks: AskMasks, state: bool) -> None:
        self.agents = trial.agents
        #: Warnings about the game.
        self.notes = list(trial.notes)
        observed, acted, keys = trial.observed.values(), trial.actions, trial.mask_keys
        own_spaces = [without_mask(*entry) for entry in zip(observed, keys.values(), strict=True)]
        own = own_space(own_spaces)
        inner = getattr(getattr(trial.env, "unwrapped", None), "observation_spaces", None)
        check_codes_are_kept(own, inner.values() if isinstance(inner, Mapping) else ())
        leaves = [leaf for space in own_spaces for _, leaf in innermost(space)]
        if not has_pictures(own) and any(map(_is_picture, leaves)):
            self.notes.append(
                "the pictures in the agents' observations are read as plain numbers, without convolutions, because "
                f"they are of different kinds or places: {', '.join(map(str, own_spaces))}; give all agents the same "
                "picture, as the first part of their Dicts"
            )
        if any(hasattr(leaf, "atlas") for leaf in leaves) and not hasattr(own, "atlas"):
            self.notes.append(
                "tile codes beside other entries are read as plain numbers, without their pixels; give the agents the "
                "codes alone, or pixels (HECOGrid: observation='rgb')"
            )
        boxes: dict[tuple[Key, ...], list[spaces.Box]] = {}
        for place, leaf in (entry for space in own_spaces for entry in innermost(space)):
            if isinstance(leaf, spaces.Box) and leaf.low.size:
                boxes.setdefault(place, []).append(leaf)
        for alike in boxes.values():
            bounds = [(float(box.low.min()), float(box.high.max())) for box in alike]
            largest = {max(abs(low), abs(high)) for low, high in bounds if low < high} or {1.0}
            is_kept = len(alike[0].shape) == 1 or all(box.dtype.kind in "iu" for box in alike)
            divided = is_kept and any(wide_integers(box).any() for box in alike)
            divided |= (min(low for low, _ in bounds), max(high for _, high in bounds)) == (0, 255)
            if divided and 2**31 - 1 > max(largest) >= _UNEQUAL * min(largest):
                self.notes.append(
                    f"the agents' observations reach up to {sorted(largest)} in one place, and encoders divide whole "
                    "numbers, with what other agents have in their place, by the largest: they hardly see the small "
                    "ones; scale observations to equal ranges in the game"
                )
        #: Action space of a row.
        self.action_space = common_actions(acted)
        has_masks, needs_mask = self._find_masks(trial, action_masks)
        slots = slots_of(own_spaces)
        #: By agent: how its observations, masks and actions become those of rows, and back.
        self.conversions = {
            agent: AgentConversion.of(
                space, acted[agent], own, self.action_space, keys[agent], agent in needs_mask, slots
            )
            for agent, space in zip(self.agents, own_spaces, strict=True)
        }
        #: Whether to warn of masks that come after the trial.
        self.watches_masks = action_masks == "auto" and not has_masks
        self._state: tuple[Leaf, spaces.Space[Any]] | None = None
        if state:
            env, space = trial.env, None
            layer: Any
            for layer in (getattr(env, "unwrapped", None), env):
                with suppress(AttributeError, NotImplementedError):
                    found = layer.state_space
                    space = found if isinstance(found, FIXED_SHAPE) else space
            if space is None:
                raise ValueError(
                    f"state=True needs an environment with state() and a state_space of Box, Discrete, MultiDiscrete "
                    f"or MultiBinary, got {env} with {getattr(env, 'state_space', 'no state_space')}; leave state out, "
                    "or give the environment both"
                )
            self._state = Leaf.of(space), own_space([space])
        #: The form of the rows.
        self.rows = TeamSpaces(
            own,
            len(self.agents),
            active,
            n_mask_entries(self.action_space) if has_masks else None,
            None if self._state is None else self._state[1],
            self.agents,
        )

    def _find_masks(self, trial: Trial, action_masks: AskMasks) -> tuple[bool, set[Any]]:
        """Return whether rows have masks, and the agents to which the game always gives one."""
        if not action_masks:
            return False, set()
        if n_mask_entries(self.action_space) is None:
            if action_masks is True:
                raise ValueError(
                    f"action masks are for Discrete, MultiDiscrete and MultiBinary actions, got {self.action_space}; "
                    "pass action_masks=False, or make the actions Discrete in a wrapper of the environment"
                )
            return False, set()
        inside = {agent for agent in self.agents if trial.mask_keys[agent] is not None}
        differ = len({str(_counted_from_zero(space)) for space in trial.actions.values()}) > 1
        if action_masks is True and not differ:
            return True, set(self.agents)
        some = {agent for agent, n in trial.n_masks.items() if n < trial.n_turns[agent]}
        if some:
            self.notes.append(
                f"{ACTION_MASK_KEY!r} is in some infos and not in others ({trial.n_masks.total()} of "
                f"{trial.n_turns.total()} in a trial episode): where it is missing, all actions are taken to be legal"
            )
        return bool(inside or trial.n_masks or differ), inside | (trial.n_masks.keys() - some)

    def read(
        self,
        env: Any,
        observations: Mapping[Any, Any],
        infos: Mapping[Any, Any],
        shown: Container[Any],
        active: Container[Any],
        place: str,
        over: bool = False,
    ) -> Any:
        """
        Return the N rows of a game: own observations, or a dict of the parts of rows.

        :param shown: agents whose observations are shown; rows of others are zeros, or with ``"active"`` copies
        :param active: agents that take part, and must have an observation
        :param place: game and step, for messages
        :param over: whether these are last observations, on which no agent acts
        """
        own = np.zeros((len(self.agents), *self.rows.own_shape), dtype=self.rows.own.dtype)
        for row, agent in enumerate(self.agents):
            if agent in active or (agent in shown and observations.get(agent) is not None):
                own[row] = self.own(observations, agent, place)
        if not self.rows.is_dict:
            return own
        rows = {OBS_KEY: own}
        flags = np.array([agent in active for agent in self.agents], dtype=np.int64)
        if self.rows.n_masked_actions is not None:
            rows[ACTION_MASK_KEY] = np.zeros((len(self.agents), self.rows.n_masked_actions), np.int8)
            for row in np.flatnonzero(flags).tolist():
                agent = self.agents[row]
                mask = self.mask(observations, infos, agent, place, is_needed=not over)
                if over and (mask is None or not mask.any()):  # values of a time limit are those of all its actions
                    mask = self.conversions[agent].mask(np.ones(sum(self.conversions[agent].action.choices), np.int8))
                rows[ACTION_MASK_KEY][row] = mask
        if self._state is not None:
            leaf, space = self._state
            try:
                state = leaf.read(env.state())
            except ValueError as error:
                raise ValueError(f"the state {place}: {error}") from None
            rows[STATE_KEY] = np.repeat(state.astype(space.dtype)[np.newaxis], len(self.agents), axis=0)
        if self.rows.has_active:
            rows[ACTIVE_KEY] = flags
            if not over:
                fill_idle_rows(own, flags)
        return rows

    def own(self, observations: Mapping[Any, Any], agent: Any, place: str) -> Array:
        """Return an agent's own observation, as in rows."""
        conversion = self.conversions[agent]
        observation = observation_of(observations, agent, place)
        try:
            return conversion.own(conversion.split(observation)[0])
        except ValueError as error:
            raise ValueError(f"observation of {agent} {place}: {error}") from None

    def mask(
        self, observations: Mapping[Any, Any], infos: Mapping[Any, Any], agent: Any, place: str, is_needed: bool
    ) -> Array | None:
        """Return an agent's action mask, as in rows; None if it lacks one that is not needed."""
        conversion = self.conversions[agent]
        if conversion.mask_key is not None:
            key, where, given = conversion.mask_key, "observation", observations.get(agent) or {}
        else:
            where, given = "info", infos.get(agent) or {}
            key = next((name for name in MASK_NAMES if name in given), ACTION_MASK_KEY)
        if given.get(key) is None and conversion.needs_mask and not is_needed:
            return None
        try:
            return conversion.mask(given.get(key))
        except ValueError as error:
            raise mask_error(error, key, f"the {where} of {agent} {place}") from None


# ---- spaces of rows


def own_space(observed: Sequence[spaces.Space[Any]]) -> spaces.Space[Any]:
    """
    Return the space of rows' own observations.

    Equal spaces of fixed shape stay, counted from 0, as Stable-Baselines3 encodes and samples them whatever their
    start. Boxes with equal numbers of axes are padded to the largest; all others become vectors, as
    ``gymnasium.spaces.flatten_space`` makes them, in which parts of one name have one place, for all agents.
    float64 becomes float32, which networks read.
    """
    own: spaces.Space[Any]
    first, slots = observed[0], slots_of(observed)
    if slots is not None:
        vectors = [_flat_space(space, slots) for space in observed]
        own = vectors[0] if all(vector == vectors[0] for vector in vectors) else _common_vector(vectors)
    elif all(space == first for space in observed):
        own = _counted_from_zero(first)
    else:
        own = _common_vector(observed) if len(first.shape or ()) == 1 else _common_box(observed)
    if isinstance(own, spaces.Box) and own.dtype == np.float64:
        with np.errstate(over="ignore"):
            return spaces.Box(own.low.astype(np.float32), own.high.astype(np.float32), dtype=np.float32)
    return own


def _counted_from_zero(space: spaces.Space[Any]) -> spaces.Space[Any]:
    if isinstance(space, spaces.Discrete) and space.start != 0:
        return spaces.Discrete(int(space.n))
    if isinstance(space, spaces.MultiDiscrete) and np.any(space.start != 0):
        return spaces.MultiDiscrete(space.nvec, dtype=space.dtype.type)
    return space


def slots_of(observed: Sequence[spaces.Space[Any]]) -> dict[tuple[Key, ...], range] | None:
    """Return where rows that are vectors have the parts of Dicts and Tuples; None where they have the game's form."""
    first = observed[0]
    are_boxes = all(isinstance(space, spaces.Box) for space in observed)
    if are_boxes and len({len(space.shape or ()) for space in observed}) == 1:
        return None
    if isinstance(first, FIXED_SHAPE) and all(space == first for space in observed):
        return None
    sizes: dict[tuple[Key, ...], int] = {}
    for space in observed:
        for path, leaf in innermost(space):
            sizes[path] = max(sizes.get(path, 0), spaces.flatdim(leaf))
    ends = accumulate(sizes.values())
    return {path: range(end - size, end) for (path, size), end in zip(sizes.items(), ends, strict=True)}


def _flat_space(space: spaces.Space[Any], slots: Mapping[tuple[Key, ...], range]) -> spaces.Box:
    """Return the space of the vector of a Dict or a Tuple; pictures in it stay known to encoders."""
    n_entries, dtype = max(slot.stop for slot in slots.values()), spaces.flatten_space(space).dtype
    low, high, whole = np.zeros(n_entries, dtype), np.zeros(n_entries, dtype), np.zeros(n_entries, np.bool_)
    pictures = []
    for path, leaf in innermost(space):
        start, flat = slots[path].start, spaces.flatten_space(leaf)
        assert isinstance(flat, spaces.Box)
        stop = start + len(flat.low)
        low[start:stop], high[start:stop] = flat.low, flat.high
        if isinstance(leaf, spaces.Box):
            whole[start:stop] = wide_integers(leaf).reshape(-1)
            if _is_picture(leaf):
                pictures.append(Part(start, stop, leaf))
    return _with_parts(spaces.Box(low, high, dtype=low.dtype.type), tuple(pictures), whole)


def _common_box(boxes: Sequence[Any]) -> spaces.Box:
    shape = tuple(int(size) for size in np.max([box.shape for box in boxes], axis=0))
    dtype = np.result_type(*(box.dtype for box in boxes))
    low = np.min([padded(box.low, shape, dtype) for box in boxes], axis=0)
    high = np.max([padded(box.high, shape, dtype) for box in boxes], axis=0)
    return spaces.Box(low, high, dtype=dtype.type)


def _common_vector(vectors: Sequence[Any]) -> spaces.Box:
    """Return the space of vectors of different agents; what they have in common of parts stays known to encoders."""
    common = _common_box(vectors)
    whole = np.any([padded(wide_integers(one), common.shape, np.bool_) for one in vectors], axis=0)
    pictures = getattr(vectors[0], "pictures", ())
    if any(getattr(one, "pictures", ()) != pictures for one in vectors):
        pictures = ()
    return _with_parts(common, pictures, whole)


def _is_picture(space: spaces.Space[Any]) -> bool:
    return picture_of(space) is not None and not hasattr(space, "atlas")


def _with_parts(vector: spaces.Box, pictures: tuple[Part, ...], whole: Array) -> spaces.Box:
    """Return the space of a vector that has pictures, or integers among floats, which encoders must tell apart."""
    is_needed = pictures or (whole.any() and not np.issubdtype(vector.dtype, np.integer))
    return PartsSpace(vector, pictures, whole) if is_needed else vector


def common_actions(acted: Mapping[Any, spaces.Space[Any]]) -> spaces.Space[Any]:
    """
    Return the action space of rows.

    Where agents differ, Discrete spaces are extended to the largest one; MultiDiscrete spaces, also beside Discrete
    ones, to the largest number of choices of each dimension; vectors are padded.

    :raises ValueError: if actions are neither all discrete nor all vectors
    """
    first, *others = every = [_counted_from_zero(space) for space in acted.values()]
    if all(space == first for space in others):
        return first
    if all(isinstance(space, spaces.Discrete) for space in every):
        return spaces.Discrete(max(Leaf.of(space).choices[0] for space in every))
    if all(isinstance(x, spaces.Discrete) or (isinstance(x, spaces.MultiDiscrete) and x.nvec.ndim == 1) for x in every):
        choices = [Leaf.of(space).choices for space in every]
        length = max(map(len, choices))
        return spaces.MultiDiscrete(np.max([padded(one, (length,), np.int64) for one in choices], axis=0))
    if all(isinstance(space, spaces.Box) and len(space.shape) == 1 for space in every):
        boxes: Any = every
        shape = (max(box.shape[0] for box in boxes),)
        # The padding of an agent that lacks an entry does not widen the bounds of that entry.
        low = np.min([padded(box.low, shape, np.float32, np.inf) for box in boxes], axis=0)
        high = np.max([padded(box.high, shape, np.float32, -np.inf) for box in boxes], axis=0)
        return spaces.Box(low, high, dtype=np.float32)
    raise ValueError(
        "expected actions that are discrete for all agents (Discrete or MultiDiscrete), or vectors for all (Box of one "
        f"axis), where agents differ; got {', '.join(f'{agent}: {space}' for agent, space in acted.items())}. A policy "
        "has one kind of actions: in a wrapper of the environment, give the agents with Box actions a table of vectors "
        "to choose from (Discrete), or take the largest entry of a Box for the agents with Discrete actions"
    )
