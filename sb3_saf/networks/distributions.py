"""
Action distributions of single policies and of pools of policies: likelihoods, masks, samples, modes, as SB3's
distributions.

A policy's parameters are one vector per row: logits (Discrete, MultiDiscrete, MultiBinary), or means and then log
standard deviations (Box). A pool is given by log weights (B, U), normalised, and the parameters of all its policies
(B, U, P). Letters: B rows, U policies of a pool, P parameters, D action dimensions, M choices of all dimensions, A
actions, J joint actions.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from math import isnan, prod
from typing import Any, ClassVar, Final, cast

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import (
    CategoricalDistribution,
    DiagGaussianDistribution,
    Distribution,
    kl_divergence,
    make_proba_distribution,
)
from torch.distributions import Categorical, Normal, register_kl
from torch.distributions import Distribution as TorchDistribution
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from sb3_saf.teams.checks import NonFiniteError
from sb3_saf.teams.rows import choices_of

#: Logit of masked actions: the probability is exactly zero, without the NaN in sums and gradients of -inf.
_FORBIDDEN: Final = -1e8


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
    """Return the most likely actions (B, D) of one policy per row, from parameters (B, P)."""
    if isinstance(action_space, spaces.Box):
        return parameters.chunk(2, dim=-1)[0]
    if isinstance(action_space, spaces.MultiBinary):
        return parameters.sigmoid().round()
    return th.stack([part.softmax(dim=1).argmax(dim=1) for part in split_by_dimension(action_space, parameters)], dim=1)


def split_by_dimension(action_space: spaces.Space[Any], parameters: th.Tensor) -> tuple[th.Tensor, ...]:
    """Return the logits of each action dimension."""
    return th.split(parameters, list(choices_of(action_space)), dim=-1)


def distribution_of(action_space: spaces.Space[Any], parameters: th.Tensor) -> Distribution:
    """Make SB3's distribution of a single policy from parameters (B, P)."""
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


#: Maximum number of joint actions for which a pool's entropy and most likely action are enumerated.
MAX_ENUMERATED_ACTIONS: Final = 4096
#: Maximum number of values in memory while enumerating; more rows are split into checkpointed chunks.
_ENUMERATED_AT_ONCE: Final = 1 << 22


def policy_parameters(parameters: th.Tensor, policy: th.Tensor) -> th.Tensor:
    """Return the parameters (B, P) of one policy per row, with indices (B,), from those of the pool (B, U, P)."""
    # shape[0], not len(), here and elsewhere: it stays dynamic in exported graphs.
    return parameters[th.arange(policy.shape[0], device=policy.device), policy]


def mixture_log_prob(
    action_space: spaces.Space[Any], log_weights: th.Tensor, parameters: th.Tensor, actions: th.Tensor
) -> th.Tensor:
    """Return the exact log-likelihoods (B,) of actions (B, D) under a mixture: log sum_u w_u pi_u(a)."""
    actions = actions.reshape(parameters.shape[0], 1, -1)
    if isinstance(action_space, spaces.Box):
        mean, log_std = parameters.chunk(2, dim=-1)
        of_dimensions = Normal(mean, log_std.exp(), validate_args=False).log_prob(actions)
    elif isinstance(action_space, spaces.MultiBinary):
        of_dimensions = -F.softplus(parameters * (1 - 2 * actions))  # precise for large logits in exported graphs, too
    else:
        logits = split_by_dimension(action_space, parameters)
        of_actions = [
            (one - one.logsumexp(dim=2, keepdim=True)).gather(2, action.expand(-1, parameters.shape[1], 1))
            for one, action in zip(logits, actions.long().split(1, dim=2), strict=True)
        ]
        of_dimensions = th.cat(of_actions, dim=2)
    return (log_weights + of_dimensions.sum(dim=2)).logsumexp(dim=1)


def draw_policy(log_weights: th.Tensor, parameters: th.Tensor) -> th.Tensor:
    """
    Draw one policy per row by its weight, with straight-through gradients to the weights.

    :return: (B, P), bit for bit the parameters of the drawn policy
    """
    uniform = th.rand_like(log_weights).clamp_min(th.finfo(log_weights.dtype).tiny)
    noisy = log_weights - (-uniform.log()).log()
    soft = noisy.softmax(dim=1)
    # Zero in value; its gradient is that of the soft choice.
    straight_through = ((soft - soft.detach()).unsqueeze(2) * parameters.detach()).sum(dim=1)
    return policy_parameters(parameters, noisy.argmax(dim=1)) + straight_through


def is_enumerable(action_space: spaces.Space[Any]) -> bool:
    """Return whether a mixture's entropy and most likely action are computed by enumerating joint actions."""
    choices = choices_of(action_space)
    return bool(choices) and prod(choices) <= MAX_ENUMERATED_ACTIONS


def mixture_mode(action_space: spaces.Space[Any], log_weights: th.Tensor, parameters: th.Tensor) -> th.Tensor:
    """Return a mixture's most likely actions (B, D), or its likeliest policy's if they cannot be enumerated."""
    if not is_enumerable(action_space):
        return likeliest_action(action_space, policy_parameters(parameters, log_weights.argmax(dim=1)))
    best = _over_joint_actions(action_space, log_weights, parameters, lambda joint: joint.argmax(dim=1))
    joint_actions = th.tensor(list(product(*map(range, choices_of(action_space)))), device=best.device)
    # SB3's MultiBinary actions are floats.
    return joint_actions[best].to(parameters.dtype if isinstance(action_space, spaces.MultiBinary) else th.int64)


def _over_joint_actions(
    action_space: spaces.Space[Any],
    log_weights: th.Tensor,
    parameters: th.Tensor,
    reduce: Callable[[th.Tensor], th.Tensor],
) -> th.Tensor:
    """Apply a function (rows, J) -> (rows,) to the mixture's joint log-probabilities, in chunks of bounded memory."""

    def part(log_weights: th.Tensor, parameters: th.Tensor) -> th.Tensor:
        joint = _joint_log_probs(action_space, parameters)
        return reduce((log_weights.unsqueeze(2) + joint).logsumexp(dim=1))

    if th.compiler.is_compiling():
        return part(log_weights, parameters)
    rows_at_once = max(1, _ENUMERATED_AT_ONCE // (log_weights.shape[1] * prod(choices_of(action_space))))
    parts = list(zip(th.split(log_weights, rows_at_once), th.split(parameters, rows_at_once), strict=True))
    if len(parts) == 1:
        return part(*parts[0])
    return th.cat([checkpoint(part, *arguments, use_reentrant=False) for arguments in parts])


def _joint_log_probs(action_space: spaces.Space[Any], parameters: th.Tensor) -> th.Tensor:
    """Return log-probabilities (B, U, J) of every joint action under every policy, last action dimension fastest."""
    if isinstance(action_space, spaces.MultiBinary):
        factors = list(th.stack([-F.softplus(parameters), -F.softplus(-parameters)], dim=3).unbind(dim=2))
    else:
        factors = [logits.log_softmax(dim=2) for logits in split_by_dimension(action_space, parameters)]
    joint = factors[0]
    for factor in factors[1:]:
        joint = (joint.unsqueeze(3) + factor.unsqueeze(2)).flatten(2)
    return joint


def mixture_of(action_space: spaces.Space[Any], log_weights: th.Tensor, parameters: th.Tensor) -> Distribution:
    """Make the exact mixture of a pool of policies: pi(a|o) = sum_u w_u(o) pi_u(a|o)."""
    if isinstance(action_space, spaces.Discrete):
        return LeanCategorical(int(action_space.n)).of_log_probs(mixture_log_probs(log_weights, parameters))
    return PoolDistribution(action_space).proba_distribution(log_weights, parameters)


class PoolDistribution(Distribution):
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
        return mixture_log_prob(self.action_space, self.log_weights, self.parameters, actions)

    def entropy(self) -> th.Tensor | None:
        """Return exact entropies (B,) by enumeration, or None."""
        if not is_enumerable(self.action_space):
            return None
        return _over_joint_actions(
            self.action_space, self.log_weights, self.parameters, lambda joint: -(joint.exp() * joint).sum(dim=1)
        )

    def sample(self) -> th.Tensor:
        """Draw a policy, then its action: (B, D)."""
        policy = th.multinomial(self.log_weights.exp(), 1).squeeze(1)
        return distribution_of(self.action_space, policy_parameters(self.parameters, policy)).sample()

    def mode(self) -> th.Tensor:
        """Return the most likely joint action (B, D), or the likeliest policy's mode if they cannot be enumerated."""
        return mixture_mode(self.action_space, self.log_weights, self.parameters)

    def _unused(self, *_: Any, **__: Any) -> Any:  # abstract in SB3, which calls them in off-policy algorithms only
        raise NotImplementedError

    proba_distribution_net = actions_from_params = log_prob_from_params = _unused


class SelectedDistribution(PoolDistribution):
    """
    Distribution of one policy, drawn when the parameters are set; deterministic actions are those of the policy with
    the highest selection logit.
    """

    drawn: Distribution

    def proba_distribution(self, log_weights: th.Tensor, parameters: th.Tensor) -> SelectedDistribution:
        """Set normalised log weights (B, U) and parameters (B, U, P), and draw."""
        super().proba_distribution(log_weights, parameters)
        self.drawn = distribution_of(self.action_space, draw_policy(log_weights, parameters))
        return self

    @property
    def distribution(self) -> PolicyAndAction:  # type: ignore[override]  # SB3's attribute
        """Raise an error: TRPO would compare policies drawn at different times."""
        raise ValueError(
            "selection='gumbel' draws a policy whenever actions are evaluated, so how far two evaluations are apart "
            "(TRPO's KL divergence) says nothing; use selection='mixture'"
        )

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
        """Return the most likely action of the likeliest policy."""
        likeliest = policy_parameters(self.parameters, self.log_weights.argmax(dim=1))
        return distribution_of(self.action_space, likeliest).mode()


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
