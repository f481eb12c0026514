"""Policies of QPLEX: the agents' Q networks, the mixer, and their target networks."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import asdict, fields
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_saf.buffers.replay import TeamSteps
from sb3_saf.networks.actor import ActorNetwork
from sb3_saf.networks.encoders import ObservationEncoder
from sb3_saf.networks.layers import HIDDEN_GAIN, NetworkSpec, gather, orthogonal_init
from sb3_saf.policies.rows import ChunkSize, TeamRowsPolicy
from sb3_saf.qplex.mixers import Mixer
from sb3_saf.qplex.parts import AgentMemory, QPLEXParts, QPLEXPoolParts, q_values
from sb3_saf.teams.rows import STATE_KEY, Array

#: What agents with memory remember: memory (B, M), last action (B,).
State = tuple[Array, ...]


class QNetworks(NamedTuple):
    """
    All networks of Q_tot.

    :param memory: memory of each agent, or None
    :param mixer: mixer from Q_i of all agents to Q_tot
    :param state_encoder: encoder of the games' states for the mixer; None if it reads the agents' features
    """

    encoder: nn.Module
    memory: AgentMemory | None
    actor: ActorNetwork
    mixer: Mixer
    state_encoder: nn.Module | None


class Evaluated(NamedTuple):
    """
    Result of one step of the agents' networks.

    :param values: (B, A) Q_i of every action, -inf for illegal ones
    :param latents: (B, H) inputs of the heads
    :param state: next recurrent state if each agent takes its best action; None without memory
    """

    values: th.Tensor
    latents: th.Tensor
    state: State | None


class QPLEXPolicy(TeamRowsPolicy):
    """
    Policy of QPLEX, QMIX and VDN.

    Acting reads each agent's own observation only (``obs``; ``agent`` with one head per agent or with memory;
    ``action_mask`` if observations have it). The mixer reads features of all agents, or the state of the game if
    observations have one; it is used in training only.

    It also takes the fields of :class:`QPLEXParts` by keyword, including ``mixer``.

    :param observation_space: Dict observation space of ``CentralizedValueWrapper``
    :param action_space: Discrete, counting from 0
    :param lr_schedule: learning rate schedule
    :param net_arch: hidden sizes of the Q heads
    :param activation_fn: activation of hidden layers
    :param ortho_init: whether encoder and heads have orthogonal initialisation, as in SAF
    :param encode_once: False encodes every row, with the same result but slower
    :param chunk_size: observations encoded at once on the CPU; None for all
    :param features_extractor_class: encoder, built for the space of ``obs``
    :param features_extractor_kwargs: its further arguments
    :param normalize_images: whether pictures are divided by 255
    :param optimizer_class: optimizer; RMSprop as published
    :param optimizer_kwargs: its arguments without the learning rate; None for the published ones of RMSprop
    :param kwargs: fields of :class:`QPLEXParts`
    """

    #: Parts with the defaults of the policy.
    parts_class: ClassVar[type[QPLEXParts]] = QPLEXParts

    action_space: spaces.Discrete
    features_extractor: BaseFeaturesExtractor
    actor: ActorNetwork
    actor_memory: AgentMemory | None
    state_encoder: nn.Module | None

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        net_arch: list[int] | None = None,
        activation_fn: type[nn.Module] = nn.Tanh,
        ortho_init: bool = True,
        *,
        encode_once: bool = True,
        chunk_size: ChunkSize = "auto",
        features_extractor_class: type[BaseFeaturesExtractor] = ObservationEncoder,
        features_extractor_kwargs: Mapping[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.RMSprop,
        optimizer_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ):
        self._read_rows_of(observation_space, action_space, encode_once, chunk_size)
        if optimizer_kwargs is None and optimizer_class is th.optim.RMSprop:
            optimizer_kwargs = {"alpha": 0.99, "eps": 1e-5}
        names = {field.name for field in fields(self.parts_class)}
        if unknown := [name for name in kwargs if name not in names]:
            raise TypeError(f"{type(self).__name__} takes no argument {unknown[0]!r}")
        self.parts = self.parts_class(**kwargs)
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class,
            dict(features_extractor_kwargs or {}),
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
        )
        self.net_arch = [128, 128] if net_arch is None else list(net_arch)
        self.activation_fn, self.ortho_init = activation_fn, ortho_init
        self._build(lr_schedule)

    def _build(self, lr_schedule: Schedule) -> None:
        self.features_extractor = self.make_features_extractor()
        self.features_dim = self.features_extractor.features_dim
        parts, n_agents = self.parts, self.team_spaces.n_agents
        self.actor_memory = parts.agent_memory(self.features_dim, self.action_space, n_agents)
        latent_dim = self.features_dim if self.actor_memory is None else self.actor_memory.size
        self.actor = parts.actor(
            NetworkSpec(latent_dim, n_agents, self.action_space, self.net_arch, [], self.activation_fn)
        )
        if self.ortho_init:
            self.features_extractor.apply(partial(self.init_weights, gain=HIDDEN_GAIN))
            orthogonal_init(self.actor)
            if self.actor_memory is not None:
                orthogonal_init(self.actor_memory)
        # The mixer is made last: with one seed, policies with different mixers have the same initial agents.
        state = self.team_spaces.state
        self.state_encoder = None if state is None else ObservationEncoder(state, self.features_dim)
        state_dim = self.features_dim * (n_agents if state is None else 1)
        self.mixer = parts.make_mixer(state_dim, n_agents, int(self.action_space.n))
        learning = [module for module in self.online if module is not None]
        self.target_networks = copy.deepcopy(nn.ModuleList(learning)).requires_grad_(False)
        self.optimizer = self.optimizer_class(  # type: ignore[call-arg]
            [parameter for module in learning for parameter in module.parameters()],
            lr=lr_schedule(1),
            **self.optimizer_kwargs,
        )

    @property
    def online(self) -> QNetworks:
        """The networks that are trained and act."""
        return QNetworks(self.features_extractor, self.actor_memory, self.actor, self.mixer, self.state_encoder)

    @property
    def target(self) -> QNetworks:
        """The target networks."""
        copies = iter(self.target_networks)
        parts = [None if module is None else next(copies) for module in self.online]
        return QNetworks(*parts)  # type: ignore[arg-type]

    def parameter_pairs(self) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
        """Return the parameters of the online networks, and of the target networks in the same order."""
        online = [parameter for module in self.online if module is not None for parameter in module.parameters()]
        return online, list(self.target_networks.parameters())

    def _get_constructor_parameters(self) -> dict[str, Any]:
        names = ["net_arch", "activation_fn", "ortho_init", "encode_once", "chunk_size"]
        names += ["features_extractor_class", "features_extractor_kwargs", "optimizer_class", "optimizer_kwargs"]
        own = {name: getattr(self, name) for name in names}
        data = super()._get_constructor_parameters() | own | asdict(self.parts)
        return data | {"lr_schedule": self._dummy_schedule}

    # --- encoding ---------------------------------------------------------------------------------------------------

    def encode_with(self, encoder: nn.Module, observations: th.Tensor) -> th.Tensor:
        """Return features (K, d) of own observations (K, *shape), by the online or the target encoder."""
        return self._in_chunks(encoder, observations, self.team_spaces.own)

    def encode_states(self, encoder: nn.Module, states: th.Tensor) -> th.Tensor:
        """Return features (G, d) of states (G, *state), with each unique state encoded once."""
        assert self.team_spaces.state is not None
        found = self.row_encoder.find(states)
        return gather(self._in_chunks(encoder, states[found.index], self.team_spaces.state), found.inverse)

    # --- acting -----------------------------------------------------------------------------------------------------

    def own_q_values(self, obs: PyTorchObs) -> th.Tensor:
        """
        Compute Q_i of every action from own observations, without memory; -inf for illegal actions.

        :param obs: rows, or only own observations
        :return: (B, A)
        """
        own = self.encode_own(obs)
        agent = self._agent(obs) if self.actor.reads_agent else None
        values = self.row_encoder.apply(partial(q_values, self.actor), own, agent)
        masks = self._action_mask(obs)
        return values if masks is None else values.masked_fill(~masks, -th.inf)

    def forward(self, obs: PyTorchObs, deterministic: bool = True) -> th.Tensor:
        """Return greedy actions, (B,)."""
        return self._predict(obs, deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = True) -> th.Tensor:
        """Return greedy actions, (B,); exploration is done by the algorithm."""
        return self.own_q_values(observation).argmax(dim=1)

    @property
    def acts_by_index(self) -> bool:
        """See the base class; memory reads the index, too."""
        return self.actor.reads_agent or self.actor_memory is not None

    def _predict_rows(
        self, rows: Any, state: Any, episode_start: np.ndarray | None, deterministic: bool, **kwargs: Any
    ) -> tuple[np.ndarray, State | None]:
        """Act greedily; with memory, rows need ``"agent"``, and ``state`` is memory and last action."""
        if self.actor_memory is None:
            return super()._predict_rows(rows, state, episode_start, deterministic)
        self.set_training_mode(False)
        obs, is_batch = self.obs_to_tensor(rows)
        with th.no_grad():
            values, _, state = self.evaluate(obs, state, episode_start)
        actions = values.argmax(dim=1).cpu().numpy()
        return (actions if is_batch else actions.squeeze(axis=0)), state

    def evaluate(
        self, obs: PyTorchObs, state: State | None = None, episode_start: np.ndarray | None = None
    ) -> Evaluated:
        """
        Evaluate the agents' networks for one step; ``episode_start`` as in ``predict``.

        :param obs: rows, or only own observations
        """
        net, features = self.actor_memory, self.encode_own(obs).of_rows()
        if net is None:
            return Evaluated(self.own_q_values(obs), features, None)
        if state is None:
            starts = th.ones(len(features), dtype=th.bool, device=features.device)
            memory = features.new_zeros(len(features), net.state_dim)
            last = th.full((len(features),), -1, device=features.device)
        else:
            starts = self._starts(obs, episode_start)
            memory, last = (th.as_tensor(part, device=features.device) for part in state)
        agent = self._agent(obs)
        inputs = net.inputs(features, last.long().masked_fill(starts, -1), agent)
        latents, memory = net.step(inputs, memory, starts)
        values = q_values(self.actor, latents, agent, self._action_mask(obs))
        return Evaluated(values, latents, (memory.cpu().numpy(), values.argmax(dim=1).cpu().numpy()))

    def team_steps(self, obs: dict[str, th.Tensor]) -> TeamSteps:
        """Return the mixer's inputs from rows of whole teams, game-major."""
        n_agents, active = self.team_spaces.n_agents, self._active(obs)
        own = self._own(obs).unflatten(0, (-1, n_agents))
        states = None if self.state_encoder is None else obs[STATE_KEY][::n_agents]
        return TeamSteps(own, None, None if active is None else active[::n_agents], states)


class QPLEXPoolPolicy(QPLEXPolicy):
    """
    QPLEX with a pool: each agent's Q head is selected from a shared pool by signature keys, as in SAF.

    Training draws the head (Gumbel noise, hard choice, straight-through gradient): heads learn in proportion to their
    weights, and Q_i, V_i and A_i of a row come from one head, so the mixer is consistent for every draw. Acting and the
    targets of the loss use the favourite head, so that the bootstrapped value is that of the executed action.
    """

    parts_class: ClassVar[type[QPLEXParts]] = QPLEXPoolParts
