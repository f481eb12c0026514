"""
Replay buffer of teams: joint observations, each stored once, and joint actions.

Letters: S slots, E games, N agents, A actions, G sampled team steps. A *team step* is one game step of one game.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import psutil
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_saf.buffers.rollout import check_rows, of_games
from sb3_saf.teams.checks import check_count, check_form, check_whole_teams
from sb3_saf.teams.rows import ACTION_MASK_KEY, ACTIVE_KEY, OBS_KEY, STATE_KEY, TRUNCATED, Array, TeamSpaces

Indices = npt.NDArray[np.int64]

_NO_ACTION: Final = -1
#: The observation after a step is that of the next slot.
_IN_NEXT_SLOT: Final = -1


class TeamSteps(NamedTuple):
    """
    Observations of teams at G steps.

    :param own: (G, N, *shape) own observations of all agents
    :param masks: (G, N, A) bool, legal actions; None if all always are
    :param active: (G, N) bool, agents that take part; None if all always do
    :param states: (G, *state) states of the games, None if observations have none
    """

    own: th.Tensor
    masks: th.Tensor | None
    active: th.Tensor | None
    states: th.Tensor | None


class Sequences(NamedTuple):
    """
    Order in time of the G steps of a sample: ``n`` sequences of ``length`` steps, one after the other.

    :param length: steps of each sequence, burn-in included
    :param last_actions: (G, N) the agents' actions one step earlier; -1 where an episode starts or an agent joins
    :param resets: (G,) bool, steps before which the memory is reset
    :param counted: (G,) bool, steps that enter the loss
    """

    n: int
    length: int
    last_actions: th.Tensor
    resets: th.Tensor
    counted: th.Tensor


class TeamReplaySamples(NamedTuple):
    """
    Joint transitions.

    :param now: observations before the step
    :param actions: (G, N) int64
    :param after: observations after the step; at the end of an episode, its last observations
    :param rewards: (G,) team rewards, the sums of the agents' rewards
    :param dones: (G,) 1.0 where the next value is not bootstrapped
    :param sequences: None for single steps
    """

    now: TeamSteps
    actions: th.Tensor
    after: TeamSteps
    rewards: th.Tensor
    dones: th.Tensor
    sequences: Sequences | None = None


class TeamReplayBuffer(ReplayBuffer):
    """
    Replay buffer for the rows of ``CentralizedValueWrapper``.

    - **Memory**: per team step, the N own observations in their own dtype (245 bytes for 5 agents of HECOGrid's tiles),
      N actions, one reward. The observation after a step is that of the next slot; if they differ (a time limit with
      ``"bootstrap"``, a reset in between), it is stored separately.
    - **Team reward**: the sum of the rewards of all agents.
    - **Time limits**: as ``CentralizedValueWrapper`` reports them. With ``time_limit="terminal"`` they are true ends;
      with ``"bootstrap"`` the value of the last observation is used.
    - ``"action_mask"``, ``"active"`` and ``"state"`` are stored if observations have them.

    Samples are drawn with NumPy's global generator, as in SB3.

    :param buffer_size: **game steps** to keep, over all games
    :param observation_space: Dict observation space of ``CentralizedValueWrapper``
    :param action_space: one agent's action space, Discrete
    :param device: device of samples
    :param n_envs: B = E * N rows
    :param optimize_memory_usage: unused, present because SB3 passes it: observations are always stored once
    :raises ValueError: if the space is not that of teams or the rows are not whole teams
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
    ) -> None:
        self.team_spaces = TeamSpaces.from_observation_space(observation_space)
        assert isinstance(action_space, spaces.Discrete)
        self.n_agents = self.team_spaces.n_agents
        self.n_games = check_whole_teams(n_envs, self.n_agents, "give the buffer the rows of whole games")
        # Not ReplayBuffer's constructor: it would allocate arrays for rows.
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.buffer_size = max(check_count("buffer_size", buffer_size) // self.n_games, 1)
        self.optimize_memory_usage = True
        self.handle_timeout_termination = True
        self._agents = np.tile(np.arange(self.n_agents), self.n_games)
        n_actions = int(action_space.n)
        #: One more slot than steps, for the observation after the newest step.
        self.n_slots = self.buffer_size + 1
        shape = (self.n_slots, self.n_games)
        team = self.team_spaces
        self.seen: dict[str, Array] = {OBS_KEY: np.zeros((*shape, *team.team.shape), dtype=team.team.dtype)}
        if team.action_mask is not None:
            self.seen[ACTION_MASK_KEY] = np.ones((*shape, self.n_agents, n_actions), dtype=np.int8)
        if team.active is not None:
            self.seen[ACTIVE_KEY] = np.ones((*shape, self.n_agents), dtype=np.int8)
        if team.state is not None:
            self.seen[STATE_KEY] = np.zeros((*shape, *(team.state.shape or ())), dtype=team.state.dtype)
        self.actions = np.zeros((*shape, self.n_agents), dtype=np.min_scalar_type(n_actions - 1))
        self.rewards = np.zeros(shape, dtype=np.float32)
        #: Whether the next value is not bootstrapped; whether the episode ends; whether one starts.
        self.terminal, self.ended, self.starts = (np.zeros(shape, dtype=np.bool_) for _ in range(3))
        #: Index in ``aside`` of the observation after a step; -1 if it is in the next slot.
        self.aside_index = np.full(shape, _IN_NEXT_SLOT, dtype=np.int32)
        self.aside = {key: array[:0, 0].copy() for key, array in self.seen.items()}
        self._free: list[int] = []
        self._n_steps = 0
        #: Whether any agent took part since the last reset.
        self._has_played = False
        available = psutil.virtual_memory().available
        if self.nbytes > available:
            warnings.warn(
                f"The replay buffer of {self.buffer_size * self.n_games} game steps takes {self.nbytes / 1e9:.2f} GB, "
                f"but {available / 1e9:.2f} GB are free; lower buffer_size, or take observations of fewer bytes "
                '(observation="tiles")',
                UserWarning,
                stacklevel=2,
            )

    def reset(self) -> None:
        """Remove all steps."""
        super().reset()
        self._has_played = False
        self._n_steps = 0
        self.aside_index[:] = _IN_NEXT_SLOT
        self._free = list(range(len(self.aside[OBS_KEY])))

    @property
    def nbytes(self) -> int:
        """Size of all arrays in bytes."""
        return sum(array.nbytes for array in [*self._by_slot().values(), *self.aside.values()])

    @property
    def n_stored(self) -> int:
        """Number of game steps that can be sampled, over all games."""
        return self.size() * self.n_games

    # --- adding -----------------------------------------------------------------------------------------------------

    def add(  # type: ignore[override]
        self,
        obs: Mapping[str, Array],
        next_obs: Mapping[str, Array],
        action: Array,
        reward: Array,
        done: Array,
        infos: list[dict[str, Any]],
        episode_starts: Array | None = None,
    ) -> None:
        """
        Store one step of all games.

        :param obs: Dict observation of B rows
        :param next_obs: observation after the step; the last one for rows whose episode ended. ``team`` is not read
        :param action: (B,)
        :param reward: (B,)
        :param done: (B,)
        :param infos: of B rows, read for ``"TimeLimit.truncated"``
        :param episode_starts: (B,) whether an episode starts with ``obs``; None to infer it from the ends of episodes
        :raises ValueError: if the rows are not whole teams in index order
        """
        now, after = self._parts(obs), self._parts(next_obs)
        self._has_played |= ACTIVE_KEY not in now or bool(now[ACTIVE_KEY].any())
        slot = self.pos
        self._begin(slot, now, None if episode_starts is None else np.asarray(episode_starts)[:: self.n_agents])
        ended = np.asarray(done).reshape(self.n_games, self.n_agents)[:, 0].astype(bool)
        # Agents that ended before the time limit of their team have no such flag.
        limits = np.array([bool(info.get(TRUNCATED, False)) for info in infos])
        truncated = limits.reshape(self.n_games, self.n_agents).any(axis=1)
        self.actions[slot] = np.asarray(action).reshape(self.n_games, self.n_agents)
        self.rewards[slot] = np.asarray(reward).reshape(self.n_games, self.n_agents).sum(axis=1, dtype=np.float64)
        self.ended[slot], self.terminal[slot] = ended, ended & ~truncated
        self.pos = (slot + 1) % self.n_slots
        places = self.aside_index[self.pos]
        self._free += places[places >= 0].tolist()
        self.aside_index[self.pos] = _IN_NEXT_SLOT
        for key, part in after.items():
            self.seen[key][self.pos] = part
        self._n_steps = min(self.size() + 1, self.buffer_size)
        self.full = self._n_steps == self.buffer_size

    def size(self) -> int:
        """Return the number of steps of each game that can be sampled."""
        return self._n_steps

    def _parts(self, obs: Mapping[str, Array]) -> dict[str, Array]:
        """Check rows and return their stored parts by game: (B, ...) -> (E, N, ...) or (E, ...)."""
        own, by_agent = check_rows(obs, self.team_spaces, self._agents), (self.n_games, self.n_agents)
        parts = {OBS_KEY: own.reshape(*by_agent, *own.shape[1:])}
        if ACTION_MASK_KEY in self.seen:
            parts[ACTION_MASK_KEY] = np.asarray(obs[ACTION_MASK_KEY]).reshape(*by_agent, -1)
        for key in (ACTIVE_KEY, STATE_KEY):
            if key in self.seen:
                parts[key] = of_games(obs, key, self.seen[key], self.n_agents, self.pos)
        return parts

    def _begin(self, slot: int, now: dict[str, Array], starts: npt.NDArray[Any] | None) -> None:
        """Write the observation before a step; move the one it replaces to ``aside`` if the previous step needs it."""
        if self.size() == 0:
            self.starts[slot] = True
        else:
            before = (slot - 1) % self.n_slots
            other = np.zeros(self.n_games, dtype=np.bool_)
            for key, part in now.items():
                other |= (self.seen[key][slot] != part).reshape(self.n_games, -1).any(axis=1)
            self.starts[slot] = self.ended[before] | other if starts is None else starts.astype(bool)
            for game in np.flatnonzero((other | self.starts[slot]) & ~self.terminal[before]).tolist():
                if not self._free:  # at most one place per step is in use
                    n_places = len(self.aside[OBS_KEY])
                    n_more = max(n_places, self.n_games)
                    for key, array in self.aside.items():
                        self.aside[key] = np.concatenate([array, np.zeros((n_more, *array.shape[1:]), array.dtype)])
                    self._free = list(range(n_places, n_places + n_more))[::-1]
                place = self.aside_index[before, game] = self._free.pop()
                for key, array in self.seen.items():
                    self.aside[key][place] = array[slot, game]
        for key, part in now.items():
            self.seen[key][slot] = part

    # --- checkpoints ------------------------------------------------------------------------------------------------

    def checkpoint_state(self) -> dict[str, Any]:
        """
        Return the stored data, for exact resume; slots that were never filled are left out.

        :return: plain data for :meth:`load_checkpoint_state` of an equal buffer; arrays are views of the buffer's
        """
        n_filled = self.n_slots if self.full else self.pos + 1
        return {
            "n_slots": self.n_slots,
            "slots": {name: array[:n_filled] for name, array in self._by_slot().items()},
            "aside": dict(self.aside),
            "free": list(self._free),
            "pos": self.pos,
            "n_steps": self._n_steps,
        }

    def load_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of :meth:`checkpoint_state`; the ValueError for that of another buffer names what differs."""
        if state["n_slots"] != self.n_slots:
            raise ValueError(f"expected a replay buffer of {self.n_slots} slots, got {state['n_slots']}")
        n_filled = self.n_slots if state["n_steps"] == self.buffer_size else state["pos"] + 1
        check_form("the replay buffer", state["slots"], {k: part[:n_filled] for k, part in self._by_slot().items()})
        self.reset()
        for name, array in self._by_slot().items():
            array[:n_filled] = state["slots"][name]
        self.aside = {key: np.array(part) for key, part in state["aside"].items()}
        self._free, self.pos, self._n_steps = list(state["free"]), state["pos"], state["n_steps"]
        self.full = self._n_steps == self.buffer_size
        active = state["slots"].get(f"seen {ACTIVE_KEY}")
        self._has_played = self._n_steps > 0 and (active is None or bool(active.any()))

    def _by_slot(self) -> dict[str, Array]:
        """Return all arrays with one entry per slot, by name."""
        seen = {f"seen {key}": array for key, array in self.seen.items()}
        names = ("actions", "rewards", "terminal", "ended", "starts", "aside_index")
        return seen | {name: getattr(self, name) for name in names}

    # --- sampling ---------------------------------------------------------------------------------------------------

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> TeamReplaySamples:  # type: ignore[override]
        """
        Draw single steps uniformly with replacement.

        :param batch_size: G, team steps
        :param env: unused: QPLEX does not train on VecNormalize
        """
        self._check_filled()
        steps, games = self._draw(self.size(), batch_size)
        return self._get_samples(steps * self.n_games + games, env)

    def every_step(self) -> TeamReplaySamples:
        """Return all T E stored team steps, from the oldest on, those of all games at a step together."""
        self._check_filled()
        return self._get_samples(np.arange(self.size() * self.n_games))

    def sample_sequences(self, n_sequences: int, length: int, burn_in: int) -> TeamReplaySamples:
        """
        Draw sequences of consecutive steps of a game, for agents with memory.

        The steps that enter the loss follow burn-in steps for the memory, at most ``burn_in`` and as many as are
        stored. Sequences may span several episodes; the memory is reset between them.

        :param n_sequences: number of sequences
        :param length: steps of each that enter the loss; fewer while the buffer holds fewer
        :param burn_in: steps before them
        """
        self._check_filled()
        length = min(length, self.size())
        first, games = self._draw(self.size() - length + 1, n_sequences)
        window = np.arange(-burn_in, length)
        raw = (first[:, np.newaxis] + window).reshape(-1)
        # Steps before the oldest are replaced by it, with a reset of the memory at each, so they have no effect.
        steps, games = np.maximum(raw, 0), np.repeat(games, len(window))
        samples = self._get_samples(steps * self.n_games + games)
        slots = self.slots(steps)
        starts = self.starts[slots, games]
        last = self.actions[(slots - 1) % self.n_slots, games].astype(np.int64)
        last[starts] = _NO_ACTION
        if ACTIVE_KEY in self.seen:  # agents that join
            last[self.seen[ACTIVE_KEY][(slots - 1) % self.n_slots, games] == 0] = _NO_ACTION
        sequences = Sequences(
            n_sequences,
            len(window),
            last_actions=self.to_torch(last),
            resets=self.to_torch(starts | (raw <= 0)),
            counted=self.to_torch(np.tile(window >= 0, n_sequences)),
        )
        return samples._replace(sequences=sequences)

    def _check_filled(self) -> None:
        if self.size() == 0:
            raise ValueError("expected a replay buffer with at least one step, got an empty one; add steps first")
        if not self._has_played:
            raise ValueError(
                f"expected agents that take part, got none in {self.size()} steps of {self.n_games} games; there is "
                f"nothing to learn from: check the {ACTIVE_KEY!r} of the environment, or raise learning_starts"
            )

    def _draw(self, n_steps: int, count: int) -> tuple[Indices, Indices]:
        """Draw ``count`` steps, counted from the oldest, and games, with the generator that SB3 seeds."""
        steps = np.random.randint(0, n_steps, size=count)  # noqa: NPY002
        return steps, np.random.randint(0, self.n_games, size=count)  # noqa: NPY002

    def slots(self, steps: Indices) -> Indices:
        """Return the slots of steps that are counted from the oldest."""
        return (self.pos - self.size() + steps) % self.n_slots

    def _get_samples(  # type: ignore[override]
        self, batch_inds: Indices, env: VecNormalize | None = None
    ) -> TeamReplaySamples:
        """
        Return the given team steps.

        :param batch_inds: (G,) each is ``step * E + game``, steps counted from the oldest
        """
        steps, games = np.divmod(batch_inds, self.n_games)
        slots = self.slots(steps)
        now = {key: array[slots, games] for key, array in self.seen.items()}
        after = {key: array[(slots + 1) % self.n_slots, games] for key, array in self.seen.items()}
        places = self.aside_index[slots, games]
        if (apart := places >= 0).any():
            for key, array in after.items():
                array[apart] = self.aside[key][places[apart]]
        return TeamReplaySamples(
            now=self._team_steps(now),
            actions=self.to_torch(self.actions[slots, games].astype(np.int64)),
            after=self._team_steps(after),
            rewards=self.to_torch(self.rewards[slots, games]),
            dones=self.to_torch(self.terminal[slots, games].astype(np.float32)),
        )

    def _team_steps(self, parts: dict[str, Array]) -> TeamSteps:
        tensors = {key: self.to_torch(part, copy=False) for key, part in parts.items()}
        masks, active = tensors.get(ACTION_MASK_KEY), tensors.get(ACTIVE_KEY)
        return TeamSteps(
            tensors[OBS_KEY],
            None if masks is None else masks != 0,
            None if active is None else active != 0,
            tensors.get(STATE_KEY),
        )
