"""
Rollouts of teams: each observation stored once, minibatches of whole teams, values computed many steps at a time.

Values are not needed before the end of a rollout, where advantages are computed. For the few rows of a single step, the
overhead of calling the critic dominates; evaluating many steps together takes a fraction of the time.

Letters: T steps, E games, N agents, B = E N rows, U states of the critic for a team; M, Ma, Mc sizes of the memory of a
game, of the actor, and of one of the critic's states.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, ItemsView, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal, NamedTuple, TypeAlias, get_args
from weakref import WeakValueDictionary

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, DictRolloutBuffer
from stable_baselines3.common.type_aliases import DictRolloutBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_saf.networks.critic import ValueNormalizer
from sb3_saf.networks.row_encoder import Encoded
from sb3_saf.teams.checks import check_choice, check_count, check_whole_teams
from sb3_saf.teams.rows import (
    ACTION_MASK_KEY,
    ACTIVE_KEY,
    AGENT_KEY,
    EPISODE_START_KEY,
    OBS_KEY,
    STATE_KEY,
    TEAM_KEY,
    Array,
    TeamSpaces,
)

#: Rows whose values are computed at once: enough to amortise the calls, few enough for the cache.
ROWS_AT_ONCE: Final = 1024


@dataclass
class Step:
    """
    Critic's input of one step of all games, and the memory before it.

    :param obs: entries of the rows that critics read (agent indices, active agents)
    :param encoded: their encoded observations, without the observations themselves
    :param starts: (B,) bool, rows whose episode begins with the step; None for policies without memory
    :param actor: (B, Ma) the actor's memory before the step
    :param critic: (E U, Mc) the critic's memory before the step, if it has one; known when values are computed
    :param values: (B, 1) values, as soon as they are computed
    """

    obs: dict[str, th.Tensor]
    encoded: Encoded
    starts: th.Tensor | None = None
    actor: th.Tensor | None = None
    critic: th.Tensor | None = None
    values: th.Tensor | None = None

    @classmethod
    def of(cls, obs: th.Tensor | Mapping[str, th.Tensor], encoded: Encoded) -> Step:
        """Return the critic's input of a step; critics read features, so observations are dropped."""
        entries = {} if isinstance(obs, th.Tensor) else obs
        own = encoded.own._replace(observations=encoded.own.features.new_empty(0))
        return cls({key: entries[key] for key in (AGENT_KEY, ACTIVE_KEY) if key in entries}, encoded._replace(own=own))


#: Maps the critic's inputs of several steps to the values of each, (B, 1).
Compute: TypeAlias = Callable[[Sequence[Step]], list[th.Tensor]]


class LaterValues(th.Tensor):
    """
    Lazily computed values of one step, (B, 1).

    Any use as a tensor computes them for this step only; ``TeamRolloutBuffer`` computes those of many steps together.
    """

    step: Step
    compute: Compute
    known: th.Tensor | None

    @classmethod
    def of(cls, step: Step, like: th.Tensor, compute: Compute) -> LaterValues:
        """Make values to be computed later; ``like`` (B, ...) has their device and number of rows."""
        later = like.new_empty(len(like), 1).as_subclass(cls)
        later.step, later.compute, later.known = step, compute, None
        return later

    @classmethod
    def __torch_function__(
        cls, func: Callable[..., Any], types: Any, args: Sequence[Any] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Compute the values and call the function with them."""
        return func(*map(_known, args), **{name: _known(value) for name, value in (kwargs or {}).items()})


def compute_together(steps: Sequence[LaterValues]) -> list[th.Tensor]:
    """Compute the values, (B, 1), of several steps of one policy."""
    waiting = [step for step in steps if step.known is None]
    if waiting:
        for step, values in zip(waiting, waiting[0].compute([step.step for step in waiting]), strict=True):
            step.known = values
    return [_known(step) for step in steps]


def _known(argument: Any) -> Any:
    if isinstance(argument, (list, tuple)):
        return type(argument)(map(_known, argument))
    if not isinstance(argument, LaterValues):
        return argument
    if argument.known is None:
        (argument.known,) = argument.compute([argument.step])
    return argument.known


#: Arrays with one entry per step and row, without the observations.
_ROW_ARRAYS: Final = ("actions", "rewards", "returns", "episode_starts", "values", "log_probs", "advantages")


#: Where the return of an agent ends.
Ends = Literal["own", "team"]


@dataclass
class RolloutReturns:
    """
    Returns of one rollout, for policies that normalise values.

    :param returns: all returns used for training
    :param known: the conversion of values, once it was asked for
    """

    returns: npt.NDArray[np.floating]
    agents: npt.NDArray[np.integer]
    known: tuple[th.Tensor, th.Tensor] | None = None

    def rescaling(self, normalizer: ValueNormalizer) -> tuple[th.Tensor, th.Tensor]:
        """Return the conversion of values to the new statistics, which the first call updates with the returns."""
        if self.known is None:
            self.known = normalizer.update(self.returns, self.agents)
        return self.known


class Sequences(NamedTuple):
    """
    Order in time of the teams of a minibatch: S sequences of L steps, where team ``t * S + s`` is step t of sequence s.

    :param starts: (L, S, N) bool, agents whose episode begins with the step
    :param memory: (S, M) memory of the games before the first step
    """

    starts: th.Tensor
    memory: th.Tensor


class WholeTeams(NamedTuple):
    """
    Teams of the rows of a minibatch.

    :param observations: (G, N, *shape) own observations, agents in index order
    :param rows: (B,) index of each row's agent among the G N agents; None if rows are these agents in order
    :param active: (G, N) bool, agents that take part; None if all do
    :param sequences: order in time of the teams, for policies with memory; None for single steps
    """

    observations: th.Tensor
    rows: th.Tensor | None = None
    active: th.Tensor | None = None
    sequences: Sequences | None = None


class TeamMinibatch(dict[str, th.Tensor]):
    """
    Observations of the rows of whole teams.

    The dict of SB3's buffer, except that ``"team"``, N times as large as the rest, is only made on access: policies of
    this package read :attr:`teams`.

    :param entries: all other entries of the rows' observations, ``"obs"`` among them
    :param returns: returns of the rows' rollout
    :param old_values: (B,) old values of the rows, a copy that may be modified
    """

    def __init__(
        self, teams: WholeTeams, entries: dict[str, th.Tensor], returns: RolloutReturns, old_values: th.Tensor
    ) -> None:
        super().__init__(entries)
        self.teams = teams
        self._returns = returns
        self._old_values: th.Tensor | None = old_values

    def update_statistics(self, normalizer: ValueNormalizer) -> None:
        """
        Update the statistics with the rollout's returns, and convert the minibatch's old values to them, so that they
        equal the values of the unchanged critic, as PPO's ``clip_range_vf`` expects. Call it once per minibatch.
        """
        scale, shift = self._returns.rescaling(normalizer)
        if self._old_values is not None:
            agents = self[AGENT_KEY].reshape(-1).long()
            scale, shift = (values[agents] if values.ndim else values for values in (scale, shift))
            self._old_values.mul_(scale).add_(shift)
            self._old_values = None

    def __missing__(self, key: str) -> th.Tensor:
        """Make ``"team"``, (B, N, *shape)."""
        if key != TEAM_KEY:
            raise KeyError(key)
        observations, rows = self.teams.observations, self.teams.rows
        n_teams, n_agents = observations.shape[:2]
        teams = th.arange(n_teams * n_agents, device=observations.device) if rows is None else rows
        self[TEAM_KEY] = observations[teams // n_agents]
        return self[TEAM_KEY]

    def items(self) -> ItemsView[str, Any]:  # type: ignore[override]
        """Return all entries including ``"team"``, which SB3's own policies read."""
        self.__missing__(TEAM_KEY)
        return super().items()


def check_rows(obs: Mapping[str, Array], team: TeamSpaces, agents: Array) -> Array:
    """
    Return the own observations of rows, (B, *shape).

    :param agents: (B,) agents of the rows of whole teams in index order
    :raises ValueError: for rows of another form, or in another order
    """
    own, found = np.asarray(obs[OBS_KEY]), np.asarray(obs[AGENT_KEY]).reshape(-1)
    shape, dtype = (len(agents), *team.own_shape), team.team.dtype
    if own.shape != shape or not np.can_cast(own.dtype, dtype, "same_kind"):
        raise ValueError(
            f"expected {OBS_KEY!r} of shape {shape} and dtype {dtype}, got {own.shape} and {own.dtype}; fill the "
            "buffer from the environment that it was made for, and change or normalise observations below "
            "CentralizedValueWrapper"
        )
    if not np.array_equal(found, agents):
        raise ValueError(
            f"expected rows game-major, then agent, with {AGENT_KEY!r} 0 to {team.n_agents - 1} in each team, got "
            f"{found[: 2 * team.n_agents].tolist()} ...; no wrapper above CentralizedValueWrapper may reorder rows"
        )
    return own


def of_games(obs: Mapping[str, Array], key: str, stored: Array, n_agents: int, slot: int) -> Array:
    """Return an entry that all rows of a game share, (B, ...) -> (E, ...); ValueError if the compared row differs."""
    by_game = np.asarray(obs[key]).reshape(stored.shape[1], n_agents, *stored.shape[2:])
    differs = by_game[:, 0] != by_game[:, slot % n_agents]
    if differs.any():
        game = int(np.flatnonzero(differs.reshape(len(by_game), -1).any(axis=1))[0])
        raise ValueError(f"expected one {key!r} for all rows of a game, but the rows of game {game} differ")
    return by_game[:, 0]


class TeamRolloutBuffer(DictRolloutBuffer):
    """
    SB3 rollout buffer for the observations of ``CentralizedValueWrapper``, passed as ``rollout_buffer_class``.

    - **Memory**: own observations are stored once, ``(T, E, N, *shape)`` in their own dtype. SB3's buffer stores N + 1
      observations per row. A row of HECOGrid with 10 agents takes 49 bytes of tiles (or 2,352 of pixels) and 33 bytes
      of action, reward, value etc.; SB3's buffer takes 587 (or 25,920); see :attr:`nbytes`. Rollouts reuse the arrays.
    - **Minibatches** hold whole teams, agents in index order (:class:`TeamMinibatch`), so that each team is encoded in
      one minibatch only, and critics need no search. ``batch_size`` counts rows and is rounded down to whole teams, at
      least one: SB3's default of 64 is 60 for 5 agents. The last minibatch may be smaller.
    - **Advantages** are computed by SB3's code.
    - **Value normalisation**: minibatches hold the returns of the rollout for policies with ``normalize_values=True``;
      advantages and :attr:`values` are those of the rollout.
    - **Inactive agents** (if observations have ``"active"``): minibatches omit their rows, so that loss, entropy and
      the normalisation of advantages use active rows only; ``batch_size`` is then an upper bound. Rewards paid while an
      agent waits or after its end count for its last action, see :meth:`compute_returns_and_advantage`.
    - **Memory of policies** (``policy_kwargs={"memory": "gru"}``): minibatches are sequences of ``sequence_length``
      steps of whole teams, through which gradients run. The memory before each sequence is that of the rollout.
    - ``"action_mask"`` is stored for each row, ``"state"`` once per game.
    - Adding rows that are not whole teams in index order raises a ValueError.

    The order of teams comes from NumPy's global generator, as in SB3, so seeded runs repeat.

    :param buffer_size: T, steps per rollout
    :param observation_space: Dict observation space of ``CentralizedValueWrapper``
    :param action_space: one agent's action space
    :param device: device of minibatches
    :param gae_lambda: trade-off of bias and variance of the advantages, 1 for Monte-Carlo
    :param gamma: discount factor
    :param n_envs: B, rows
    :param ends: whether values end with an agent's ``"own"`` end, after which only what its row is paid counts, or with
        the episode of its ``"team"``: after an agent's end, values are then those of its team, for agents that receive
        the team's reward (``make_team_env(..., team_reward="sum")``), also where a rollout ends before the episode
    :param normalize_advantage: ``"agent"`` gives the advantages of each agent mean 0 and standard deviation 1 over the
        rollout, for agents whose own rewards differ in scale: PPO normalises over the rows of all agents, where the one
        that is paid more drowns the others. A rollout in which agents of a team were paid alike stays as it is (not if
        SB3 has added their different values at time limits), and so does every one with None
    :param sequence_length: L, steps of a sequence for policies with memory, a divisor of ``buffer_size``; None for
        whole rollouts
    :raises ValueError: if the space is not that of teams, the rows are not whole teams, ``ends`` is invalid, or
        ``sequence_length`` does not divide the rollout
    """

    #: Buffers without a policy, by the identity of their space: SB3 makes an algorithm's buffer, then its policy.
    _waiting: ClassVar[WeakValueDictionary[int, TeamRolloutBuffer]] = WeakValueDictionary()

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Dict,
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        gae_lambda: float = 1,
        gamma: float = 0.99,
        n_envs: int = 1,
        ends: Ends = "own",
        normalize_advantage: Literal["agent"] | None = None,
        sequence_length: int | None = None,
    ) -> None:
        check_choice("ends", ends, get_args(Ends))
        check_choice("normalize_advantage", normalize_advantage, ("agent", None))
        self.ends = ends
        self.normalize_advantage = normalize_advantage
        self.sequence_length = buffer_size if sequence_length is None else sequence_length
        check_count("sequence_length", self.sequence_length)
        if buffer_size % self.sequence_length:
            raise ValueError(
                f"expected sequence_length to divide the {buffer_size} steps of a rollout (n_steps), got "
                f"{sequence_length}; choose a divisor, or None for whole rollouts"
            )
        self.team_spaces = TeamSpaces.from_observation_space(observation_space)
        self.n_agents = self.team_spaces.n_agents
        self.n_games = check_whole_teams(n_envs, self.n_agents, "give the buffer the rows of whole games")
        self._agents = np.tile(np.arange(self.n_agents), self.n_games)
        self._allocated = False
        self._returns = RolloutReturns(np.zeros(0), self._agents[:0])
        self._later: list[tuple[int, LaterValues]] = []
        self._waiting[id(observation_space)] = self
        #: (T / L, E, M), the memory of games before each sequence, of policies that have one: that of all agents,
        #: then the critic's.
        self.memories: th.Tensor | None = None
        super().__init__(buffer_size, observation_space, action_space, device, gae_lambda, gamma, n_envs)

    @classmethod
    def waits_for(cls, observation_space: spaces.Space[Any]) -> bool:
        """Return whether a buffer was made for a space whose policy is not made yet; asked by the policy, once."""
        return cls._waiting.pop(id(observation_space), None) is not None

    def reset(self) -> None:
        """Clear the rollout; the arrays are reused, since touching new memory takes as long as the encoder."""
        if not self._allocated:
            # SB3 allocates one array for each key of obs_shape, and stores only those keys.
            by_row = [key for key in (OBS_KEY, ACTION_MASK_KEY) if key in self.obs_shape]
            self.obs_shape = {key: self.obs_shape[key] for key in by_row}
            super().reset()
            if isinstance(self.action_space, spaces.Box):  # also of integers: likelihoods are those of the floats drawn
                self.actions = self.actions.astype(np.float32)
            # One entry per step and game, (T, E, ...).
            self._agents_of_steps = th.arange(self.n_agents, device=self.device).repeat(
                self.buffer_size * self.n_games, 1
            )
            self.active: Array | None = None
            self.states: Array | None = None
            self.starts: Array | None = None
            shape = (self.buffer_size, self.n_games)
            if self.team_spaces.has_starts:
                self.starts = np.zeros((self.buffer_size, self.n_envs, 1), dtype=np.int8)
            if self.team_spaces.active is not None:
                self.active = np.ones((*shape, self.n_agents), dtype=np.int8)
            if self.team_spaces.state is not None:
                state = self.team_spaces.state
                self.states = np.zeros((*shape, *(state.shape or ())), dtype=state.dtype)
            self._allocated = True
        self._later.clear()
        self.memories = None
        BaseBuffer.reset(self)

    @property
    def nbytes(self) -> int:
        """Size of the rollout in bytes."""
        optional = [array for array in (self.active, self.states, self.starts) if array is not None]
        arrays = [*self.observations.values(), *optional, *(getattr(self, name) for name in _ROW_ARRAYS)]
        return sum(array.nbytes for array in arrays)

    def add(  # type: ignore[override]
        self,
        obs: dict[str, Array],
        action: Array,
        reward: Array,
        episode_start: Array,
        value: th.Tensor,
        log_prob: th.Tensor,
    ) -> None:
        """
        Store one step of all games.

        :param obs: Dict observation of B rows
        :param action: (B, ...)
        :param reward: (B,)
        :param episode_start: (B,) whether an episode starts with this step
        :param value: (B,) or (B, 1) predicted values; :class:`LaterValues` are computed at the end of the rollout
        :param log_prob: (B,)
        :raises ValueError: if the rows are not whole teams in index order
        """
        own, team = check_rows(obs, self.team_spaces, self._agents), np.asarray(obs[TEAM_KEY])
        # Equality once for each rollout: a wrapper above CentralizedValueWrapper may change one of the two.
        is_of_rows = team.shape == (self.n_envs, self.n_agents, *self.team_spaces.own_shape)
        if not is_of_rows or (self.pos == 0 and not np.array_equal(team[:: self.n_agents].reshape(own.shape), own)):
            raise ValueError(
                f"expected {TEAM_KEY!r} to hold the {OBS_KEY!r} of the team's own rows, got another one of shape "
                f"{team.shape}; change or normalise observations below CentralizedValueWrapper only"
            )
        for array, key in ((self.active, ACTIVE_KEY), (self.states, STATE_KEY)):
            if array is not None:
                array[self.pos] = of_games(obs, key, array, self.n_agents, self.pos)
        if self.starts is not None:
            self.starts[self.pos] = np.reshape(obs[EPISODE_START_KEY], (-1, 1))
        if isinstance(value, LaterValues):
            self._later.append((self.pos, value))
            value = th.full_like(log_prob, th.nan)  # until compute_returns_and_advantage
        super().add(obs, action, reward, episode_start, value, log_prob)

    def compute_returns_and_advantage(self, last_values: th.Tensor, dones: npt.NDArray[Any]) -> None:
        """
        Compute advantages A and returns A + V of each agent by SB3's recursion.

        With b_t = 1 if an episode begins at step t::

            A_t = r_t + gamma (1 - b_{t+1}) V_{t+1} - V_t + gamma lambda (1 - b_{t+1}) A_{t+1}

        After the last step T, b is ``dones`` and V_T ``last_values``. Where an agent does not take part, V is not that
        of the critic, but what the rows hold until it takes part again or the episode ends::

            V_t = r_t + gamma (1 - b_{t+1}) V_{t+1}

        So an absence is no end, rewards paid to an agent that waits or has ended count for its last action, and V is
        zero after its end if nothing is paid. V_T is zero for inactive agents. Advantages of inactive rows are unused;
        their values and returns become the means of the active ones, which leaves SB3's explained variance to these.

        With ``ends="team"``, V of an inactive agent is the mean of V over the active agents of its team, since all
        receive the same reward.

        With ``normalize_advantage="agent"``, the advantages of each agent then get mean 0 and standard deviation 1 over
        its rows, unless all agents of each team received the same rewards.

        :param last_values: (B,) or (B, 1) values after the last step
        :param dones: (B,) whether an episode ended with the last step
        """
        at_once = max(1, ROWS_AT_ONCE // self.n_envs)
        for start in range(0, len(self._later), at_once):
            positions, steps = zip(*self._later[start : start + at_once], strict=True)
            for position, values in zip(positions, compute_together(steps), strict=True):
                self.values[position] = values.reshape(-1).cpu().numpy()
        if self._later:  # not in a second call, after a callback has changed rewards
            cuts = [value.step for _, value in self._later[:: self.sequence_length]]
            of_actor = [step.actor for step in cuts if step.actor is not None]
            of_critic = [step.critic for step in cuts if step.critic is not None]
            parts = [th.stack(part).view(len(cuts), self.n_games, -1) for part in (of_actor, of_critic) if part]
            self.memories = th.cat(parts, dim=2) if parts else None
            self._later.clear()
        counted = np.ones((self.buffer_size, self.n_envs), dtype=np.bool_)
        if self.active is not None:
            counted = self.active.reshape(self.buffer_size, self.n_envs) != 0
        if self.active is not None and self.ends == "team":
            # At a time limit of the team the values that follow were added to the rewards of those who take part.
            over = np.vstack([self.episode_starts[1:], np.asarray(dones, dtype=np.float32)]) != 0
            over &= ~counted & self.active.any(axis=2).repeat(self.n_agents, axis=1)
            self.rewards = np.where(over, self._with_values_of_teams(self.rewards, counted), self.rewards)
            self.values = self._with_values_of_teams(self.values, counted)
            last = last_values.reshape(-1).cpu().numpy()
            last_values = th.from_numpy(self._with_values_of_teams(last, last != 0))
        elif self.active is not None:
            following, continues = last_values.reshape(-1).cpu().numpy(), 1.0 - np.asarray(dones, dtype=np.float32)
            for step in reversed(range(self.buffer_size)):
                paid = self.rewards[step] + self.gamma * following * continues
                self.values[step] = np.where(counted[step], self.values[step], paid)
                following, continues = self.values[step], 1.0 - self.episode_starts[step]
        super().compute_returns_and_advantage(last_values, dones)
        agents = np.broadcast_to(self._agents, counted.shape)
        self._returns = RolloutReturns(self.returns[counted], agents[counted])
        if self.normalize_advantage == "agent":
            by_team = (self.buffer_size, self.n_games, self.n_agents)
            rewards, playing = self.rewards.reshape(by_team), counted.reshape(by_team)
            highest = np.where(playing, rewards, -np.inf).max(axis=2)
            lowest = np.where(playing, rewards, np.inf).min(axis=2)
            # Not if the active agents of each team received the same rewards in all steps of the rollout.
            for agent in range(self.n_agents) if (highest > lowest).any() else ():
                rows = counted & (agents == agent)
                advantages = self.advantages[rows].astype(np.float64)
                if len(advantages):
                    self.advantages[rows] = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        for array in (self.values, self.returns) if counted.any() else ():
            # SB3 logs ``train/explained_variance`` of all rows: constants in the others leave that of the counted ones.
            array[~counted] = array[counted].mean()

    def _with_values_of_teams(self, values: Array, active: npt.NDArray[np.bool_]) -> Array:
        """Return values (..., B) in which those of inactive agents are the mean over their team's active agents."""
        by_team, playing = (array.reshape(-1, self.n_agents) for array in (values, active))
        total = np.where(playing, by_team, 0).sum(axis=1, keepdims=True)
        mean = total / playing.sum(axis=1, keepdims=True).clip(min=1)
        return np.where(playing, by_team, mean).astype(values.dtype).reshape(values.shape)

    def get(self, batch_size: int | None = None) -> Generator[DictRolloutBufferSamples, None, None]:  # type: ignore[override]
        """
        Yield minibatches of the whole rollout, with teams in random order.

        :param batch_size: rows per minibatch, rounded down to whole teams, at least one; None for all; inactive rows
            are omitted
        :return: minibatches of whole teams: rows of one team are consecutive and in index order
        :raises ValueError: if the buffer is not full, or no agent was ever active
        """
        if not self.full:
            raise ValueError(f"expected a full rollout of {self.buffer_size} steps, got {self.pos}; add the rest first")
        # Team steps with at least one active agent, each ``step * E + game``.
        playing = np.arange(self.buffer_size * self.n_games)
        if self.active is not None:
            playing = np.flatnonzero(self.active.any(axis=2))
        if not len(playing):
            raise ValueError(
                f"expected agents that take part, got none in {self.buffer_size} steps of {self.n_games} games; there "
                f"is nothing to learn from: check the {ACTIVE_KEY!r} of the environment, or collect longer rollouts"
            )
        sequences = playing[:, np.newaxis]
        if self.memories is not None:
            stride = self.sequence_length * self.n_games
            firsts = np.unique(sequences // stride * stride + sequences % self.n_games)
            sequences = firsts[:, np.newaxis] + np.arange(0, stride, self.n_games)
        # SB3 seeds only NumPy's global generator from the run's seed.
        order = sequences[np.random.permutation(len(sequences))]  # noqa: NPY002
        per_batch = len(order)
        if batch_size is not None:
            per_batch = max(1, batch_size // self.n_agents // sequences.shape[1])
        for start in range(0, len(order), per_batch):
            yield self._get_samples(order[start : start + per_batch].T)

    def _get_samples(  # type: ignore[override]
        self, batch_inds: npt.NDArray[np.int64], env: VecNormalize | None = None
    ) -> DictRolloutBufferSamples:
        """
        Return the active rows of the given team steps.

        :param batch_inds: (L, S) team steps of S sequences, each ``step * E + game``
        :return: L * S * N rows without those of inactive agents
        """
        first, batch_inds, sequences = batch_inds[0], batch_inds.reshape(-1), None
        if self.memories is not None and self.starts is not None:
            starts = self._gather(self.starts, batch_inds).view(-1, len(first), self.n_agents) != 0
            cut, game = first // (self.sequence_length * self.n_games), first % self.n_games
            at = th.as_tensor(cut * self.n_games + game, device=self.memories.device)
            sequences = Sequences(starts, self.memories.flatten(0, 1)[at].to(self.device))
        parts = {
            name: self._gather(getattr(self, name), batch_inds).flatten(end_dim=1)
            for name in ("actions", "values", "log_probs", "advantages", "returns")
        }
        own = self._gather(self.observations[OBS_KEY], batch_inds)
        # In the shapes of SB3's buffer.
        entries = {OBS_KEY: own.flatten(end_dim=1), AGENT_KEY: self._agents_of_steps[: len(batch_inds)].reshape(-1, 1)}
        if ACTION_MASK_KEY in self.observations:
            entries[ACTION_MASK_KEY] = self._gather(self.observations[ACTION_MASK_KEY], batch_inds).flatten(end_dim=1)
        if self.starts is not None:
            entries[EPISODE_START_KEY] = self._gather(self.starts, batch_inds).flatten(end_dim=1).long()
        for array, key in ((self.active, ACTIVE_KEY), (self.states, STATE_KEY)):
            if array is not None:
                by_game = self.to_torch(self._of_games_at(array, batch_inds), copy=False)
                entries[key] = by_game.repeat_interleave(self.n_agents, dim=0)
        active = None if self.active is None else self._of_games_at(self.active, batch_inds)
        rows = None
        if active is not None and not active.all():
            rows = th.as_tensor(np.flatnonzero(active), device=self.device)
            parts, entries = ({key: part[rows] for key, part in some.items()} for some in (parts, entries))
        teams = WholeTeams(
            own.reshape(*own.shape[:2], *self.team_spaces.own_shape),
            rows,
            None if active is None else self.to_torch(active != 0, copy=False),
            sequences,
        )
        return DictRolloutBufferSamples(
            observations=TeamMinibatch(teams, entries, self._returns, parts["values"]),
            actions=parts["actions"].float(),
            old_values=parts["values"],
            old_log_prob=parts["log_probs"],
            advantages=parts["advantages"],
            returns=parts["returns"],
        )

    def _of_games_at(self, array: Array, team_steps: npt.NDArray[np.int64]) -> Array:
        """Select team steps: (T, E, ...) -> (K, ...)."""
        return array.reshape(self.buffer_size * self.n_games, *array.shape[2:]).take(team_steps, axis=0)

    def _gather(self, array: Array, team_steps: npt.NDArray[np.int64]) -> th.Tensor:
        """Gather team steps: (T, B, ...) -> (K, N, ...); with game-major rows, each team step is contiguous."""
        by_team = array.reshape(self.buffer_size * self.n_games, self.n_agents, *array.shape[2:])
        return self.to_torch(by_team.take(team_steps, axis=0), copy=False)
