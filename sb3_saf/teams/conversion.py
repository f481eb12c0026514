"""
One agent's observations, action masks and actions: from the form of the game to that of rows, and back.

A conversion is plain data, known when the environment is made. Games are read by it in training, and it travels in the
observation space (:class:`~sb3_saf.teams.rows.AgentSpace`), hence with every saved model and every exported actor, so
that models act on what the game itself gives. To use one needs NumPy only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from math import prod
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from gymnasium import spaces

Array: TypeAlias = npt.NDArray[Any]
Key: TypeAlias = str | int

#: Entries of rows, as in ``sb3_saf.teams.rows``, which needs more than NumPy.
OBS, AGENT, ACTION_MASK = "obs", "agent", "action_mask"
#: Keys of PettingZoo's observations with masks.
CLASSIC = frozenset({"observation", ACTION_MASK})
#: Names under which games give action masks, in observations or infos.
MASK_NAMES = (ACTION_MASK, "action_masks", "avail_actions", "available_actions")


@dataclass(frozen=True)
class Leaf:
    """
    One array of a game's observation, or its action.

    :param dtype: NumPy's name of the type in the game
    :param low: lowest values of all entries, or one value for all
    :param path: keys and indices that lead to it through Dicts and Tuples
    :param choices: numbers of choices of all entries of Discrete and MultiDiscrete, 2 for MultiBinary; else empty
    :param is_one_hot: whether it is Discrete or MultiDiscrete, which vectors hold one-hot and rows count from 0
    """

    space: str
    shape: tuple[int, ...]
    dtype: str
    low: tuple[float, ...]
    high: tuple[float, ...]
    path: tuple[Key, ...] = ()
    choices: tuple[int, ...] = ()
    is_one_hot: bool = False

    @classmethod
    def of(cls, space: spaces.Space[Any], path: tuple[Key, ...] = ()) -> Leaf:
        """Describe a space of fixed shape."""
        from gymnasium import spaces

        form = str(space), tuple(space.shape or ()), str(space.dtype)
        if isinstance(space, spaces.Box):
            return cls(*form, _compact(space.low), _compact(space.high), path)
        if isinstance(space, spaces.MultiBinary):
            return cls(*form, (0,), (1,), path, (2,) * prod(space.shape))
        assert isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)), space
        count = space.n if isinstance(space, spaces.Discrete) else space.nvec
        low, choices = (tuple(np.reshape(values, -1).tolist()) for values in (space.start, count))
        high = tuple(first + n - 1 for first, n in zip(low, choices, strict=True))
        return cls(*form, low, high, path, choices, True)

    @cached_property
    def _dtype(self) -> np.dtype[Any]:
        return np.dtype(self.dtype)

    @cached_property
    def start(self) -> Array | None:
        """Lowest values if rows count from 0 what the game does not."""
        is_shifted = self.is_one_hot and any(self.low)
        return np.array(self.low, dtype=self._dtype).reshape(self.shape) if is_shifted else None

    @cached_property
    def _bounds(self) -> tuple[Any, Any]:
        """Lowest and highest values of integers, in one number if all entries have the same; None for the type's."""
        if self._dtype.kind not in "iu":
            return None, None if self._dtype.kind == "f" else 1
        limits = np.iinfo(self._dtype)
        low, high = (
            None if bound == (limit,) else bound[0] if len(bound) == 1 else np.reshape(bound, self.shape)
            for bound, limit in ((self.low, limits.min), (self.high, limits.max))
        )
        return low, high

    def read(self, observation: Any) -> Array:
        """
        Return the array, counted from 0, from an observation.

        Integers outside the bounds, which index tables, are refused.

        :raises ValueError: if it is missing, of another shape or type, or out of bounds
        """
        for depth, key in enumerate(self.path):
            try:
                observation = observation[key]
            except (KeyError, IndexError, TypeError):
                got = list(observation) if isinstance(observation, Mapping) else type(observation).__name__
                raise ValueError(f"{_where(self.path[:depth])}expected a part {key!r}, got {got}") from None
        array = observation if type(observation) is np.ndarray else _as_array(observation)
        is_castable = array.dtype == self._dtype or np.can_cast(array.dtype, self._dtype, "same_kind")
        if array.shape != self.shape or not is_castable:
            got = f"{array.dtype} of shape {array.shape}"
            raise ValueError(f"{_where(self.path)}expected {self.dtype} of shape {self.shape}, got {got}")
        low, high = self._bounds
        if array.dtype != self._dtype and self._dtype.kind in "iu":  # a wider type may exceed the limits of this one
            low, high = (one[0] if len(one) == 1 else np.reshape(one, self.shape) for one in (self.low, self.high))
        if high is not None and (array > high).any():
            raise ValueError(self.outside(array, array > high))
        if low is not None and (array < low).any():
            raise ValueError(self.outside(array, array < low))
        if self.start is not None:
            array = array - self.start
        return array.astype(self._dtype, copy=False)

    def outside(self, array: Array, wrong: Array) -> str:
        """Describe values outside the bounds."""
        return (
            f"{_where(self.path)}expected values from {min(self.low)} to {max(self.high)} as in {self.space}, got "
            f"{array[wrong].reshape(-1)[0]}; make the space as wide as what the game gives"
        )

    def flat(self, array: Array) -> Array:
        """Return an array of :meth:`read` as a vector, as ``gymnasium.spaces.flatten``: choices are one-hot."""
        if not self.is_one_hot:
            return array.reshape(-1)
        codes = [np.eye(n)[int(choice)] for n, choice in zip(self.choices, array.reshape(-1), strict=True)]
        return np.concatenate(codes)


def _compact(bound: Array) -> tuple[float, ...]:
    """Return the bounds of all entries, one value if all are equal."""
    values = bound.reshape(-1).tolist()
    return (values[0],) if (bound == bound.flat[0]).all() else tuple(values)


def _where(path: tuple[Key, ...]) -> str:
    return "".join(f"[{key!r}]" for key in path) + (": " if path else "")


def _as_array(value: Any) -> Array:
    try:
        return np.asarray(value)
    except ValueError:  # lists of unequal lengths
        return np.asarray(None)


def innermost(space: spaces.Space[Any], path: tuple[Key, ...] = ()) -> Iterator[tuple[tuple[Key, ...], Any]]:
    """Yield the innermost spaces of nested Dicts and Tuples with their paths, as ``gymnasium.spaces.flatten`` does."""
    from gymnasium import spaces

    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        parts = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        for key, part in parts:
            yield from innermost(part, (*path, key))
    else:
        yield path, space


def leaves_of(space: spaces.Space[Any]) -> list[Leaf]:
    """Describe the innermost spaces of nested Dicts and Tuples."""
    return [Leaf.of(part, path) for path, part in innermost(space)]


def read_leaves(leaves: Sequence[Leaf], observation: Any) -> list[Array]:
    """
    Return all arrays of an observation, see :meth:`Leaf.read`.

    :raises ValueError: also for entries that the space lacks
    """
    if leaves and leaves[0].path:  # parts of a Dict or Tuple
        keys = list(dict.fromkeys(leaf.path[0] for leaf in leaves))
        known = isinstance(observation, (Mapping, tuple, list))
        got = list(observation) if isinstance(observation, Mapping) else list(range(len(observation))) if known else []
        if not known or set(got) != set(keys):
            raise ValueError(f"expected the parts {keys}, got {got if known else type(observation).__name__}")
    return [leaf.read(observation) for leaf in leaves]


def checked_mask(mask: Any, n_entries: int) -> npt.NDArray[np.int8]:
    """Return an action mask as int8, (n_entries,); the ValueError for any other form says what was expected."""
    array = _as_array(mask)
    if array.shape != (n_entries,) or array.dtype.kind not in "biuf" or not ((array == 0) | (array == 1)).all():
        raise ValueError(f"expected an action mask of {n_entries} zeros and ones (one per action), got {mask!r}")
    return array.astype(np.int8)


@dataclass(frozen=True)
class AgentConversion:
    """
    The conversion of one agent.

    :param leaves: arrays of its observation in the game, in the order in which rows have them
    :param is_flat: whether rows have them as one vector
    :param starts: their first entries in that vector, with zeros between them; empty if one follows the other
    :param shape: shape of a row's own observation; smaller ones are padded with zeros at the end of each axis
    :param channels_last: whether the game's pictures have channels last, and rows have them first
    :param mask_key: key of the mask in observations of the game that have one
    :param needs_mask: whether the game itself gives the agent action masks
    """

    leaves: tuple[Leaf, ...]
    is_flat: bool
    shape: tuple[int, ...]
    dtype: str
    action: Leaf
    row_action: Leaf
    channels_last: bool = False
    mask_key: str | None = None
    needs_mask: bool = False
    starts: tuple[int, ...] = ()

    @classmethod
    def of(
        cls,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        own: spaces.Space[Any],
        row_actions: spaces.Space[Any],
        mask_key: str | None = None,
        needs_mask: bool = False,
        slots: Mapping[tuple[Key, ...], range] | None = None,
    ) -> AgentConversion:
        """
        Describe the conversion between spaces of the game and of rows; ``observation_space`` is without masks.

        :param own: space of a row's own observation
        :param row_actions: action space of rows
        :param slots: where rows that are vectors have the parts of observations, by path; None for the game's form
        """
        from gymnasium import spaces

        leaves, shape = tuple(leaves_of(observation_space)), tuple(own.shape or ())
        starts = () if slots is None else tuple(slots[leaf.path].start for leaf in leaves)
        sizes = [spaces.flatdim(part) for _, part in innermost(observation_space)]
        return cls(
            leaves,
            slots is not None,
            shape,
            str(own.dtype),
            Leaf.of(action_space),
            Leaf.of(row_actions),
            mask_key=mask_key,
            needs_mask=needs_mask,
            starts=() if starts == (0, *accumulate(sizes[:-1])) else starts,
        )

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> AgentConversion:
        """Return a conversion from what JSON gives back of ``dataclasses.asdict``."""
        entries = tupled(plain)
        leaves = {key: Leaf(**entries[key]) for key in ("action", "row_action")}
        return cls(**{**entries, **leaves, "leaves": tuple(Leaf(**leaf) for leaf in entries["leaves"])})

    def with_channels_first(self) -> AgentConversion:
        """Return the conversion for rows whose pictures have channels first, (H, W, C) -> (C, H, W)."""
        height, width, channels = self.shape
        return replace(self, shape=(channels, height, width), channels_last=True)

    def split(self, observation: Any) -> tuple[Any, Any]:
        """Return an observation of the game without its mask, and the mask; None if it has none."""
        if type(observation) is np.ndarray:
            return observation, None
        key = ACTION_MASK if self.mask_key is None else self.mask_key
        if (
            not isinstance(observation, Mapping)
            or key not in observation
            or any(key in x.path[:1] for x in self.leaves)
        ):
            return observation, None
        own = {name: value for name, value in observation.items() if name != key}
        is_alone = len(own) == 1 and not any(leaf.path[:1] == tuple(own) for leaf in self.leaves)
        return next(iter(own.values())) if is_alone else own, observation[key]

    def own(self, observation: Any) -> Array:
        """
        Convert an observation of the game, without mask, to that of a row.

        :raises ValueError: if it does not have the form of the game's space
        """
        arrays = read_leaves(self.leaves, observation)
        if self.is_flat:
            parts = [leaf.flat(one) for leaf, one in zip(self.leaves, arrays, strict=True)]
            array = np.concatenate(parts)
            if self.starts:
                array = np.zeros(self.shape, array.dtype)
                for start, part in zip(self.starts, parts, strict=True):
                    array[start : start + len(part)] = part
        else:
            array = np.moveaxis(arrays[0], -1, 0) if self.channels_last else arrays[0]
        if array.shape != self.shape:
            array = padded(array, self.shape)
        if array.dtype == self.dtype:
            return array
        with np.errstate(over="ignore"):
            return array.astype(self.dtype)

    def mask(self, mask: Any) -> Array:
        """
        Convert an action mask of the game to that of a row: choices and entries that the agent lacks are illegal.

        :param mask: (A of the agent,); None where the game gives none: all its actions are legal
        :return: (A of a row,) int8
        :raises ValueError: for a mask of another form, and for none where the game gives one
        """
        own, row_choices = self.action.choices, self.row_action.choices
        if mask is not None and own != row_choices and np.shape(mask) == (sum(row_choices),):
            given, mask = checked_mask(mask, sum(row_choices)), np.ones(sum(own), np.int8)  # that of a row already
            return given & self.mask(mask)
        array = np.ones(sum(own), np.int8) if mask is None and not self.needs_mask else checked_mask(mask, sum(own))
        if own == row_choices:
            return array
        parts = [*np.split(array, np.cumsum(own)[:-1]), *[np.ones(1, np.int8)] * (len(row_choices) - len(own))]
        return np.concatenate([padded(part, (n,)) for part, n in zip(parts, row_choices, strict=True)])

    @cached_property
    def keeps_actions(self) -> bool:
        """Whether actions of rows are those of the game."""
        return self.action.start is None and replace(self.action, space="") == replace(self.row_action, space="")

    def game_action(self, action: Any) -> Any:
        """
        Convert a row's action to that of the game.

        :raises ValueError: for choices that the agent lacks
        """
        leaf, array = self.action, np.asarray(action).reshape(-1)[: prod(self.action.shape)]
        if not leaf.choices:
            array = np.clip(np.rint(array) if np.dtype(leaf.dtype).kind in "iu" else array, leaf.low, leaf.high)
        elif ((array < 0) | (array >= np.array(leaf.choices))).any():
            raise ValueError(
                f"expected an action of {leaf.space}, got {array.tolist()}, which is masked; use a policy that takes "
                "legal actions only (those of sb3_saf do, with action_masks='auto' of make_team_env)"
            )
        array = array.reshape(leaf.shape) if leaf.start is None else array.reshape(leaf.shape) + leaf.start
        return array.astype(leaf.dtype)[()]

    def row_action_of(self, action: Any) -> Array:
        """Convert an action of the game to that of a row; the inverse of :meth:`game_action`."""
        leaf, shape = self.action, self.row_action.shape
        array = np.asarray(action).reshape(leaf.shape) - (0 if leaf.start is None else np.asarray(leaf.start))
        return padded(array.reshape(-1), (prod(shape),)).reshape(shape)

    @property
    def action_bounds(self) -> tuple[Array, Array]:
        """Return the lowest and highest values of the agent's Box actions, as in rows; 0 for entries that it lacks."""
        size, shape = prod(self.action.shape), self.row_action.shape
        own = (np.resize(bound, size) for bound in (self.action.low, self.action.high))
        low, high = (padded(bound, (prod(shape),), self.row_action.dtype).reshape(shape) for bound in own)
        return low, high

    def fits(self, observation: Any) -> bool:
        """Return whether an observation has the form of the agent's in the game, with or without mask."""
        own, mask = self.split(observation)
        try:
            self.own(own)
            if mask is not None:
                checked_mask(mask, sum(self.action.choices))
        except ValueError:
            return False
        return True


def padded(array: Any, shape: tuple[int, ...], dtype: npt.DTypeLike | None = None, fill: float = 0) -> Array:
    """Add ``fill`` at the end of each axis; None: the array's own dtype."""
    row = np.full(shape, fill, dtype=array.dtype if dtype is None else dtype)
    row[tuple(slice(size) for size in np.shape(array))] = array
    return row


def tupled(value: Any) -> Any:
    """Return nested containers with tuples in place of lists."""
    if isinstance(value, Mapping):
        return {key: tupled(item) for key, item in value.items()}
    return tuple(tupled(item) for item in value) if isinstance(value, list) else value


class RowForm(NamedTuple):
    """
    What is known of rows.

    :param names: of the agents in index order, if they are known
    :param conversions: of the agents, in index order; None if rows are the game's
    :param own_shape: shape of one agent's own observation
    :param has_masks: whether rows have action masks
    :param keys: of rows, which are no agents
    """

    n_agents: int
    names: Sequence[Any] | None
    conversions: Sequence[AgentConversion] | None
    own_shape: tuple[int, ...]
    has_masks: bool
    keys: frozenset[str] = frozenset()


def check_form_of_state(by_agent: bool, state: Any, episode_start: Any) -> None:
    """Raise ValueError if what is by agent is not what observations are; starts of agents may be an array, too."""
    is_other = state is not None and isinstance(state, Mapping) != by_agent
    if is_other or (isinstance(episode_start, Mapping) and not by_agent):
        raise ValueError(
            "expected state and episode_start in the form of observations, all of them by agent or none, got only some"
        )


class Given(NamedTuple):
    """
    What a game gives some agents, as rows.

    :param rows: entries of the rows
    :param action_masks: (B, M), masks of policies of MaskablePPO whose rows have none
    :param conversions: of the rows' agents; None if rows are the game's
    :param agents: their names; None for one agent without name
    """

    rows: dict[str, Array]
    action_masks: Array | None
    conversions: Sequence[AgentConversion] | None
    agents: list[Any] | None

    def row_actions(self, action: Any) -> Array:
        """Convert an action of the game, by agent if the observations are, to those of rows."""
        actions = [action]
        if self.agents is not None:
            if not isinstance(action, Mapping) or set(action) != set(self.agents):
                raise ValueError(
                    f"expected {{agent: action}} of {self.agents}, the observed agents, got {action!r:.90}"
                )
            actions = [action[agent] for agent in self.agents]
        if self.conversions is not None:
            actions = [one.row_action_of(own) for one, own in zip(self.conversions, actions, strict=True)]
        return np.stack([np.asarray(own) for own in actions])

    def memory(self, state: Any, episode_start: Any = None) -> tuple[Any, Any]:
        """
        Return the memory of rows, and which rows begin, (B,), from those by agent if the observations are.

        :raises ValueError: if they have another form than the observations, or do not tell of an observed agent
        """
        agents = self.agents
        check_form_of_state(agents is not None, state, episode_start)
        if agents is None:
            return state, episode_start
        if isinstance(episode_start, Mapping):
            if missing := [agent for agent in agents if agent not in episode_start]:
                raise ValueError(f"expected episode_start of each observed agent, got none of {missing}")
            episode_start = [bool(episode_start[agent]) for agent in agents]
        if np.size(episode_start) not in (1, len(agents)):
            raise ValueError(f"expected episode_start of {len(agents)} agents, got {np.size(episode_start)}")
        if not state:
            return None, episode_start
        blank = tuple(np.zeros_like(part) for part in next(iter(state.values())))
        memory = tuple(np.stack(part) for part in zip(*(state.get(agent, blank) for agent in agents), strict=True))
        starts = np.array([agent not in state for agent in agents])
        return memory, starts if episode_start is None else starts | np.reshape(episode_start, -1).astype(bool)

    def act(
        self, predict: Callable[..., tuple[Any, Any]], state: Any, episode_start: Any, deterministic: bool
    ) -> tuple[Any, Any]:
        """
        Act in the game; of observations by agent, actions and state are by agent, too.

        :param predict: acts on rows, as SB3's ``predict``, whose arguments the others are
        """
        agents = self.agents
        memory, starts = self.memory(state, episode_start)
        masks = {} if self.action_masks is None else {"action_masks": self.action_masks}
        actions, after = predict(self.rows, memory, starts, deterministic, **masks)
        of_game = list(actions)
        if self.conversions is not None:
            of_game = [one.game_action(action) for one, action in zip(self.conversions, actions, strict=True)]
        if agents is None:
            return of_game[0], after
        if after is not None:
            after = dict(zip(agents, zip(*after, strict=True), strict=True))
        return dict(zip(agents, of_game, strict=True)), after


def mask_in(info: Mapping[str, Any] | None) -> Any:
    """Return the action mask in an agent's info, None if there is none."""
    return next((info[name] for name in MASK_NAMES if info.get(name) is not None), None) if info else None


def given_by_game(
    team: RowForm, observation: Any, action_masks: Any, takes_masks: bool, agent: int | None = None
) -> Given | None:
    """
    Convert what a game gives to rows; see :meth:`sb3_saf.policies.rows.TeamRowsPolicy.predict`.

    :param observation: rows, or observations of the game
    :param action_masks: masks in the form of the observation, or one for all agents, beside those in observations and
        infos: all must allow an action
    :param agent: index of the agent whose observation it is, if that is known
    :return: None for rows
    :raises ValueError: for unknown agents, and observations and masks that are not of the game's form
    """
    if action_masks is not None and not takes_masks:
        raise ValueError("this policy was trained without masks of actions: leave them out")
    infos: Mapping[Any, Any] = {}
    if isinstance(observation, tuple) and len(observation) == 2 and all(isinstance(x, Mapping) for x in observation):
        observation, infos = observation
    names, conversions = team.names, team.conversions
    agents = _agents_in(team, observation)
    if agents is not None:
        indices = list(range(len(agents))) if names is None else [names.index(name) for name in agents]
        known = indices if names is not None or len(agents) == team.n_agents else None
        kinds = None if conversions is None else [conversions[index] for index in indices]
        # Where the game has masks in observations, infos are not read, as in training.
        masks = [
            [mask_in(infos.get(name))] if kinds is None or kinds[number].mask_key is None else []
            for number, name in enumerate(agents)
        ]
        if action_masks is not None:
            if not isinstance(action_masks, Mapping):
                action_masks = dict.fromkeys(agents, action_masks)
            if missing := [name for name in agents if name not in action_masks]:
                raise ValueError(
                    f"expected a mask of each observed agent, None for all of its actions, got none of {missing}"
                )
            masks = [[*of_agent, action_masks[name]] for name, of_agent in zip(agents, masks, strict=True)]
        return _given(team, [observation[name] for name in agents], masks, kinds, known, agents, takes_masks)
    if conversions is None:
        return None
    fitting = [i for i, one in enumerate(conversions) if agent in (None, i) and one.fits(observation)]
    if not fitting:
        return None
    kind = conversions[fitting[0]]
    if any(conversions[index] != kind for index in fitting):
        if isinstance(observation, np.ndarray) and observation.shape == team.own_shape:
            return None
        known_by = fitting if names is None else [names[index] for index in fitting]
        raise ValueError(
            f"expected to know whose observation this is: it may be one of {', '.join(map(repr, known_by))}; name "
            f"the agent: {{{known_by[0]!r}: observation}}"
        )
    index = fitting if len(fitting) == 1 else None
    return _given(team, [observation], [[action_masks]], [kind], index, None, takes_masks)


def _agents_in(team: RowForm, observation: object) -> list[Any] | None:
    """Return the agents of ``{agent: observation}``; None for any other observation."""
    if not isinstance(observation, Mapping) or not observation:
        return None
    agents, names = list(observation), team.names
    unknown = [] if names is None else [agent for agent in agents if agent not in names]
    if names is not None and not unknown:
        return agents
    has_keys = not team.keys.union(CLASSIC).isdisjoint(observation)
    if has_keys or any(one.fits(observation) for one in team.conversions or ()):
        return None
    if names is None:
        if len(agents) > team.n_agents:
            raise ValueError(f"expected observations of at most {team.n_agents} agents, got {len(agents)}")
        return agents
    raise ValueError(
        f"expected observations of {', '.join(map(repr, names))}, the agents of the training environment, or one with "
        f"all parts of an agent's, got {unknown[0]!r}"
    )


def _given(
    team: RowForm,
    entries: list[Any],
    masks: list[list[Any]],
    conversions: Sequence[AgentConversion] | None,
    indices: list[int] | None,
    agents: list[Any] | None,
    takes_masks: bool,
) -> Given:
    """Convert observations and masks of some agents; without ``conversions`` they have the form of rows."""
    own: list[Array] = []
    legal: list[Any] = []
    for number, (entry, of_agent) in enumerate(zip(entries, masks, strict=True)):
        try:
            if conversions is None:
                has_mask = isinstance(entry, Mapping) and set(entry) == CLASSIC
                own.append(np.asarray(entry["observation"] if has_mask else entry))
                of_agent = [*of_agent, entry[ACTION_MASK] if has_mask else None]
                given = [np.asarray(mask) for mask in of_agent if mask is not None]
            else:
                conversion = conversions[number]
                observation, mask_of_entry = conversion.split(entry)
                own.append(conversion.own(observation))
                if mask_of_entry is not None and conversion.mask_key is None and not takes_masks:
                    raise ValueError(f"expected no {ACTION_MASK!r}, because this policy was trained without masks")
                given = [
                    conversion.mask(mask) for mask in (*of_agent, mask_of_entry) if takes_masks and mask is not None
                ]
                if team.has_masks and not given:
                    given = [conversion.mask(None)]
            legal.append(np.minimum.reduce(given) if given else None)
        except ValueError as error:
            raise ValueError(f"observation of {'the agent' if agents is None else agents[number]}: {error}") from None
    if len(shapes := {array.shape for array in own}) > 1:
        raise ValueError(f"expected observations of one shape, that of rows, {team.own_shape}, got {sorted(shapes)}")
    rows = {OBS: np.stack(own)} | ({} if indices is None else {AGENT: np.array(indices)})
    action_masks = None
    if takes_masks and (first := next((mask for mask in legal if mask is not None), None)) is not None:
        for number, mask in enumerate(legal):
            if mask is None:  # the agent has all of its actions
                legal[number] = np.ones_like(first) if conversions is None else conversions[number].mask(None)
        action_masks = np.stack(legal)
    if action_masks is not None and team.has_masks:
        rows, action_masks = {**rows, ACTION_MASK: action_masks}, None
    return Given(rows, action_masks, conversions, agents)


def pixels_to_codes(pictures: Array, atlas: Array) -> Array:
    """
    Convert pictures to tile codes, exactly.

    With them an agent trained on tile codes can act on the game's pixels. Of several codes with equal pixels the first
    is returned; for networks that read the pixels of codes these are equivalent.

    :param pictures: (..., rows * t, columns * t, C) uint8, or channels first
    :param atlas: (n_codes, t, t, C) uint8 pixels of every code
    :return: (..., rows, columns) int64
    :raises ValueError: if a picture has a tile that the atlas lacks
    """
    pictures, (n_codes, tile, _, channels) = np.asarray(pictures), atlas.shape
    if pictures.ndim >= 3 and pictures.shape[-1] != channels and pictures.shape[-3] == channels:
        pictures = np.moveaxis(pictures, -3, -1)
    if pictures.ndim < 3 or pictures.dtype != np.uint8 or pictures.shape[-1] != channels:
        raise ValueError(f"expected uint8 pictures of {channels} channels, got {pictures.dtype} of {pictures.shape}")
    *batch, height, width, _ = pictures.shape
    if height % tile or width % tile:
        raise ValueError(f"expected pictures of whole tiles of {tile} pixels, got {height} x {width}")
    cut = pictures.reshape(*batch, height // tile, tile, width // tile, tile, channels).swapaxes(-4, -3)
    known: dict[bytes, int] = {}
    for code in range(n_codes):
        known.setdefault(atlas[code].tobytes(), code)
    tiles = np.ascontiguousarray(cut).reshape(-1, tile * tile * channels)
    codes = [known.get(pixels.tobytes(), -1) for pixels in tiles]
    if -1 in codes:
        column, row = codes.index(-1) % (width // tile), codes.index(-1) // (width // tile) % (height // tile)
        raise ValueError(
            f"the tile in row {row}, column {column} is none of the {n_codes} tiles that this agent was trained on; "
            "give it pictures of the same game, drawn with the same colours and tile size"
        )
    return np.array(codes, dtype=np.int64).reshape(*batch, height // tile, width // tile)
