"""
What a policy computes in one step of all games: actions and values, the weights of its pool, the attention of its
knowledge source, and the values of its critic without the message that it read.

Rows are read with the policies' own readers, so that what is shown is what they read. Letters: B rows of E games with
N agents each, U policies or heads, L slots, P parameters of an action distribution, A actions, d features.
"""

from __future__ import annotations

from typing import Any, ClassVar, Final, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy

from sb3_saf.buffers.replay import TeamSteps
from sb3_saf.envs.teams import STATE_KEY
from sb3_saf.networks.actor import PolicyPool
from sb3_saf.networks.critic import JointStates, TeamStates
from sb3_saf.networks.distributions import masked_parameters, mixture_log_probs
from sb3_saf.policies.base import TeamMaskablePolicy, TeamPolicy
from sb3_saf.policies.recurrent import LstmStates, RecurrentCritic, TeamRecurrentPolicy
from sb3_saf.policies.saf import SAFCritic, SAFStates
from sb3_saf.qplex.heads import q_values
from sb3_saf.qplex.learning import greedy_q_tot
from sb3_saf.qplex.policies import QPLEXPolicy, State

Tensors = dict[str, th.Tensor]
#: Policies of this package.
OurPolicy = TeamPolicy | QPLEXPolicy

#: What replaces a message: zeros, or what the same agent of another game read at the same time.
Replacement = Literal["zero", "shuffled"]
REPLACEMENTS: Final[tuple[Replacement, ...]] = get_args(Replacement)


class PoolReading(NamedTuple):
    """
    The pool of policies in one step.

    :param weights: (B, U), how likely each policy is chosen; sums to 1
    :param actions: (B, U, P), parameters of each policy's action distribution, illegal actions masked
    """

    weights: th.Tensor
    actions: th.Tensor


class SourceReading(NamedTuple):
    """
    The knowledge source in one step.

    :param write: (E, L, N), attention of slots over agents
    :param read: (E, N, L), attention of agents over slots
    :param strengths: (B,), Euclidean norm of the message that each agent read
    :param values: (B,) each, values with another message in place of the one read
    """

    write: th.Tensor
    read: th.Tensor
    strengths: th.Tensor
    values: dict[Replacement, th.Tensor]


class StepReading(NamedTuple):
    """
    One step of all games.

    :param actions: (B, ...) as an environment takes them
    :param values: (B,)
    :param probabilities: (B, A) of each action; None unless actions are Discrete
    :param pool: None for a policy without a pool
    :param source: None for a policy without a knowledge source
    """

    actions: npt.NDArray[Any]
    values: th.Tensor
    probabilities: th.Tensor | None
    pool: PoolReading | None
    source: SourceReading | None


def require_our_policy(policy: BasePolicy) -> OurPolicy:
    """
    Check that a policy can be inspected.

    :raises ValueError: if it is none of this package's policies
    """
    if isinstance(policy, (TeamPolicy, QPLEXPolicy)):
        return policy
    raise ValueError(
        "expected a policy of sb3_saf such as 'SAFPolicy', 'MAPPOPolicy', 'IPPOPolicy' or 'QPLEXPolicy', got "
        f"{type(policy).__name__}"
    )


def reader_of(policy: OurPolicy, n_rows: int, deterministic: bool = False) -> PolicyReader | QReader:
    """
    Make the reader of a policy.

    :param policy: to read
    :param n_rows: B
    :param deterministic: whether it takes its most likely actions; those of a value-based policy always are its best
    """
    if isinstance(policy, QPLEXPolicy):
        return QReader(policy)
    if isinstance(policy, TeamRecurrentPolicy):
        return RecurrentPolicyReader(policy, n_rows, deterministic)
    return PolicyReader(policy, deterministic)


class PolicyReader:
    """
    Acts with an actor-critic policy and reads what it computes.

    :param policy: SAF's, MAPPO's, IPPO's, with or without memory and action masks
    :param deterministic: whether it takes its most likely actions
    """

    #: Whether values are of the team's reward, not of the agent's.
    of_team: ClassVar[bool] = False

    def __init__(self, policy: TeamPolicy, deterministic: bool = False):
        self.policy = policy
        self.deterministic = deterministic
        self.source = _saf_states(policy)

    def step(
        self, obs: Tensors, starts: npt.NDArray[np.bool_], action_masks: npt.NDArray[np.bool_] | None = None
    ) -> StepReading:
        """
        Act in one step.

        :param obs: rows of whole teams, game-major
        :param starts: (B,) whether an episode starts with this step, for policies with memory
        :param action_masks: (B, M) for policies of MaskablePPO
        """
        arguments = {} if action_masks is None else {"action_masks": action_masks}
        actions, values, _ = self.policy(obs, deterministic=self.deterministic, **arguments)
        return self._reading(obs, actions, values, self.policy.extract_features(obs), action_masks, None)

    def last_values(self, obs: Tensors, rows: npt.NDArray[np.int64]) -> th.Tensor:
        """
        Compute the values of last observations, which bootstrap a time limit that is no true end.

        :param obs: rows of the games that ended
        :param rows: (K,) which rows of the last step they are
        :return: (K,)
        """
        values: th.Tensor = self.policy.predict_values(obs)
        return values.flatten()

    def _reading(
        self,
        obs: Tensors,
        actions: th.Tensor,
        values: th.Tensor,
        latent: th.Tensor,
        action_masks: npt.NDArray[np.bool_] | None,
        starts: th.Tensor | None,
    ) -> StepReading:
        space = self.policy.action_space
        pool = self._pool_reading(obs, latent, action_masks)
        is_discrete = isinstance(space, spaces.Discrete)
        probabilities = mixture_log_probs(pool.weights.log(), pool.actions).exp() if is_discrete else None
        array = actions.cpu().numpy()
        taken = np.clip(array, space.low, space.high) if isinstance(space, spaces.Box) else array  # as SB3 does
        source = None if self.source is None else self._source_reading(self.source, obs, starts)
        is_pool = isinstance(self.policy.actor, PolicyPool)
        return StepReading(taken, values.flatten(), probabilities, pool if is_pool else None, source)

    def _pool_reading(self, obs: Tensors, latent: th.Tensor, action_masks: npt.NDArray[np.bool_] | None) -> PoolReading:
        """Read the actor; a single policy is a pool of one."""
        actor = self.policy.actor
        log_weights, actions = actor.evaluate(latent, self.policy._agent(obs) if actor.reads_agent else None)
        legal = self.policy._action_mask(obs)
        if action_masks is not None:
            allowed = th.as_tensor(action_masks, dtype=th.bool, device=latent.device).reshape(len(latent), -1)
            legal = allowed if legal is None else allowed & legal
        if legal is not None:
            actions = masked_parameters(self.policy.action_space, actions, legal)
        return PoolReading(log_weights.exp(), actions)

    def _source_reading(self, source: SAFStates, obs: Tensors, starts: th.Tensor | None) -> SourceReading:
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
            name: self._values_with(name, obs, source.combine(states, message), active, starts)
            for name, message in messages.items()
        }
        strengths = read.norm(dim=2).flatten()
        return SourceReading(exchanged.write_attention[team], exchanged.read_attention[team], strengths, values)

    def _values_with(
        self,
        name: Replacement,
        obs: Tensors,
        states: th.Tensor,
        active: th.Tensor | None,
        starts: th.Tensor | None,
    ) -> th.Tensor:
        """Compute (B,) values of s^SAF (E, N, d)."""
        critic = self.policy.value_net
        assert isinstance(critic, SAFCritic)
        return self.policy._raw_values(obs, critic.judge(states, active).flatten()).flatten()


class RecurrentPolicyReader(PolicyReader):
    """
    Reader of a policy with memory. Messages are replaced at every step, so the critic's memory is of replaced messages.

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

    def step(
        self, obs: Tensors, starts: npt.NDArray[np.bool_], action_masks: npt.NDArray[np.bool_] | None = None
    ) -> StepReading:
        """See :class:`PolicyReader`."""
        from sb3_contrib.common.recurrent.type_aliases import RNNStates

        policy = self.policy
        started = th.as_tensor(starts, dtype=th.float32, device=policy.device)
        before = RNNStates(self._actor_states, self._critic_states)
        actions, values, _, after = policy(obs, before, started, deterministic=self.deterministic)
        latent, _ = policy._process(policy.extract_features(obs), before.pi, started, policy.lstm_actor)
        self._actor_states, self._critic_states = after.pi, after.vf
        return self._reading(obs, actions, values, latent, None, started)

    def last_values(self, obs: Tensors, rows: npt.NDArray[np.int64]) -> th.Tensor:
        """See :class:`PolicyReader`."""
        hidden, cell = (states[:, rows].contiguous() for states in self._critic_states)
        going_on = th.zeros(len(rows), device=self.policy.device)
        return self.policy.predict_values(obs, (hidden, cell), going_on).flatten()

    def _values_with(
        self,
        name: Replacement,
        obs: Tensors,
        states: th.Tensor,
        active: th.Tensor | None,
        starts: th.Tensor | None,
    ) -> th.Tensor:
        critic = self.policy.value_net
        if not isinstance(critic, RecurrentCritic):
            return super()._values_with(name, obs, states, active, starts)
        assert starts is not None
        if isinstance(critic.team_states, JointStates):
            states = critic.team_states.join(states, active)
        latent, self._without[name] = self.policy._process(
            states.flatten(0, 1), self._without[name], starts, critic.lstm
        )
        agent = self.policy._agent(obs) if critic.head.reads_agent else None
        return self.policy._raw_values(obs, critic.head(latent, agent)).flatten()


class QReader:
    """
    Acts with a value-based policy and reads what it computes. It always takes its best actions.

    :param policy: QPLEX's, QMIX's or VDN's, with or without memory
    """

    #: Values are Q_tot, of the sum of all agents' rewards.
    of_team: ClassVar[bool] = True

    def __init__(self, policy: QPLEXPolicy):
        self.policy = policy
        self._state: State | None = None

    def step(
        self, obs: Tensors, starts: npt.NDArray[np.bool_], action_masks: npt.NDArray[np.bool_] | None = None
    ) -> StepReading:
        """
        Act in one step.

        :param obs: rows of whole teams, game-major
        :param starts: (B,) whether an episode starts with this step, for policies with memory
        :param action_masks: not read; legal actions are part of the rows
        """
        values, read, self._state = self._q_values(obs, self._state, starts)
        best = values.argmax(dim=1)
        probabilities = th.nn.functional.one_hot(best, values.shape[1]).to(values.dtype)
        return StepReading(best.cpu().numpy(), self._q_tot(obs, values), probabilities, self._pool(obs, read), None)

    def last_values(self, obs: Tensors, rows: npt.NDArray[np.int64]) -> th.Tensor:
        """
        Compute the values of last observations, which bootstrap a time limit that is no true end.

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
        """Return (B, A) values with -inf for illegal actions, the heads' input (B, H), and the agents' memory."""
        policy = self.policy
        if policy.memory is None:
            return policy.own_q_values(obs), policy.extract_features(obs), None
        _, state = policy._recall_and_act(policy.memory, obs, state, starts)
        hidden = th.as_tensor(state[0], device=policy.device)
        return q_values(policy.actor, hidden, policy._agent(obs), policy._action_mask(obs)), hidden, state

    def _q_tot(self, obs: Tensors, values: th.Tensor) -> th.Tensor:
        """Return (B,) the value of the joint action of each row's team."""
        policy, n_agents = self.policy, self.policy.team_spaces.n_agents
        active = policy._active(obs)
        states = obs[STATE_KEY][::n_agents] if policy.state_encoder is not None else None
        steps = TeamSteps(
            policy._own(obs).unflatten(0, (-1, n_agents)), None, None if active is None else active[::n_agents], states
        )
        features = policy.extract_features(obs).view(-1, n_agents, policy.features_dim)
        q_tot = greedy_q_tot(policy, values.view(-1, n_agents, values.shape[1]), steps, features)
        return q_tot.repeat_interleave(n_agents)

    def _pool(self, obs: Tensors, read: th.Tensor) -> PoolReading | None:
        """Return the weights with which training draws heads, and each head's best action with probability 1."""
        if not isinstance(self.policy.actor, PolicyPool):
            return None
        log_weights, of_heads = self.policy.actor.evaluate(read)
        masks = self.policy._action_mask(obs)
        if masks is not None:
            of_heads = of_heads.masked_fill(~masks.unsqueeze(1), -th.inf)
        is_best = of_heads == of_heads.max(dim=2, keepdim=True).values
        return PoolReading(log_weights.exp(), th.zeros_like(of_heads).masked_fill(~is_best, -th.inf))


def takes_masks(policy: BasePolicy) -> bool:
    """Return whether the policy asks the environment for action masks, as MaskablePPO does."""
    return isinstance(policy, TeamMaskablePolicy)


def _saf_states(policy: TeamPolicy) -> SAFStates | None:
    """Return the part of the critic that has a knowledge source, if any."""
    critic: Any = policy.value_net
    states: TeamStates | None = critic.team_states if isinstance(critic, RecurrentCritic) else critic
    if isinstance(states, JointStates):
        states = states.members
    return states if isinstance(states, SAFStates) else None
