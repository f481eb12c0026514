"""
What the policies of SAF, MAPPO and IPPO share: ``TeamPolicy``, and what it becomes for PPO, A2C and TRPO
(``TeamActorCriticPolicy``) and for MaskablePPO (``TeamMaskablePolicy``).

The actor reads ``obs`` (and ``agent``, where it reads who acts); only the critic reads ``team``. Letters: B rows, N
agents.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from functools import partial
from typing import Any, ClassVar, Final, NamedTuple, NoReturn

import numpy.typing as npt
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_saf.buffers.later import LaterValues
from sb3_saf.buffers.rollout import TeamMinibatch
from sb3_saf.envs.teams import ACTIVE_KEY, AGENT_KEY, STATE_KEY
from sb3_saf.networks.actor import ActionHead, ActorNetwork, PoolOutput
from sb3_saf.networks.critic import OwnValueHead, StateCritic, TeamCritic
from sb3_saf.networks.distributions import masked_parameters
from sb3_saf.networks.layers import HIDDEN_GAIN, NetworkSpec, gather_agents, orthogonal_init
from sb3_saf.networks.row_encoder import EncodedRows, EncodedTeams, joined_rows, joined_teams
from sb3_saf.networks.value_normalizer import ValueNormalizer
from sb3_saf.policies.distributions import actor_distribution
from sb3_saf.policies.extractors import ObservationEncoder
from sb3_saf.policies.parts import TeamParts
from sb3_saf.policies.rows import ChunkSize, TeamRowsPolicy, entry_of, pop_named

#: Action masks of MaskablePPO, (B, M).
Masks = npt.NDArray[Any] | th.Tensor
#: A head of the actor: (K, d) features and (K,) agents or None, to (K, ...).
Head = Callable[[th.Tensor, th.Tensor | None], th.Tensor]

NetArch = list[int] | dict[str, list[int]]

#: Arguments of SB3's base class that only gSDE reads; team policies refuse gSDE and do not save them.
_SDE_ARGUMENTS: Final = ("use_sde", "squash_output", "full_std", "use_expln")


class Encoded(NamedTuple):
    """
    Encoded rows.

    :param own: own observations of the rows
    :param teams: those of their teams; None if the critic does not read them
    """

    own: EncodedRows
    teams: EncodedTeams | None


class Step(NamedTuple):
    """
    What a critic reads of one step of all games.

    :param obs: who acts and who takes part, of the rows
    :param encoded: what they see
    """

    obs: dict[str, th.Tensor]
    encoded: Encoded


class TeamPolicy(TeamRowsPolicy):
    """
    Base of policies on rows of teams: one row is one agent in one game at one step.

    It is inherited together with one of the actor-critic policies of SB3 or sb3-contrib, whose networks it replaces.

    A row's observation is that of ``CentralizedValueWrapper``: ``obs``, ``team`` and ``agent``. The actor reads
    ``obs`` alone: what other agents see cannot change an action's probability by a bit. Equal observations of a batch
    are encoded once, so extractors must treat observations one by one (no batch normalisation).

    Where observations have ``action_mask``, illegal actions have probability zero: in every policy of a pool, so also
    in their mixture; entropies are over legal actions. ``predict`` then needs the mask beside ``obs``. Where they have
    ``active``, critics leave out agents that take no part, and the value of such an agent is exactly zero.

    Beside these arguments, a policy takes the fields of its ``parts_class`` by keyword.

    :param observation_space: Dict of ``obs``, ``team``, ``agent``, and perhaps ``active``, ``action_mask``, ``state``
    :param action_space: Discrete, MultiDiscrete, MultiBinary or Box
    :param lr_schedule: learning rate schedule
    :param net_arch: hidden sizes of actor and critic heads, or ``dict(pi=..., vf=...)``; None for [128, 128]
    :param encode_once: whether equal observations of a batch are encoded once; False encodes every row, which gives
        the same numbers. None: once where observations are whole numbers (pictures, codes, choices); float
        observations are hardly ever equal
    :param chunk_size: observations encoded at once on the CPU; None for all, ``"auto"`` for all but where pictures are
        convolved, whose intermediate results shall fit the cache
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
    #: Whether the algorithm takes TeamRolloutBuffer, which ``normalize_values`` needs.
    normalizes_values: ClassVar[bool] = False

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        net_arch: NetArch | None = None,
        *,
        encode_once: bool | None = None,
        chunk_size: ChunkSize = "auto",
        normalize_values: bool = False,
        use_sde: bool = False,
        share_features_extractor: bool = True,
        features_extractor_class: type[BaseFeaturesExtractor] = ObservationEncoder,
        features_extractor_kwargs: Mapping[str, Any] | None = None,
        **kwargs: Any,
    ):
        _refuse(use_sde=use_sde, share_features_extractor=share_features_extractor)
        self._read_rows_of(observation_space, action_space, encode_once, chunk_size)
        self._warned_of_minibatch = False
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

    def forward(
        self, obs: PyTorchObs, deterministic: bool = False, action_masks: Masks | None = None
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        Act and estimate values.

        :param obs: rows
        :param deterministic: whether to take the most likely actions
        :param action_masks: (B, M) of MaskablePPO; None allows everything
        :return: actions (B, ...), values (B, 1), log-likelihoods (B,). In a rollout, values are computed when they are
            used
        """
        encoded = self._encoded(obs)
        distribution = self._distribution(obs, encoded.own, action_masks)
        actions = distribution.get_actions(deterministic=deterministic)
        log_prob = distribution.log_prob(actions)
        actions = actions.reshape((-1, *(self.action_space.shape or ())))
        return actions, self._values_of_step(obs, encoded), log_prob

    def evaluate_actions(
        self, obs: PyTorchObs, actions: th.Tensor, action_masks: Masks | None = None
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """
        Evaluate given actions.

        :param obs: rows
        :param actions: (B, ...) actions
        :param action_masks: (B, M) of MaskablePPO; None allows everything
        :return: values (B, 1), log-likelihoods (B,), entropies (B,) or None if there is no closed form
        """
        self._check_minibatch(obs)
        encoded = self._encoded(obs)
        distribution = self._distribution(obs, encoded.own, action_masks)
        return self._values(obs, encoded), self._likelihood(distribution, actions), distribution.entropy()

    def get_distribution(self, obs: PyTorchObs, action_masks: Masks | None = None) -> Distribution:
        """
        Return the action distribution; ``team`` is not read and may be missing.

        :param obs: rows, or own observations alone (B, ...)
        :param action_masks: (B, M) of MaskablePPO; None allows everything
        """
        return self._distribution(obs, self.encode_own(obs), action_masks)

    def predict_values(self, obs: PyTorchObs) -> th.Tensor:
        """
        Estimate values.

        :param obs: rows
        :return: (B, 1)
        """
        return self._values(obs, self._encoded(obs))

    def _check_minibatch(self, obs: PyTorchObs) -> None:
        """Warn once of minibatches that TeamRolloutBuffer would give better."""
        if self._warned_of_minibatch or not self.training or isinstance(obs, TeamMinibatch):
            return
        active, takes_part = self._active(obs), self._takes_part(obs)
        if active is not None and takes_part is not None and (active.any(dim=1) & ~takes_part.squeeze(1)).any():
            # Rows of a padding have no team.
            message = (
                "The minibatch has rows of agents that take no part (dead, or not joined yet); they enter the loss, "
                f"the entropy and the normalisation of advantages. {self._advice()}"
            )
        elif self.normalizes_values:
            message = (
                f"{type(self).__name__} is trained on minibatches of SB3's own rollout buffer, which stores "
                f"{self.team_spaces.n_agents + 1} observations per row and splits teams: slower, with the same result. "
                "Train with rollout_buffer_class=sb3_saf.TeamRolloutBuffer; PPO(policy, env, "
                "**sb3_saf.ppo_settings(env)) sets it, with a batch size of whole teams"
            )
        else:
            return
        self._warned_of_minibatch = True
        warnings.warn(message, UserWarning, stacklevel=3)

    def _advice(self) -> str:
        if self.normalizes_values:
            return "Train with rollout_buffer_class=sb3_saf.TeamRolloutBuffer, which leaves them out."
        return (
            f"The buffers of {type(self).__name__}'s algorithms cannot leave them out; PPO with "
            "sb3_saf.TeamRolloutBuffer can."
        )

    def _encoded(self, obs: PyTorchObs) -> Encoded:
        """Encode what actor and critic read of rows."""
        if self._critic_reads_teams:
            return Encoded(*self.encode_teams(obs))
        return Encoded(self.encode_own(obs), None)

    @property
    def _critic_reads_teams(self) -> bool:
        return isinstance(self.value_net, TeamCritic)

    def _likelihood(self, distribution: Distribution, actions: th.Tensor) -> th.Tensor:
        """(B,) log-likelihoods; sb3-contrib's buffers give the bits of MultiBinary actions as whole numbers."""
        return distribution.log_prob(actions.float() if isinstance(self.action_space, spaces.MultiBinary) else actions)

    def _distribution(self, obs: PyTorchObs, own: EncodedRows, action_masks: Masks | None = None) -> Distribution:
        """Over actions that both the rows' own masks and ``action_masks``, (B, M), allow."""
        agent = self._agent(obs) if self.actor.reads_agent else None
        masks = self._legal(obs, action_masks, own.features.device)
        return self._distribution_of(lambda module: self.row_encoder.apply(module, own, agent), masks)

    def _legal(self, obs: PyTorchObs, action_masks: Masks | None, device: th.device) -> th.Tensor | None:
        """(B, M) choices that both the rows' own masks and ``action_masks`` allow; None if all are."""
        masks = self._action_mask(obs)
        if action_masks is None:
            return masks
        allowed = th.as_tensor(action_masks, dtype=th.bool, device=device)
        allowed = allowed.reshape(-1, allowed.shape[-1])
        return allowed if masks is None else masks & allowed

    def evaluate_pool(self, obs: PyTorchObs, latent: th.Tensor, action_masks: Masks | None = None) -> PoolOutput:
        """
        Return what actions are drawn from; a single policy is a pool of one.

        :param obs: rows
        :param latent: (B, H) what the actor reads: features, or what a memory makes of them
        :param action_masks: (B, M) of MaskablePPO; None allows everything
        :return: log weights (B, U) and parameters (B, U, P), illegal actions masked
        """
        output = self.actor.evaluate(latent, self._agent(obs) if self.actor.reads_agent else None)
        legal = self._legal(obs, action_masks, latent.device)
        if legal is None:
            return output
        return output._replace(actions=masked_parameters(self.action_space, output.actions, legal))

    def _distribution_of(self, apply: Callable[[Head], th.Tensor], masks: th.Tensor | None) -> Distribution:
        """Of the actor, which ``apply`` calls for all rows; masks apply to every policy of a pool."""
        parameters = apply(self.actor if masks is None else self.actor.unmixed)
        return actor_distribution(self.actor, self.action_space, parameters, masks)

    def _values(self, obs: PyTorchObs, encoded: Encoded) -> th.Tensor:
        """(B, 1) values."""
        critic, teams = self.value_net, encoded.teams
        if isinstance(critic, TeamCritic):
            assert teams is not None
            values = teams.of_rows(critic(teams.features, teams.members, teams.active))
        elif isinstance(critic, StateCritic):
            values = self._values_of_states(obs, critic)
        else:
            values = self.row_encoder.apply(critic, encoded.own, self._agent(obs) if critic.reads_agent else None)
        return self._raw_values(obs, values)

    def _values_of_step(self, obs: PyTorchObs, encoded: Encoded) -> th.Tensor:
        """(B, 1) values of a step of all games: in a rollout those of many steps are computed together."""
        if self.training or th.is_grad_enabled() or isinstance(self.value_net, StateCritic):
            return self._values(obs, encoded)
        entries = {} if isinstance(obs, th.Tensor) else obs
        read: dict[str, th.Tensor] = {key: entries[key] for key in (AGENT_KEY, ACTIVE_KEY) if key in entries}
        features = encoded.own.features
        # Critics read features: the observations need not be kept.
        encoded = encoded._replace(own=encoded.own._replace(observations=features.new_empty(0)))
        return LaterValues.of(Step(read, encoded), features.new_empty(encoded.own.n_rows, 0), self._values_of_steps)

    def _values_of_steps(self, steps: Sequence[Step]) -> list[th.Tensor]:
        """(B, 1) values of each step."""
        with th.no_grad():
            obs = {key: th.cat([step.obs[key] for step in steps]) for key in steps[0].obs}
            own = joined_rows([step.encoded.own for step in steps])
            found = [step.encoded.teams for step in steps]
            teams = None if None in found else joined_teams([one for one in found if one is not None])
            values = self._values(obs, Encoded(own, teams))
            return list(th.split(values, [step.encoded.own.n_rows for step in steps]))

    def _raw_values(self, obs: PyTorchObs, outputs: th.Tensor) -> th.Tensor:
        """(B, 1) values on the raw scale, of the critic's outputs (B,)."""
        # The value of who takes no part is zero: an agent's own end is the end of its return.
        values, takes_part = outputs.unsqueeze(1), self._takes_part(obs)
        if self.value_normalizer is None:
            return values if takes_part is None else values * takes_part
        if isinstance(obs, TeamMinibatch):
            obs.update_statistics(self.value_normalizer)
        elif self.training and outputs.requires_grad:
            outputs.register_hook(_refuse_to_train)
        return self.value_normalizer(values, takes_part)

    def _values_of_states(self, obs: PyTorchObs, critic: StateCritic) -> th.Tensor:
        """(B,) values, equal states encoded once."""
        space = self.team_spaces.state
        assert space is not None
        states = entry_of(obs, STATE_KEY, "the critic").reshape(-1, *(space.shape or ()))
        found = self.row_encoder.find(states)
        values = self._in_chunks(critic, states[found.index], space)
        return gather_agents(values, found.inverse, self._agent(obs))


def _refuse_to_train(gradient: th.Tensor) -> NoReturn:
    raise ValueError(
        "normalize_values=True needs a rollout buffer that updates the statistics of returns, but values are being "
        "trained and none did; pass rollout_buffer_class=sb3_saf.TeamRolloutBuffer (or, in a buffer of your own, give "
        "sb3_saf.buffers.rollout.TeamMinibatch), or leave normalize_values=False"
    )


def _with_fused_steps(optimizer_class: type[th.optim.Optimizer], kwargs: dict[str, Any]) -> dict[str, Any]:
    """Arguments of Adam with the implementation that takes a third of the time, if none is asked for."""
    if optimizer_class not in (th.optim.Adam, th.optim.AdamW) or kwargs.keys() & {"fused", "foreach", "differentiable"}:
        return kwargs
    return {**kwargs, "fused": True}


class TeamActorCriticPolicy(TeamPolicy, ActorCriticPolicy):  # type: ignore[misc]  # value_net, log_std: ours
    """Policy for PPO, A2C and TRPO on rows of teams; see :class:`TeamPolicy` for the parameters."""

    normalizes_values: ClassVar[bool] = True


class TeamMaskablePolicy(TeamPolicy, MaskableActorCriticPolicy):  # type: ignore[misc]  # value_net: ours
    """
    Policy for MaskablePPO on rows of teams; see :class:`TeamPolicy` for the parameters.

    sb3-contrib asks the environment for masks, ``venv.env_method("action_masks")``: one per row, that is, per agent.

    Masks are (B, M): one flag per choice of an action, those of each dimension in turn (of a MultiBinary: off, on).
    The actions of each policy of a pool are masked before they are mixed: likelihood and entropy are exactly those of
    drawing a policy and then one of its allowed actions. A mask that allows nothing leaves the actions equally likely.
    Where observations have masks, too, an action must be allowed by both.
    """

    #: There are no masks for Box actions, so nothing reads it.
    log_std_init: float = 0.0


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
