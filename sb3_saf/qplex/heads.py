"""
Q values of each agent from its own observations only, for decentralised execution.

Letters: K rows, N agents, A actions, U heads of a pool, d features, H size of the memory.
"""

from __future__ import annotations

import torch as th
from gymnasium import spaces
from torch import nn

from sb3_saf.networks.actor import ActorNetwork, PolicyPool, draw_policy
from sb3_saf.networks.distributions import policy_parameters

#: Hidden and cell states of agents, each (K, H).
Memory = tuple[th.Tensor, th.Tensor]


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


class AgentMemory(nn.Module):
    """
    An LSTM over an agent's observations and actions. It reads the features, the last action and the agent's index.

    :param features_dim: d
    :param action_space: one agent's action space
    :param n_agents: N
    :param hidden_size: H
    """

    def __init__(self, features_dim: int, action_space: spaces.Discrete, n_agents: int, hidden_size: int):
        super().__init__()
        self.n_actions, self.n_agents, self.hidden_size = int(action_space.n), n_agents, hidden_size
        self.cell = nn.LSTMCell(features_dim + self.n_actions + n_agents, hidden_size)

    def inputs(self, features: th.Tensor, last_actions: th.Tensor, agent: th.Tensor) -> th.Tensor:
        """
        Concatenate the inputs of the LSTM.

        :param features: (K, d)
        :param last_actions: (K,) int64, -1 at the start of an episode
        :param agent: (K,) int64
        :return: (K, d + A + N)
        """
        # One extra class for "none", which is then cut off.
        last = nn.functional.one_hot(last_actions + 1, self.n_actions + 1)[:, 1:]
        identity = nn.functional.one_hot(agent, self.n_agents)
        return th.cat([features, last.to(features.dtype), identity.to(features.dtype)], dim=1)

    def forward(self, inputs: th.Tensor, memory: Memory) -> Memory:
        """Run one step on inputs (K, d + A + N)."""
        return self.cell(inputs, memory)

    def empty(self, n_rows: int, like: th.Tensor) -> Memory:
        """Return the memory of K agents at the start of an episode."""
        zeros = like.new_zeros(n_rows, self.hidden_size)
        return zeros, zeros

    def unroll(self, inputs: th.Tensor, resets: th.Tensor) -> Memory:
        """
        Run over whole sequences.

        :param inputs: (n, T, N, d + A + N) inputs of n sequences of T steps
        :param resets: (n, T) bool, steps before which the memory is reset
        :return: hidden and cell state after every step, each (n * T * N, H)
        """
        n, length, n_agents = inputs.shape[:3]
        memory = self.empty(n * n_agents, inputs)
        keep = (~resets).to(inputs.dtype).repeat_interleave(n_agents, dim=0)
        steps = []
        for t in range(length):
            kept = keep[:, t : t + 1]
            memory = self(inputs[:, t].flatten(0, 1), (memory[0] * kept, memory[1] * kept))
            steps.append(memory)
        hidden, cell = (th.stack(part, dim=1) for part in zip(*steps, strict=True))
        return tuple(  # type: ignore[return-value]
            part.view(n, n_agents, length, -1).transpose(1, 2).reshape(n * length * n_agents, -1)
            for part in (hidden, cell)
        )
