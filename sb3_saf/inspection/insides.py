"""
What an actor-critic policy does and thinks in one step of all games: actions and values, the weights of its pool, the
attention of its knowledge source, and what its critic would say without the message that it read.

This module reads rows with the policies' own (private) readers, so that it sees exactly what they see. Letters: B rows
of E games with N agents each, U policies, L slots, P parameters of an action distribution, d features.
"""

from __future__ import annotations

from typing import Any, ClassVar, Final, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy

from sb3_saf.networks.critic import JointStates, TeamStates
from sb3_saf.networks.distributions import masked_parameters
from sb3_saf.networks.policy_pool import PolicyPool
from sb3_saf.policies.base import TeamPolicy
from sb3_saf.policies.maskable import TeamMaskablePolicy
from sb3_saf.policies.recurrent import LstmStates, RecurrentCritic, TeamRecurrentPolicy
from sb3_saf.policies.saf import SAFCritic, SAFStates

Tensors = dict[str, th.Tensor]

#: What stands in the place of a message: nothing, or what the same agent of another game read at the same time.
Replacement = Literal["zero", "shuffled"]
REPLACEMENTS: Final[tuple[Replacement, ...]] = get_args(Replacement)


class PoolView(NamedTuple):
    """
    The pool of policies in one step.

    :param weights: (B, U), how likely each policy is chosen; sums to 1
    :param actions: (B, U, P), parameters of each policy's action distribution, illegal actions masked
    """

    weights: th.Tensor
    actions: th.Tensor


class SourceView(NamedTuple):
    """
    The knowledge source in one step.

    :param write: (E, L, N), how much each slot took from each agent
    :param read: (E, N, L), how much each agent took from each slot
    :param values: what the critic says with another message in the place of the one read, (B,) each
    """

    write: th.Tensor
    read: th.Tensor
    values: dict[Replacement, th.Tensor]


class StepView(NamedTuple):
    """
    One step of all games.

    :param actions: (B, ...) as an environment takes them
    :param values: (B,)
    :param pool: None for a policy without a pool
    :param source: None for a policy without a knowledge source
    """

    actions: npt.NDArray[Any]
    values: th.Tensor
    pool: PoolView | None
    source: SourceView | None


class Insides:
    """
    Plays a policy and looks into it.

    :param policy: SAF's, MAPPO's, IPPO's, with or without memory and action masks
    :param deterministic: whether it takes its most likely actions
    """

    #: Whether values are of the team's reward, not of the agent's.
    of_team: ClassVar[bool] = False

    def __init__(self, policy: TeamPolicy, deterministic: bool = False):
        self.policy = policy
        self.deterministic = deterministic
        self.pool = policy.actor if isinstance(policy.actor, PolicyPool) else None
        self.source = _saf_states(policy)

    def look(
        self, obs: Tensors, starts: npt.NDArray[np.bool_], action_masks: npt.NDArray[np.bool_] | None = None
    ) -> StepView:
        """
        Take one step.

        :param obs: rows of whole teams, game-major
        :param starts: (B,) whether an episode starts with this step, for policies with memory
        :param action_masks: (B, M) for policies of MaskablePPO
        """
        arguments = {} if action_masks is None else {"action_masks": action_masks}
        actions, values, _ = self.policy(obs, deterministic=self.deterministic, **arguments)
        latent = self.policy.extract_features(obs) if self.pool else None
        return self._view(obs, actions, values, latent, action_masks, None)

    def last_values(self, obs: Tensors, rows: npt.NDArray[np.int64]) -> th.Tensor:
        """
        Values of last observations, which a time limit that is no true end is bootstrapped with.

        :param obs: rows of the games that ended
        :param rows: (K,) which rows of the last step they are
        :return: (K,)
        """
        values: th.Tensor = self.policy.predict_values(obs)
        return values.flatten()

    def _view(
        self,
        obs: Tensors,
        actions: th.Tensor,
        values: th.Tensor,
        latent: th.Tensor | None,
        action_masks: npt.NDArray[np.bool_] | None,
        starts: th.Tensor | None,
    ) -> StepView:
        pool = None if latent is None else self._pool_view(obs, latent, action_masks)
        source = None if self.source is None else self._source_view(self.source, obs, starts)
        return StepView(self._clipped(actions), values.flatten(), pool, source)

    def _clipped(self, actions: th.Tensor) -> npt.NDArray[Any]:
        """As SB3 hands them to environments."""
        array = actions.cpu().numpy()
        space = self.policy.action_space
        return np.clip(array, space.low, space.high) if isinstance(space, spaces.Box) else array

    def _pool_view(self, obs: Tensors, latent: th.Tensor, action_masks: npt.NDArray[np.bool_] | None) -> PoolView:
        assert self.pool is not None
        agent = self.policy._agent(obs) if self.pool.reads_agent else None
        log_weights, actions = self.pool.evaluate(latent, agent)
        legal = self.policy._action_mask(obs)
        if action_masks is not None:
            allowed = th.as_tensor(action_masks, dtype=th.bool, device=latent.device).reshape(len(latent), -1)
            legal = allowed if legal is None else allowed & legal
        if legal is not None:
            actions = masked_parameters(self.policy.action_space, actions, legal)
        return PoolView(log_weights.exp(), actions)

    def _source_view(self, source: SAFStates, obs: Tensors, starts: th.Tensor | None) -> SourceView:
        _, teams = self.policy.encode_teams(obs)
        known, exchanged = source.communicate(teams.features, teams.members, teams.active)
        # Rows that are no whole teams in order have equal teams computed once; from here on, games count.
        n_agents = self.policy.team_spaces.n_agents
        team = th.arange(len(known)) if teams.rows is None else teams.rows[::n_agents] // n_agents
        states, read = known[team], exchanged.read[team]
        active = None if teams.active is None else teams.active[team]
        messages: dict[Replacement, th.Tensor] = {"zero": th.zeros_like(read)}
        if len(team) > 1:
            messages["shuffled"] = read.roll(1, dims=0)
        values = {
            name: self._judge(name, obs, source.combine(states, message), active, starts)
            for name, message in messages.items()
        }
        return SourceView(exchanged.write_attention[team], exchanged.read_attention[team], values)

    def _judge(
        self,
        name: Replacement,
        obs: Tensors,
        states: th.Tensor,
        active: th.Tensor | None,
        starts: th.Tensor | None,
    ) -> th.Tensor:
        """(B,) values of s^SAF (E, N, d)."""
        critic = self.policy.value_net
        assert isinstance(critic, SAFCritic)
        return self.policy._raw_values(obs, critic.judge(states, active).flatten()).flatten()


class RecurrentInsides(Insides):
    """
    Insides of a policy with memory. Where messages are replaced, they are so at every step: the critic's memory is then
    of what it would have read.

    :param policy: of RecurrentPPO
    :param n_rows: B
    :param deterministic: whether it takes its most likely actions
    """

    policy: TeamRecurrentPolicy

    def __init__(self, policy: TeamRecurrentPolicy, n_rows: int, deterministic: bool = False):
        super().__init__(policy, deterministic)
        lstm = policy.lstm_actor
        blank = th.zeros(lstm.num_layers, n_rows, lstm.hidden_size, device=policy.device)
        self._actor_states: LstmStates = (blank, blank)
        self._critic_states: LstmStates = (blank, blank)
        self._without: dict[Replacement, LstmStates] = dict.fromkeys(REPLACEMENTS, (blank, blank))

    def look(
        self, obs: Tensors, starts: npt.NDArray[np.bool_], action_masks: npt.NDArray[np.bool_] | None = None
    ) -> StepView:
        """See :class:`Insides`."""
        from sb3_contrib.common.recurrent.type_aliases import RNNStates

        policy = self.policy
        started = th.as_tensor(starts, dtype=th.float32, device=policy.device)
        before = RNNStates(self._actor_states, self._critic_states)
        actions, values, _, after = policy(obs, before, started, deterministic=self.deterministic)
        latent = None
        if self.pool:
            latent, _ = policy._process(policy.extract_features(obs), before.pi, started, policy.lstm_actor)
        self._actor_states, self._critic_states = after.pi, after.vf
        return self._view(obs, actions, values, latent, None, started)

    def last_values(self, obs: Tensors, rows: npt.NDArray[np.int64]) -> th.Tensor:
        """See :class:`Insides`."""
        hidden, cell = (states[:, rows].contiguous() for states in self._critic_states)
        going_on = th.zeros(len(rows), device=self.policy.device)
        return self.policy.predict_values(obs, (hidden, cell), going_on).flatten()

    def _judge(
        self,
        name: Replacement,
        obs: Tensors,
        states: th.Tensor,
        active: th.Tensor | None,
        starts: th.Tensor | None,
    ) -> th.Tensor:
        critic = self.policy.value_net
        if not isinstance(critic, RecurrentCritic):
            return super()._judge(name, obs, states, active, starts)
        assert starts is not None
        if isinstance(critic.team_states, JointStates):
            states = critic.team_states.join(states, active)
        latent, self._without[name] = self.policy._process(
            states.flatten(0, 1), self._without[name], starts, critic.lstm
        )
        agent = self.policy._agent(obs) if critic.head.reads_agent else None
        return self.policy._raw_values(obs, critic.head(latent, agent)).flatten()


def takes_masks(policy: BasePolicy) -> bool:
    """Whether the policy asks the environment for action masks, as MaskablePPO does."""
    return isinstance(policy, TeamMaskablePolicy)


def _saf_states(policy: TeamPolicy) -> SAFStates | None:
    """The part of a critic that has a knowledge source, if any."""
    critic: Any = policy.value_net
    states: TeamStates | None = critic.team_states if isinstance(critic, RecurrentCritic) else critic
    if isinstance(states, JointStates):
        states = states.members
    return states if isinstance(states, SAFStates) else None
