"""
Policies of QPLEX: the agents' Q networks (heads, pool, memory), which read own observations only, the mixer, and their
target networks.

Letters: B or K rows, N agents, A actions, U heads of a pool, d features, H size of the memory.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple, get_args

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.utils import get_parameters_by_name
from torch import nn

from sb3_saf.buffers.replay import TeamSteps
from sb3_saf.networks.actor import ActorNetwork, PolicyPool, SinglePolicy
from sb3_saf.networks.critic import Heads
from sb3_saf.networks.distributions import draw_policy, policy_parameters
from sb3_saf.networks.encoders import ObservationEncoder
from sb3_saf.networks.layers import HIDDEN_GAIN, NetworkSpec, gather, orthogonal_init
from sb3_saf.networks.memory import MEMORY_NAMES, Memory, MemoryName
from sb3_saf.policies.rows import ChunkSize, TeamRowsPolicy
from sb3_saf.qplex.mixers import MIXER_NAMES, Mixer, MixerName, QMIXMixer, QPLEXMixer, VDNMixer
from sb3_saf.teams.checks import check_choice, check_count
from sb3_saf.teams.rows import STATE_KEY, Array


def q_values(
    actor: ActorNetwork, latents: th.Tensor, agent: th.Tensor | None, masks: th.Tensor | None = None, draw: bool = False
) -> th.Tensor:
    """
    Compute Q_i of every action.

    A pool uses its favourite head (highest q . k_u), or a head drawn by its weight (Gumbel noise on the logits, hard
    choice, straight-through gradient). One head evaluates all actions of a row, so the best one is well defined.

    :param actor: one head for all agents, one for each, or a pool
    :param latents: (K, d) input of the heads
    :param agent: (K,) indices of agents, needed with one head per agent
    :param masks: (K, A) bool, legal actions; others get -inf. None if all are legal
    :param draw: whether the head is drawn
    :return: (K, A)
    """
    if isinstance(actor, PolicyPool):
        log_weights, of_heads = actor.evaluate(latents)
        values = draw_policy(log_weights, of_heads) if draw else policy_parameters(of_heads, log_weights.argmax(dim=1))
    else:
        values = actor(latents, agent if actor.reads_agent else None)
    return values if masks is None else values.masked_fill(~masks, -th.inf)


class AgentMemory(Memory):
    """Memory of an agent, which reads the features, the last action and the agent's index."""

    def __init__(self, kind: MemoryName, features_dim: int, n_actions: int, n_agents: int, size: int):
        super().__init__(kind, features_dim + n_actions + n_agents, size)
        self.n_actions, self.n_agents, self.size = n_actions, n_agents, size

    def inputs(self, features: th.Tensor, last_actions: th.Tensor, agent: th.Tensor) -> th.Tensor:
        """Concatenate features (K, d), last actions (K,), -1 where episodes begin, and agents (K,); (K, d + A + N)."""
        # One extra class for "none", which is then cut off.
        last = nn.functional.one_hot(last_actions + 1, self.n_actions + 1)[:, 1:]
        identity = nn.functional.one_hot(agent, self.n_agents)
        return th.cat([features, last.to(features.dtype), identity.to(features.dtype)], dim=1)


@dataclass(frozen=True)
class QPLEXParts:
    """
    Settings of a value-factorisation algorithm.

    :param mixer: ``"qplex"``, ``"qmix"`` or ``"vdn"``
    :param heads: ``"shared"`` for one Q head that all agents use, ``"per_agent"`` for one each; a pool is always shared
    :param n_policies: U, Q heads of the pool; 1 for none
    :param latent_dim: d, size of the pool's queries and signature keys
    :param projection_arch: hidden sizes of the pool's query network g_psel
    :param mixer_hidden: hidden size of the mixer's networks
    :param n_kernels: attention kernels of QPLEX's lambda
    :param kernel_arch: hidden sizes of each kernel's networks
    :param detach_state: whether the mixer's gradient stops before the agents' encoder
    :param memory: ``"gru"`` or ``"lstm"`` over features, last action and the agent's index; None for none
    :param memory_size: H, size of each agent's memory
    :param sequence_length: with memory, game steps of a training sequence that enter the loss
    :param burn_in: with memory, game steps before them that only warm up the memory; the length of an episode to always
        start at its beginning
    """

    mixer: MixerName = "qplex"
    heads: Heads = "shared"
    n_policies: int = 1
    latent_dim: int = 64
    projection_arch: tuple[int, ...] = (128, 128)
    mixer_hidden: int = 64
    n_kernels: int = 4
    kernel_arch: tuple[int, ...] = (64,)
    detach_state: bool = False
    memory: MemoryName | None = None
    memory_size: int = 64
    sequence_length: int = 16
    burn_in: int = 8

    def __post_init__(self) -> None:
        check_choice("mixer", self.mixer, MIXER_NAMES)
        check_choice("heads", self.heads, get_args(Heads))
        check_choice("memory", self.memory, (*MEMORY_NAMES, None))
        for name in ("n_policies", "latent_dim", "mixer_hidden", "n_kernels", "memory_size", "sequence_length"):
            check_count(name, getattr(self, name))
        if isinstance(self.burn_in, bool) or not isinstance(self.burn_in, int) or self.burn_in < 0:
            raise ValueError(f"burn_in must be a whole number of at least 0, got {self.burn_in!r}")
        # Saved models may have lists.
        for name in ("projection_arch", "kernel_arch"):
            object.__setattr__(self, name, tuple(getattr(self, name)))

    def actor(self, spec: NetworkSpec) -> ActorNetwork:
        """Make the Q heads: an actor whose logits are Q values."""
        if self.n_policies == 1:
            return SinglePolicy(spec, self.heads == "per_agent")
        return PolicyPool(spec, self.n_policies, "gumbel", self.latent_dim, self.projection_arch)

    def make_mixer(self, state_dim: int, n_agents: int, n_actions: int) -> Mixer:
        """Make the mixer of N agents with as many actions each, for states of size S."""
        if self.mixer == "vdn":
            return VDNMixer()
        if self.mixer == "qmix":
            return QMIXMixer(state_dim, n_agents, self.mixer_hidden)
        return QPLEXMixer(state_dim, n_agents, n_actions, self.mixer_hidden, self.n_kernels, self.kernel_arch)


@dataclass(frozen=True)
class QPLEXPoolParts(QPLEXParts):
    """QPLEX with as many heads in its pool as SAF has policies."""

    n_policies: int = 4


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
        parts, n_agents, n_actions = self.parts, self.team_spaces.n_agents, int(self.action_space.n)
        self.actor_memory = None
        if parts.memory is not None:
            self.actor_memory = AgentMemory(parts.memory, self.features_dim, n_actions, n_agents, parts.memory_size)
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
        self.mixer = parts.make_mixer(state_dim, n_agents, n_actions)
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

    def parameter_pairs(self) -> tuple[list[th.Tensor], list[th.Tensor]]:
        """Return parameters and running statistics of the online networks, and of the targets in the same order."""
        networks = (self.online, self.target_networks)
        online, target = (
            [part for module in modules if module is not None for part in _learned(module)] for modules in networks
        )
        return online, target

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
    ) -> tuple[th.Tensor, th.Tensor, State | None]:
        """
        Evaluate the agents' networks for one step; ``episode_start`` as in ``predict``.

        :param obs: rows, or only own observations
        :return: Q_i of every action (B, A), -inf for illegal ones; inputs of the heads (B, H); the state after the
            step if each agent takes its best action, None without memory
        """
        net, features = self.actor_memory, self.encode_own(obs).of_rows()
        if net is None:
            return self.own_q_values(obs), features, None
        if state is None:
            starts = th.ones(len(features), dtype=th.bool, device=features.device)
            memory = features.new_zeros(len(features), net.state_dim)
            last = th.full((len(features),), -1, device=features.device)
        else:
            starts = self._starts(obs, episode_start)
            memory, last = (th.as_tensor(part, device=features.device) for part in state)
            net.check_state(memory, len(features))
        agent = self._agent(obs)
        inputs = net.inputs(features, last.long().masked_fill(starts, -1), agent)
        latents, memory = net.step(inputs, memory, starts)
        values = q_values(self.actor, latents, agent, self._action_mask(obs))
        return values, latents, (memory.cpu().numpy(), values.argmax(dim=1).cpu().numpy())

    def team_steps(self, obs: dict[str, th.Tensor]) -> TeamSteps:
        """Return the mixer's inputs from rows of whole teams, game-major."""
        n_agents, active = self.team_spaces.n_agents, self._active(obs)
        own = self._own(obs).unflatten(0, (-1, n_agents))
        states = None if self.state_encoder is None else obs[STATE_KEY][::n_agents]
        return TeamSteps(own, None, None if active is None else active[::n_agents], states)


def _learned(module: nn.Module) -> list[th.Tensor]:
    """Return parameters, and the running statistics of layers such as BatchNorm."""
    return [*module.parameters(), *get_parameters_by_name(module, ["running_"])]


class QPLEXPoolPolicy(QPLEXPolicy):
    """
    QPLEX with a pool: each agent's Q head is selected from a shared pool by signature keys, as in SAF.

    Training draws the head (Gumbel noise, hard choice, straight-through gradient): heads learn in proportion to their
    weights, and Q_i, V_i and A_i of a row come from one head, so the mixer is consistent for every draw. Acting and the
    targets of the loss use the favourite head, so that the bootstrapped value is that of the executed action.
    """

    parts_class: ClassVar[type[QPLEXParts]] = QPLEXPoolParts
