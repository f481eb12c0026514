"""
Base of the policies of SAF, MAPPO and IPPO: ``TeamPolicy``, and its versions for PPO, A2C and TRPO
(``TeamActorCriticPolicy``) and for MaskablePPO (``TeamMaskablePolicy``).

The actor reads ``obs`` (and ``agent``, if it depends on the agent's index); only the critic reads ``team``. Letters: B
rows, N agents.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from functools import partial
from inspect import signature
from typing import Any, ClassVar, Final, Literal, NoReturn

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_saf.buffers.rollout import LaterValues, Step, TeamMinibatch, TeamRolloutBuffer
from sb3_saf.networks.actor import ActionHead, ActorNetwork
from sb3_saf.networks.critic import StateCritic, TeamCritic, ValueNormalizer
from sb3_saf.networks.distributions import masked_parameters
from sb3_saf.networks.encoders import ObservationEncoder
from sb3_saf.networks.layers import HIDDEN_GAIN, NetworkSpec, gather, orthogonal_init
from sb3_saf.networks.memory import Memory, MemoryName
from sb3_saf.networks.row_encoder import Encoded, EncodedRows, joined
from sb3_saf.policies.memory import Masks, RememberingPolicy, RunningMemory
from sb3_saf.policies.parts import TeamParts
from sb3_saf.policies.rows import ChunkSize, entry_of
from sb3_saf.teams.checks import check_choice, check_count, check_flag
from sb3_saf.teams.rows import STATE_KEY

#: Arguments of Adam that exclude its fused implementation, or choose it.
_OTHER_THAN_FUSED: Final = {"fused", "foreach", "differentiable"}

NetArch = list[int] | dict[str, list[int]]


class TeamPolicy(RememberingPolicy):
    """
    Base of policies on rows of teams: one row is one agent in one game at one step.

    Mixin for the actor-critic policies of SB3 or sb3-contrib, whose networks it replaces.

    A row's observation is that of ``CentralizedValueWrapper``: ``obs``, ``team`` and ``agent``. Action probabilities
    depend on ``obs`` only, bit for bit. Equal observations of a batch are encoded once, so extractors must treat
    observations independently (no batch normalisation).

    With ``action_mask`` in observations, illegal actions have probability zero in every policy of a pool, hence in the
    mixture; entropies are over legal actions. ``predict`` then needs the mask beside ``obs``. With ``active``, critics
    ignore inactive agents, and the value of an inactive agent is exactly zero.

    With ``memory``, the actor's heads (the selection of a pool, too) read a GRU or an LSTM over the agent's own
    observations in its episode, and the critic has one of its own over its states. It needs
    ``rollout_buffer_class=TeamRolloutBuffer``, whose minibatches are then sequences. The memory of the games that are
    played advances with every :meth:`forward`, and begins where rows have ``episode_start``; :meth:`predict` takes and
    returns it as SB3's ``state``, (B, Ma).

    A policy also takes the fields of its ``parts_class`` by keyword.

    :param observation_space: Dict of ``obs``, ``team``, ``agent``, and optionally ``active``, ``action_mask``,
        ``state``
    :param action_space: Discrete, MultiDiscrete, MultiBinary or Box
    :param lr_schedule: learning rate schedule
    :param net_arch: hidden sizes of actor and critic heads, or ``dict(pi=..., vf=...)``; None for [128, 128]
    :param encode_once: whether equal observations of a batch are encoded once; False encodes every row, with the same
        result. None: True for integer observations (pictures, codes, choices); float observations are rarely equal
    :param chunk_size: observations encoded at once on the CPU; None for all, ``"auto"`` for all, except for convolved
        pictures, whose intermediate results should fit the cache
    :param normalize_values: whether the critic learns returns normalised by their running mean and variance (see
        ``sb3_saf.networks.critic``); needs ``rollout_buffer_class=TeamRolloutBuffer``. ``"agent"`` keeps mean
        and variance of each agent's own returns, for agents whose rewards differ in scale. The policy's values,
        ``train/value_loss`` and ``clip_range_vf`` are on the raw scale in all cases
    :param memory: ``"gru"``, ``"lstm"``, or None for policies of the present observation
    :param memory_size: H, size of the actor's memory and of the critic's
    :param critic_memory: whether the critic of a policy with memory has one, too
    :param use_sde: must not be True. SB3's algorithms pass False: their policy warns if they have a buffer of SB3's own
    :param share_features_extractor: must be True: actor and critic always share the encoder
    :param features_extractor_class: encoder, built for the space of ``obs``
    :param features_extractor_kwargs: its further arguments
    :param kwargs: fields of ``parts_class``, and other arguments of SB3's ``ActorCriticPolicy``: activation_fn,
        ortho_init, log_std_init, normalize_images, optimizer_class, optimizer_kwargs (Adam and AdamW use ``fused=True``
        by default)
    """

    #: Actor and critic of the algorithm.
    parts_class: ClassVar[type[TeamParts]]

    actor: ActorNetwork
    value_normalizer: ValueNormalizer | None
    features_dim: int
    net_arch: NetArch
    activation_fn: type[nn.Module]
    log_std_init: float
    ortho_init: bool

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        net_arch: NetArch | None = None,
        *,
        encode_once: bool | None = None,
        chunk_size: ChunkSize = "auto",
        normalize_values: bool | Literal["agent"] = False,
        memory: MemoryName | None = None,
        memory_size: int = 64,
        critic_memory: bool = True,
        use_sde: bool | None = None,
        share_features_extractor: bool = True,
        features_extractor_class: type[BaseFeaturesExtractor] = ObservationEncoder,
        features_extractor_kwargs: Mapping[str, Any] | None = None,
        **kwargs: Any,
    ):
        if use_sde:
            raise ValueError("team policies have no state-dependent exploration (gSDE): leave use_sde=False")
        if not share_features_extractor:
            raise ValueError(
                "team policies share the features extractor between actor and critic: leave "
                "share_features_extractor=True"
            )
        has_other_buffer = use_sde is not None and self.takes_team_buffer
        if has_other_buffer and not TeamRolloutBuffer.waits_for(observation_space):
            if isinstance(action_space, spaces.Box) and not np.can_cast(np.float32, action_space.dtype):
                raise ValueError(
                    f"SB3's own rollout buffer rounds drawn actions to {action_space.dtype}, the numbers of "
                    f"{action_space}, and learns from likelihoods of others than were drawn: train with "
                    "rollout_buffer_class=sb3_saf.TeamRolloutBuffer, which keeps them"
                )
            warnings.warn(
                f"{type(self).__name__} is trained on minibatches of SB3's own rollout buffer, which stores each "
                "observation once more for every agent and splits teams: slower, with the same result where all agents "
                "always take part. Train with rollout_buffer_class=sb3_saf.TeamRolloutBuffer (in a YAML file: "
                "rollout_buffer_class: TeamRolloutBuffer); PPO(policy, env, **sb3_saf.ppo_settings(env)) sets it, with "
                "a batch size of whole teams instead of SB3's 64 rows",
                UserWarning,
                stacklevel=5,
            )
        self._read_rows_of(observation_space, action_space, encode_once, chunk_size)
        self._warned_of_minibatch = False
        self.parts = self._pop_parts(kwargs)
        check_choice("normalize_values", normalize_values, (True, False, "agent"))
        if normalize_values and not self.takes_team_buffer:
            raise ValueError(
                f"normalize_values=True needs TeamRolloutBuffer, which the algorithms of {type(self).__name__} do not "
                "take; leave normalize_values=False, or use PPO with SAFPolicy, MAPPOPolicy or IPPOPolicy"
            )
        self.normalize_values = normalize_values
        check_count("memory_size", memory_size)
        check_flag("critic_memory", critic_memory)
        self.memory, self.memory_size, self.critic_memory = memory, memory_size, critic_memory
        self.running, self.actor_memory = RunningMemory(), None
        if memory is not None:
            self._check_memory()
        # The next class in the MRO is SB3's or sb3-contrib's, which has more arguments than BasePolicy.
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            [128, 128] if net_arch is None else net_arch,
            features_extractor_class=features_extractor_class,
            features_extractor_kwargs=dict(features_extractor_kwargs or {}),  # SB3 modifies it
            **kwargs,
        )

    def _pop_parts(self, kwargs: dict[str, Any]) -> TeamParts:
        """Take the fields of the parts out of the keyword arguments; TypeError for names that nobody knows."""
        names = [field.name for field in fields(self.parts_class)]
        known = {name for base in type(self).__mro__ if "__init__" in vars(base) for name in signature(base).parameters}
        unknown = [name for name in kwargs if name not in known.union(names)]
        if unknown:
            raise TypeError(
                f"{type(self).__name__} has no argument {unknown[0]!r}, which may be one of another method; it takes "
                f"{', '.join(names)}, and those of SB3's policies. Settings of the method are "
                f"sb3_saf.ppo_settings(env, {self.parts_class.__name__.removesuffix('Parts').lower()!r})"
            )
        return self.parts_class(**{name: kwargs.pop(name) for name in names if name in kwargs})

    # --- construction -----------------------------------------------------------------------------------------------

    def _build(self, lr_schedule: Schedule) -> None:
        sizes = self.net_arch if isinstance(self.net_arch, dict) else {"pi": self.net_arch, "vf": self.net_arch}
        if set(sizes) != {"pi", "vf"}:
            raise ValueError(f"net_arch must be a list or have the keys 'pi' and 'vf', got the keys {sorted(sizes)}")
        spec = of_critic = NetworkSpec(
            self.features_dim,
            self.team_spaces.n_agents,
            self.action_space,
            list(sizes["pi"]),
            list(sizes["vf"]),
            self.activation_fn,
            self.log_std_init,
            self.team_spaces.state,
        )
        if self.memory is not None:
            self.actor_memory = Memory(self.memory, self.features_dim, self.memory_size)
            spec = spec._replace(features_dim=self.memory_size)
        self.actor = self.parts.actor(spec)
        if self.ortho_init:
            self.features_extractor.apply(partial(self.init_weights, gain=HIDDEN_GAIN))
            orthogonal_init(self.actor)
            if self.actor_memory is not None:
                orthogonal_init(self.actor_memory)
        # The critic is built last: with one seed, the initial encoder and actor do not depend on the critic.
        # TRPO identifies the critic's parameters by "value" in their name, as in all names below value_net.
        if self.critic_memory:
            of_critic = of_critic._replace(memory=self.memory, memory_size=self.memory_size)
        self.value_net = self.parts.critic(of_critic)
        if self.ortho_init:
            orthogonal_init(self.value_net)
        n_scales = self.team_spaces.n_agents if self.normalize_values == "agent" else None
        self.value_normalizer = ValueNormalizer(n_scales) if self.normalize_values else None
        kwargs = dict(self.optimizer_kwargs)
        if self.optimizer_class in (th.optim.Adam, th.optim.AdamW) and not kwargs.keys() & _OTHER_THAN_FUSED:
            kwargs["fused"] = True  # takes a third of the time
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **kwargs)  # type: ignore[call-arg]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        for name in ("use_sde", "squash_output", "full_std", "use_expln"):  # of gSDE
            data.pop(name, None)
        names = ("encode_once", "chunk_size", "normalize_values", "memory", "memory_size", "critic_memory")
        return data | asdict(self.parts) | {name: getattr(self, name) for name in names}

    @property
    def log_std(self) -> th.Tensor:
        """(policies, D) log standard deviations of Box actions; AttributeError for other actions."""
        heads = [module for module in self.actor.modules() if isinstance(module, ActionHead)]
        log_stds: list[th.Tensor] = [head.log_std for head in heads if head.log_std is not None]
        if not log_stds:
            raise AttributeError("only policies with Box actions have a log_std")
        return th.stack(log_stds)

    # --- what SB3 calls ---------------------------------------------------------------------------------------------

    @property
    def acts_by_index(self) -> bool:
        """See the base class."""
        return self.actor.reads_agent

    def forward(
        self, obs: PyTorchObs, deterministic: bool = False, action_masks: Masks | None = None
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        Act and estimate values.

        :param obs: rows
        :param deterministic: whether to take the most likely actions
        :param action_masks: (B, M) of MaskablePPO; None allows everything
        :return: actions (B, ...), values (B, 1), log-likelihoods (B,). In evaluation mode without gradients,
            values are computed when they are read: read them before the weights change
        """
        encoded = self._encoded(obs, of_step=True)
        step, latents = (None, None) if self.actor_memory is None else self._advance(obs, encoded)
        distribution = self._distribution(obs, encoded.own, action_masks, latents)
        actions = distribution.get_actions(deterministic=deterministic)
        log_prob = distribution.log_prob(actions)
        actions = actions.reshape((-1, *(self.action_space.shape or ())))
        return actions, self._values_of_step(obs, encoded, step), log_prob

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
        latents = None if self.actor_memory is None else self._latents_of_sequences(obs, encoded)
        distribution = self._distribution(obs, encoded.own, action_masks, latents)
        if isinstance(self.action_space, spaces.MultiBinary):
            actions = actions.float()  # sb3-contrib's buffers give integers
        return self._values(obs, encoded), distribution.log_prob(actions), distribution.entropy()

    def get_distribution(self, obs: PyTorchObs, action_masks: Masks | None = None) -> Distribution:
        """
        Return the action distribution; ``team`` is not read and may be missing.

        With memory, minibatches are sequences; in other rows, the agents' episodes begin.

        :param obs: rows, or only own observations (B, ...)
        :param action_masks: (B, M) of MaskablePPO; None allows everything
        """
        if self.actor_memory is None:
            return self._distribution(obs, self.encode_own(obs), action_masks)
        if not isinstance(obs, TeamMinibatch):
            own = self.encode_own(obs)
            return self._distribution(obs, own, action_masks, self.remember(own.of_rows())[0])
        encoded = Encoded(*self.encode_teams(obs))
        latents = self._latents_of_sequences(obs, encoded, twice=True)
        return self._distribution(obs, encoded.own, action_masks, latents)

    def predict_values(self, obs: PyTorchObs) -> th.Tensor:
        """
        Estimate values.

        A critic with memory remembers the steps of the running games (:meth:`forward`), which are not changed: rows are
        those of the next step of all games, or a last observation (:class:`~sb3_saf.teams.rows.TerminalRow`). Other
        rows are those of games that begin.

        :param obs: rows
        :return: (B, 1)
        """
        critic = self._remembering_critic
        if critic is not None and not isinstance(obs, TeamMinibatch):
            return self._values_of_running_games(obs, critic)
        return self._values(obs, self._encoded(obs))

    def _check_minibatch(self, obs: PyTorchObs) -> None:
        """Warn once about minibatches with rows of agents that take no part."""
        if self._warned_of_minibatch or not self.training or isinstance(obs, TeamMinibatch):
            return
        active, takes_part = self._active(obs), self._takes_part(obs)
        if active is None or takes_part is None or not (active.any(dim=1) & ~takes_part.squeeze(1)).any():
            return  # padding rows have no team
        advice = (
            "Train with rollout_buffer_class=sb3_saf.TeamRolloutBuffer, which leaves them out."
            if self.takes_team_buffer
            else f"The buffers of {type(self).__name__}'s algorithms cannot leave them out; PPO with "
            "sb3_saf.TeamRolloutBuffer can."
        )
        self._warned_of_minibatch = True
        warnings.warn(
            "The minibatch has rows of agents that take no part (dead, away, or not joined yet); they enter the loss, "
            f"the entropy and the normalisation of advantages, and an absence ends the agent's return. {advice}",
            UserWarning,
            stacklevel=3,
        )

    def _encoded(self, obs: PyTorchObs, of_step: bool = False) -> Encoded:
        """Encode the inputs of actor and critic; ``of_step`` as in :meth:`encode_teams`."""
        if isinstance(self.value_net, TeamCritic):
            return Encoded(*self.encode_teams(obs, of_step))
        return Encoded(self.encode_own(obs), None)

    def _distribution(
        self, obs: PyTorchObs, own: EncodedRows, action_masks: Masks | None = None, latents: th.Tensor | None = None
    ) -> Distribution:
        """
        Return the distribution over actions allowed by both the rows' own masks and ``action_masks``, (B, M).

        With memory, heads read ``latents`` (B, H) instead of own observations.
        """
        agent = self._agent(obs) if self.actor.reads_agent else None
        masks = self._legal(obs, action_masks, own.features.device)
        head = self.actor if masks is None else self.actor.unmixed
        parameters = self.row_encoder.apply(head, own, agent) if latents is None else head(latents, agent)
        return self.actor.distribution(parameters, masks)

    def _legal(self, obs: PyTorchObs, action_masks: Masks | None, device: th.device) -> th.Tensor | None:
        """Return the choices (B, M) allowed by both the rows' own masks and ``action_masks``; None if all are."""
        masks = self._action_mask(obs)
        if action_masks is None:
            return masks
        allowed = th.as_tensor(action_masks, dtype=th.bool, device=device)
        allowed = allowed.reshape(-1, allowed.shape[-1])
        return allowed if masks is None else masks & allowed

    def evaluate_pool(
        self, obs: PyTorchObs, latent: th.Tensor, action_masks: Masks | None = None
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Return weights and parameters of the policies; a single policy is a pool of one.

        :param obs: rows
        :param latent: (B, H) input of the actor: features, or the output of its LSTM
        :param action_masks: (B, M) of MaskablePPO; None allows everything
        :return: log weights (B, U) and parameters (B, U, P), illegal actions masked
        """
        log_weights, parameters = self.actor.evaluate(latent, self._agent(obs) if self.actor.reads_agent else None)
        legal = self._legal(obs, action_masks, latent.device)
        if legal is not None:
            parameters = masked_parameters(self.action_space, parameters, legal)
        return log_weights, parameters

    def _values(self, obs: PyTorchObs, encoded: Encoded) -> th.Tensor:
        """Return values (B, 1)."""
        critic, teams = self.value_net, encoded.teams
        if isinstance(critic, TeamCritic):
            assert teams is not None
            states = critic.states(teams.features, teams.members, teams.active)
            if critic.memory is not None:
                states = self._over_time(critic.memory, states, obs, teams.active)
            values = teams.of_rows(critic.values(states))
        elif isinstance(critic, StateCritic):
            space = self.team_spaces.state
            assert space is not None
            games = entry_of(obs, STATE_KEY, "the critic").reshape(-1, *(space.shape or ()))
            unique = self.row_encoder.find(games)  # equal states are encoded once
            of_games = self._in_chunks(critic, games[unique.index], space)
            values = gather(of_games.flatten(0, 1), unique.inverse * of_games.shape[1] + self._agent(obs))
        else:
            values = self.row_encoder.apply(critic, encoded.own, self._agent(obs) if critic.reads_agent else None)
        return self._raw_values(obs, values)

    def _values_of_step(self, obs: PyTorchObs, encoded: Encoded, step: Step | None) -> th.Tensor:
        """Return values (B, 1) of a step of all games; in a rollout, many steps are evaluated together."""
        if step is None and (self.training or th.is_grad_enabled() or isinstance(self.value_net, StateCritic)):
            return self._values(obs, encoded)
        step = Step.of(obs, encoded) if step is None else step
        if isinstance(self.value_net, StateCritic):
            step.values = self._values(obs, encoded)
        features = encoded.own.features
        return LaterValues.of(step, features.new_empty(encoded.own.n_rows, 0), self._values_of_steps)

    def _values_of_steps(self, steps: Sequence[Step]) -> list[th.Tensor]:
        """Return values (B, 1) of each step."""
        if self.memory is not None:
            self._compute_waiting()
        known = [step.values for step in steps if step.values is not None]
        if len(known) == len(steps):
            return known
        with th.no_grad():
            obs = {key: th.cat([step.obs[key] for step in steps]) for key in steps[0].obs}
            values = self._values(obs, joined([step.encoded for step in steps]))
            return list(th.split(values, [step.encoded.own.n_rows for step in steps]))

    def _raw_values(self, obs: PyTorchObs, outputs: th.Tensor) -> th.Tensor:
        """Return values (B, 1) on the raw scale from the critic's outputs (B,)."""
        # The value of an inactive agent is zero: its return ends when the agent ends.
        values, takes_part = outputs.unsqueeze(1), self._takes_part(obs)
        if self.value_normalizer is None:
            return values if takes_part is None else values * takes_part
        if isinstance(obs, TeamMinibatch):
            obs.update_statistics(self.value_normalizer)
        elif self.training and outputs.requires_grad:
            outputs.register_hook(_refuse_to_train)
        agents = self._agent(obs).unsqueeze(1) if self.normalize_values == "agent" else None
        return self.value_normalizer(values, takes_part, agents)


def _refuse_to_train(gradient: th.Tensor) -> NoReturn:
    raise ValueError(
        "normalize_values=True needs a rollout buffer that updates the statistics of returns, but values are being "
        "trained and none did; pass rollout_buffer_class=sb3_saf.TeamRolloutBuffer (or, in a buffer of your own, give "
        "sb3_saf.buffers.rollout.TeamMinibatch), or leave normalize_values=False"
    )


class TeamActorCriticPolicy(TeamPolicy, ActorCriticPolicy):  # type: ignore[misc]  # value_net, log_std: ours
    """Policy for PPO, A2C and TRPO on rows of teams; see :class:`TeamPolicy` for the parameters."""

    takes_team_buffer: ClassVar[bool] = True


class TeamMaskablePolicy(TeamPolicy, MaskableActorCriticPolicy):  # type: ignore[misc]  # value_net: ours
    """
    Policy for MaskablePPO on rows of teams; see :class:`TeamPolicy` for the parameters.

    sb3-contrib reads masks by ``venv.env_method("action_masks")``: one per row, that is, per agent.

    Masks are (B, M): one flag per choice, those of each action dimension in turn (of a MultiBinary: off, on). Each
    policy of a pool is masked before mixing: likelihood and entropy are those of drawing a policy and then one of its
    allowed actions. If a mask allows nothing, all actions are equally likely. If observations also have masks, an
    action must be allowed by both.
    """

    #: Unused: Box actions have no masks.
    log_std_init: float = 0.0
