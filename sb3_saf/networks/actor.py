"""
Actors: networks from the features of an agent's own observation to its action distribution. They have no other input
(but the agent's index, where enabled), so that execution is decentralised.

IPPO and MAPPO use a :class:`SinglePolicy`, SAF a :class:`PolicyPool`: policies that all agents share, selected by
signature keys (arXiv 2210.03022, section 5).

Letters: K rows, U policies, d features, A actions, P parameters of one policy's action distribution.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Literal, cast

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import Distribution
from torch import nn

from sb3_saf.networks.distributions import (
    SelectedDistribution,
    distribution_of,
    masked_parameters,
    mixture_log_probs,
    mixture_of,
    n_action_outputs,
    n_action_parameters,
)
from sb3_saf.networks.layers import AgentHeads, NetworkSpec, mlp, side_by_side

#: Orthogonal gain of the last layer: initial policies are close to uniform.
ACTION_GAIN = 0.01

#: Action distribution of the pool: the exact mixture of its policies, or one policy drawn at every evaluation.
Selection = Literal["mixture", "gumbel"]


class ActionHead(nn.Module):
    """
    One policy: an MLP, and for Box actions a learned standard deviation that does not depend on the observation.

    :param n_identities: N if the one-hot index of the agent stands beside the features; else 0
    """

    log_std: nn.Parameter | None

    def __init__(self, spec: NetworkSpec, n_identities: int = 0):
        super().__init__()
        n_outputs = n_action_outputs(spec.action_space)
        if isinstance(spec.action_space, spaces.Box):
            self.log_std = nn.Parameter(th.full((n_outputs,), spec.log_std_init))
        else:
            self.register_parameter("log_std", None)
        sizes = [spec.features_dim + n_identities, *spec.actor_hidden, n_outputs]
        self.net = mlp(sizes, spec.activation_fn, output_gain=ACTION_GAIN)

    def forward(self, features: th.Tensor) -> th.Tensor:
        """Return the parameters (K, P) of the action distributions for features (K, d)."""
        outputs: th.Tensor = self.net(features)
        return outputs if self.log_std is None else th.cat([outputs, self.log_std.expand_as(outputs)], dim=1)


class ActorNetwork(nn.Module, ABC):
    """
    Base of all networks that act.

    :param reads_agent: whether ``forward`` needs the agent's index
    :param identity: whether the network reads the agent's index as a one-hot vector beside the features
    """

    def __init__(self, spec: NetworkSpec, reads_agent: bool, identity: bool):
        super().__init__()
        self.action_space = spec.action_space
        self.reads_agent = reads_agent
        self.n_identities = spec.n_agents if identity else 0

    @abstractmethod
    def forward(self, features: th.Tensor, agent: th.Tensor | None = None) -> th.Tensor:
        """
        Return the parameters of the whole action distribution, one vector per row.

        :param features: (K, d) features of own observations
        :param agent: (K,) int64 index of the agent, where ``reads_agent``
        :return: (K, P')
        """

    @abstractmethod
    def evaluate(self, features: th.Tensor, agent: th.Tensor | None = None) -> tuple[th.Tensor, th.Tensor]:
        """
        Evaluate every policy and its weight, with arguments as in :meth:`forward`; a single policy has weight 1.

        :return: normalised log weights (K, U) and the parameters of each policy's action distribution (K, U, P)
        """

    def with_identity(self, features: th.Tensor, agent: th.Tensor | None) -> th.Tensor:
        """
        Append the one-hot agent index to the features if the network reads it.

        :param features: (K, d)
        :param agent: (K,) int64 index of the agent
        :return: (K, d + N), or the features if ``n_identities`` is 0
        """
        if not self.n_identities:
            return features
        if agent is None:
            raise ValueError("this actor reads who acts (actor_identity): expected the agent's index of each row")
        identity = nn.functional.one_hot(agent, self.n_identities).to(features.dtype)
        return th.cat([features, identity], dim=1)

    def unmixed(self, features: th.Tensor, agent: th.Tensor | None = None) -> th.Tensor:
        """
        Return the parameters of every policy (K, P''), to which action masks must be applied before mixing.

        Arguments are those of :meth:`forward`.
        """
        return self(features, agent)

    def distribution(self, parameters: th.Tensor, masks: th.Tensor | None = None) -> Distribution:
        """
        Make the distribution of the network's output.

        :param parameters: (B, P') of :meth:`forward`, or with masks of :meth:`unmixed`
        :param masks: (B, M) bool, allowed choices; None if all are
        """
        if masks is not None:
            parameters = masked_parameters(self.action_space, parameters, masks)
        return distribution_of(self.action_space, parameters)


class SinglePolicy(ActorNetwork):
    """
    One policy for all agents, or one for each: the actor of IPPO and MAPPO.

    :param per_agent: whether each agent has a policy of its own
    :param identity: whether a policy that all share reads the agent's index as a one-hot vector beside the features
    """

    def __init__(self, spec: NetworkSpec, per_agent: bool = False, identity: bool = False):
        identity = identity and not per_agent
        super().__init__(spec, per_agent or identity, identity)

        def make_head() -> ActionHead:
            return ActionHead(spec, self.n_identities)

        self.head: ActionHead | AgentHeads = AgentHeads(make_head, spec.n_agents) if per_agent else make_head()

    def forward(self, features: th.Tensor, agent: th.Tensor | None = None) -> th.Tensor:
        """See :class:`ActorNetwork`; (K, d) to (K, P)."""
        if isinstance(self.head, AgentHeads):
            return self.head(features, agent)
        return self.head(self.with_identity(features, agent))

    def evaluate(self, features: th.Tensor, agent: th.Tensor | None = None) -> tuple[th.Tensor, th.Tensor]:
        """See :class:`ActorNetwork`; (K, 1) log weights of zero and (K, 1, P) parameters."""
        return th.zeros_like(features[:, :1]), self(features, agent).unsqueeze(1)


class PolicyPool(ActorNetwork):
    """
    Pool of U policies with selection weights softmax(q . k_u / sqrt(d)), q = g_psel(z).

    ``selection="mixture"``: u is drawn from the weights, then the action from policy u. Likelihood, entropy and most
    likely action are those of the mixture, exact where the action space allows it (see
    ``sb3_saf.networks.distributions``).

    ``selection="gumbel"``: one policy is drawn for each distribution (Gumbel noise on the logits, hard choice,
    straight-through gradient), and likelihood and entropy are that policy's. This is the behaviour of the released
    code; two evaluations of one action may use different policies. Deterministic actions use the highest weight.

    :param n_policies: U, at least 2
    :param selection: ``"mixture"`` or ``"gumbel"``
    :param latent_dim: d, size of queries and signature keys
    :param projection_hidden: sizes of the hidden layers of g_psel
    :param identity: whether selection and policies read the agent's index as a one-hot vector beside z
    """

    def __init__(
        self,
        spec: NetworkSpec,
        n_policies: int,
        selection: Selection,
        latent_dim: int,
        projection_hidden: Sequence[int],
        identity: bool = False,
    ):
        super().__init__(spec, identity, identity)
        self.selection = selection
        self.n_policies = n_policies
        # Initial selection is close to uniform, so that policies differentiate before the selection settles.
        sizes = [spec.features_dim + self.n_identities, *projection_hidden, latent_dim]
        self.query_net = mlp(sizes, spec.activation_fn, output_gain=ACTION_GAIN)
        self.signature_keys = nn.Parameter(th.randn(n_policies, latent_dim))
        self.policies = nn.ModuleList(ActionHead(spec, self.n_identities) for _ in range(n_policies))

    def evaluate(self, features: th.Tensor, agent: th.Tensor | None = None) -> tuple[th.Tensor, th.Tensor]:
        """See :class:`ActorNetwork`; rows are the last axis of the parameters in memory."""
        features = self.with_identity(features, agent)
        policies = [cast(ActionHead, policy) for policy in self.policies]
        (queries,), actions = side_by_side([[self.query_net], [policy.net for policy in policies]], features)
        logits = self.signature_keys @ queries.t() * self.signature_keys.shape[1] ** -0.5
        if isinstance(self.action_space, spaces.Box):
            log_stds = th.stack([cast(nn.Parameter, policy.log_std) for policy in policies])
            actions = th.cat([actions, log_stds.unsqueeze(1).expand_as(actions)], dim=2)
        return logits.log_softmax(dim=0).t(), actions.transpose(0, 1)

    def forward(self, features: th.Tensor, agent: th.Tensor | None = None) -> th.Tensor:
        """See :class:`ActorNetwork`; (K, A) log-probabilities of a discrete mixture, or as :meth:`unmixed`."""
        if self.is_categorical_mixture:
            return mixture_log_probs(*self.evaluate(features, agent))
        return self.unmixed(features, agent)

    def unmixed(self, features: th.Tensor, agent: th.Tensor | None = None) -> th.Tensor:
        """See :class:`ActorNetwork`; (K, d) to (K, U + U P) weights and parameters."""
        log_weights, actions = self.evaluate(features, agent)
        return th.cat([log_weights, actions.flatten(1)], dim=1)

    def distribution(self, parameters: th.Tensor, masks: th.Tensor | None = None) -> Distribution:
        """See :class:`ActorNetwork`."""
        if masks is None and self.is_categorical_mixture:
            return distribution_of(self.action_space, parameters)
        log_weights, flat = parameters[:, : self.n_policies], parameters[:, self.n_policies :]
        actions = flat.reshape(-1, self.n_policies, n_action_parameters(self.action_space))
        if masks is not None:
            # Masked before mixing, so that masks do not change the selection of policies.
            actions = masked_parameters(self.action_space, actions, masks)
        if self.selection == "mixture":
            return mixture_of(self.action_space, log_weights, actions)
        return SelectedDistribution(self.action_space).proba_distribution(log_weights, actions)

    @property
    def is_categorical_mixture(self) -> bool:
        """Whether the mixture is a single categorical, which is then computed before rows are gathered."""
        return self.selection == "mixture" and isinstance(self.action_space, spaces.Discrete)
