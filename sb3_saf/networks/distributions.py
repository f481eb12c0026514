"""
Action distributions of single policies and of pools of policies, in pure torch: likelihoods, masks, samples, modes.

A policy's parameters are one vector per row: logits (Discrete, MultiDiscrete, MultiBinary), or means and then log
standard deviations (Box). A pool is given by log weights (B, U), normalised, and the parameters of all its policies
(B, U, P). Letters: B rows, U policies, P parameters, D action dimensions, M choices of all dimensions, J joint actions.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from math import prod
from typing import Final

import torch as th
from torch.distributions import Bernoulli, Categorical, Distribution, Normal
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from sb3_saf.networks.spaces import AnySpace, SpaceSpec, spec_of

#: Maximum number of joint actions for which a pool's entropy and most likely action are enumerated.
MAX_ENUMERATED_ACTIONS: Final = 4096
#: Maximum number of values in memory while enumerating; more rows are split into checkpointed chunks.
_ENUMERATED_AT_ONCE: Final = 1 << 22
#: Logit of masked actions: the probability is exactly zero, without the NaN in sums and gradients of -inf.
_FORBIDDEN: Final = -1e8


def n_action_parameters(action_space: AnySpace) -> int:
    """
    Count P, the parameters of one policy's distribution.

    :param action_space: Discrete, MultiDiscrete, MultiBinary or Box
    :raises ValueError: for any other space
    """
    space = spec_of(action_space)
    return space.n_outputs * (2 if space.kind == "box" else 1)


def masked_parameters(action_space: AnySpace, parameters: th.Tensor, masks: th.Tensor) -> th.Tensor:
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
    space = spec_of(action_space)
    if space.kind == "box":
        raise ValueError(f"continuous actions cannot be masked, got {action_space}")
    if masks.shape != (parameters.shape[0], sum(space.choices)):
        raise ValueError(
            f"expected action masks of shape {(parameters.shape[0], sum(space.choices))}, one flag for each choice of "
            f"{action_space}, got {tuple(masks.shape)}; let the environment's action_masks give that"
        )
    if space.kind == "multi_binary":
        off, on = masks.unflatten(1, (-1, 2)).unbind(dim=2)
        kept, otherwise = off & on, _FORBIDDEN * (off.to(parameters.dtype) - on.to(parameters.dtype))
    else:
        some = [part.any(dim=1, keepdim=True).expand_as(part) for part in th.split(masks, list(space.choices), dim=1)]
        kept, otherwise = masks, _FORBIDDEN * th.cat(some, dim=1).to(parameters.dtype)
    if parameters.dim() == 3:
        kept, otherwise = kept.unsqueeze(1), otherwise.unsqueeze(1)
    return parameters.where(kept, otherwise)


# --- one policy -------------------------------------------------------------------------------------------------------


def sample_action(action_space: AnySpace, parameters: th.Tensor) -> th.Tensor:
    """
    Draw an action of one policy per row, with the same random numbers as SB3's distributions.

    :param action_space: the action space
    :param parameters: (B, P)
    :return: (B, D)
    """
    space = spec_of(action_space)
    factors = _factors(space, parameters)
    if space.is_one_hot:
        return th.stack([factor.sample() for factor in factors], dim=1)
    (joint,) = factors
    return joint.rsample() if space.kind == "box" else joint.sample()


def likeliest_action(action_space: AnySpace, parameters: th.Tensor) -> th.Tensor:
    """
    Return the most likely action of one policy per row.

    :param action_space: the action space
    :param parameters: (B, P)
    :return: (B, D)
    """
    space = spec_of(action_space)
    if space.kind == "box":
        return parameters.chunk(2, dim=-1)[0]
    if space.kind == "multi_binary":
        return parameters.sigmoid().round()
    return th.stack([part.softmax(dim=1).argmax(dim=1) for part in _split(space, parameters)], dim=1)


def policy_log_probs(action_space: AnySpace, parameters: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """
    Compute log-likelihoods under every policy of a pool.

    :param action_space: the action space
    :param parameters: (B, U, P)
    :param actions: (B, D)
    :return: (B, U)
    """
    space = spec_of(action_space)
    actions = actions.reshape(parameters.shape[0], 1, -1)
    if not space.is_one_hot:
        (joint,) = _factors(space, parameters)
        return joint.log_prob(actions).sum(dim=2)
    log_probs = [
        (logits - logits.logsumexp(dim=2, keepdim=True)).gather(2, action.expand(-1, parameters.shape[1], 1))
        for logits, action in zip(_split(space, parameters), actions.long().split(1, dim=2), strict=True)
    ]
    return th.cat(log_probs, dim=2).sum(dim=2)


def _factors(space: SpaceSpec, parameters: th.Tensor) -> list[Distribution]:
    """Return torch's distributions: one for all dimensions (Box, MultiBinary), or one for each."""
    if space.kind == "box":
        mean, log_std = parameters.chunk(2, dim=-1)
        return [Normal(mean, log_std.exp(), validate_args=False)]
    if space.kind == "multi_binary":
        return [Bernoulli(logits=parameters, validate_args=False)]
    return [Categorical(logits=part, validate_args=False) for part in _split(space, parameters)]


def _split(space: SpaceSpec, parameters: th.Tensor) -> tuple[th.Tensor, ...]:
    """Return the logits of each action dimension."""
    return th.split(parameters, list(space.choices), dim=-1)


# --- a pool of policies -----------------------------------------------------------------------------------------------


def policy_parameters(parameters: th.Tensor, policy: th.Tensor) -> th.Tensor:
    """
    Return the parameters of one policy per row.

    :param parameters: (B, U, P)
    :param policy: (B,) index of a policy
    :return: (B, P)
    """
    # shape[0], not len(), here and elsewhere: it stays dynamic in exported graphs.
    return parameters[th.arange(policy.shape[0], device=policy.device), policy]


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


def mixture_log_prob(
    action_space: AnySpace, log_weights: th.Tensor, parameters: th.Tensor, actions: th.Tensor
) -> th.Tensor:
    """
    Return the exact log-likelihood of a mixture: log sum_u w_u pi_u(a).

    :param action_space: the action space
    :param log_weights: (B, U)
    :param parameters: (B, U, P)
    :param actions: (B, D)
    :return: (B,)
    """
    return (log_weights + policy_log_probs(action_space, parameters, actions)).logsumexp(dim=1)


def mixture_sample(action_space: AnySpace, log_weights: th.Tensor, parameters: th.Tensor) -> th.Tensor:
    """
    Draw a policy by its weight, then its action.

    :param action_space: the action space
    :param log_weights: (B, U)
    :param parameters: (B, U, P)
    :return: (B, D)
    """
    drawn = th.multinomial(log_weights.exp(), 1).squeeze(1)
    return sample_action(action_space, policy_parameters(parameters, drawn))


def is_enumerable(action_space: AnySpace) -> bool:
    """Return whether a mixture's entropy and most likely action are computed by enumerating joint actions."""
    space = spec_of(action_space)
    return space.kind != "box" and prod(space.choices) <= MAX_ENUMERATED_ACTIONS


def mixture_mode(action_space: AnySpace, log_weights: th.Tensor, parameters: th.Tensor) -> th.Tensor:
    """
    Return a mixture's most likely action, or that of its likeliest policy if actions cannot be enumerated.

    :param action_space: the action space
    :param log_weights: (B, U)
    :param parameters: (B, U, P)
    :return: (B, D)
    """
    space = spec_of(action_space)
    if not is_enumerable(space):
        return likeliest_action(space, policy_parameters(parameters, log_weights.argmax(dim=1)))
    best = _over_joint_actions(space, log_weights, parameters, _argmax)
    joint_actions = th.tensor(list(product(*map(range, space.choices))), device=best.device)
    # SB3's MultiBinary actions are floats.
    return joint_actions[best].to(parameters.dtype if space.kind == "multi_binary" else th.int64)


def mixture_entropy(action_space: AnySpace, log_weights: th.Tensor, parameters: th.Tensor) -> th.Tensor | None:
    """
    Return the entropy of a mixture by enumeration; None if actions cannot be enumerated.

    :param action_space: the action space
    :param log_weights: (B, U)
    :param parameters: (B, U, P)
    :return: (B,) or None
    """
    space = spec_of(action_space)
    return _over_joint_actions(space, log_weights, parameters, _entropy) if is_enumerable(space) else None


def _over_joint_actions(
    space: SpaceSpec, log_weights: th.Tensor, parameters: th.Tensor, reduce: Callable[[th.Tensor], th.Tensor]
) -> th.Tensor:
    """Apply a function (rows, J) -> (rows,) to the mixture's joint log-probabilities, in chunks of bounded memory."""

    def part(log_weights: th.Tensor, parameters: th.Tensor) -> th.Tensor:
        joint = _joint_log_probs(space, parameters)
        return reduce((log_weights.unsqueeze(2) + joint).logsumexp(dim=1))

    if th.compiler.is_compiling():
        return part(log_weights, parameters)
    rows_at_once = max(1, _ENUMERATED_AT_ONCE // (log_weights.shape[1] * prod(space.choices)))
    parts = list(zip(th.split(log_weights, rows_at_once), th.split(parameters, rows_at_once), strict=True))
    if len(parts) == 1:
        return part(*parts[0])
    return th.cat([checkpoint(part, *arguments, use_reentrant=False) for arguments in parts])


def _joint_log_probs(space: SpaceSpec, parameters: th.Tensor) -> th.Tensor:
    """Return log-probabilities (B, U, J) of every joint action under every policy, last action dimension fastest."""
    if space.kind == "multi_binary":
        factors = list(th.stack([F.logsigmoid(-parameters), F.logsigmoid(parameters)], dim=3).unbind(dim=2))
    else:
        factors = [logits.log_softmax(dim=2) for logits in _split(space, parameters)]
    joint = factors[0]
    for factor in factors[1:]:
        joint = (joint.unsqueeze(3) + factor.unsqueeze(2)).flatten(2)
    return joint


def _entropy(log_probs: th.Tensor) -> th.Tensor:
    return -(log_probs.exp() * log_probs).sum(dim=1)


def _argmax(log_probs: th.Tensor) -> th.Tensor:
    return log_probs.argmax(dim=1)
