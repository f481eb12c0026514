"""The joint view: every row carries what a centralised critic needs, and an actor can still read its own part alone."""

from __future__ import annotations

from typing import Any, Final, Literal, get_args

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecTransposeImage
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_saf.common.teams import (
    AGENT_KEY,
    OBS_KEY,
    TEAM_KEY,
    TEAM_KEYS,
    Array,
    TeamSpaces,
    TeamVecEnvWrapper,
    check_finite,
    require_n_agents,
    team_dones,
)

TimeLimit = Literal["terminal", "bootstrap"]
TIME_LIMITS: Final[tuple[TimeLimit, ...]] = get_args(TimeLimit)

TERMINAL_OBSERVATION: Final = "terminal_observation"
TRUNCATED: Final = "TimeLimit.truncated"


class CentralizedValueWrapper(TeamVecEnvWrapper):
    """
    Turn the rows of flattened teams into rows that a centralised critic can judge one by one.

    The observation of a row becomes a Dict:

    ========= ================ ======================================================================
    key       shape of a row   content
    ========= ================ ======================================================================
    ``obs``   ``(*shape)``     the agent's own observation, all that its policy may read
    ``team``  ``(N, *shape)``  own observations of all agents of its team, in index order (always a Box)
    ``agent`` ``()``           index of the agent in its team, Discrete(N)
    ========= ================ ======================================================================

    Shuffled minibatches, ``predict_values`` on a single row and SB3's own buffers are therefore all correct.

    Images (3-D, uint8, 0 to 255) with channels last are transposed here, once, to channels first, and SB3 adds no
    transposition of its own. A space with an attribute ``atlas`` holds codes, not pixels: it is passed on as it is.
    The arrays of one step are never written to by a later one.

    :param venv: rows of flattened teams, game-major, then agent
    :param n_agents: N; None takes the attribute ``n_agents`` of ``venv``
    :param time_limit: ``"terminal"`` treats a time limit as a true end (as in the paper's experiments);
        ``"bootstrap"`` lets the algorithm add the value of the last observation where the env sets
        ``"TimeLimit.truncated"``
    :raises ValueError: if N is unknown or does not divide the rows, the observation space is a Dict or Tuple, or
        ``time_limit`` is neither of the two
    """

    def __init__(self, venv: VecEnv, n_agents: int | None = None, time_limit: TimeLimit = "terminal") -> None:
        if time_limit not in TIME_LIMITS:
            raise ValueError(f"time_limit must be {' or '.join(map(repr, TIME_LIMITS))}, got {time_limit!r}")
        raw_space = _checked_own_space(venv.observation_space)
        team = TeamSpaces.of(_channels_first(raw_space), require_n_agents(venv, n_agents))
        inner = _NoTransposition(venv) if _sb3_would_transpose(team) else venv
        super().__init__(inner, n_agents, team.to_dict_space())
        self.time_limit = time_limit
        self.team_spaces = team
        self._raw_space = raw_space
        self._agents = np.tile(np.arange(team.n_agents, dtype=np.int64), self.n_games)
        self._n_steps = 0

    def reset(self) -> dict[str, Array]:
        """
        Start new episodes in all games.

        :return: the Dict observation of all rows
        """
        return self._joint_view(self.venv.reset())

    def step_wait(self) -> VecEnvStepReturn:
        """
        Wait for the step of all games.

        :return: Dict observation, rewards (B,), dones (B,) bool, infos; ``terminal_observation`` is the complete Dict
            observation of its row
        :raises ValueError: for NaN or infinity, dones that differ inside a team, and missing terminal observations
        """
        obs, rewards, dones, infos = self.venv.step_wait()
        self._n_steps += 1
        check_finite("rewards", rewards, self.n_agents, self._n_steps)
        ended = team_dones(dones, self.n_agents)
        # Copies, because SB3 adds bootstrapped values to the rewards in place.
        return (
            self._joint_view(obs),
            np.array(rewards),
            np.repeat(ended, self.n_agents),
            self._complete_infos(infos, ended),
        )

    def _joint_view(self, obs: object) -> dict[str, Array]:
        own = self._own_rows(obs, "observations")
        teams = own.reshape(self.n_games, *self.team_spaces.team.shape)
        return {OBS_KEY: own, TEAM_KEY: np.repeat(teams, self.n_agents, axis=0), AGENT_KEY: self._agents.copy()}

    def _own_rows(self, obs: object, what: str, game: int | None = None) -> Array:
        """Check and copy own observations of all games or one, channels first: (B, *raw shape) -> (B, *shape)."""
        rows = np.asarray(obs)
        expected = (self.num_envs if game is None else self.n_agents, *(self._raw_space.shape or ()))
        if rows.shape != expected or not np.can_cast(rows.dtype, self._raw_space.dtype or rows.dtype, "same_kind"):
            raise ValueError(
                f"expected {what} of shape {expected} and dtype {self._raw_space.dtype} as in {self._raw_space}, got "
                f"shape {rows.shape} and dtype {rows.dtype}; make the environment return what its space promises"
            )
        check_finite(what, rows, self.n_agents, self._n_steps, first_game=game or 0)
        if self._raw_space is not self.team_spaces.own:
            rows = np.moveaxis(rows, -1, 1)
        return np.array(rows, dtype=self._raw_space.dtype, order="C")

    def _complete_infos(self, infos: list[dict[str, Any]], ended: npt.NDArray[np.bool_]) -> list[dict[str, Any]]:
        infos = list(infos)
        for game in np.flatnonzero(ended).tolist():
            first = game * self.n_agents
            team = self._terminal_team(infos[first : first + self.n_agents], game)
            for agent in range(self.n_agents):
                infos[first + agent] = self._terminal_info(infos[first + agent], team, agent)
        return infos

    def _terminal_team(self, infos: list[dict[str, Any]], game: int) -> Array:
        """Last observations of a team whose episode ended: (N, *shape)."""
        observations: list[Any] = [info.get(TERMINAL_OBSERVATION) for info in infos]
        missing = [agent for agent, observation in enumerate(observations) if observation is None]
        if missing:
            raise ValueError(
                f"expected infos[row]['{TERMINAL_OBSERVATION}'] for all {self.n_agents} agents of game {game}, whose "
                f"episode ended at step {self._n_steps}, got none for agents {missing}; every row of a done team must "
                "carry its last observation, as SB3's VecEnvs do"
            )
        shapes = {np.shape(observation) for observation in observations}
        if len(shapes) > 1:
            raise ValueError(
                f"expected terminal observations of one shape for the agents of game {game}, got {sorted(shapes)}; "
                "make the environment return what its space promises"
            )
        return self._own_rows(np.stack(observations), "terminal observations", game)

    def _terminal_info(self, info: dict[str, Any], team: Array, agent: int) -> dict[str, Any]:
        row = {OBS_KEY: team[agent], TEAM_KEY: team, AGENT_KEY: np.int64(agent)}
        info = {**info, TERMINAL_OBSERVATION: row}
        if self.time_limit == "terminal" and TRUNCATED in info:
            info[TRUNCATED] = False
        return info


class _NoTransposition(VecTransposeImage):
    """
    Does nothing but keep SB3 from transposing: it adds a VecTransposeImage only where it finds none.

    :param venv: any vector environment
    """

    def __init__(self, venv: VecEnv) -> None:
        # The parent would refuse spaces that are not of images.
        VecEnvWrapper.__init__(self, venv)
        self.skip = True


def _checked_own_space(own: spaces.Space[Any]) -> spaces.Space[Any]:
    if isinstance(own, spaces.Dict) and set(own.spaces) == set(TEAM_KEYS):
        raise ValueError(
            "expected a VecEnv of own observations, got one that already has the Dict observation of "
            "CentralizedValueWrapper; wrap it once (sb3_saf.make_team_env has done so)"
        )
    return own


def _channels_first(own: spaces.Space[Any]) -> spaces.Space[Any]:
    """The same space, or a new one with channels first if it is of channel-last images."""
    if hasattr(own, "atlas") or not isinstance(own, spaces.Box) or not is_image_space(own):
        return own
    if is_image_space_channels_first(own):
        return own
    height, width, channels = own.shape
    return spaces.Box(0, 255, (channels, height, width), np.uint8)


def _sb3_would_transpose(team: TeamSpaces) -> bool:
    """
    Whether SB3 would take a part for channel-last images and transpose it behind our back.

    The N views of a team in bytes, (N, width, height), look just like an image.
    """
    return any(is_image_space(space) and int(np.argmin(space.shape or (0,))) != 0 for space in (team.own, team.team))
