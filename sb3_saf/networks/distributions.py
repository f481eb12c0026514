"""
Action distributions: a single policy's, and those of a pool of policies.

A policy's parameters are one vector per row: logits (Discrete, MultiDiscrete, MultiBinary), or means and then log
standard deviations (Box). Letters: B rows, U policies, P parameters, D action dimensions, J joint actions.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from itertools import product
from math import prod
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
from stable_baselines3.common.preprocessing import get_action_dim
from torch import nn
from torch.distributions import Distribution as TorchDistribution
from torch.distributions import register_kl
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

#: Up to this many joint actions, a pool's entropy and most likely action are found by enumeration.
MAX_ENUMERATED_ACTIONS: Final = 4096
#: Numbers held at once while enumerating; more rows are done in parts that backpropagation computes again.
_ENUMERATED_AT_ONCE: Final = 1 << 22
#: Logit of what a mask forbids: its probability is zero to the last bit, and no sum or gradient is NaN as with -inf.
_FORBIDDEN: Final = -1e8


def n_action_parameters(action_space: spaces.Space[Any]) -> int:
    """
    P, the number of parameters of one policy's distribution.

    :param action_space: Discrete, MultiDiscrete, MultiBinary or Box
    :raises ValueError: for any other space
    """
    if isinstance(action_space, spaces.Box):
        return 2 * get_action_dim(action_space)
    if isinstance(action_space, spaces.MultiBinary):
        return get_action_dim(action_space)
    return sum(_choices(action_space))


def distribution_of(action_space: spaces.Space[Any], parameters: th.Tensor) -> Distribution:
    """
    SB3's distribution of a single policy.

    :param action_space: Discrete, MultiDiscrete, MultiBinary or Box
    :param parameters: (B, P)
    """
    distribution: Any = make_proba_distribution(action_space)
    if isinstance(distribution, DiagGaussianDistribution):
        mean, log_std = parameters.chunk(2, dim=1)
        distribution.proba_distribution(mean, log_std)
    else:
        distribution.proba_distribution(action_logits=parameters)
    return cast(Distribution, distribution)


def masked_parameters(action_space: spaces.Space[Any], parameters: th.Tensor, masks: th.Tensor) -> th.Tensor:
    """
    Parameters of the policies with forbidden choices taken out.

    A mask that allows none of the choices of an action dimension leaves them equally likely: such rows (agents that
    are out of the game) act, but teach nothing.

    :param action_space: Discrete, MultiDiscrete or MultiBinary
    :param parameters: (B, P), or (B, U, P) for a pool
    :param masks: (B, M) bool, True for what is allowed: the choices of each dimension in turn (of a MultiBinary: off,
        on), as sb3-contrib wants them
    :return: as ``parameters``
    :raises ValueError: if the masks do not fit, or the actions are of a Box
    """
    if isinstance(action_space, spaces.Box):
        raise ValueError(f"continuous actions cannot be masked, got {action_space}")
    n_choices = sum(_choices(action_space))
    if masks.shape != (len(parameters), n_choices):
        raise ValueError(
            f"expected action masks of shape {(len(parameters), n_choices)}, one flag for each choice of "
            f"{action_space}, got {tuple(masks.shape)}; let the environment's action_masks give that"
        )
    if isinstance(action_space, spaces.MultiBinary):
        off, on = masks.unflatten(1, (-1, 2)).unbind(dim=2)
        kept, otherwise = off & on, _FORBIDDEN * (off.to(parameters.dtype) - on.to(parameters.dtype))
    else:
        some = [
            part.any(dim=1, keepdim=True).expand_as(part) for part in th.split(masks, _choices(action_space), dim=1)
        ]
        kept, otherwise = masks, _FORBIDDEN * th.cat(some, dim=1).to(parameters.dtype)
    if parameters.dim() == 3:
        kept, otherwise = kept.unsqueeze(1), otherwise.unsqueeze(1)
    return parameters.where(kept, otherwise)


def mixture_log_probs(log_weights: th.Tensor, logits: th.Tensor) -> th.Tensor:
    """
    Log-probabilities of a mixture of categorical policies: log sum_u w_u pi_u(a).

    :param log_weights: (B, U), normalised
    :param logits: (B, U, A)
    :return: (B, A), normalised
    """
    return (log_weights.unsqueeze(2) + logits.log_softmax(dim=2)).logsumexp(dim=1)


def mixture_of(action_space: spaces.Space[Any], log_weights: th.Tensor, parameters: th.Tensor) -> Distribution:
    """
    Exact mixture of a pool of policies: pi(a|o) = sum_u w_u(o) pi_u(a|o).

    :param action_space: Discrete, MultiDiscrete, MultiBinary or Box
    :param log_weights: (B, U), normalised
    :param parameters: (B, U, P)
    """
    if isinstance(action_space, spaces.Discrete):
        logits = mixture_log_probs(log_weights, parameters)
        return CategoricalDistribution(int(action_space.n)).proba_distribution(logits)
    return PoolDistribution(action_space).proba_distribution(log_weights, parameters)


class _FromPool(Distribution):
    """What SB3 asks of a distribution beside its mathematics."""

    def __init__(self) -> None:
        super().__init__()

    def proba_distribution_net(self, *args: Any, **kwargs: Any) -> nn.Module:
        """Not here: the networks are those of ``sb3_saf.networks.policy_pool.PolicyPool``."""
        raise NotImplementedError(
            "the parameters of a pool's distribution come from sb3_saf.networks.policy_pool.PolicyPool"
        )

    @abstractmethod
    def proba_distribution(self, *args: Any, **kwargs: Any) -> Any:
        """Set the parameters."""

    def actions_from_params(self, *args: Any, deterministic: bool = False, **kwargs: Any) -> th.Tensor:
        """Set the parameters (see ``proba_distribution``) and act."""
        self.proba_distribution(*args, **kwargs)
        return self.get_actions(deterministic=deterministic)

    def log_prob_from_params(self, *args: Any, **kwargs: Any) -> tuple[th.Tensor, th.Tensor]:
        """Set the parameters (see ``proba_distribution``), sample, and give the sample's log-likelihood too."""
        actions = self.actions_from_params(*args, **kwargs)
        return actions, self.log_prob(actions)


class PoolDistribution(_FromPool):
    """
    Mixture of a pool of policies over actions of several dimensions.

    ``log_prob`` is exact. ``entropy`` and ``mode`` are exact while there are at most ``MAX_ENUMERATED_ACTIONS`` joint
    actions. Beyond, and for Box actions, the entropy is None (no closed form; SB3 then estimates it by -log_prob),
    and the mode is that of the likeliest policy.

    :param action_space: MultiDiscrete, MultiBinary or Box
    """

    log_weights: th.Tensor
    parameters: th.Tensor

    def __init__(self, action_space: spaces.Space[Any]):
        super().__init__()
        self.action_space = action_space
        self._choices = None if isinstance(action_space, spaces.Box) else _choices(action_space)
        self.enumerable = self._choices is not None and prod(self._choices) <= MAX_ENUMERATED_ACTIONS

    def proba_distribution(self, log_weights: th.Tensor, parameters: th.Tensor) -> PoolDistribution:
        """
        Set the parameters.

        :param log_weights: (B, U), normalised
        :param parameters: (B, U, P)
        """
        self.log_weights, self.parameters = log_weights, parameters
        return self

    @property
    def distribution(self) -> PolicyAndAction:  # type: ignore[override]  # read-only
        """What TRPO compares: the distribution of policy and action together."""
        return PolicyAndAction(self.log_weights, distribution_of(self.action_space, self.parameters.flatten(0, 1)))

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """
        Log-likelihood by logsumexp over policies.

        :param actions: (B, D)
        :return: (B,)
        """
        n_rows, n_policies = self.log_weights.shape
        policies = distribution_of(self.action_space, self.parameters.flatten(0, 1))
        by_policy = policies.log_prob(actions.repeat_interleave(n_policies, dim=0)).view(n_rows, n_policies)
        return (self.log_weights + by_policy).logsumexp(dim=1)

    def entropy(self) -> th.Tensor | None:
        """(B,) exact by enumeration, or None."""
        return self._over_joint_actions(_entropy) if self.enumerable else None

    def sample(self) -> th.Tensor:
        """(B, D): draw a policy, then its action."""
        drawn = th.multinomial(self.log_weights.exp(), 1).squeeze(1)
        return distribution_of(self.action_space, policy_parameters(self.parameters, drawn)).sample()

    def mode(self) -> th.Tensor:
        """(B, D): the most likely joint action, or the mode of the likeliest policy where they cannot be enumerated."""
        if self._choices is None or not self.enumerable:
            likeliest = self.log_weights.argmax(dim=1)
            return distribution_of(self.action_space, policy_parameters(self.parameters, likeliest)).mode()
        best = self._over_joint_actions(_argmax)
        joint_actions = th.tensor(list(product(*map(range, self._choices))), device=best.device)
        # SB3's MultiBinary actions are floats.
        return joint_actions[best].to(
            self.parameters.dtype if isinstance(self.action_space, spaces.MultiBinary) else th.int64
        )

    def _over_joint_actions(self, reduce: Callable[[th.Tensor], th.Tensor]) -> th.Tensor:
        """(B,) of a function of the mixture's joint log-probabilities (rows, J), in parts of bounded memory."""
        assert self._choices is not None

        def part(log_weights: th.Tensor, parameters: th.Tensor) -> th.Tensor:
            joint = _joint_log_probs(self.action_space, parameters)
            return reduce((log_weights.unsqueeze(2) + joint).logsumexp(dim=1))

        rows_at_once = max(1, _ENUMERATED_AT_ONCE // (self.log_weights.shape[1] * prod(self._choices)))
        parts = list(
            zip(th.split(self.log_weights, rows_at_once), th.split(self.parameters, rows_at_once), strict=True)
        )
        if len(parts) == 1:
            return part(*parts[0])
        return th.cat([checkpoint(part, *arguments, use_reentrant=False) for arguments in parts])


class PolicyAndAction(TorchDistribution):
    """
    Which policy is drawn, and what it does: here for its divergence, KL(w || w') + sum_u w_u KL(pi_u || pi'_u).

    That is never less than the divergence of the mixtures, which has no closed form (the policy is one more thing to
    tell them apart by), and zero where nothing differs: who stays within it, as TRPO does, stays within the other.

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
    """(B,) see :class:`PolicyAndAction`."""
    weights = one.log_weights.exp()
    # SB3 gives one number per row, or one per action dimension.
    of_actions = kl_divergence(one.policies, other.policies).reshape(*weights.shape, -1).sum(dim=2)
    return (weights * (one.log_weights - other.log_weights + of_actions)).sum(dim=1)


class SelectedDistribution(_FromPool):
    """
    The distribution of the one policy that was drawn; deterministic actions are those of the favourite policy.

    :param drawn: distribution of the policy drawn for each row
    :param favourite: distribution of the policy with the highest selection logit of each row
    """

    def __init__(self, drawn: Distribution, favourite: Distribution):
        super().__init__()
        self.drawn = drawn
        self.favourite = favourite

    @property
    def distribution(self) -> TorchDistribution:  # type: ignore[override]  # read-only
        """Not there: TRPO would compare policies drawn at different times."""
        raise ValueError(
            "selection='gumbel' draws a policy whenever actions are evaluated, so how far two evaluations are apart "
            "(TRPO's KL divergence) says nothing; use selection='mixture'"
        )

    def proba_distribution(self, *args: Any, **kwargs: Any) -> SelectedDistribution:
        """Set the parameters of the drawn policy."""
        self.drawn.proba_distribution(*args, **kwargs)
        return self

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """(B,) log-likelihood under the drawn policy."""
        return self.drawn.log_prob(actions)

    def entropy(self) -> th.Tensor | None:
        """(B,) entropy of the drawn policy."""
        return self.drawn.entropy()

    def sample(self) -> th.Tensor:
        """Sample from the drawn policy."""
        return self.drawn.sample()

    def mode(self) -> th.Tensor:
        """Most likely action of the favourite policy."""
        return self.favourite.mode()


def policy_parameters(parameters: th.Tensor, policy: th.Tensor) -> th.Tensor:
    """
    Parameters of one policy per row.

    :param parameters: (B, U, P)
    :param policy: (B,) index of a policy
    :return: (B, P)
    """
    return parameters[th.arange(len(policy), device=policy.device), policy]


def _choices(action_space: spaces.Space[Any]) -> list[int]:
    """Number of choices of each action dimension."""
    if isinstance(action_space, spaces.Discrete):
        return [int(action_space.n)]
    if isinstance(action_space, spaces.MultiDiscrete) and action_space.nvec.ndim == 1:
        return [int(n) for n in action_space.nvec]
    if isinstance(action_space, spaces.MultiBinary):
        return [2] * get_action_dim(action_space)
    raise ValueError(
        f"expected a Discrete, MultiDiscrete (of one axis), MultiBinary or Box action space, got {action_space}; "
        "flatten the actions in a wrapper of the environment"
    )


def _joint_log_probs(action_space: spaces.Space[Any], parameters: th.Tensor) -> th.Tensor:
    """(B, U, J) log-probabilities of every joint action under every policy, the last action dimension fastest."""
    if isinstance(action_space, spaces.MultiBinary):
        factors = list(th.stack([F.logsigmoid(-parameters), F.logsigmoid(parameters)], dim=3).unbind(dim=2))
    else:
        factors = [logits.log_softmax(dim=2) for logits in th.split(parameters, _choices(action_space), dim=2)]
    joint = factors[0]
    for factor in factors[1:]:
        joint = (joint.unsqueeze(3) + factor.unsqueeze(2)).flatten(2)
    return joint


def _entropy(log_probs: th.Tensor) -> th.Tensor:
    return -(log_probs.exp() * log_probs).sum(dim=1)


def _argmax(log_probs: th.Tensor) -> th.Tensor:
    return log_probs.argmax(dim=1)
