"""
Readers of a policy's outputs in one step of all games: actions and values, weights of the pool, attention of the
knowledge source, and the critic's values without the message read.

Rows are read by the policies' own methods. Letters: B rows of E games with N agents each, U policies or heads, L slots,
P parameters of an action distribution, A actions, d features.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, ClassVar, Final, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy

from sb3_saf.networks.actor import PolicyPool
from sb3_saf.networks.distributions import mixture_log_probs
from sb3_saf.policies.base import TeamPolicy
from sb3_saf.policies.memory import RunningMemory
from sb3_saf.policies.saf import SAFCritic
from sb3_saf.qplex.learning import greedy_q_tot
from sb3_saf.qplex.policies import QPLEXPolicy, State
from sb3_saf.teams.rows import EPISODE_START_KEY, TerminalRow

Tensors = dict[str, th.Tensor]
Bools = npt.NDArray[np.bool_]
#: Policies of this package.
OurPolicy = TeamPolicy | QPLEXPolicy

#: Replacement of a message: zeros, or the message of the same agent in another game at the same step.
Replacement = Literal["zero", "shuffled"]
REPLACEMENTS: Final[tuple[Replacement, ...]] = get_args(Replacement)


class StepReading(NamedTuple):
    """
    One step of all games. What a policy lacks is None.

    :param actions: (B, ...) actions for the environment
    :param values: (B,)
    :param action_probabilities: (B, A) probability of each action; None unless actions are Discrete
    :param pool_weights: (B, U), selection probability of each policy of a pool; sums to 1
    :param pool_actions: (B, U, P), parameters of each policy's action distribution, illegal actions masked
    :param write_attention: (E, L, N), attention of slots over agents
    :param read_attention: (E, N, L), attention of agents over slots
    :param message_strengths: (B,), Euclidean norm of the message that each agent read
    :param values_without: (B,) each, values with a replaced message
    """

    actions: npt.NDArray[Any]
    values: th.Tensor
    action_probabilities: th.Tensor | None
    pool_weights: th.Tensor | None = None
    pool_actions: th.Tensor | None = None
    write_attention: th.Tensor | None = None
    read_attention: th.Tensor | None = None
    message_strengths: th.Tensor | None = None
    values_without: Mapping[Replacement, th.Tensor] = MappingProxyType({})


def require_our_policy(policy: BasePolicy) -> OurPolicy:
    """Return the policy; ValueError if it is not of this package and cannot be inspected."""
    if isinstance(policy, (TeamPolicy, QPLEXPolicy)):
        return policy
    raise ValueError(
        "expected a policy of sb3_saf such as 'SAFPolicy', 'MAPPOPolicy', 'IPPOPolicy' or 'QPLEXPolicy', got "
        f"{type(policy).__name__}"
    )


def reader_of(policy: OurPolicy, n_rows: int, deterministic: bool = False) -> PolicyReader | QReader:
    """
    Make the reader of a policy.

    :param deterministic: whether it takes its most likely actions; value-based policies always take their best ones
    """
    if isinstance(policy, QPLEXPolicy):
        return QReader(policy)
    return PolicyReader(policy, deterministic)


class PolicyReader:
    """
    Act with an actor-critic policy and read its outputs. Its memory of the games of a training is left alone.

    :param deterministic: whether it takes its most likely actions
    """

    #: Whether values are of the team's reward, not of the agent's.
    of_team: ClassVar[bool] = False

    def __init__(self, policy: TeamPolicy, deterministic: bool = False):
        self.policy = policy
        self.deterministic = deterministic
        critic = policy.value_net
        self.source = critic if isinstance(critic, SAFCritic) else None
        self._memory = RunningMemory()
        # Messages are replaced at every step, so that the critic's memory depends on them, too.
        self._without = {name: RunningMemory() for name in REPLACEMENTS}

    def step(self, obs: Tensors, starts: Bools, action_masks: Bools | None = None) -> StepReading:
        """
        Act in one step.

        :param obs: rows of whole teams, game-major
        :param starts: (B,) whether an episode starts with this step, for policies with memory
        :param action_masks: (B, M) for policies of MaskablePPO
        """
        arguments = {} if action_masks is None else {"action_masks": action_masks}
        latents, before = self.policy.extract_features(obs), self._memory.actor
        with self.policy.remembering(self._memory):
            actions, values, _ = self.policy(obs, deterministic=self.deterministic, **arguments)
            values = values.flatten()
        if self.policy.actor_memory is not None:
            latents, _ = self.policy.remember(latents, before, obs[EPISODE_START_KEY] != 0)
        return self._reading(obs, actions, values, latents, action_masks)

    def last_values(self, obs: Tensors, rows: npt.NDArray[np.int64]) -> th.Tensor:
        """
        Compute the values of last observations, for bootstrapping time limits that are no true ends.

        :param obs: rows of the games that ended
        :param rows: (K,) their indices among the rows of the last step
        :return: (K,)
        """
        with self.policy.remembering(self._memory):
            values: th.Tensor = self.policy.predict_values(TerminalRow(obs, rows))
        return values.flatten()

    def _reading(
        self, obs: Tensors, actions: th.Tensor, values: th.Tensor, latent: th.Tensor, action_masks: Bools | None
    ) -> StepReading:
        policy, space = self.policy, self.policy.action_space
        log_weights, parameters = policy.evaluate_pool(obs, latent, action_masks)
        is_discrete = isinstance(space, spaces.Discrete)
        probabilities = mixture_log_probs(log_weights, parameters).exp() if is_discrete else None
        array = actions.cpu().numpy()
        clipped = np.clip(array, space.low, space.high) if isinstance(space, spaces.Box) else array  # as SB3 does
        reading = StepReading(clipped, values, probabilities)
        if isinstance(policy.actor, PolicyPool):
            reading = reading._replace(pool_weights=log_weights.exp(), pool_actions=parameters)
        if self.source is None:
            return reading
        _, teams = policy.encode_teams(obs)
        _, exchanged = self.source.communicate(teams.features, teams.members, teams.active)
        # In rows that are not whole teams in order, equal teams are computed once; expand them to games.
        n_agents = policy.team_spaces.n_agents
        team = th.arange(len(exchanged.read)) if teams.rows is None else teams.rows[::n_agents] // n_agents
        values_without: dict[Replacement, th.Tensor] = {}
        for name in REPLACEMENTS if len(team) > 1 else REPLACEMENTS[:1]:
            with _other_messages(self.source, name):
                if policy.actor_memory is None:
                    values_without[name] = policy.predict_values(obs).flatten()
                else:
                    with policy.remembering(self._without[name]):
                        values_without[name] = policy(obs, deterministic=True)[1].flatten()
        return reading._replace(
            write_attention=exchanged.write_attention[team],
            read_attention=exchanged.read_attention[team],
            message_strengths=exchanged.read[team].norm(dim=2).flatten(),
            values_without=values_without,
        )


@contextmanager
def _other_messages(source: SAFCritic, replacement: Replacement) -> Iterator[None]:
    """Replace the messages that a critic reads."""

    def replaced(_: th.nn.Module, inputs: tuple[th.Tensor, ...]) -> th.Tensor:
        states, read = inputs[0].chunk(2, dim=2)
        return th.cat([states, th.zeros_like(read) if replacement == "zero" else read.roll(1, dims=0)], dim=2)

    hook = source.combine_net.register_forward_pre_hook(replaced)
    try:
        yield
    finally:
        hook.remove()


class QReader:
    """Act with a value-based policy and read its outputs. It always takes its best actions."""

    #: Values are Q_tot, of the sum of all agents' rewards.
    of_team: ClassVar[bool] = True

    def __init__(self, policy: QPLEXPolicy):
        self.policy = policy
        self._state: State | None = None

    def step(self, obs: Tensors, starts: Bools, action_masks: Bools | None = None) -> StepReading:
        """See :class:`PolicyReader`; ``action_masks`` is unused: legal actions are part of the rows."""
        values, latents, self._state = self.policy.evaluate(obs, self._state, starts)
        best = values.argmax(dim=1)
        probabilities = th.nn.functional.one_hot(best, values.shape[1]).to(values.dtype)
        reading = StepReading(best.cpu().numpy(), greedy_q_tot(self.policy, obs, values), probabilities)
        if not isinstance(self.policy.actor, PolicyPool):
            return reading
        # The weights with which training samples heads, and each head's best action with probability 1.
        log_weights, of_heads = self.policy.actor.evaluate(latents)
        of_heads = of_heads.masked_fill(values.isneginf().unsqueeze(1), -th.inf)  # illegal actions
        is_best = of_heads == of_heads.max(dim=2, keepdim=True).values
        pool_actions = th.zeros_like(of_heads).masked_fill(~is_best, -th.inf)
        return reading._replace(pool_weights=log_weights.exp(), pool_actions=pool_actions)

    def last_values(self, obs: Tensors, rows: npt.NDArray[np.int64]) -> th.Tensor:
        """See :class:`PolicyReader`."""
        state = None if self._state is None else tuple(part[rows] for part in self._state)
        return greedy_q_tot(self.policy, obs, self.policy.evaluate(obs, state).values)
