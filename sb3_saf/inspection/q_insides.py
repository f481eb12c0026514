"""
What QPLEX, QMIX and VDN do and think in one step of all games: best actions, the value of the team's joint action, and
the weights of the pool of Q heads.

Letters: B rows of E games with N agents each, U heads of a pool, A actions, d features, H what heads read.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import numpy.typing as npt
import torch as th

from sb3_saf.buffers.replay import TeamSteps
from sb3_saf.envs.teams import STATE_KEY
from sb3_saf.inspection.insides import PoolView, StepView, Tensors
from sb3_saf.networks.policy_pool import PolicyPool
from sb3_saf.qplex.heads import q_values
from sb3_saf.qplex.learning import greedy_q_tot
from sb3_saf.qplex.policies import QPLEXPolicy, State


class QInsides:
    """
    Plays a value-based policy and looks into it. It always takes its best actions: exploration is the algorithm's.

    :param policy: QPLEX's, QMIX's or VDN's, with or without memory
    """

    #: Values are Q_tot, of the sum of all agents' rewards.
    of_team: ClassVar[bool] = True

    def __init__(self, policy: QPLEXPolicy):
        self.policy = policy
        self._state: State | None = None

    def look(
        self, obs: Tensors, starts: npt.NDArray[np.bool_], action_masks: npt.NDArray[np.bool_] | None = None
    ) -> StepView:
        """
        Take one step.

        :param obs: rows of whole teams, game-major
        :param starts: (B,) whether an episode starts with this step, for policies with memory
        :param action_masks: not read; legal actions are part of the rows
        """
        values, read, self._state = self._q_values(obs, self._state, starts)
        return StepView(values.argmax(dim=1).cpu().numpy(), self._q_tot(obs, values), self._pool(obs, read), None)

    def last_values(self, obs: Tensors, rows: npt.NDArray[np.int64]) -> th.Tensor:
        """
        Values of last observations, which a time limit that is no true end is bootstrapped with.

        :param obs: rows of the games that ended
        :param rows: (K,) which rows of the last step they are
        :return: (K,)
        """
        state = None if self._state is None else tuple(part[rows] for part in self._state)
        values, _, _ = self._q_values(obs, state, np.zeros(len(rows), dtype=bool))
        return self._q_tot(obs, values)

    def _q_values(
        self, obs: Tensors, state: State | None, starts: npt.NDArray[np.bool_]
    ) -> tuple[th.Tensor, th.Tensor, State | None]:
        """(B, A) values with -inf for illegal actions, (B, H) what heads have read, and what agents remember."""
        policy = self.policy
        if policy.memory is None:
            return policy.own_q_values(obs), policy.extract_features(obs), None
        _, state = policy._recall_and_act(policy.memory, obs, state, starts)
        hidden = th.as_tensor(state[0], device=policy.device)
        return q_values(policy.actor, hidden, policy._agent(obs), policy._action_mask(obs)), hidden, state

    def _q_tot(self, obs: Tensors, values: th.Tensor) -> th.Tensor:
        """(B,) value of what each row's team does."""
        policy, n_agents = self.policy, self.policy.team_spaces.n_agents
        active = policy._active(obs)
        states = obs[STATE_KEY][::n_agents] if policy.state_encoder is not None else None
        steps = TeamSteps(
            policy._own(obs).unflatten(0, (-1, n_agents)), None, None if active is None else active[::n_agents], states
        )
        features = policy.extract_features(obs).view(-1, n_agents, policy.features_dim)
        q_tot = greedy_q_tot(policy, values.view(-1, n_agents, values.shape[1]), steps, features)
        return q_tot.repeat_interleave(n_agents)

    def _pool(self, obs: Tensors, read: th.Tensor) -> PoolView | None:
        """The weights with which training draws heads, and each head's best action as a sure choice."""
        if not isinstance(self.policy.actor, PolicyPool):
            return None
        log_weights, of_heads = self.policy.actor.evaluate(read)
        masks = self.policy._action_mask(obs)
        if masks is not None:
            of_heads = of_heads.masked_fill(~masks.unsqueeze(1), -th.inf)
        is_best = of_heads == of_heads.max(dim=2, keepdim=True).values
        return PoolView(log_weights.exp(), th.zeros_like(of_heads).masked_fill(~is_best, -th.inf))
