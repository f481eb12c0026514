"""
The base of policies for MaskablePPO: one mask of actions per row, that is, per agent.

sb3-contrib asks the environment: ``venv.env_method("action_masks")`` gives one mask per row.

Letters: B rows, M choices.
"""

from __future__ import annotations

import numpy as np
import torch as th
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_saf.networks.row_encoder import EncodedRows
from sb3_saf.policies.base import TeamPolicy

Masks = np.ndarray | th.Tensor


class TeamMaskablePolicy(TeamPolicy, MaskableActorCriticPolicy):  # type: ignore[misc]  # value_net: ours
    """
    Policy for MaskablePPO on rows of teams; see :class:`TeamPolicy` for the parameters.

    Masks are (B, M): one flag per choice of an action, those of each dimension in turn (of a MultiBinary: off, on).
    The actions of each policy of a pool are masked before they are mixed: likelihood and entropy are exactly those of
    drawing a policy and then one of its allowed actions. A mask that allows nothing leaves the actions equally likely.
    Where observations have masks, too, an action must be allowed by both.
    """

    #: There are no masks for Box actions, so nothing reads it.
    log_std_init: float = 0.0

    def forward(
        self, obs: PyTorchObs, deterministic: bool = False, action_masks: Masks | None = None
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        Act and estimate values.

        :param obs: rows
        :param deterministic: whether to take the most likely actions
        :param action_masks: (B, M); None allows everything
        :return: actions (B, ...), values (B, 1), log-likelihoods (B,)
        """
        encoded = self._encoded(obs)
        distribution = self._masked_distribution(obs, encoded.own, action_masks)
        actions = distribution.get_actions(deterministic=deterministic)
        log_prob = distribution.log_prob(actions)
        return actions.reshape((-1, *(self.action_space.shape or ()))), self._values(obs, encoded), log_prob

    def evaluate_actions(
        self, obs: PyTorchObs, actions: th.Tensor, action_masks: Masks | None = None
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """
        Evaluate given actions.

        :param obs: rows
        :param actions: (B, ...) actions
        :param action_masks: (B, M); None allows everything
        :return: values (B, 1), log-likelihoods (B,), entropies (B,) or None if there is no closed form
        """
        self._check_minibatch(obs)
        encoded = self._encoded(obs)
        distribution = self._masked_distribution(obs, encoded.own, action_masks)
        return self._values(obs, encoded), self._likelihood(distribution, actions), distribution.entropy()

    def get_distribution(  # type: ignore[override]
        self, obs: PyTorchObs, action_masks: Masks | None = None
    ) -> Distribution:
        """
        Action distribution; ``team`` is not read and may be missing.

        :param obs: rows, or own observations alone (B, ...)
        :param action_masks: (B, M); None allows everything
        """
        return self._masked_distribution(obs, self.encode_own(obs), action_masks)

    def _masked_distribution(self, obs: PyTorchObs, own: EncodedRows, action_masks: Masks | None) -> Distribution:
        if action_masks is None:
            return self._distribution(obs, own)
        masks = th.as_tensor(action_masks, dtype=th.bool, device=own.inverse.device)
        return self._distribution(obs, own, masks.reshape(len(own.inverse), -1))
