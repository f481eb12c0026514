"""One PettingZoo game as rows: SuperSuit's ``MarkovVectorEnv`` with fixes."""

from __future__ import annotations

from collections.abc import Container, Mapping
from copy import deepcopy
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium.vector.utils import iterate
from supersuit.vector import MarkovVectorEnv

from sb3_saf.envs import parallel_calls
from sb3_saf.envs.game_copies import Way, pickled, unpickled
from sb3_saf.envs.game_form import OBSERVATION, AnyParallelEnv, GameForm
from sb3_saf.envs.game_layers import get_attribute
from sb3_saf.envs.joint_observation import TERMINAL_OBSERVATION, TRUNCATED
from sb3_saf.envs.space_reader import SpaceReader
from sb3_saf.teams.rows import ACTION_MASK_KEY, ACTIVE_KEY, OBS_KEY, STATE_KEY

Info: TypeAlias = "dict[str, Any]"
Infos: TypeAlias = "list[Info]"

#: Keys of infos that Stable-Baselines3 or this package uses. A game's own entries with these names are renamed.
RESERVED_KEYS: Final = frozenset({TERMINAL_OBSERVATION, TRUNCATED, ACTIVE_KEY, "episode"})

_UNCHANGING = (type(None), bool, int, float, str, np.bool_, np.int64, np.float32, np.float64)


class TeamMarkovVectorEnv(MarkovVectorEnv):
    """
    The agents of one game as rows that end together.

    Changes to :class:`supersuit.vector.MarkovVectorEnv`:

    - an agent that has ended or not joined yet keeps its row, with zeros and no reward;
    - the last step's infos are kept: those of the next episode's reset are in ``reset_infos``;
    - infos of done rows have ``"TimeLimit.truncated"`` and ``"terminal_observation"``;
    - rows have signals on request: active agents, action masks, the game's state;
    - all results of the game are checked, and errors name agent, game and step.

    :param env: the game
    :param form: its form
    :param index: index of the game, for messages
    :param notes: gets a note if observations leave their bounds
    """

    par_env: AnyParallelEnv

    def __init__(self, env: AnyParallelEnv, form: GameForm, index: int, notes: list[str]) -> None:
        _add_missing_attributes(env)
        super().__init__(env, black_death=True)
        self.observation_space = form.rows.to_row_space()
        self.agents = form.agents
        self.index = index
        self._is_closed = False
        #: Infos of the last reset, one per row.
        self.reset_infos: Infos = []
        self._form = form
        self._own_reader = form.own_reader(notes)
        self._state_reader = None if form.state is None else SpaceReader(form.state, notes)
        self._blank = self._own_reader.blank()
        self._count_step(0)
        self._ended: set[Any] = set()
        #: Agents that take part, in the order of the rows: a set with an order.
        self._playing: dict[Any, None] = {}

    def _count_step(self, number: int) -> None:
        self._n_steps = number
        #: Game and step, for messages.
        self._place = f"game {self.index} at step {number}"

    # ---- episodes

    def reset(self, seed: int | None = None, options: Info | None = None) -> tuple[Any, Infos]:
        """
        Begin an episode.

        :param seed: seed of the game, None to continue its random stream
        :param options: options for the game
        :return: observations and infos of the N rows
        :raises ValueError: if the game violates PettingZoo's API
        """
        observations, infos = parallel_calls.reset(self.par_env, seed, options)
        self._count_step(0)
        self._ended.clear()
        self._playing = self._find_playing()
        if not self._playing:
            raise ValueError(f"expected at least one name in agents after reset of game {self.index}, got none")
        self.reset_infos = [
            _copied(parallel_calls.info(infos, agent, self._place), agent) if agent in self._playing else _inactive()
            for agent in self.agents
        ]
        return self._rows(observations, infos, self._playing), self.reset_infos

    def step(self, actions: npt.NDArray[Any]) -> tuple[Any, Any, Any, Any, Infos]:
        """Step the game with the actions of the N rows (see PettingZoo); the next episode begins automatically."""
        acted = self._playing
        chosen = dict(zip(self.agents, iterate(self.action_space, actions), strict=True))
        self._count_step(self._n_steps + 1)
        place = self._place
        step = parallel_calls.step(self.par_env, {agent: chosen[agent] for agent in acted})
        rewards = {agent: parallel_calls.number(step.rewards, agent, place) for agent in acted}
        terminated = {agent for agent in acted if parallel_calls.flag("terminations", step.terminations, agent, place)}
        truncated = {agent for agent in acted if parallel_calls.flag("truncations", step.truncations, agent, place)}
        truncated -= terminated
        self._ended |= terminated | truncated
        self._playing = self._find_playing()
        infos = [self._info(step.infos, agent) if agent in acted else _inactive() for agent in self.agents]
        over = not self._playing
        if over:
            observations = self._finish_episode(step, acted, truncated, infos)
        else:
            observations = self._rows(step.observations, step.infos, self._playing)
            for agent in terminated | truncated:
                row = self.agents.index(agent)
                infos[row][TERMINAL_OBSERVATION] = deepcopy(self._own(step.observations, agent, required=False))
        return (
            observations,
            np.array([rewards.get(agent, 0.0) for agent in self.agents], dtype=np.float32),
            np.array([over and agent not in truncated for agent in self.agents]),
            np.array([over and agent in truncated for agent in self.agents]),
            infos,
        )

    def _finish_episode(
        self, step: parallel_calls.Step, acted: Container[Any], truncated: set[Any], infos: Infos
    ) -> Any:
        """Put the last observations into the infos, and begin the next episode; return its observations."""
        # Rows are copies, so games may reuse their arrays in the reset.
        last = self._rows(step.observations, step.infos, acted, active=truncated, over=True)
        for agent, info, row in zip(self.agents, infos, iterate(self.observation_space, last), strict=True):
            info[TRUNCATED] = agent in truncated
            info[TERMINAL_OBSERVATION] = row
        return self.reset()[0]

    def close(self) -> None:
        """Close the game, once."""
        if not self._is_closed:
            self._is_closed = True
            super().close()

    def _find_playing(self) -> dict[Any, None]:
        """Return the agents that take part; an agent that has ended does not return."""
        present = parallel_calls.playing_agents(self.par_env, self.agents, self._place)
        return {agent: None for agent in self.agents if agent in present and agent not in self._ended}

    def _info(self, infos: Mapping[Any, Any], agent: Any) -> Info:
        info = _copied(parallel_calls.info(infos, agent, self._place), agent)
        if info:
            for key in RESERVED_KEYS.intersection(info):
                info[f"game_{key}"] = info.pop(key)
        return info

    # ---- copies

    def snapshot(self, way: Way) -> dict[str, Any]:
        """Return the complete state of the game, in a way of :func:`~sb3_saf.envs.game_copies.find_way`."""
        if way == "pickle":
            content = {"pickled": pickled(self.par_env)}
        else:
            content = {"state": get_attribute(self.par_env, "get_state")()}
        return {"n_steps": self._n_steps, "ended": [agent in self._ended for agent in self.agents], **content}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot; the infos of the last reset are not part of it."""
        if "pickled" in snapshot:
            self.par_env = unpickled(snapshot["pickled"], self.par_env)
        else:
            parallel_calls.reset(self.par_env, None, None)
            get_attribute(self.par_env, "set_state")(snapshot["state"])
        self._count_step(snapshot["n_steps"])
        self._ended = {agent for agent, ended in zip(self.agents, snapshot["ended"], strict=True) if ended}
        self._playing = self._find_playing()
        self.reset_infos = [{} for _ in self.agents]

    # ---- rows

    def _rows(
        self,
        observations: Mapping[Any, Any],
        infos: Mapping[Any, Any],
        shown: Container[Any],
        active: Container[Any] | None = None,
        over: bool = False,
    ) -> Any:
        """
        Stack the observations of the N rows.

        :param shown: agents whose observations are shown, the rows of others are zeros
        :param active: agents that take part, and must have an observation; None for those shown
        :param over: whether these are the last observations of the episode, on which no agent acts
        """
        active = shown if active is None else active
        rows = {
            agent: self._own(observations, agent, required=agent in active) if agent in shown else self._blank
            for agent in self.agents
        }
        if self._form.rows.is_dict:
            state = self._read_state()
            rows = {
                agent: {OBS_KEY: own, **self._signals(agent, observations, infos, agent in active, over), **state}
                for agent, own in rows.items()
            }
        return self.concat_obs(rows)

    def _own(self, observations: Mapping[Any, Any], agent: Any, required: bool) -> Any:
        """Return an agent's own observation, zeros if there is none and none is required."""
        observation = observations.get(agent)
        if observation is None:
            if required:
                raise ValueError(
                    f"expected an observation for {agent}, which takes part, in {self._place}, got observations for "
                    f"{[name for name, value in observations.items() if value is not None]}"
                )
            return self._blank
        if self._form.has_masks_inside:
            if not isinstance(observation, Mapping) or OBSERVATION not in observation:
                got = list(observation) if isinstance(observation, Mapping) else type(observation).__name__
                raise ValueError(
                    f"observation of {agent} in {self._place}: expected a dict with "
                    f"{[OBSERVATION, ACTION_MASK_KEY]}, got {got}"
                )
            observation = observation[OBSERVATION]
        return self._own_reader.read(observation, f"{agent} in {self._place}")

    def _read_state(self) -> Info:
        if self._state_reader is None:
            return {}
        return {STATE_KEY: self._state_reader.read(self.par_env.state(), f"the state of {self._place}")}

    def _signals(
        self, agent: Any, observations: Mapping[Any, Any], infos: Mapping[Any, Any], active: bool, over: bool
    ) -> Info:
        """Return the signals of an agent's row, without the state."""
        rows = self._form.rows
        signals: Info = {}
        if rows.has_active:
            signals[ACTIVE_KEY] = int(active)
        if rows.n_masked_actions is not None:
            signals[ACTION_MASK_KEY] = np.zeros(rows.n_masked_actions, dtype=np.int8)
            if active:
                signals[ACTION_MASK_KEY] = self._mask(agent, observations, infos, rows.n_masked_actions, over)
        return signals

    def _mask(
        self, agent: Any, observations: Mapping[Any, Any], infos: Mapping[Any, Any], n_actions: int, over: bool
    ) -> npt.NDArray[np.int8]:
        source = observations if self._form.masks == "observation" else infos
        found = (source.get(agent) or {}).get(ACTION_MASK_KEY)
        mask = np.asarray(found)
        if mask.shape == (n_actions,) and mask.dtype.kind in "biuf" and ((mask == 0) | (mask == 1)).all():
            return mask.astype(np.int8)
        if over:
            return np.zeros(n_actions, dtype=np.int8)
        raise ValueError(
            f"expected {ACTION_MASK_KEY!r} in the {self._form.masks} of {agent} in {self._place}, {n_actions} zeros "
            f"and ones (one per action), got {found!r}; give it at every step to every agent that acts, or pass "
            "action_masks=False"
        )


def _add_missing_attributes(env: Any) -> None:
    """Add the attributes that SuperSuit and SB3 read but PettingZoo does not require."""
    if not hasattr(env, "metadata"):
        env.metadata = {}
    if not hasattr(env.unwrapped, "render_mode"):
        env.unwrapped.render_mode = None


def _inactive() -> Info:
    """Return the info of an inactive agent."""
    return {ACTIVE_KEY: False}


def _copied(info: Mapping[str, Any], agent: Any) -> Info:
    """Copy an info, since games may reuse theirs."""
    if not info:
        return {}
    if all(type(value) in _UNCHANGING for value in info.values()):
        return dict(info)  # equivalent to a deep copy, and ten times faster
    try:
        return deepcopy(dict(info))
    except Exception as error:
        raise TypeError(
            f"the info of {agent} cannot be copied ({error}), it is {info}; leave out what cannot be copied"
        ) from error
