"""Minibatches of whole teams: what a policy may know of the rows that TeamRolloutBuffer gives it."""

from __future__ import annotations

from collections.abc import ItemsView
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th

from sb3_saf.envs.teams import TEAM_KEY
from sb3_saf.networks.value_normalizer import Rescaling, ValueNormalizer


class RolloutReturns:
    """
    The returns of one rollout, for policies that normalise values.

    :param returns: all returns that are trained on
    """

    def __init__(self, returns: npt.NDArray[np.floating]) -> None:
        self._returns = returns
        self._rescaling: Rescaling | None = None

    def rescaling(self, normalizer: ValueNormalizer) -> Rescaling:
        """
        Return how values change with this rollout; the first call takes the returns into the statistics.

        :param normalizer: of the policy that is trained
        """
        if self._rescaling is None:
            self._rescaling = normalizer.update(self._returns)
        return self._rescaling


class WholeTeams(NamedTuple):
    """
    The teams that the rows of a minibatch belong to.

    :param observations: (G, N, *shape) own observations, agents in index order
    :param rows: (B,) where the agent of each row is among the G N agents; None if rows are these agents in order
    :param active: (G, N) bool, agents that take part; None if all do
    """

    observations: th.Tensor
    rows: th.Tensor | None = None
    active: th.Tensor | None = None


class TeamMinibatch(dict[str, th.Tensor]):
    """
    Observations of the rows of whole teams.

    It is the dict that SB3's buffer gives, but that ``"team"``, N times as large as the rest, is made when it is asked
    for: policies that know this class read :attr:`teams`.

    :param teams: the teams
    :param entries: all other entries of the rows' observations, ``"obs"`` among them
    :param returns: of the rollout that the rows are from
    :param old_values: (B,) of the rows, in memory of their own
    """

    def __init__(
        self, teams: WholeTeams, entries: dict[str, th.Tensor], returns: RolloutReturns, old_values: th.Tensor
    ) -> None:
        super().__init__(entries)
        self.teams = teams
        self._returns = returns
        self._old_values: th.Tensor | None = old_values

    def update_statistics(self, normalizer: ValueNormalizer) -> None:
        """
        Take the rollout's returns into the statistics, and state the minibatch's old values under them: they are then
        what the unchanged critic says, and PPO's ``clip_range_vf`` starts from no difference. Once per minibatch.

        :param normalizer: of the policy that is trained
        """
        scale, shift = self._returns.rescaling(normalizer)
        if self._old_values is not None:
            self._old_values.mul_(scale).add_(shift)
            self._old_values = None

    def __missing__(self, key: str) -> th.Tensor:
        """Make ``"team"``, (B, N, *shape)."""
        if key != TEAM_KEY:
            raise KeyError(key)
        observations, rows, _ = self.teams
        n_teams, n_agents = observations.shape[:2]
        teams = th.arange(n_teams * n_agents, device=observations.device) if rows is None else rows
        self[TEAM_KEY] = observations[teams // n_agents]
        return self[TEAM_KEY]

    def items(self) -> ItemsView[str, Any]:  # type: ignore[override]
        """Return all entries, ``"team"`` among them: SB3's own policies read every one."""
        self.__missing__(TEAM_KEY)
        return super().items()
