"""
Q values of each agent from its own observations only, for decentralised execution.

Letters: K rows, N agents, A actions, U heads of a pool, d features, H size of the memory.
"""

from __future__ import annotations

import torch as th
from torch import nn

from sb3_saf.networks.actor import ActorNetwork, PolicyPool, draw_policy
from sb3_saf.networks.distributions import policy_parameters
from sb3_saf.networks.memory import Memory, MemoryName


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
    :param features_dim: d
    :param n_actions: A
    :param n_agents: N
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
