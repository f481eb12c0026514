"""Tell teams from opponents by their rewards."""

from __future__ import annotations

import warnings
from typing import Final

import numpy as np

from sb3_saf.envs.teams import Array

#: Game steps after which rewards are judged.
_N_STEPS: Final = 2000
#: Correlation of the rewards of two agents below which they oppose each other.
_OPPOSED: Final = -0.5


class OppositionDetector:
    """
    Warn once if two agents' rewards oppose each other: their correlation over the first game steps is below -0.5.

    Agents share parameters, and QPLEX maximises the sum of their rewards: what was made for one team. Self-play is the
    use that opponents may have of it.

    :param n_agents: N
    """

    def __init__(self, n_agents: int) -> None:
        self._sum = np.zeros(n_agents)
        self._products = np.zeros((n_agents, n_agents))
        self._n_steps = 0

    def see(self, rewards: Array) -> None:
        """
        Take the rewards of a step.

        :param rewards: (E, N)
        """
        if self._n_steps >= _N_STEPS:
            return
        rewards = rewards.astype(np.float64)
        self._sum += rewards.sum(axis=0)
        self._products += rewards.T @ rewards
        self._n_steps += len(rewards)
        if self._n_steps >= _N_STEPS:
            self._judge()

    def _judge(self) -> None:
        means = self._sum / self._n_steps
        covariances = self._products / self._n_steps - np.outer(means, means)
        scales = np.sqrt(np.maximum(np.diag(covariances), 0.0))
        scale = np.outer(scales, scales)
        correlations = np.divide(covariances, scale, out=np.zeros_like(scale), where=scale > 1e-12)
        first, second = np.unravel_index(int(np.argmin(correlations)), correlations.shape)
        if correlations[first, second] < _OPPOSED:
            warnings.warn(
                f"the rewards of agents {first} and {second} oppose each other (correlation "
                f"{correlations[first, second]:.2f} over {self._n_steps} game steps): they are opponents, but all "
                "agents are trained as one team with shared parameters. Where that is meant as self-play, ignore "
                "this warning; else make a team of one side and play the other inside the environment",
                UserWarning,
                stacklevel=4,
            )
