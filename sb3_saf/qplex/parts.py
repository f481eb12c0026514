"""
The parts of QPLEX: heads of Q values that read each agent's own observations only, pool, memory and mixer.

Letters: K rows, N agents, A actions, U heads of a pool, d features, H size of the memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import torch as th
from gymnasium import spaces
from torch import nn

from sb3_saf.networks.actor import ActorNetwork, PolicyPool, SinglePolicy
from sb3_saf.networks.critic import Heads
from sb3_saf.networks.layers import NetworkSpec
from sb3_saf.networks.memory import MEMORY_NAMES, Memory, MemoryName
from sb3_saf.networks.mixtures import draw_policy, policy_parameters
from sb3_saf.qplex.mixers import MIXER_NAMES, Mixer, MixerName, QMIXMixer, QPLEXMixer, VDNMixer
from sb3_saf.teams.checks import check_choice, check_count


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
    """
    Memory of an agent, which reads the features, the last action and the agent's index.

    :param kind: ``"gru"`` or ``"lstm"``
    :param n_actions: A
    :param size: H
    """

    def __init__(self, kind: MemoryName, features_dim: int, n_actions: int, n_agents: int, size: int):
        super().__init__(kind, features_dim + n_actions + n_agents, size)
        self.n_actions, self.n_agents, self.size = n_actions, n_agents, size

    def inputs(self, features: th.Tensor, last_actions: th.Tensor, agent: th.Tensor) -> th.Tensor:
        """
        Concatenate the inputs.

        :param features: (K, d)
        :param last_actions: (K,) int64, -1 at the start of an episode
        :param agent: (K,) int64
        :return: (K, d + A + N)
        """
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

    def agent_memory(self, features_dim: int, action_space: spaces.Discrete, n_agents: int) -> AgentMemory | None:
        """Make each agent's memory, if any."""
        if self.memory is None:
            return None
        return AgentMemory(self.memory, features_dim, int(action_space.n), n_agents, self.memory_size)

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
