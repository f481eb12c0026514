"""
What the policies of SAF, MAPPO and IPPO share, for rows that carry their team's joint view: all of their construction
(``TeamPolicy``), and SB3's ActorCriticPolicy of them (``TeamActorCriticPolicy``).

The actor reads ``obs`` (and ``agent``, with one head per agent); only the critic reads ``team``. Letters: B rows, N
agents.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, fields
from functools import partial
from typing import Any, ClassVar, Final

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_saf.envs.teams import STATE_KEY
from sb3_saf.networks.actor import ActionHead, ActorNetwork
from sb3_saf.networks.critic import OwnValueHead, StateCritic, TeamCritic
from sb3_saf.networks.gather import gather_agents
from sb3_saf.networks.layers import HIDDEN_GAIN, orthogonal_init
from sb3_saf.networks.value_normalizer import ValueNormalizer
from sb3_saf.networks.views import OwnViews
from sb3_saf.policies.distributions import actor_distribution
from sb3_saf.policies.extractors import ObservationEncoder
from sb3_saf.policies.parts import NetworkSpec, TeamParts
from sb3_saf.policies.rows import TeamRowsPolicy, entry_of, pop_named

NetArch = list[int] | dict[str, list[int]]

#: Arguments of SB3's base class that only gSDE reads; team policies refuse gSDE and do not save them.
_SDE_ARGUMENTS: Final = ("use_sde", "squash_output", "full_std", "use_expln")


class TeamPolicy(TeamRowsPolicy):
    """
    Base of policies on rows of teams: one row is one agent in one game at one step.

    It goes in front of one of the actor-critic policies of SB3 or sb3-contrib, whose networks it replaces by its own.

    A row's observation is that of ``CentralizedValueWrapper``: ``obs``, ``team`` and ``agent``. The actor reads
    ``obs`` alone: what other agents see cannot change an action's probability by a bit. Each distinct observation of
    a batch is encoded once, so extractors must treat views one by one (no batch normalisation).

    Where observations have ``action_mask``, illegal actions have probability zero: in every policy of a pool, so also
    in their mixture; entropies are over legal actions. ``predict`` then needs the mask beside ``obs``. Where they have
    ``active``, critics leave out agents that take no part, and the value of such an agent is exactly zero.

    Beside these arguments, a policy takes the fields of its ``parts_class`` by keyword.

    :param observation_space: Dict of ``obs``, ``team``, ``agent``, and perhaps ``active``, ``action_mask``, ``state``
    :param action_space: Discrete, MultiDiscrete, MultiBinary or Box
    :param lr_schedule: learning rate schedule
    :param net_arch: hidden sizes of actor and critic heads, or ``dict(pi=..., vf=...)``; None for [128, 128]
    :param encode_once: False encodes every row, which gives the same numbers slowly
    :param chunk_size: views encoded at once on the CPU, few enough for the cache; None for all
    :param normalize_values: whether the critic learns returns normalised by their running mean and variance (see
        ``sb3_saf.networks.value_normalizer``); needs ``rollout_buffer_class=TeamRolloutBuffer``. Values that the policy
        gives, ``train/value_loss`` and ``clip_range_vf`` are on the raw scale either way
    :param use_sde: refused; here because SB3's algorithms pass it
    :param share_features_extractor: actor and critic always share the encoder; False is refused
    :param features_extractor_class: encoder, built on the space of ``obs``
    :param features_extractor_kwargs: its further arguments
    :param kwargs: fields of ``parts_class``, and other arguments of SB3's ``ActorCriticPolicy``: activation_fn,
        ortho_init, log_std_init, normalize_images, optimizer_class, optimizer_kwargs (Adam and AdamW step all weights
        at once, ``fused=True``, unless told otherwise)
    """

    #: The algorithm: which actor and critic to make.
    parts_class: ClassVar[type[TeamParts]]

    actor: ActorNetwork
    value_net: OwnValueHead | TeamCritic | StateCritic
    value_normalizer: ValueNormalizer | None
    features_dim: int
    net_arch: NetArch
    activation_fn: type[nn.Module]
    log_std_init: float
    ortho_init: bool
    #: Whether ``normalize_values`` may be used: the algorithm takes a rollout buffer that updates the statistics.
    normalizes_values: ClassVar[bool] = False

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        net_arch: NetArch | None = None,
        *,
        encode_once: bool = True,
        chunk_size: int | None = 512,
        normalize_values: bool = False,
        use_sde: bool = False,
        share_features_extractor: bool = True,
        features_extractor_class: type[BaseFeaturesExtractor] = ObservationEncoder,
        features_extractor_kwargs: Mapping[str, Any] | None = None,
        **kwargs: Any,
    ):
        _refuse(use_sde=use_sde, share_features_extractor=share_features_extractor)
        self._read_rows_of(observation_space, action_space, encode_once, chunk_size)
        self._warned_of_idle_rows = False
        self.parts = self.parts_class(**pop_named(kwargs, {field.name for field in fields(self.parts_class)}))
        if normalize_values and not self.normalizes_values:
            raise ValueError(
                f"normalize_values=True needs TeamRolloutBuffer, which the algorithms of {type(self).__name__} do not "
                "take; leave normalize_values=False, or use PPO with SAFPolicy, MAPPOPolicy or IPPOPolicy"
            )
        self.normalize_values = normalize_values
        # The next class in line is SB3's or sb3-contrib's, which takes more than BasePolicy.
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            [128, 128] if net_arch is None else net_arch,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=dict(features_extractor_kwargs or {}),  # SB3 writes into it
            **kwargs,
        )

    # --- construction -----------------------------------------------------------------------------------------------

    def _build(self, lr_schedule: Schedule) -> None:
        # The critic comes last: policies of one seed that differ in the critic start with the same encoder and actor.
        self._build_actor()
        self._build_critic(lr_schedule)

    def _build_actor(self) -> None:
        self.actor = self._make_actor()
        if self.ortho_init:
            self.features_extractor.apply(partial(self.init_weights, gain=HIDDEN_GAIN))
            orthogonal_init(self.actor)

    def _build_critic(self, lr_schedule: Schedule) -> None:
        """Make the critic, and the optimizer of everything."""
        # TRPO tells the critic's parameters by "value" in their name: everything below value_net has it.
        self.value_net = self._make_critic()
        if self.ortho_init:
            orthogonal_init(self.value_net)
        self.value_normalizer = ValueNormalizer() if self.normalize_values else None
        learning_rate = lr_schedule(1)
        kwargs = _with_fused_steps(self.optimizer_class, self.optimizer_kwargs)
        self.optimizer = self.optimizer_class(self.parameters(), lr=learning_rate, **kwargs)  # type: ignore[call-arg]

    def _make_actor(self) -> ActorNetwork:
        return self.parts.actor(self._network_spec())

    def _make_critic(self) -> OwnValueHead | TeamCritic | StateCritic:
        return self.parts.critic(self._network_spec())

    def _network_spec(self) -> NetworkSpec:
        actor_hidden, value_hidden = _hidden_sizes(self.net_arch)
        return NetworkSpec(
            self.features_dim,
            self.team_spaces.n_agents,
            self.action_space,
            actor_hidden,
            value_hidden,
            self.activation_fn,
            self.log_std_init,
            self.team_spaces.state,
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        for name in _SDE_ARGUMENTS:
            data.pop(name, None)
        own = {name: getattr(self, name) for name in ("encode_once", "chunk_size", "normalize_values")}
        return data | asdict(self.parts) | own

    @property
    def log_std(self) -> th.Tensor:
        """(policies, D) log standard deviations of Box actions; there is no such attribute for other actions."""
        heads = [module for module in self.actor.modules() if isinstance(module, ActionHead)]
        found: list[th.Tensor] = [head.log_std for head in heads if head.log_std is not None]
        if not found:
            raise AttributeError("only policies with Box actions have a log_std")
        return th.stack(found)

    # --- what SB3 calls ---------------------------------------------------------------------------------------------

    def predict_values(self, obs: PyTorchObs) -> th.Tensor:
        """
        Estimate values.

        :param obs: rows
        :return: (B, 1)
        """
        return self._values(obs, None)

    def _warn_of_idle_rows(self, obs: PyTorchObs) -> None:
        """Rows of agents that take no part come from buffers that do not leave them out."""
        if self.team_spaces.active is None or self._warned_of_idle_rows:
            return
        active = self._active(obs)
        assert active is not None
        takes_part = active.gather(1, self._agent(obs).unsqueeze(1)).squeeze(1)
        if (active.any(dim=1) & ~takes_part).any():  # rows of a padding have no team
            self._warned_of_idle_rows = True
            advice = (
                "Train with rollout_buffer_class=sb3_saf.TeamRolloutBuffer, which leaves them out."
                if self.normalizes_values
                else f"The buffers of {type(self).__name__}'s algorithms cannot leave them out; PPO with "
                "sb3_saf.TeamRolloutBuffer can."
            )
            warnings.warn(
                "The minibatch has rows of agents that take no part (dead, or not joined yet); they enter the loss, "
                f"the entropy and the normalisation of advantages. {advice}",
                UserWarning,
                stacklevel=3,
            )

    def _likelihood(self, distribution: Distribution, actions: th.Tensor) -> th.Tensor:
        """(B,) log-likelihoods; sb3-contrib's buffers give the bits of MultiBinary actions as whole numbers."""
        return distribution.log_prob(actions.float() if isinstance(self.action_space, spaces.MultiBinary) else actions)

    def _distribution(self, obs: PyTorchObs, own: OwnViews, action_masks: th.Tensor | None = None) -> Distribution:
        """Over actions that both the rows' own masks and ``action_masks``, (B, M) bool, allow."""
        agent = self._agent(obs) if self.actor.reads_agent else None
        masks = self._action_mask(obs)
        if action_masks is not None:
            masks = action_masks if masks is None else masks & action_masks
        if masks is None:
            return actor_distribution(self.actor, self.action_space, self.views.per_agent(self.actor, own, agent))
        unmixed = self.views.per_agent(self.actor.unmixed, own, agent)
        return actor_distribution(self.actor, self.action_space, unmixed, masks)

    def _values(self, obs: PyTorchObs, own: OwnViews | None) -> th.Tensor:
        """(B, 1) values; ``own`` are the rows' own views if they were encoded before."""
        critic, active = self.value_net, self._active(obs)
        if isinstance(critic, TeamCritic):
            views = self.views.teams(self._team(obs), own, active)
            of_teams = critic(views.features, views.teams, views.active)
            values = gather_agents(of_teams, views.rows, self._agent(obs))
        elif isinstance(critic, StateCritic):
            values = self._values_of_states(obs, critic)
        else:
            own = self.views.own(self._own(obs)) if own is None else own
            values = self.views.per_agent(critic, own, self._agent(obs) if critic.reads_agent else None)
        return self._raw_values(obs, values)

    def _raw_values(self, obs: PyTorchObs, outputs: th.Tensor) -> th.Tensor:
        """(B, 1) values on the raw scale, of the critic's outputs (B,)."""
        values, active = outputs.unsqueeze(1), self._active(obs)
        # Whoever takes no part expects nothing: an agent's own end is the end of its return.
        takes_part = None if active is None else active.gather(1, self._agent(obs).unsqueeze(1))
        if self.value_normalizer is not None:
            return self.value_normalizer(values, takes_part)
        return values if takes_part is None else values * takes_part

    def _values_of_states(self, obs: PyTorchObs, critic: StateCritic) -> th.Tensor:
        """(B,) values, each distinct state encoded once."""
        space = self.team_spaces.state
        assert space is not None
        states = entry_of(obs, STATE_KEY, "the critic").reshape(-1, *(space.shape or ()))
        found = self.views.find(states)
        values = self._in_chunks(critic, states[found.index], space)
        return gather_agents(values, found.inverse, self._agent(obs))


def _with_fused_steps(optimizer_class: type[th.optim.Optimizer], kwargs: dict[str, Any]) -> dict[str, Any]:
    """Arguments of Adam with the implementation that takes a third of the time, if none is asked for."""
    if optimizer_class not in (th.optim.Adam, th.optim.AdamW) or kwargs.keys() & {"fused", "foreach", "differentiable"}:
        return kwargs
    return {**kwargs, "fused": True}


class TeamActorCriticPolicy(TeamPolicy, ActorCriticPolicy):  # type: ignore[misc]  # value_net, log_std: ours
    """Policy for PPO, A2C and TRPO on rows of teams; see :class:`TeamPolicy` for the parameters."""

    normalizes_values: ClassVar[bool] = True

    @classmethod
    @abstractmethod
    def paper_table_kwargs(cls) -> dict[str, Any]:
        """Arguments with which the policy has as many parameters as in the paper's table."""

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        Act and estimate values.

        :param obs: rows
        :param deterministic: whether to take the most likely actions
        :return: actions (B, ...), values (B, 1), log-likelihoods (B,)
        """
        own = self.views.own(self._own(obs))
        distribution = self._distribution(obs, own)
        actions = distribution.get_actions(deterministic=deterministic)
        log_prob = distribution.log_prob(actions)
        return actions.reshape((-1, *(self.action_space.shape or ()))), self._values(obs, own), log_prob

    def evaluate_actions(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """
        Evaluate given actions.

        :param obs: rows
        :param actions: (B, ...) actions
        :return: values (B, 1), log-likelihoods (B,), entropies (B,) or None if there is no closed form
        """
        self._warn_of_idle_rows(obs)
        own = self.views.own(self._own(obs))
        distribution = self._distribution(obs, own)
        return self._values(obs, own), distribution.log_prob(actions), distribution.entropy()

    def get_distribution(self, obs: PyTorchObs) -> Distribution:
        """
        Action distribution; ``team`` is not read and may be missing.

        :param obs: rows, or own observations alone (B, ...)
        """
        return self._distribution(obs, self.views.own(self._own(obs)))


def _refuse(use_sde: bool, share_features_extractor: bool) -> None:
    if use_sde:
        raise ValueError("team policies have no state-dependent exploration (gSDE): leave use_sde=False")
    if not share_features_extractor:
        raise ValueError(
            "team policies share the features extractor between actor and critic: leave share_features_extractor=True"
        )


def _hidden_sizes(net_arch: NetArch) -> tuple[list[int], list[int]]:
    """Hidden sizes of action heads and of value heads."""
    if not isinstance(net_arch, dict):
        return list(net_arch), list(net_arch)
    if set(net_arch) != {"pi", "vf"}:
        raise ValueError(f"net_arch must be a list or have the keys 'pi' and 'vf', got the keys {sorted(net_arch)}")
    return list(net_arch["pi"]), list(net_arch["vf"])
