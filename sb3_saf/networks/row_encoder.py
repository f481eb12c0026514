"""
Encode own observations: each different one of a batch once, and those of whole teams in one go with the rows' own.

Letters: B rows, K unique own observations, G teams, N agents, d features; ``*shape`` is that of one own observation.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch as th

from sb3_saf.networks.gather import gather
from sb3_saf.networks.unique import every_row, unique_rows


class EncodedRows(NamedTuple):
    """
    Encoded own observations of rows.

    :param observations: (K, *shape) unique own observations
    :param features: (K, d) their features
    :param inverse: (B,) which of them each row has
    """

    observations: th.Tensor
    features: th.Tensor
    inverse: th.Tensor

    def of_rows(self) -> th.Tensor:
        """Return the features of all rows, (B, d)."""
        return gather(self.features, self.inverse)

    def at(self, rows: th.Tensor) -> EncodedRows:
        """
        Select rows.

        :param rows: (B',) int64
        """
        return self._replace(inverse=self.inverse[rows])


class EncodedTeams(NamedTuple):
    """
    Encoded own observations of whole teams, as critics read them.

    :param features: (K, d) features of unique own observations
    :param members: (G, N) which of them each agent of a team has
    :param rows: (B,) where the agent of each row is among the G N agents, team by team; None if rows are these agents
    :param active: (G, N) bool, agents that take part; None if all do
    """

    features: th.Tensor
    members: th.Tensor
    rows: th.Tensor | None = None
    active: th.Tensor | None = None

    def of_rows(self, of_agents: th.Tensor) -> th.Tensor:
        """
        Select what rows need of all agents.

        :param of_agents: (G, N, ...)
        :return: (B, ...)
        """
        flat = of_agents.flatten(0, 1)
        return flat if self.rows is None else gather(flat, self.rows)


class RowEncoder:
    """
    Encodes the own observations of a batch.

    :param encode: (K, *shape) observations to (K, d) features
    :param once: whether equal observations are encoded once; False encodes every row, which gives the same numbers
    """

    def __init__(self, encode: Callable[[th.Tensor], th.Tensor], once: bool = True):
        self.encode = encode
        self.find = unique_rows if once else every_row

    def rows(self, observations: th.Tensor) -> EncodedRows:
        """
        Encode own observations. Nothing but they decide the result, to the last bit.

        :param observations: (B, *shape)
        """
        found = self.find(observations)
        unique = observations[found.index]
        return EncodedRows(unique, self.encode(unique), found.inverse)

    def joint_rows(
        self, observations: th.Tensor, agent: th.Tensor, own: EncodedRows, active: th.Tensor | None = None
    ) -> EncodedTeams:
        """
        Encode the teams of rows in any order, each different team once; what rows see themselves is encoded already.

        :param observations: (B, N, *shape) joint observations
        :param agent: (B,) whose rows they are
        :param own: own observations of the rows
        :param active: (B, N) bool, agents that take part; teams that differ in it are different
        """
        found = self.find(observations)
        if active is not None:
            found = self.find(th.cat([found.inverse.unsqueeze(1), active.long()], dim=1))
        joint, n_known = observations[found.index], len(own.features)
        # The known ones come first and differ from each other: they keep their numbers.
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
        :param own: own observations of B rows
        :param agent: (B,) the rows' agents where the head depends on them, else None
        :return: (B, ...)
        """
        if agent is None:
            return gather(module(own.features, None), own.inverse)
        pairs = self.find(th.stack([own.inverse, agent], dim=1))
        of_pairs = module(gather(own.features, own.inverse[pairs.index]), agent[pairs.index])
        return gather(of_pairs, pairs.inverse)
