"""
SB3 distributions for the networks' outputs. The mathematics is in ``sb3_saf.networks.distributions``.

Letters: B rows, U policies, P parameters, D action dimensions.
"""

from __future__ import annotations

from math import isnan
from typing import Any, ClassVar, cast

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import (
    CategoricalDistribution,
    DiagGaussianDistribution,
    Distribution,
    kl_divergence,
    make_proba_distribution,
)
from torch import nn
from torch.distributions import Categorical, register_kl
from torch.distributions import Distribution as TorchDistribution

from sb3_saf.networks.actor import ActorNetwork, PolicyPool, PoolOutput, draw_policy
from sb3_saf.networks.distributions import (
    masked_parameters,
    mixture_entropy,
    mixture_log_prob,
    mixture_log_probs,
    mixture_mode,
    mixture_sample,
    policy_parameters,
)
from sb3_saf.networks.spaces import spec_of
from sb3_saf.teams.errors import NonFiniteError


def actor_distribution(
    actor: ActorNetwork, action_space: spaces.Space[Any], parameters: th.Tensor, masks: th.Tensor | None = None
) -> Distribution:
    """
    Make the distribution of an actor's output.

    :param actor: the actor
    :param action_space: the action space
    :param parameters: (B, P') of ``actor(...)``, or with masks of ``actor.unmixed(...)``
    :param masks: (B, M) bool, allowed choices; None if all are
    """
    if not isinstance(actor, PolicyPool):
        allowed = parameters if masks is None else masked_parameters(actor.space, parameters, masks)
        return distribution_of(action_space, allowed)
    if masks is None and actor.is_categorical_mixture:
        return distribution_of(action_space, parameters)
    log_weights, actions = actor.split(parameters)
    if masks is not None:
        # Masked before mixing, so that masks do not change the selection of policies.
        actions = masked_parameters(actor.space, actions, masks)
    return _pool_distribution(actor, action_space, PoolOutput(log_weights, actions))


def _pool_distribution(pool: PolicyPool, action_space: spaces.Space[Any], output: PoolOutput) -> Distribution:
    log_weights, actions = output
    if pool.selection == "mixture":
        return mixture_of(action_space, log_weights, actions)
    favourite = policy_parameters(actions, log_weights.argmax(dim=1))
    return SelectedDistribution(
        drawn=distribution_of(action_space, draw_policy(log_weights, actions)),
        favourite=distribution_of(action_space, favourite),
    )


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


def mixture_of(action_space: spaces.Space[Any], log_weights: th.Tensor, parameters: th.Tensor) -> Distribution:
    """
    Make the exact mixture of a pool of policies: pi(a|o) = sum_u w_u(o) pi_u(a|o).

    :param action_space: Discrete, MultiDiscrete, MultiBinary or Box
    :param log_weights: (B, U), normalised
    :param parameters: (B, U, P)
    """
    if isinstance(action_space, spaces.Discrete):
        return LeanCategorical(int(action_space.n)).of_log_probs(mixture_log_probs(log_weights, parameters))
    return PoolDistribution(action_space).proba_distribution(log_weights, parameters)


class _FromPool(Distribution):
    """Methods of SB3's ``Distribution`` that pools share."""

    def proba_distribution_net(self, *args: Any, **kwargs: Any) -> nn.Module:
        """Raise an error: the networks are those of ``sb3_saf.networks.actor.PolicyPool``."""
        raise NotImplementedError("the parameters of a pool's distribution come from sb3_saf.networks.actor.PolicyPool")

    def actions_from_params(self, *args: Any, deterministic: bool = False, **kwargs: Any) -> th.Tensor:
        """Set the parameters (see ``proba_distribution``) and act."""
        self.proba_distribution(*args, **kwargs)
        return self.get_actions(deterministic=deterministic)

    def log_prob_from_params(self, *args: Any, **kwargs: Any) -> tuple[th.Tensor, th.Tensor]:
        """Set the parameters (see ``proba_distribution``), sample, and return the sample and its log-likelihood."""
        actions = self.actions_from_params(*args, **kwargs)
        return actions, self.log_prob(actions)


class PoolDistribution(_FromPool):
    """
    Mixture of a pool of policies over actions of several dimensions.

    ``log_prob`` is exact. ``entropy`` and ``mode`` are exact for at most ``MAX_ENUMERATED_ACTIONS`` joint actions. For
    more, and for Box actions, the entropy is None (no closed form; SB3 then estimates it by -log_prob), and the mode is
    that of the likeliest policy.

    :param action_space: MultiDiscrete, MultiBinary or Box
    """

    log_weights: th.Tensor
    parameters: th.Tensor

    def __init__(self, action_space: spaces.Space[Any]):
        super().__init__()
        self.action_space = action_space
        self.space = spec_of(action_space)

    def proba_distribution(self, log_weights: th.Tensor, parameters: th.Tensor) -> PoolDistribution:
        """Set normalised log weights (B, U) and parameters (B, U, P)."""
        self.log_weights, self.parameters = log_weights, parameters
        return self

    @property
    def distribution(self) -> PolicyAndAction:  # type: ignore[override]  # SB3's attribute
        """Joint distribution of policy and action, for TRPO's KL divergence."""
        return PolicyAndAction(self.log_weights, distribution_of(self.action_space, self.parameters.flatten(0, 1)))

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """Return log-likelihoods (B,) of actions (B, D)."""
        return mixture_log_prob(self.space, self.log_weights, self.parameters, actions)

    def entropy(self) -> th.Tensor | None:
        """Return exact entropies (B,) by enumeration, or None."""
        return mixture_entropy(self.space, self.log_weights, self.parameters)

    def sample(self) -> th.Tensor:
        """Draw a policy, then its action: (B, D)."""
        return mixture_sample(self.space, self.log_weights, self.parameters)

    def mode(self) -> th.Tensor:
        """Return the most likely joint action (B, D), or the likeliest policy's mode if they cannot be enumerated."""
        return mixture_mode(self.space, self.log_weights, self.parameters)


class PolicyAndAction(TorchDistribution):
    """
    Joint distribution of the drawn policy and its action, with KL(w || w') + sum_u w_u KL(pi_u || pi'_u).

    This is an upper bound of the KL divergence of the mixtures, which has no closed form, and zero for equal pools:
    TRPO's trust region on it also bounds the mixtures.

    :param log_weights: (B, U), normalised
    :param policies: distribution of B * U rows, those of a mixture's policies consecutive
    """

    arg_constraints: ClassVar[dict[str, Any]] = {}

    def __init__(self, log_weights: th.Tensor, policies: Distribution):
        super().__init__(log_weights.shape[:1], validate_args=False)
        self.log_weights = log_weights
        self.policies = policies


@register_kl(PolicyAndAction, PolicyAndAction)
def _divergence(one: PolicyAndAction, other: PolicyAndAction) -> th.Tensor:
    """Return the divergence (B,), see :class:`PolicyAndAction`."""
    weights = one.log_weights.exp()
    # kl_divergence returns one number per row, or one per action dimension.
    of_actions = kl_divergence(one.policies, other.policies).reshape(*weights.shape, -1).sum(dim=2)
    return (weights * (one.log_weights - other.log_weights + of_actions)).sum(dim=1)


class SelectedDistribution(_FromPool):
    """
    Distribution of the drawn policy; deterministic actions are those of the favourite policy.

    :param drawn: distribution of the policy drawn for each row
    :param favourite: distribution of the policy with the highest selection logit of each row
    """

    def __init__(self, drawn: Distribution, favourite: Distribution):
        super().__init__()
        self.drawn = drawn
        self.favourite = favourite

    @property
    def distribution(self) -> TorchDistribution:  # type: ignore[override]  # SB3's attribute
        """Raise an error: TRPO would compare policies drawn at different times."""
        raise ValueError(
            "selection='gumbel' draws a policy whenever actions are evaluated, so how far two evaluations are apart "
            "(TRPO's KL divergence) says nothing; use selection='mixture'"
        )

    def proba_distribution(self, *args: Any, **kwargs: Any) -> SelectedDistribution:
        """Set the parameters of the drawn policy."""
        self.drawn.proba_distribution(*args, **kwargs)
        return self

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """Return log-likelihoods (B,) under the drawn policy."""
        return self.drawn.log_prob(actions)

    def entropy(self) -> th.Tensor | None:
        """Return entropies (B,) of the drawn policy."""
        return self.drawn.entropy()

    def sample(self) -> th.Tensor:
        """Sample from the drawn policy."""
        return self.drawn.sample()

    def mode(self) -> th.Tensor:
        """Return the most likely action of the favourite policy."""
        return self.favourite.mode()
