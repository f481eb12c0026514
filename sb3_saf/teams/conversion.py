"""
One agent's observations, action masks and actions: from the form of the game to that of rows, and back.

A conversion is plain data, known when the environment is made. It travels in the observation space
(:class:`~sb3_saf.teams.rows.AgentSpace`), hence with every saved model, so that a model acts on what the game itself
gives, and with every exported actor. To use one needs NumPy only.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import prod
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from gymnasium import spaces

Array: TypeAlias = npt.NDArray[Any]
Key: TypeAlias = str | int

_ACTION_MASK = "action_mask"


@dataclass(frozen=True)
class Leaf:
    """
    One array of a game's observation, or its action.

    :param kind: kind of space
    :param shape: shape in the game
    :param dtype: NumPy's name of the type in the game
    :param path: keys and indices that lead to it through Dicts and Tuples
    :param choices: numbers of choices of all entries of Discrete and MultiDiscrete, 2 for MultiBinary; else empty
    :param start: lowest values of all entries of Discrete and MultiDiscrete, else empty
    """

    kind: Literal["box", "discrete", "multi_discrete", "multi_binary"]
    shape: tuple[int, ...]
    dtype: str
    path: tuple[Key, ...] = ()
    choices: tuple[int, ...] = ()
    start: tuple[int, ...] = ()

    @classmethod
    def of(cls, space: spaces.Space[Any], path: tuple[Key, ...] = ()) -> Leaf:
        """Describe a space of fixed shape."""
        from gymnasium import spaces

        shape, dtype = tuple(space.shape or ()), str(space.dtype)
        if isinstance(space, spaces.Discrete):
            return cls("discrete", shape, dtype, path, (int(space.n),), (int(space.start),))
        if isinstance(space, spaces.MultiDiscrete):
            choices, start = (tuple(values.reshape(-1).tolist()) for values in (space.nvec, space.start))
            return cls("multi_discrete", shape, dtype, path, choices, start)
        if isinstance(space, spaces.MultiBinary):
            return cls("multi_binary", shape, dtype, path, (2,) * prod(shape))
        assert isinstance(space, spaces.Box), space
        return cls("box", shape, dtype, path)

    def read(self, observation: Any) -> Array:
        """
        Return the array, counted from 0, from an observation.

        :param observation: as the game gives it
        :raises ValueError: if it is missing, or of another shape or type
        """
        where = "".join(f"[{key!r}]" for key in self.path)
        for key in self.path:
            try:
                observation = observation[key]
            except (KeyError, IndexError, TypeError):
                got = list(observation) if isinstance(observation, Mapping) else type(observation).__name__
                raise ValueError(f"expected observation{where}, got {got}") from None
        array = np.asarray(observation)
        if array.shape != self.shape or not np.can_cast(array.dtype, self.dtype, "same_kind"):
            raise ValueError(
                f"expected observation{where} of shape {self.shape} and dtype {self.dtype}, got {array.shape} and "
                f"{array.dtype}"
            )
        array = array.astype(self.dtype, copy=False)
        if not self.start:
            return array
        array = array - np.array(self.start, dtype=array.dtype).reshape(self.shape)
        if ((array < 0) | (array >= np.array(self.choices).reshape(self.shape))).any():
            raise ValueError(
                f"expected observation{where} from {list(self.start)} with {list(self.choices)} choices, got "
                f"{np.asarray(observation).tolist()}"
            )
        return array

    def flat(self, array: Array) -> Array:
        """Return an array of :meth:`read` as a vector, as ``gymnasium.spaces.flatten``: choices are one-hot."""
        if not self.start:
            return array.reshape(-1)
        codes = [np.eye(n)[int(choice)] for n, choice in zip(self.choices, array.reshape(-1), strict=True)]
        return np.concatenate(codes)


@dataclass(frozen=True)
class AgentConversion:
    """
    The conversion of one agent.

    :param leaves: arrays of its observation in the game, in the order in which rows have them
    :param is_flat: whether rows have them as one vector
    :param shape: shape of a row's own observation; smaller ones are padded with zeros at the end of each axis
    :param dtype: its type
    :param channels_last: whether the game's pictures have channels last, and rows have them first
    :param action: the agent's action in the game
    :param row_choices: numbers of choices of all entries of a row's action; empty for Boxes
    :param low: lowest values of all entries of a Box action in the game, else empty
    :param high: highest values
    :param mask_key: key of the mask in observations of the game that have one
    :param needs_mask: whether the game itself gives the agent action masks
    """

    leaves: tuple[Leaf, ...]
    is_flat: bool
    shape: tuple[int, ...]
    dtype: str
    action: Leaf
    row_choices: tuple[int, ...] = ()
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    channels_last: bool = False
    mask_key: str | None = None
    needs_mask: bool = False

    @classmethod
    def of(
        cls,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        own: spaces.Space[Any],
        row_actions: spaces.Space[Any],
        mask_key: str | None = None,
        needs_mask: bool = False,
    ) -> AgentConversion:
        """
        Describe the conversion between spaces.

        :param observation_space: of the agent in the game, without masks
        :param action_space: of the agent in the game
        :param own: space of a row's own observation
        :param row_actions: action space of rows
        :param mask_key: key of the mask in observations of the game that have one
        :param needs_mask: whether the game itself gives the agent action masks
        """
        from gymnasium import spaces

        shape, action = tuple(own.shape or ()), Leaf.of(action_space)
        is_own_form = isinstance(observation_space, type(own)) and len(observation_space.shape or ()) == len(shape)
        low, high = (), ()
        if isinstance(action_space, spaces.Box):
            low, high = (tuple(bound.reshape(-1).tolist()) for bound in (action_space.low, action_space.high))
        return cls(
            tuple(_leaves(observation_space)),
            isinstance(own, spaces.Box) and not is_own_form,
            shape,
            str(own.dtype),
            action,
            Leaf.of(row_actions).choices,
            low,
            high,
            mask_key=mask_key,
            needs_mask=needs_mask,
        )

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> AgentConversion:
        """Return a conversion from what JSON gives back of ``dataclasses.asdict``."""
        entries = _with_tuples(plain)
        leaves = tuple(Leaf(**leaf) for leaf in entries["leaves"])
        return cls(**{**entries, "leaves": leaves, "action": Leaf(**entries["action"])})

    def with_channels_first(self) -> AgentConversion:
        """Return the conversion for rows whose pictures have channels first, (H, W, C) -> (C, H, W)."""
        height, width, channels = self.shape
        return replace(self, shape=(channels, height, width), channels_last=True)

    def split(self, observation: Any) -> tuple[Any, Any]:
        """Return an observation of the game without its mask, and the mask; None if it has none."""
        key = _ACTION_MASK if self.mask_key is None else self.mask_key
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
        keys = list(dict.fromkeys(leaf.path[0] for leaf in self.leaves if leaf.path))
        if keys and isinstance(observation, Mapping) and set(observation) != set(keys):
            raise ValueError(f"expected an observation with the parts {keys}, got {list(observation)}")
        arrays = [leaf.read(observation) for leaf in self.leaves]
        if self.is_flat:
            array = np.concatenate([leaf.flat(one) for leaf, one in zip(self.leaves, arrays, strict=True)])
        else:
            array = np.moveaxis(arrays[0], -1, 0) if self.channels_last else arrays[0]
        if array.shape == self.shape:
            return array.astype(self.dtype, copy=False)
        row = np.zeros(self.shape, dtype=self.dtype)
        row[tuple(slice(size) for size in array.shape)] = array
        return row

    def mask(self, mask: Any) -> Array:
        """
        Convert an action mask of the game to that of a row: choices and entries that the agent lacks are illegal.

        :param mask: (A of the agent,); None where the game gives none: all its actions are legal
        :raises ValueError: for a mask of another form, and for none where the game gives one
        """
        own = self.action.choices
        if mask is None and self.needs_mask:
            raise ValueError(f"expected the {_ACTION_MASK!r} of the game, which masks {sum(own)} choices, got none")
        array = np.ones(sum(own), dtype=np.int8) if mask is None else np.asarray(mask)
        if array.shape == (sum(self.row_choices),) and own != self.row_choices:
            return array.astype(np.int8)  # that of a row already
        if array.shape != (sum(own),) or not ((array == 0) | (array == 1)).all():
            raise ValueError(f"expected {_ACTION_MASK!r} with {sum(own)} zeros and ones, got {mask!r}")
        row = np.zeros((len(self.row_choices), max(self.row_choices)), dtype=np.int8)
        row[len(own) :, 0] = 1  # entries that the agent lacks
        for entry, part in enumerate(np.split(array, np.cumsum(own)[:-1])):
            row[entry, : len(part)] = part
        return np.concatenate([entry[:n] for entry, n in zip(row, self.row_choices, strict=True)])

    def game_action(self, action: Any) -> Any:
        """
        Convert a row's action to that of the game.

        :param action: of a row
        :raises ValueError: for choices that the agent lacks
        """
        leaf, array = self.action, np.asarray(action).reshape(-1)[: prod(self.action.shape)]
        if leaf.kind == "box":
            array = np.clip(array, self.low, self.high)
        elif (array >= np.array(leaf.choices)).any():
            raise ValueError(
                f"expected an action with {list(leaf.choices)} choices, got {array.tolist()}, which is masked; use a "
                "policy that takes legal actions only (those of sb3_saf do, with action_masks='auto' of make_team_env)"
            )
        if leaf.start:
            array = array + np.array(leaf.start)
        array = array.astype(leaf.dtype).reshape(leaf.shape)
        return array if leaf.shape else array[()]

    def fits(self, observation: Any) -> bool:
        """Return whether an observation has the form of the agent's in the game, with or without mask."""
        try:
            self.own(self.split(observation)[0])
        except ValueError:
            return False
        return True


def conversions_of(
    env: Any,
    own: spaces.Space[Any],
    row_actions: spaces.Space[Any],
    needs_mask: bool,
    mask_keys: Mapping[Any, str | None],
) -> tuple[AgentConversion, ...]:
    """
    Return the conversions of a game's agents, in the order of ``possible_agents``.

    :param env: the game, a ParallelEnv
    :param own: space of a row's own observation
    :param row_actions: action space of rows
    :param needs_mask: whether the game gives action masks in its infos
    :param mask_keys: key of the masks in an agent's observations, if they have masks
    """
    conversions = []
    for agent in env.possible_agents:
        observed, key = env.observation_space(agent), mask_keys.get(agent)
        if key is not None:
            others = {name: space for name, space in observed.spaces.items() if name != key}
            observed = next(iter(others.values())) if len(others) == 1 else type(observed)(list(others.items()))
        action_space = env.action_space(agent)
        conversions.append(AgentConversion.of(observed, action_space, own, row_actions, key, needs_mask or bool(key)))
    return tuple(conversions)


def _with_tuples(value: Any) -> Any:
    """Return nested containers with tuples in place of lists."""
    if isinstance(value, Mapping):
        return {key: _with_tuples(item) for key, item in value.items()}
    return tuple(_with_tuples(item) for item in value) if isinstance(value, list) else value


def _leaves(space: spaces.Space[Any], path: tuple[Key, ...] = ()) -> Iterator[Leaf]:
    """Yield the innermost spaces of nested Dicts and Tuples, in the order of ``gymnasium.spaces.flatten``."""
    from gymnasium import spaces

    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        parts = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        for key, part in parts:
            yield from _leaves(part, (*path, key))
    else:
        yield Leaf.of(space, path)


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
