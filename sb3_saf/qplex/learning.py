"""
The loss of QPLEX: the temporal-difference error of Q_tot, with double Q-learning and a target network.

    y = r + gamma (1 - done) Q_tot_target(s', a'),   a'_i = the agent's own best legal action under the online networks

Letters: G team steps, N agents, A actions, K unique own observations, d features, H inputs of the heads.
"""

from __future__ import annotations

from typing import NamedTuple

import torch as th
from torch import nn

from sb3_saf.buffers.replay import Sequences, TeamReplaySamples, TeamSteps
from sb3_saf.networks.layers import gather
from sb3_saf.networks.row_encoder import UniqueRows
from sb3_saf.qplex.heads import q_values
from sb3_saf.qplex.mixers import JointChoice, Mixed
from sb3_saf.qplex.policies import QNetworks, QPLEXPolicy


class TeamError(NamedTuple):
    """
    Temporal-difference errors of the G' team steps that enter the loss.

    :param td: (G',) Q_tot - y
    :param q_tot: (G',)
    :param weights: (G', N) lambda_i, or None; zero for inactive agents
    """

    td: th.Tensor
    q_tot: th.Tensor
    weights: th.Tensor | None

    @property
    def loss(self) -> th.Tensor:
        """Mean of the squared errors, as published."""
        return self.td.square().mean()


class Features(NamedTuple):
    """Features (G, N, d) of the observations before and after each team's step."""

    now: th.Tensor
    after: th.Tensor


class _Views(NamedTuple):
    """Unique own observations (K, *shape), with the ``n_now`` before steps first, and each agent's index, (G, N)."""

    views: th.Tensor
    now: th.Tensor
    after: th.Tensor
    n_now: int

    @classmethod
    def of(cls, policy: QPLEXPolicy, samples: TeamReplaySamples) -> _Views:
        """Find the unique observations of a batch."""
        shape = samples.now.own.shape[:2]
        both = th.cat([samples.now.own.flatten(0, 1), samples.after.own.flatten(0, 1)])
        found: UniqueRows = policy.row_encoder.find(both)
        now, after = found.inverse.view(2, *shape)
        return cls(both[found.index], now, after, int(now.max()) + 1)


def team_errors(policy: QPLEXPolicy, samples: TeamReplaySamples, gamma: float) -> TeamError:
    """
    Compute temporal-difference errors; the gradient goes into the online networks.

    :param policy: the policy with its online and target networks
    :param samples: joint transitions
    :param gamma: discount per game step
    """
    views = _Views.of(policy, samples)
    online, latents = _online(policy, views, samples)
    agent = _agents(samples.actions)
    values = _q_values(policy.online, latents.now, agent, samples.now, draw=True)
    mixed = _mix(policy, policy.online, values, samples.now, online.now, samples.actions)
    with th.no_grad():
        best = _q_values(policy.online, latents.after, agent, samples.after).argmax(dim=2)
        features, remembered = _target(policy, views, samples)
        following = _q_values(policy.target, remembered.after, agent, samples.after)
        value = _mix(policy, policy.target, following, samples.after, features.after, best).q_tot
        target = samples.rewards + gamma * (1.0 - samples.dones) * value
    return _counted(TeamError(mixed.q_tot - target, mixed.q_tot, mixed.weights), samples.sequences)


def _counted(error: TeamError, sequences: Sequences | None) -> TeamError:
    if sequences is None:
        return error
    td, q_tot, weights = error
    kept = sequences.counted
    return TeamError(td[kept], q_tot[kept], None if weights is None else weights[kept])


def _agents(actions: th.Tensor) -> th.Tensor:
    """Return the agents' indices, (G N,)."""
    n_steps, n_agents = actions.shape
    return th.arange(n_agents, device=actions.device).repeat(n_steps)


# --- encoding, each unique observation once per network ---------------------------------------------------------------


def _online(policy: QPLEXPolicy, views: _Views, samples: TeamReplaySamples) -> tuple[Features, Features]:
    """Encode with the online networks; no gradient for observations that only occur after a step."""
    encoder = policy.online.encoder
    known = policy.encode_with(encoder, views.views[: views.n_now])
    with th.no_grad():
        new = views.views[views.n_now :]
        every = known.detach() if not len(new) else th.cat([known.detach(), policy.encode_with(encoder, new)])
    features = Features(gather(known, views.now), gather(every, views.after))
    return features, _recall(policy.online, features, samples)


def _target(policy: QPLEXPolicy, views: _Views, samples: TeamReplaySamples) -> tuple[Features, Features]:
    """Encode with the target networks; without memory, only the observations after a step."""
    networks = policy.target
    if networks.memory is not None:
        every = policy.encode_with(networks.encoder, views.views)
        features = Features(gather(every, views.now), gather(every, views.after))
        return features, _recall(networks, features, samples)
    seen, rows = views.after.unique(return_inverse=True)
    after = gather(policy.encode_with(networks.encoder, views.views[seen]), rows)
    features = Features(after, after)  # the target's features before the step are unused
    return features, features


def _recall(networks: QNetworks, features: Features, samples: TeamReplaySamples) -> Features:
    """Return the inputs of the heads: the features, or the memory's output."""
    memory, sequences = networks.memory, samples.sequences
    if memory is None:
        return features
    assert sequences is not None, "agents with memory learn from sequences"
    shape, (n, length) = samples.actions.shape, (sequences.n, sequences.length)
    agent, starts, joins = _agents(samples.actions), sequences.resets.unsqueeze(1).expand(shape), None
    if samples.now.active is not None and samples.after.active is not None:  # agents that join begin
        before = samples.now.active.roll(1, dims=0)
        before[::length] = True
        starts = starts | ~before
        joins = (samples.after.active & ~samples.now.active).flatten()
    last = sequences.last_actions.masked_fill(starts, -1).flatten()
    inputs = memory.inputs(features.now.flatten(0, 1), last, agent)

    def by_step(x: th.Tensor) -> th.Tensor:
        """Arrange agents of team steps (n T N, ...) by step: (T, n N, ...)."""
        return x.view(n, length, shape[1], -1).transpose(0, 1).reshape(length, n * shape[1], -1)

    remembered = memory.every(
        by_step(inputs), inputs.new_zeros(n * shape[1], memory.state_dim), by_step(starts.flatten()).squeeze(2)
    )
    remembered = remembered.view(length, n, shape[1], -1).transpose(0, 1).reshape(len(inputs), -1)
    # One step from each step: also exact if the next step of the sequence belongs to another episode.
    with th.no_grad():
        last = samples.actions.flatten() if joins is None else samples.actions.flatten().masked_fill(joins, -1)
        after, _ = memory.step(memory.inputs(features.after.flatten(0, 1), last, agent), remembered, joins)
    return Features(remembered[:, : memory.size].view(*shape, -1), after.view(*shape, -1))


# --- values -----------------------------------------------------------------------------------------------------------


def _q_values(
    networks: QNetworks, latents: th.Tensor, agent: th.Tensor, steps: TeamSteps, draw: bool = False
) -> th.Tensor:
    """Compute (G, N, A) values of agents' actions, -inf for illegal ones, from (G, N, H)."""
    masks = None if steps.masks is None else steps.masks.flatten(0, 1)
    return q_values(networks.actor, latents.flatten(0, 1), agent, masks, draw).view(*latents.shape[:2], -1)


def _mix(
    policy: QPLEXPolicy,
    networks: QNetworks,
    values: th.Tensor,
    steps: TeamSteps,
    features: th.Tensor,
    actions: th.Tensor,
) -> Mixed:
    """Compute Q_tot of joint actions (G, N) from (G, N, A) values and (G, N, d) features."""
    chosen = values.gather(2, actions.unsqueeze(2)).squeeze(2)
    choice = JointChoice(chosen, values.max(dim=2).values, actions, steps.active)
    return networks.mixer(_state(policy, networks.state_encoder, steps, features), choice)


def greedy_q_tot(policy: QPLEXPolicy, obs: dict[str, th.Tensor], values: th.Tensor) -> th.Tensor:
    """
    Compute Q_tot of the greedy joint action, in which each agent takes its own best action.

    :param policy: the policy
    :param obs: rows of whole teams, game-major
    :param values: (B, A) Q_i, -inf for illegal actions
    :return: (B,), equal for all rows of a team
    """
    n_agents = policy.team_spaces.n_agents
    of_teams = values.view(-1, n_agents, values.shape[1])
    features = policy.extract_features(obs).view(-1, n_agents, policy.features_dim)
    mixed = _mix(policy, policy.online, of_teams, policy.team_steps(obs), features, of_teams.argmax(dim=2))
    return mixed.q_tot.repeat_interleave(n_agents)


def _state(policy: QPLEXPolicy, state_encoder: nn.Module | None, steps: TeamSteps, features: th.Tensor) -> th.Tensor:
    """Return the mixer's input (G, S): the encoded state of the game, or the features of all agents."""
    if state_encoder is not None:
        assert steps.states is not None
        return policy.encode_states(state_encoder, steps.states)
    if policy.parts.detach_state:
        features = features.detach()
    if steps.active is not None:
        features = features * steps.active.unsqueeze(2)
    return features.flatten(1)
