"""
Action distributions of single policies: likelihoods, masks, samples, modes, as SB3's distributions.

A policy's parameters are one vector per row: logits (Discrete, MultiDiscrete, MultiBinary), or means and then log
standard deviations (Box). Letters: B rows, U policies of a pool, P parameters, D action dimensions, M choices of all
dimensions, A actions.
"""

from __future__ import annotations

from math import isnan, prod
from typing import Any, Final, cast

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import (
    CategoricalDistribution,
    DiagGaussianDistribution,
    Distribution,
    make_proba_distribution,
)
from torch.distributions import Categorical

from sb3_saf.teams.errors import NonFiniteError

#: Logit of masked actions: the probability is exactly zero, without the NaN in sums and gradients of -inf.
_FORBIDDEN: Final = -1e8


def choices_of(action_space: spaces.Space[Any]) -> tuple[int, ...]:
    """
    Return the number of choices of each action dimension, of which a Box has none.

    :param action_space: Discrete, MultiDiscrete (of one axis), MultiBinary or Box
    :raises ValueError: for any other space
    """
    if isinstance(action_space, spaces.Box):
        return ()
    if isinstance(action_space, spaces.Discrete):
        return (int(action_space.n),)
    if isinstance(action_space, spaces.MultiDiscrete) and len(action_space.shape) == 1:
        return tuple(action_space.nvec.tolist())
    if isinstance(action_space, spaces.MultiBinary):
        return (2,) * prod(action_space.shape)
    raise ValueError(
        f"expected a Discrete, MultiDiscrete (of one axis), MultiBinary or Box space, got {action_space}; flatten it "
        "in a wrapper of the environment"
    )


def n_action_outputs(action_space: spaces.Space[Any]) -> int:
    """Count the outputs of a policy's last layer; see :func:`choices_of`."""
    choices = choices_of(action_space)
    return sum(choices) if is_one_hot(action_space) else prod(action_space.shape or ())


def n_action_parameters(action_space: spaces.Space[Any]) -> int:
    """Count P, the parameters of one policy's distribution; see :func:`choices_of`."""
    return n_action_outputs(action_space) * (2 if isinstance(action_space, spaces.Box) else 1)


def is_one_hot(action_space: spaces.Space[Any]) -> bool:
    """Return whether each action dimension has a logit for every choice."""
    return isinstance(action_space, (spaces.Discrete, spaces.MultiDiscrete))


def masked_parameters(action_space: spaces.Space[Any], parameters: th.Tensor, masks: th.Tensor) -> th.Tensor:
    """
    Mask illegal choices in the parameters of policies.

    If a mask allows none of the choices of an action dimension, these become equally likely: such rows (inactive
    agents) act, but have no gradient.

    :param action_space: Discrete, MultiDiscrete or MultiBinary
    :param parameters: (B, P), or (B, U, P) for a pool
    :param masks: (B, M) bool, allowed choices of each dimension in turn (of a MultiBinary: off, on), as in sb3-contrib
    :return: as ``parameters``
    :raises ValueError: if the masks have a wrong shape, or the action space is a Box
    """
    choices = choices_of(action_space)
    if isinstance(action_space, spaces.Box):
        raise ValueError(f"continuous actions cannot be masked, got {action_space}")
    if masks.shape != (parameters.shape[0], sum(choices)):
        raise ValueError(
            f"expected action masks of shape {(parameters.shape[0], sum(choices))}, one flag for each choice of "
            f"{action_space}, got {tuple(masks.shape)}; let the environment's action_masks give that"
        )
    if isinstance(action_space, spaces.MultiBinary):
        off, on = masks.unflatten(1, (-1, 2)).unbind(dim=2)
        kept, otherwise = off & on, _FORBIDDEN * (off.to(parameters.dtype) - on.to(parameters.dtype))
    else:
        some = [part.any(dim=1, keepdim=True).expand_as(part) for part in th.split(masks, list(choices), dim=1)]
        kept, otherwise = masks, _FORBIDDEN * th.cat(some, dim=1).to(parameters.dtype)
    if parameters.dim() == 3:
        kept, otherwise = kept.unsqueeze(1), otherwise.unsqueeze(1)
    return parameters.where(kept, otherwise)


# --- one policy -------------------------------------------------------------------------------------------------------


def likeliest_action(action_space: spaces.Space[Any], parameters: th.Tensor) -> th.Tensor:
    """
    Return the most likely action of one policy per row.

    :param parameters: (B, P)
    :return: (B, D)
    """
    if isinstance(action_space, spaces.Box):
        return parameters.chunk(2, dim=-1)[0]
    if isinstance(action_space, spaces.MultiBinary):
        return parameters.sigmoid().round()
    return th.stack([part.softmax(dim=1).argmax(dim=1) for part in split_by_dimension(action_space, parameters)], dim=1)


def split_by_dimension(action_space: spaces.Space[Any], parameters: th.Tensor) -> tuple[th.Tensor, ...]:
    """Return the logits of each action dimension."""
    return th.split(parameters, list(choices_of(action_space)), dim=-1)


def distribution_of(action_space: spaces.Space[Any], parameters: th.Tensor) -> Distribution:
    """
    Make SB3's distribution of a single policy.

    :param action_space: Discrete, MultiDiscrete, MultiBinary or Box
    :param parameters: (B, P)
    """
    if isinstance(action_space, spaces.Discrete):
        return LeanCategorical(int(action_space.n)).proba_distribution(parameters)
    distribution: Any = make_proba_distribution(action_space)
    if isinstance(distribution, DiagGaussianDistribution):
        mean, log_std = parameters.chunk(2, dim=1)
        distribution.proba_distribution(mean, log_std)
    else:
        distribution.proba_distribution(action_logits=parameters)
    return cast(Distribution, distribution)


class LeanCategorical(CategoricalDistribution):
    """
    SB3's distribution of Discrete actions, with equal results in a third of the time: PyTorch's is created on access.

    :param action_dim: number of actions, A
    """

    log_probs: th.Tensor

    def proba_distribution(self, action_logits: th.Tensor) -> LeanCategorical:
        """Set the parameters, logits (B, A)."""
        # With rows last in memory, inner loops run over many rows instead of few actions.
        return self.of_log_probs(action_logits.t().contiguous().log_softmax(dim=0).t())

    def of_log_probs(self, log_probs: th.Tensor) -> LeanCategorical:
        """Set the parameters, normalised log-probabilities (B, A)."""
        self.log_probs = log_probs
        return self

    @property
    def distribution(self) -> Categorical:  # type: ignore[override]  # SB3's attribute
        """PyTorch's distribution, for TRPO's KL divergence."""
        return Categorical(logits=self.log_probs, validate_args=False)

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """Return log-likelihoods (B,) of actions (B,)."""
        return self.log_probs.gather(1, actions.long().reshape(-1, 1)).squeeze(1)

    def entropy(self) -> th.Tensor:
        """Return entropies (B,)."""
        return -(self.log_probs.exp() * self.log_probs).sum(dim=1)

    def sample(self) -> th.Tensor:
        """
        Sample actions (B,), those of ``torch.multinomial`` from the same random numbers.

        :raises NonFiniteError: for NaN
        """
        probabilities = self.log_probs.exp()
        if isnan(probabilities.sum().item()):
            raise NonFiniteError(
                "the probabilities of actions are NaN: the policy's parameters, or its observations, are; check the "
                "observations' range, lower the learning rate, or set max_grad_norm"
            )
        # The first of A exponential clocks with rates p: action a with probability p_a.
        return (probabilities / th.empty_like(probabilities).exponential_()).argmax(dim=1)

    def mode(self) -> th.Tensor:
        """Return the most likely actions (B,)."""
        return self.log_probs.argmax(dim=1)


def mixture_log_probs(log_weights: th.Tensor, logits: th.Tensor) -> th.Tensor:
    """
    Return log-probabilities of a mixture of categorical policies: log sum_u w_u pi_u(a).

    :param log_weights: (B, U), normalised
    :param logits: (B, U, A)
    :return: (B, A), normalised
    """
    # With rows last in memory, inner loops run over many rows instead of few actions.
    of_policies = logits.permute(1, 2, 0).contiguous().log_softmax(dim=1)
    return (log_weights.t().unsqueeze(1) + of_policies).logsumexp(dim=0).t()
