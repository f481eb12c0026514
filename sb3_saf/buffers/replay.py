"""
Replay of teams: what all agents of a game saw and did, each joint observation stored once.

Letters: S slots, E games, N agents, A actions, G sampled team steps. A *team step* is one game step of one game.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_saf.envs.teams import (
    ACTION_MASK_KEY,
    ACTIVE_KEY,
    AGENT_KEY,
    OBS_KEY,
    STATE_KEY,
    Array,
    TeamSpaces,
    check_count,
    check_whole_teams,
)

try:
    import psutil
except ImportError:  # SB3 does without it, too
    psutil = None

Indices = npt.NDArray[np.int64]

_TRUNCATED: Final = "TimeLimit.truncated"
_NO_ACTION: Final = -1


def free_memory() -> int | None:
    """Bytes of memory that are free; None where nobody knows."""
    if psutil is not None:
        return int(psutil.virtual_memory().available)
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not Linux
        return None


class TeamSteps(NamedTuple):
    """
    What teams see at G steps.

    :param own: (G, N, *shape) own observations of all agents
    :param masks: (G, N, A) bool, legal actions; None if all always are
    :param active: (G, N) bool, agents that take part; None if all always do
    :param states: (G, *state) states of the games, where observations have them
    """

    own: th.Tensor
    masks: th.Tensor | None
    active: th.Tensor | None
    states: th.Tensor | None


class Sequences(NamedTuple):
    """
    How the G steps of a sample lie in time: ``n`` sequences of ``length`` steps, one after the other.

    :param n: number of sequences
    :param length: steps of each, those before the loss counts included
    :param last_actions: (G, N) the agents' actions one step earlier; -1 where an episode starts
    :param resets: (G,) bool, steps at which agents remember nothing
    :param counted: (G,) bool, steps that the loss counts
    """

    n: int
    length: int
    last_actions: th.Tensor
    resets: th.Tensor
    counted: th.Tensor


class TeamReplaySamples(NamedTuple):
    """
    Joint transitions.

    :param now: before the step
    :param actions: (G, N) int64
    :param after: after the step; of an episode's end, its last observations
    :param rewards: (G,) team rewards, the sums of the agents' rewards
    :param dones: (G,) 1.0 where nothing follows that is worth anything
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
      N actions, one reward. The observation after a step is that of the next slot; where it is not (a time limit with
      ``"bootstrap"``, a reset in between), it is kept aside.
    - **Team reward**: the sum of the rewards of all agents.
    - **Time limits**: as ``CentralizedValueWrapper`` reports them. With ``time_limit="terminal"`` they are ends; with
      ``"bootstrap"`` the value of the last observation counts.
    - ``"action_mask"``, ``"active"`` and ``"state"`` are stored where observations have them.

    Samples are drawn with NumPy's global generator, as in SB3.

    :param buffer_size: **game steps** to keep, over all games
    :param observation_space: Dict observation space of ``CentralizedValueWrapper``
    :param action_space: one agent's action space, Discrete
    :param device: where samples go
    :param n_envs: B = E * N rows
    :param optimize_memory_usage: not read, here because SB3 passes it: observations are always stored once
    :raises ValueError: if the space is not that of teams or the rows are no whole teams
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
        # Not ReplayBuffer's constructor: it would make arrays for rows.
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.buffer_size = max(check_count("buffer_size", buffer_size) // self.n_games, 1)
        self.optimize_memory_usage = True
        self.handle_timeout_termination = True
        self._agents = np.tile(np.arange(self.n_agents), self.n_games)
        self._allocate(int(action_space.n))
        self._check_memory()

    def _allocate(self, n_actions: int) -> None:
        #: One more slot than steps: for what was seen after the newest step.
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
        #: Whether nothing follows that is worth anything; whether the episode ends; whether one starts.
        self.terminal, self.ended, self.starts = (np.zeros(shape, dtype=np.bool_) for _ in range(3))
        #: Where the observation after a step was put aside; -1 if it is in the next slot.
        self.aside_index = np.full(shape, -1, dtype=np.int32)
        self.aside = {key: array[:0, 0].copy() for key, array in self.seen.items()}
        self._free: list[int] = []
        self._n_steps = 0

    def reset(self) -> None:
        """Forget everything."""
        super().reset()
        self._n_steps = 0
        self.aside_index[:] = -1
        self._free = list(range(len(self.aside[OBS_KEY])))

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        parts = [*self.seen.values(), *self.aside.values()]
        parts += [self.actions, self.rewards, self.terminal, self.ended, self.starts, self.aside_index]
        return sum(array.nbytes for array in parts)

    @property
    def n_stored(self) -> int:
        """Game steps that can be sampled, over all games."""
        return self.size() * self.n_games

    def _check_memory(self) -> None:
        available = free_memory()
        if available is not None and self.nbytes > available:
            warnings.warn(
                f"The replay buffer of {self.buffer_size * self.n_games} game steps takes {self.nbytes / 1e9:.2f} GB, "
                f"but {available / 1e9:.2f} GB are free; lower buffer_size, or take observations of fewer bytes "
                '(observation="tiles")',
                UserWarning,
                stacklevel=3,
            )

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
        :param next_obs: after the step; of rows whose episode ended, their last observation. ``team`` is not read
        :param action: (B,)
        :param reward: (B,)
        :param done: (B,)
        :param infos: of B rows, read for ``"TimeLimit.truncated"``
        :param episode_starts: (B,) whether an episode starts with ``obs``; None to tell by the ends of episodes
        :raises ValueError: if the rows are not whole teams in index order
        """
        now, after = self._parts(obs, "obs"), self._parts(next_obs, "next_obs")
        slot = self.pos
        self._begin(slot, now, None if episode_starts is None else np.asarray(episode_starts)[:: self.n_agents])
        ended = np.asarray(done).reshape(self.n_games, self.n_agents)[:, 0].astype(bool)
        truncated = np.array([bool(info.get(_TRUNCATED, False)) for info in infos[:: self.n_agents]])
        self.actions[slot] = np.asarray(action).reshape(self.n_games, self.n_agents)
        self.rewards[slot] = np.asarray(reward).reshape(self.n_games, self.n_agents).sum(axis=1, dtype=np.float64)
        self.ended[slot], self.terminal[slot] = ended, ended & ~truncated
        self.pos = (slot + 1) % self.n_slots
        self._release(self.pos)
        for key, part in after.items():
            self.seen[key][self.pos] = part
        self._n_steps = min(self.size() + 1, self.buffer_size)
        self.full = self._n_steps == self.buffer_size

    def size(self) -> int:
        """Steps of each game that can be sampled."""
        return self._n_steps

    def _parts(self, obs: Mapping[str, Array], what: str) -> dict[str, Array]:
        """What is stored of rows, by game: (B, ...) -> (E, N, ...) or (E, ...)."""
        own, agents = np.asarray(obs[OBS_KEY]), np.asarray(obs[AGENT_KEY]).reshape(-1)
        expected, dtype = (self.n_envs, *self.team_spaces.own_shape), self.team_spaces.team.dtype
        if own.shape != expected or not np.can_cast(own.dtype, dtype, "same_kind"):
            raise ValueError(
                f"expected {OBS_KEY!r} of {what} of shape {expected} and dtype {dtype}, got {own.shape} and {own.dtype}"
                "; fill the buffer from the environment that it was made for"
            )
        if not np.array_equal(agents, self._agents):
            raise ValueError(
                f"expected rows game-major, then agent, with {AGENT_KEY!r} 0 to {self.n_agents - 1} in each team, got "
                f"{agents[: 2 * self.n_agents].tolist()} ...; no wrapper above CentralizedValueWrapper may reorder rows"
            )
        by_agent = (self.n_games, self.n_agents)
        parts = {OBS_KEY: own.reshape(*by_agent, *expected[1:])}
        if ACTION_MASK_KEY in self.seen:
            parts[ACTION_MASK_KEY] = np.asarray(obs[ACTION_MASK_KEY]).reshape(*by_agent, -1)
        for key in (ACTIVE_KEY, STATE_KEY):
            if key in self.seen:
                parts[key] = np.asarray(obs[key])[:: self.n_agents]
        return parts

    def _begin(self, slot: int, now: dict[str, Array], starts: npt.NDArray[Any] | None) -> None:
        """Write what is seen before a step, and put aside what it replaces if the step before needs it."""
        if self.size() == 0:
            self.starts[slot] = True
        else:
            before = (slot - 1) % self.n_slots
            other = np.zeros(self.n_games, dtype=np.bool_)
            for key, part in now.items():
                other |= (self.seen[key][slot] != part).reshape(self.n_games, -1).any(axis=1)
            self.starts[slot] = self.ended[before] | other if starts is None else starts.astype(bool)
            for game in np.flatnonzero((other | self.starts[slot]) & ~self.terminal[before]).tolist():
                self._put_aside(before, game)
        for key, part in now.items():
            self.seen[key][slot] = part

    def _put_aside(self, slot: int, game: int) -> None:
        if not self._free:
            self._grow()
        place = self._free.pop()
        self.aside_index[slot, game] = place
        for key, array in self.seen.items():
            self.aside[key][place] = array[(slot + 1) % self.n_slots, game]

    def _grow(self) -> None:
        """More places for observations put aside; at most as many as there are steps are ever in use."""
        n_places = len(self.aside[OBS_KEY])
        n_more = max(n_places, self.n_games)
        for key, array in self.aside.items():
            self.aside[key] = np.concatenate([array, np.zeros((n_more, *array.shape[1:]), dtype=array.dtype)])
        self._free = list(range(n_places, n_places + n_more))[::-1]

    def _release(self, slot: int) -> None:
        """Free what a step that is overwritten has put aside."""
        places = self.aside_index[slot]
        self._free += places[places >= 0].tolist()
        self.aside_index[slot] = -1

    # --- checkpoints ------------------------------------------------------------------------------------------------

    def checkpoint_state(self) -> dict[str, Any]:
        """
        All that is stored, for exact resume; slots that were never filled are left out.

        :return: plain data for :meth:`load_checkpoint_state` of a buffer that was made with the same arguments
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
        """
        Go on from there.

        :param state: what :meth:`checkpoint_state` gave
        :raises ValueError: if it is that of a buffer of another size
        """
        if state["n_slots"] != self.n_slots:
            raise ValueError(f"expected a replay buffer of {self.n_slots} slots, got {state['n_slots']}")
        self.reset()
        for name, array in self._by_slot().items():
            saved = state["slots"][name]
            array[: len(saved)] = saved
        self.aside = {key: np.array(part) for key, part in state["aside"].items()}
        self._free, self.pos, self._n_steps = list(state["free"]), state["pos"], state["n_steps"]
        self.full = self._n_steps == self.buffer_size

    def _by_slot(self) -> dict[str, Array]:
        """All arrays with one entry per slot, by name."""
        seen = {f"seen {key}": array for key, array in self.seen.items()}
        names = ("actions", "rewards", "terminal", "ended", "starts", "aside_index")
        return seen | {name: getattr(self, name) for name in names}

    # --- sampling ---------------------------------------------------------------------------------------------------

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> TeamReplaySamples:  # type: ignore[override]
        """
        Draw single steps, each equally likely, with replacement.

        :param batch_size: G, team steps
        :param env: must be None; normalise below ``CentralizedValueWrapper``
        """
        self._check_filled()
        steps, games = self._draw(self.size(), batch_size)
        return self._get_samples(steps * self.n_games + games, env)

    def sample_sequences(self, n_sequences: int, length: int, burn_in: int) -> TeamReplaySamples:
        """
        Draw sequences of consecutive steps of a game, for agents that remember.

        The steps that the loss counts are preceded by steps that only warm up the memory, as many as are stored, at
        most ``burn_in``. Sequences may go over the ends of episodes, where the memory is reset.

        :param n_sequences: sequences
        :param length: steps of each that the loss counts; fewer while the buffer holds fewer
        :param burn_in: steps before them
        """
        self._check_filled()
        length = min(length, self.size())
        first, games = self._draw(self.size() - length + 1, n_sequences)
        window = np.arange(-burn_in, length)
        raw = (first[:, np.newaxis] + window).reshape(-1)
        # Steps before the oldest stand still at the oldest: the memory is reset at each of them, so they leave nothing.
        steps, games = np.maximum(raw, 0), np.repeat(games, len(window))
        samples = self._get_samples(steps * self.n_games + games)
        slots = self._slots(steps)
        starts = self.starts[slots, games]
        last = self.actions[(slots - 1) % self.n_slots, games].astype(np.int64)
        last[starts] = _NO_ACTION
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

    def _draw(self, n_steps: int, count: int) -> tuple[Indices, Indices]:
        """``count`` steps counted from the oldest, and games, from the generator that SB3 seeds."""
        steps = np.random.randint(0, n_steps, size=count)  # noqa: NPY002
        return steps, np.random.randint(0, self.n_games, size=count)  # noqa: NPY002

    def _slots(self, steps: Indices) -> Indices:
        """Slots of steps that are counted from the oldest."""
        slots: Indices = (self.pos - self.size() + steps) % self.n_slots
        return slots

    def _get_samples(  # type: ignore[override]
        self, batch_inds: Indices, env: VecNormalize | None = None
    ) -> TeamReplaySamples:
        """
        The given team steps.

        :param batch_inds: (G,) each is ``step * E + game``, steps counted from the oldest
        :param env: must be None
        """
        if env is not None:
            raise ValueError("TeamReplayBuffer does not undo VecNormalize; normalise below CentralizedValueWrapper")
        steps, games = np.divmod(batch_inds, self.n_games)
        slots = self._slots(steps)
        now = {key: array[slots, games] for key, array in self.seen.items()}
        return TeamReplaySamples(
            now=self._team_steps(now),
            actions=self.to_torch(self.actions[slots, games].astype(np.int64)),
            after=self._team_steps(self._after(slots, games)),
            rewards=self.to_torch(self.rewards[slots, games]),
            dones=self.to_torch(self.terminal[slots, games].astype(np.float32)),
        )

    def _after(self, slots: Indices, games: Indices) -> dict[str, Array]:
        after = {key: array[(slots + 1) % self.n_slots, games] for key, array in self.seen.items()}
        places = self.aside_index[slots, games]
        apart = places >= 0
        if apart.any():
            for key, array in after.items():
                array[apart] = self.aside[key][places[apart]]
        return after

    def _team_steps(self, parts: dict[str, Array]) -> TeamSteps:
        tensors = {key: self.to_torch(part, copy=False) for key, part in parts.items()}
        masks, active = tensors.get(ACTION_MASK_KEY), tensors.get(ACTIVE_KEY)
        return TeamSteps(
            tensors[OBS_KEY],
            None if masks is None else masks != 0,
            None if active is None else active != 0,
            tensors.get(STATE_KEY),
        )
