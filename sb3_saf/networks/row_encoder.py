"""
Encoding of own observations: each unique one of a batch once, and those of whole teams together with the rows' own.

Letters: B rows, K unique own observations, G teams, N agents, d features; ``*shape`` is that of an own observation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import accumulate
from math import prod
from typing import Final, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import torch as th

from hecogrid_envs.core.jit import cached
from sb3_saf.networks.layers import InOrder, Rows, gather

_WORD: Final = 8  # bytes in a machine word


class UniqueRows(NamedTuple):
    """
    The unique rows of a batch, in order of first appearance: ``x[index][inverse]`` equals ``x``.

    :param index: (K,) int64, first position of each unique row; increasing
    :param inverse: (B,) int64, the unique row that each row equals
    """

    index: th.Tensor  # type: ignore[assignment]  # hides tuple.index
    inverse: th.Tensor


def unique_rows(x: th.Tensor) -> UniqueRows:
    """
    Find the unique rows of a batch, compared by their bytes: merged rows are bitwise equal. 0.0 and -0.0 count as
    different, which only costs time.

    :param x: (B, ...) any dtype, on the CPU
    :return: K indices and their inverse
    """
    words = np.require(_bytes_of_rows(x.detach()).numpy(), requirements="A").view(np.uint64)
    index = np.empty(len(words), dtype=np.int64)
    inverse = np.empty(len(words), dtype=np.int64)
    # At most half full, for short probing; a power of two, so that a bit mask replaces the modulo.
    table = np.full(1 << max(2, 2 * len(words) - 1).bit_length(), -1, dtype=np.int32)
    count = _find_unique(words, table, np.empty(len(words), dtype=np.uint64), index, inverse)
    return UniqueRows(th.from_numpy(index[:count].copy()), th.from_numpy(inverse))


class EncodedRows(NamedTuple):
    """
    Encoded own observations of rows.

    :param observations: (K, *shape) unique own observations
    :param features: (K, d) their features
    :param inverse: (B,) index of each row's observation among the unique ones
    """

    observations: th.Tensor
    features: th.Tensor
    inverse: Rows

    @property
    def n_rows(self) -> int:
        """Number of rows B."""
        return self.inverse.shape[0]

    def of_rows(self) -> th.Tensor:
        """Return the features of all rows, (B, d)."""
        return gather(self.features, self.inverse)

    def at(self, rows: th.Tensor) -> EncodedRows:
        """Select rows (B',), int64."""
        return self._replace(inverse=rows if isinstance(self.inverse, InOrder) else self.inverse[rows])

    def arranged(self, shape: tuple[int, ...]) -> Rows:
        """Return the index into ``features`` of each row, arranged in a shape with B entries."""
        return InOrder(shape) if isinstance(self.inverse, InOrder) else self.inverse.view(shape)


class EncodedTeams(NamedTuple):
    """
    Encoded own observations of whole teams, the input of critics.

    :param features: (K, d) features of unique own observations
    :param members: (G, N) index into ``features`` of each agent of a team
    :param rows: (B,) index of each row's agent among the G N agents, team by team; None if rows are these agents
    :param active: (G, N) bool, agents that take part; None if all do
    """

    features: th.Tensor
    members: Rows
    rows: th.Tensor | None = None
    active: th.Tensor | None = None

    def of_rows(self, of_agents: th.Tensor) -> th.Tensor:
        """Select the entries (B, ...) of rows from those of all agents (G, N, ...)."""
        flat = of_agents.flatten(0, 1)
        return flat if self.rows is None else gather(flat, self.rows)


class Encoded(NamedTuple):
    """
    Encoded rows.

    :param own: encoded own observations of the rows
    :param teams: encoded teams of the rows; None if the critic does not read them
    """

    own: EncodedRows
    teams: EncodedTeams | None


def joined(parts: Sequence[Encoded]) -> Encoded:
    """Concatenate encoded rows."""
    own, teams = [part.own for part in parts], [part.teams for part in parts]
    rows = EncodedRows(
        th.cat([part.observations for part in own]),
        th.cat([part.features for part in own]),
        _joined([part.inverse for part in own], [len(part.features) for part in own]),
    )
    return Encoded(rows, None if None in teams else joined_teams([part for part in teams if part is not None]))


def joined_teams(parts: Sequence[EncodedTeams]) -> EncodedTeams:
    """Concatenate encoded teams."""
    if len(parts) == 1:
        return parts[0]
    n_agents = parts[0].members.shape[1]
    n_members = [part.members.shape[0] * n_agents for part in parts]
    every = [
        th.arange(count, device=part.features.device) if part.rows is None else part.rows
        for part, count in zip(parts, n_members, strict=True)
    ]
    active = [part.active for part in parts]
    return EncodedTeams(
        th.cat([part.features for part in parts]),
        _joined([part.members for part in parts], [len(part.features) for part in parts]),
        None if all(part.rows is None for part in parts) else cast(th.Tensor, _joined(every, n_members)),
        None if None in active else th.cat([one for one in active if one is not None]),
    )


def _joined(parts: Sequence[Rows], counts: Sequence[int]) -> Rows:
    """Concatenate indices, shifted by the start of each part."""
    if all(isinstance(part, InOrder) for part in parts):
        return InOrder((sum(part.shape[0] for part in parts), *parts[0].shape[1:]))
    (device,) = {part.device for part in parts if not isinstance(part, InOrder)}
    indices = [  # steps of whole teams, between others
        th.arange(prod(part.shape), device=device).view(part.shape) if isinstance(part, InOrder) else part
        for part in parts
    ]
    return th.cat([part + start for part, start in zip(indices, accumulate(counts, initial=0), strict=False)])


class RowEncoder:
    """
    Encoder of the own observations of a batch.

    :param encode: (K, *shape) observations to (K, d) features
    :param once: whether equal observations are encoded once; False encodes every row, with the same result, and so do
        other devices than the CPU, on which encoding costs less than the search
    """

    def __init__(self, encode: Callable[[th.Tensor], th.Tensor], once: bool = True):
        self.encode = encode
        self.once = once

    def find(self, x: th.Tensor) -> UniqueRows:
        """Find the unique rows of a batch (B, ...), or all where each is encoded."""
        if self.once and x.device.type == "cpu":
            return unique_rows(x)
        rows = th.arange(len(x), device=x.device)
        return UniqueRows(rows, rows)

    def rows(self, observations: th.Tensor) -> EncodedRows:
        """Encode own observations (B, *shape). The result depends on them only, to the last bit."""
        if not self.once or observations.device.type != "cpu":
            return EncodedRows(observations, self.encode(observations), InOrder((len(observations),)))
        found = self.find(observations)
        unique = observations[found.index]
        return EncodedRows(unique, self.encode(unique), found.inverse)

    def joint_rows(
        self, observations: th.Tensor, agent: th.Tensor, own: EncodedRows, active: th.Tensor | None = None
    ) -> EncodedTeams:
        """
        Encode the teams of rows in any order, each unique team once; the rows' own observations are encoded already.

        :param observations: (B, N, *shape) joint observations
        :param agent: (B,) agent of each row
        :param own: encoded own observations of the rows
        :param active: (B, N) bool, agents that take part; unique teams differ in observations or in it
        """
        found = self.find(observations)
        if active is not None:
            found = self.find(th.cat([found.inverse.unsqueeze(1), active.long()], dim=1))
        joint, n_known = observations[found.index], len(own.features)
        # The known ones come first and are unique: they keep their indices.
        candidates = th.cat([own.observations, joint.flatten(0, 1)])
        unique = self.find(candidates)
        missing = candidates[unique.index[n_known:]]
        features = th.cat([own.features, self.encode(missing)]) if len(missing) else own.features
        members = unique.inverse[n_known:].view(joint.shape[:2])
        rows = found.inverse * joint.shape[1] + agent
        return EncodedTeams(features, members, rows, None if active is None else active[found.index])

    def apply(
        self, module: Callable[[th.Tensor, th.Tensor | None], th.Tensor], own: EncodedRows, agent: th.Tensor | None
    ) -> th.Tensor:
        """
        Apply a head to rows, once per unique observation (and agent).

        :param module: (K, d) features and (K,) agents or None, to (K, ...)
        :param own: encoded own observations of B rows
        :param agent: (B,) the rows' agents if the head depends on them, else None
        :return: (B, ...)
        """
        if agent is None:
            return gather(module(own.features, None), own.inverse)
        if isinstance(own.inverse, InOrder):
            return module(own.features, agent)
        pairs = self.find(th.stack([own.inverse, agent], dim=1))
        of_pairs = module(gather(own.features, own.inverse[pairs.index]), agent[pairs.index])
        return gather(of_pairs, pairs.inverse)


# --- unique rows, in one pass with an open-addressing hash table ----------------------------------------------------


def _bytes_of_rows(x: th.Tensor) -> th.Tensor:
    """Return rows (B, ...) of any dtype as bytes (B, bytes), padded with zeros to at least one whole word."""
    n_rows = len(x)
    width = prod(x.shape[1:])
    flat = x.contiguous().view(n_rows, width).view(th.uint8)
    missing = -flat.shape[1] % _WORD if width else _WORD
    if missing:
        return th.nn.functional.pad(flat, (0, missing))
    # Words must be aligned in the storage, which a slice of bytes may not be.
    return flat.clone() if flat.storage_offset() % _WORD else flat


@cached()
def _hash_row(words: npt.NDArray[np.uint64], row: int) -> np.uint64:
    """Multiply and fold: products carry upwards only, so the high half is folded down before the next word."""
    code, multiplier, shift = np.uint64(1), np.uint64(0x9E3779B97F4A7C15), np.uint64(32)
    for i in range(words.shape[1]):
        code = (code ^ words[row, i]) * multiplier
        code ^= code >> shift
    return code


@cached()
def _equal_rows(words: npt.NDArray[np.uint64], row: int, other: int) -> bool:
    i = 0
    while i < words.shape[1] and words[row, i] == words[other, i]:
        i += 1
    return i == words.shape[1]


@cached()
def _find_unique(
    words: npt.NDArray[np.uint64],
    table: npt.NDArray[np.int32],
    hashes: npt.NDArray[np.uint64],
    index: npt.NDArray[np.int64],
    inverse: npt.NDArray[np.int64],
) -> int:
    """Fill ``index`` and ``inverse``; ``table`` holds numbers of unique rows, -1 where free."""
    mask = np.uint64(table.size - 1)
    count = 0
    for row in range(words.shape[0]):
        # Consecutive rows of one team share their joint observation: compare with the previous row before hashing.
        if row > 0 and _equal_rows(words, row - 1, row):
            inverse[row] = inverse[row - 1]
            continue
        code = _hash_row(words, row)
        slot = code & mask
        while True:
            known = table[slot]
            if known < 0:
                table[slot] = count
                hashes[count] = code
                index[count] = row
                inverse[row] = count
                count += 1
                break
            if hashes[known] == code and _equal_rows(words, index[known], row):
                inverse[row] = known
                break
            slot = (slot + np.uint64(1)) & mask
    return count
