"""
Encode every distinct view once.

Teammates see each other's views in every row of the joint observation, and many steps change few views. So views are
encoded once per distinct view, teams are put together once per distinct team, and rows take what they need from there.

Letters: B rows, K distinct views, G distinct teams, N agents, d features; ``*shape`` is that of one own observation.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch as th

from sb3_saf.networks.gather import gather
from sb3_saf.networks.unique import every_row, unique_rows


class OwnViews(NamedTuple):
    """
    The views that rows have of their own.

    :param observations: (K, *shape) distinct own observations
    :param features: (K, d) their features
    :param rows: (B,) which of them each row has
    """

    observations: th.Tensor
    features: th.Tensor
    rows: th.Tensor


class TeamViews(NamedTuple):
    """
    The views of the teams that rows belong to.

    :param features: (K, d) features of distinct views
    :param teams: (G, N) which view each agent of each distinct team has
    :param rows: (B,) which team each row belongs to
    :param active: (G, N) bool, agents of each distinct team that take part; None if all do
    """

    features: th.Tensor
    teams: th.Tensor
    rows: th.Tensor
    active: th.Tensor | None = None


class ViewEncoder:
    """
    Encodes the views of a batch, each distinct one once.

    :param encode: (K, *shape) observations to (K, d) features
    :param encode_once: False takes every row for a distinct one, which gives the same numbers slowly
    """

    def __init__(self, encode: Callable[[th.Tensor], th.Tensor], encode_once: bool = True):
        self.encode = encode
        self.find = unique_rows if encode_once else every_row

    def own(self, observations: th.Tensor) -> OwnViews:
        """
        Encode own observations. Nothing but they decide the result, to the last bit.

        :param observations: (B, *shape)
        """
        found = self.find(observations)
        views = observations[found.index]
        return OwnViews(views, self.encode(views), found.inverse)

    def teams(
        self, observations: th.Tensor, known: OwnViews | None = None, active: th.Tensor | None = None
    ) -> TeamViews:
        """
        Encode teams, taking over the features of views that are already known.

        :param observations: (B, N, *shape) joint observations
        :param known: own views of the same forward pass, if they were encoded before
        :param active: (B, N) bool, agents that take part; teams that differ in it are distinct
        """
        found = self.find(observations)
        if active is not None:
            found = self.find(th.cat([found.inverse.unsqueeze(1), active.long()], dim=1))
        joint = observations[found.index]
        members, features, n_known = joint.flatten(0, 1), None, 0
        if known is not None:
            # Known views come first and differ from each other: as distinct views they keep their numbers.
            features, n_known = known.features, len(known.features)
            members = th.cat([known.observations, members])
        views = self.find(members)
        missing = members[views.index[n_known:]]
        if features is None:
            features = self.encode(missing)
        elif len(missing):
            features = th.cat([features, self.encode(missing)])
        teams = views.inverse[n_known:].view(joint.shape[:2])
        return TeamViews(features, teams, found.inverse, None if active is None else active[found.index])

    def per_agent(
        self, module: Callable[[th.Tensor, th.Tensor | None], th.Tensor], views: OwnViews, agent: th.Tensor | None
    ) -> th.Tensor:
        """
        Apply a head to the views of rows, once per distinct view (and agent).

        :param module: (K, d) features and (K,) agents or None, to (K, ...)
        :param views: own views of B rows
        :param agent: (B,) the rows' agents where the head depends on them, else None
        :return: (B, ...)
        """
        if agent is None:
            return gather(module(views.features, None), views.rows)
        pairs = self.find(th.stack([views.rows, agent], dim=1))
        of_pairs = module(gather(views.features, views.rows[pairs.index]), agent[pairs.index])
        return gather(of_pairs, pairs.inverse)
