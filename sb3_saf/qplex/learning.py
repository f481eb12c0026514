"""
The loss of QPLEX: the temporal-difference error of Q_tot, with double Q-learning and a target network.

    y = r + gamma (1 - done) Q_tot_target(s', a'),   a'_i = the agent's own best legal action under the online networks

Letters: G team steps, N agents, A actions, K unique own observations, d features, H inputs of the heads.
"""

from __future__ import annotations

from typing import NamedTuple

import torch as th

from sb3_saf.buffers.replay import TeamReplaySamples, TeamSteps
from sb3_saf.networks.layers import gather
from sb3_saf.qplex.mixers import JointChoice, Mixed
from sb3_saf.qplex.policies import QNetworks, QPLEXPolicy, q_values


class TeamError(NamedTuple):
    """
    Temporal-difference errors of the G' team steps that enter the loss.

    :param td: (G',) Q_tot - y
    :param q_tot: (G',)
    :param weights: (G', N) lambda_i, or None; NaN for inactive agents
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


def team_errors(policy: QPLEXPolicy, samples: TeamReplaySamples, gamma: float) -> TeamError:
    """
    Compute temporal-difference errors; the gradient goes into the online networks.

    Each unique observation is encoded once per network; those before steps come first.

    :param policy: the policy with its online and target networks
    :param gamma: discount per game step
    """
    shape = samples.actions.shape
    both = th.cat([samples.now.own.flatten(0, 1), samples.after.own.flatten(0, 1)])
    unique = policy.row_encoder.find(both)
    views, (now, after) = both[unique.index], unique.inverse.view(2, *shape)
    online, n_now = policy.online, int(now.max()) + 1
    known = policy.encode_with(online.encoder, views[:n_now])
    with th.no_grad():  # no gradient for observations that only occur after a step
        every, new = known.detach(), views[n_now:]
        if len(new):
            every = th.cat([every, policy.encode_with(online.encoder, new)])
    features = Features(gather(known, now), gather(every, after))
    latents = _recall(online, features, samples)
    values = _q_values(online, latents.now, samples.now, draw=True)
    td, weights = _mix(policy, online, values, samples.now, features.now, samples.actions)
    with th.no_grad():
        best = _q_values(online, latents.after, samples.after).argmax(dim=2)
        if policy.target.memory is not None:
            every = policy.encode_with(policy.target.encoder, views)
            features = Features(gather(every, now), gather(every, after))
        else:  # the target's features before the step are unused
            occurring, rows = after.unique(return_inverse=True)
            of_after = gather(policy.encode_with(policy.target.encoder, views[occurring]), rows)
            features = Features(of_after, of_after)
        following = _q_values(policy.target, _recall(policy.target, features, samples).after, samples.after)
        value = _mix(policy, policy.target, following, samples.after, features.after, best).q_tot
        target = samples.rewards + gamma * (1.0 - samples.dones) * value
        if weights is not None and samples.now.active is not None:
            weights = weights.masked_fill(~samples.now.active, th.nan)
    error = TeamError(td - target, td, weights)
    if samples.sequences is None:
        return error
    counted = samples.sequences.counted
    return TeamError(*(None if part is None else part[counted] for part in error))  # type: ignore[arg-type]


def _agents(x: th.Tensor) -> th.Tensor:
    """Return the agents' indices (G N,) for the rows of a tensor (G, N, ...)."""
    return th.arange(x.shape[1], device=x.device).repeat(len(x))


def _recall(networks: QNetworks, features: Features, samples: TeamReplaySamples) -> Features:
    """Return the inputs of the heads: the features, or the memory's output."""
    memory, sequences = networks.memory, samples.sequences
    if memory is None:
        return features
    assert sequences is not None, "agents with memory learn from sequences"
    shape, (n, length) = samples.actions.shape, (sequences.n, sequences.length)
    agent, starts, joins = _agents(samples.actions), sequences.resets.unsqueeze(1) | (sequences.last_actions < 0), None
    if samples.now.active is not None and samples.after.active is not None:  # agents that join begin
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


def _q_values(networks: QNetworks, latents: th.Tensor, steps: TeamSteps, draw: bool = False) -> th.Tensor:
    """Compute (G, N, A) values of agents' actions, -inf for illegal ones, from (G, N, H)."""
    masks, agent = None if steps.masks is None else steps.masks.flatten(0, 1), _agents(latents)
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
    if networks.state_encoder is not None:
        assert steps.states is not None
        return networks.mixer(policy.encode_states(networks.state_encoder, steps.states), choice)
    features = features.detach() if policy.parts.detach_state else features
    if steps.active is not None:
        features = features * steps.active.unsqueeze(2)
    return networks.mixer(features.flatten(1), choice)


def joint_values(policy: QPLEXPolicy, steps: TeamSteps, actions: th.Tensor | None = None) -> th.Tensor:
    """
    Compute Q_tot of agents without memory by the networks that act, each distinct observation encoded once.

    :param steps: G team steps
    :param actions: (G, N) int64; None for each agent's best legal action
    :return: (G,)
    """
    own = steps.own.flatten(0, 1)
    unique = policy.row_encoder.find(own)
    encoded = policy.encode_with(policy.online.encoder, own[unique.index])
    features = gather(encoded, unique.inverse).view(*steps.own.shape[:2], -1)
    values = _q_values(policy.online, features, steps)
    actions = values.argmax(dim=2) if actions is None else actions
    return _mix(policy, policy.online, values, steps, features, actions).q_tot


def greedy_q_tot(policy: QPLEXPolicy, obs: dict[str, th.Tensor], values: th.Tensor) -> th.Tensor:
    """
    Compute Q_tot of the greedy joint action, in which each agent takes its own best action.

    :param obs: rows of whole teams, game-major
    :param values: (B, A) Q_i, -inf for illegal actions
    :return: (B,), equal for all rows of a team
    """
    n_agents = policy.team_spaces.n_agents
    of_teams = values.view(-1, n_agents, values.shape[1])
    features = policy.extract_features(obs).view(-1, n_agents, policy.features_dim)
    mixed = _mix(policy, policy.online, of_teams, policy.team_steps(obs), features, of_teams.argmax(dim=2))
    return mixed.q_tot.repeat_interleave(n_agents)
