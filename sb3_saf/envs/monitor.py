"""
Monitor of team episodes and team returns, and rewards that a team shares.

SB3's monitors would count every agent as a separate episode.
"""

from __future__ import annotations

import os
import time
import warnings
import weakref
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final, Literal

import numpy as np
from stable_baselines3.common.monitor import Monitor, ResultsWriter
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_saf.teams.checks import check_choice
from sb3_saf.teams.rows import IS_SUCCESS, STAGGERED
from sb3_saf.teams.vec_env import TeamVecEnvWrapper, check_finite, episode_value, team_dones

_COLUMNS: Final = frozenset({"r", "l", "t"})
#: Each agent its own reward; each the sum, or the mean, over the agents of its team.
TeamReward = Literal["given", "sum", "mean"]


class TeamMonitor(TeamVecEnvWrapper):
    """
    Count team episodes.

    When the episode of a game ends, only the info of its **agent 0** gets ``info["episode"] = {"r": team return, "l":
    game steps, "t": seconds since the start, "agents": [each agent's own return]}``, where the team return is the sum
    of the rewards of all agents over all steps (``team_return="mean"``: their mean over agents). SB3 logs the mean of
    these entries, so ``rollout/ep_rew_mean`` and ``rollout/ep_len_mean`` count each team episode once.

    What is of the episode is taken from whichever agent's info the game puts it in, agents that are out included, and
    then is in that of agent 0 only: ``"is_success"`` (if agents report differently in a step: whether all succeeded)
    and ``info_keywords``. Infos of the last step count, or, if none has the entry, the latest step with one. So an
    episode that agents may leave as losers is to tell at its end whether the team has succeeded.

    It is not a subclass of VecMonitor, because SB3's ``evaluate_policy`` would wait for an ``"episode"`` entry in every
    row and never return. With a TeamMonitor it counts every agent as an episode and warns; use
    ``sb3_saf.evaluate_policy``, which counts teams.

    :param venv: rows of flattened teams, game-major, then agent
    :param filename: file or folder for a ``monitor.csv`` as SB3 writes it, one line per team episode; None for none. It
        is created at the first step. An existing file is kept as ``monitor.csv.1``, ``monitor.csv.2`` ...
    :param info_keywords: entries of infos to add to the episode's; None in an episode without them, with one warning
    :param n_agents: N; None takes the attribute ``n_agents`` of ``venv``
    :param team_return: team return as the sum of the agents' rewards, or as their mean if every agent is given the
        whole reward of its team
    :raises ValueError: if N is unknown or does not divide the rows, or a keyword equals a column of the file
    """

    def __init__(
        self,
        venv: VecEnv,
        filename: str | os.PathLike[str] | None = None,
        info_keywords: tuple[str, ...] = (),
        n_agents: int | None = None,
        team_return: Literal["sum", "mean"] = "sum",
    ) -> None:
        super().__init__(venv, n_agents)
        check_choice("team_return", team_return, ("sum", "mean"))
        #: Factor of the sum of a team's rewards.
        self.share_of_sum = 1.0 if team_return == "sum" else 1.0 / self.n_agents
        columns = sorted(_COLUMNS.intersection(info_keywords))
        if columns:
            raise ValueError(
                f"expected info_keywords other than the monitor's own columns {sorted(_COLUMNS)}, got {columns}; let "
                "the environment give them other names"
            )
        self.info_keywords = info_keywords
        self._of_episode = (IS_SUCCESS, *info_keywords)
        self.episode_count = 0
        self.t_start = time.time()
        self._returns = np.zeros((self.n_games, self.n_agents), dtype=np.float64)
        #: Latest entries of infos that are of the episode, by game.
        self._notes: list[dict[str, Any]] = [{} for _ in range(self.n_games)]
        self._has_warned = False
        self._success_is_told: set[bool] = set()
        self._lengths = np.zeros(self.n_games, dtype=np.int64)
        self._n_steps = 0
        self._filename = None if filename is None else os.fspath(filename)
        self._writer: ResultsWriter | None = None

    def reset(self) -> VecEnvObs:
        """Start new episodes in all games; unfinished ones are not counted."""
        self._returns[:] = 0
        self._lengths[:] = 0
        self._notes = [{} for _ in range(self.n_games)]
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """
        Wait for the step of all games.

        :return: results of ``venv``, with the episode entries in a copy of the infos
        :raises ValueError: for NaN or infinity in the rewards, or dones that differ within a team
        """
        obs, rewards, dones, infos = self.venv.step_wait()
        if self._writer is None:
            self._writer = self._begin_file()
        self._n_steps += 1
        check_finite("rewards", rewards, self.n_agents, self._n_steps)
        ended = team_dones(dones, self.n_agents)
        # float64, because sums of many float32 rewards are inexact.
        self._returns += rewards.reshape(self.n_games, self.n_agents)
        self._lengths += 1
        if any(infos):  # most steps have none, and a loop over all rows takes as long as the games
            rows = [row for row, info in enumerate(infos) if info and any(key in info for key in self._of_episode)]
            for game in {row // self.n_agents for row in rows} - set(np.flatnonzero(ended).tolist()):
                self._notes[game].update(self._noted(infos[self._rows_of(game)]))
        if ended.any():
            infos = list(infos)
            for game in np.flatnonzero(ended).tolist():
                infos[self._rows_of(game)] = self._finish_episode(game, infos[self._rows_of(game)])
        return obs, rewards, dones, infos

    def _rows_of(self, game: int) -> slice:
        return slice(game * self.n_agents, (game + 1) * self.n_agents)

    def _noted(self, infos: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """Return what the infos of a game's agents say of the episode."""
        return {key: value for key in self._of_episode if (value := episode_value(infos, key)) is not None}

    def _finish_episode(self, game: int, infos: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """Return the last infos of a game's agents, with the episode in that of agent 0."""
        of_episode = {**self._notes[game], **self._noted(infos)}
        is_cut = any(STAGGERED in info for info in infos)
        missing = [key for key in self.info_keywords if key not in of_episode and not is_cut]
        if missing and not self._has_warned:
            self._has_warned = True
            given = sorted({str(key) for info in infos for key in info})
            warnings.warn(
                f"expected the info_keywords {list(self.info_keywords)} in infos of every episode, got one without "
                f"{missing}, of game {game}, whose last infos have {given}; its entry is None",
                UserWarning,
                stacklevel=4,
            )
        episode: dict[str, Any] = {
            "r": float(self._returns[game].sum() * self.share_of_sum),
            "l": int(self._lengths[game]),
            "t": round(time.time() - self.t_start, 6),
            **{key: of_episode.get(key) for key in self.info_keywords},
        }
        if self._writer is not None:
            self._writer.write_row(episode)
        episode["agents"] = self._returns[game].tolist()
        self._returns[game] = 0
        self._lengths[game] = 0
        self._notes[game] = {}
        self.episode_count += 1
        copies = [dict(info) for info in infos]
        told = self._success_is_told | (set() if is_cut else {IS_SUCCESS in of_episode})
        if len(told) > len(self._success_is_told) == 1:
            warnings.warn(
                f"some episodes end with {IS_SUCCESS!r} in their infos, others do not, and success rates are those of "
                "the first; give it at every end, also of episodes that are lost",
                UserWarning,
                stacklevel=4,
            )
        self._success_is_told = told
        if IS_SUCCESS in of_episode:
            for info in copies:
                info.pop(IS_SUCCESS, None)
            copies[0][IS_SUCCESS] = of_episode[IS_SUCCESS]
        copies[0]["episode"] = episode
        return copies

    def _begin_file(self) -> ResultsWriter | None:
        """Create the file at the first step, so that a run that fails earlier touches no file."""
        path, number = self._path(), 1
        if path is not None and os.path.isfile(path) and not self._is_own(path):
            while os.path.exists(f"{path}.{number}"):
                number += 1
            os.rename(path, f"{path}.{number}")
        return self._open(override_existing=True)

    def _is_own(self, path: str) -> bool:
        """Return whether a file is that of this run, killed before its first checkpoint with a file."""
        with open(path, encoding="utf-8", errors="replace") as file:
            return f'"t_start": {self.t_start!r},' in file.readline()

    def _path(self) -> str | None:
        """Return the path that SB3's ResultsWriter uses."""
        if self._filename is None or self._filename.endswith(Monitor.EXT):
            return self._filename
        if os.path.isdir(self._filename):
            return os.path.join(self._filename, Monitor.EXT)
        return f"{self._filename}.{Monitor.EXT}"

    def _open(self, override_existing: bool) -> ResultsWriter | None:
        if self._filename is None:
            return None
        header: dict[str, float | str] = {"t_start": self.t_start, "env_id": str(getattr(self.venv, "spec", None))}
        writer = ResultsWriter(self._filename, header, self.info_keywords, override_existing)
        weakref.finalize(self, writer.close)  # for runs that end by an exception without closing the environment
        return writer

    def checkpoint_state(self) -> dict[str, Any]:
        """Return counters, unfinished episodes, and the size of the file."""
        size = 0
        if self._writer is not None:
            file = self._writer.file_handler
            file.flush()
            os.fsync(file.fileno())
            size = os.fstat(file.fileno()).st_size
        return {
            "returns": self._returns.copy(),
            "lengths": self._lengths.copy(),
            "notes": [dict(notes) for notes in self._notes],
            "episode_count": self.episode_count,
            "t_start": self.t_start,
            "n_steps": self._n_steps,
            "file_size": size,
        }

    def load_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state; lines written to the file after it are cut off, since their episodes are played again."""
        path, size = self._path(), state["file_size"]
        kept = b""
        if size and path is not None and os.path.isfile(path):
            with open(path, "rb") as file:
                kept = file.read(size)
        n_lines = state["episode_count"] + 2
        if len(kept) == size and size and (kept.count(b"\n") != n_lines or not kept.endswith(b"\n")):
            raise ValueError(
                f"expected the first {size} bytes of {path} to be two lines and {n_lines - 2} episodes, got "
                f"{kept.count(bytes([10]))} lines; the file is that of another run"
            )
        self._returns[:] = state["returns"]
        self._lengths[:] = state["lengths"]
        self._notes = [dict(notes) for notes in state["notes"]]
        self.episode_count = state["episode_count"]
        self.t_start = state["t_start"]
        self._n_steps = state["n_steps"]
        if self._filename is None or not self._n_steps:
            return  # the file is created at the first step
        if self._writer is not None:
            self._writer.close()
            self._writer = None
        if size and len(kept) == size:
            self._writer = self._open(override_existing=False)
            assert self._writer is not None
            os.truncate(self._writer.file_handler.fileno(), size)
            return
        self._filename = None
        warnings.warn(
            f"no episodes are written to {path}, which lacks those before the checkpoint: it had {size} bytes "
            f"then, now {len(kept)}",
            UserWarning,
            stacklevel=2,
        )

    def close(self) -> None:
        """Close the file and the environment."""
        if self._writer is not None:
            self._writer.close()
        super().close()


class SharedReward(TeamVecEnvWrapper):
    """
    Give every agent the sum or the mean of its team's rewards. Wrap it around a TeamMonitor, which logs unchanged
    returns.

    :param team_reward: ``"sum"`` or ``"mean"`` over the agents of a team
    """

    shares_reward: ClassVar[bool] = True

    def __init__(self, venv: VecEnv, team_reward: Literal["sum", "mean"]) -> None:
        super().__init__(venv)
        self.team_reward = team_reward
        #: Factor of the sum of a team's rewards.
        self.share_of_sum = 1.0 / self.n_agents if team_reward == "sum" else 1.0

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for the step of all games; rewards (B,) are equal within a team."""
        obs, rewards, dones, infos = self.venv.step_wait()
        by_game = np.asarray(rewards).reshape(self.n_games, self.n_agents)
        shared = by_game.sum(axis=1) if self.team_reward == "sum" else by_game.mean(axis=1)
        return obs, np.repeat(shared, self.n_agents), dones, infos
