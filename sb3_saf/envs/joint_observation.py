"""Joint observation: each row holds the agent's own observation and the inputs of a centralised critic."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, Final, Literal, get_args

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecTransposeImage, unwrap_vec_normalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_saf.networks.encoders import has_pictures
from sb3_saf.teams.checks import check_choice
from sb3_saf.teams.conversion import AgentConversion
from sb3_saf.teams.rows import (
    ACTION_MASK_KEY,
    ACTIVE_KEY,
    AGENT_KEY,
    EPISODE_START_KEY,
    IS_SUCCESS,
    OBS_KEY,
    STATE_KEY,
    TEAM_KEY,
    TERMINAL_OBSERVATION,
    TRUNCATED,
    Array,
    NormalizedSpace,
    TeamSpaces,
    TerminalRow,
    allows_nothing,
    are_allowed,
    channels_first,
    check_codes_are_kept,
    first_choices,
)
from sb3_saf.teams.vec_env import TeamVecEnvWrapper, check_finite, chosen_indices, layers, require_n_agents, team_dones

TimeLimit = Literal["terminal", "bootstrap"]

#: Name of the method that sb3-contrib calls.
_ACTION_MASKS: Final = "action_masks"


class CentralizedValueWrapper(TeamVecEnvWrapper):
    """
    Extend rows of flattened teams so that a centralised critic can evaluate each row by itself.

    The observation of a row becomes a Dict:

    ================= ================ ======================================================================
    key               shape of a row   content
    ================= ================ ======================================================================
    ``obs``           ``(*shape)``     the agent's own observation, the only input of its policy
    ``team``          ``(N, *shape)``  own observations of all agents of its team, in index order (always a Box)
    ``agent``         ``()``           index of the agent in its team, Discrete(N)
    ``episode_start`` ``()``           1 if the agent took no part in the step before, Discrete(2): where memory begins
    ================= ================ ======================================================================

    Environments with signals have more keys (:class:`TeamSpaces` defines how a VecEnv provides them; ``make_team_env``
    does so for any PettingZoo environment):

    =============== ============== ================================================================================
    key             shape of a row content
    =============== ============== ================================================================================
    ``active``      ``(N,)``       1 for the agents of its team that take part, in index order (MultiBinary)
    ``action_mask`` ``(A,)``       1 for its legal actions (MultiBinary); an inactive agent has action 0
    ``state``       ``(*state)``   the state of its game, the same in all rows of the game
    =============== ============== ================================================================================

    Shuffled minibatches, ``predict_values`` on a single row and SB3's own buffers are therefore correct.

    Channel-last images (3-D, uint8, 0 to 255) are transposed to channels first here, once; SB3 adds no
    VecTransposeImage. A space with an attribute ``atlas`` holds codes, not pixels, and is left unchanged. Returned
    arrays are not modified by later steps.

    :param venv: rows of flattened teams, game-major, then agent
    :param n_agents: N; None uses the attribute ``n_agents`` of ``venv``
    :param time_limit: ``"terminal"`` treats a time limit as a true end (as in the paper's experiments); ``"bootstrap"``
        lets the algorithm add the value of the last observation where the env sets ``"TimeLimit.truncated"``
    :raises ValueError: if N is unknown or does not divide the rows, the observation space is a Tuple or a Dict of
        other keys, or ``time_limit`` is neither of the two
    """

    def __init__(self, venv: VecEnv, n_agents: int | None = None, time_limit: TimeLimit = "terminal") -> None:
        check_choice("time_limit", time_limit, get_args(TimeLimit))
        n_agents = require_n_agents(venv, n_agents)
        names = getattr(venv, "possible_agents", None)
        names = tuple(names) if names is not None and len(names) == n_agents else None
        raw = TeamSpaces.of_rows(venv.observation_space, venv.action_space, n_agents, names)
        below = (layer.observation_space for layer in layers(venv))
        own_below = (space.get(OBS_KEY, space) if isinstance(space, spaces.Dict) else space for space in below)
        check_codes_are_kept(raw.own, own_below)
        self._normalization = unwrap_vec_normalize(venv)
        raw_state = None if raw.state is None else self._normalized(raw.state, STATE_KEY)
        raw = replace(raw, own=self._normalized(raw.own, OBS_KEY), state=raw_state)
        state = None if raw.state is None else channels_first(raw.state)
        own = channels_first(raw.own)
        conversions: tuple[AgentConversion, ...] | None = getattr(venv, "conversions", None)
        if conversions is not None and own is not raw.own:
            conversions = tuple(one.with_channels_first() for one in conversions)
        team = TeamSpaces(own, n_agents, raw.has_active, raw.n_masked_actions, state, names, conversions, True)
        seen = [space for space in (team.own, team.team, team.state) if space is not None]
        # The N own observations of a team in bytes, (N, width, height), look like a picture.
        if any(is_image_space(space) and int(np.argmin(space.shape or (0,))) != 0 for space in seen):
            venv = Untransposed(venv)
        super().__init__(venv, n_agents, team.to_dict_space())
        self.time_limit = time_limit
        self.team_spaces = team
        self._raw = raw
        self._agents = np.tile(np.arange(team.n_agents, dtype=np.int64), self.n_games)
        #: (E, N), the agents that took part in the last step of episodes that go on.
        self._playing = np.zeros((self.n_games, team.n_agents), dtype=np.int8)
        self._n_steps = 0
        self._masks_shown: Array | None = None
        self._has_asked_for_masks = False
        self._taken: Array | None = None
        self._has_warned = {"masks": False, "limits": False}
        #: Whether an evaluation has played these games since the last reset, see :func:`sb3_saf.evaluation.play`.
        self.was_evaluated = False

    def _normalized(self, space: spaces.Space[Any], key: str) -> spaces.Space[Any]:
        """Return the space of a part of the rows behind VecNormalize, which keeps the space of what it normalises."""
        layer = self._normalization
        keys = None if layer is None else layer.norm_obs_keys
        if layer is None or not layer.norm_obs or (keys is not None and key not in keys):
            return space
        if has_pictures(space):
            raise ValueError(
                f"expected VecNormalize over vectors, got it over the pictures of {space} in {key!r}, which encoders "
                "scale: pass VecNormalize(..., norm_obs=False), or name other norm_obs_keys"
            )
        return NormalizedSpace(-layer.clip_obs, layer.clip_obs, space.shape, np.float32)

    def has_attr(self, attr_name: str) -> bool:
        """Return whether games have an attribute; ``action_masks`` also where observations have ``action_mask``."""
        return self._shows_masks(attr_name) or super().has_attr(attr_name)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        Call a method of the rows' games; ``action_masks``, which MaskablePPO calls, is answered from the observations
        if these have ``action_mask`` and the games have no such method.
        """
        self._has_asked_for_masks |= method_name == _ACTION_MASKS
        if self._shows_masks(method_name) and not super().has_attr(method_name):
            assert self._masks_shown is not None, "algorithms reset the environment before they ask"
            return [self._masks_shown[row].astype(bool) for row in chosen_indices(indices, self.num_envs)]
        return super().env_method(method_name, *method_args, indices=indices, **method_kwargs)

    def _shows_masks(self, method_name: str) -> bool:
        return method_name == _ACTION_MASKS and self.team_spaces.action_mask is not None

    def checkpoint_state(self) -> dict[str, Any]:
        """Return the step count, the present action masks and the agents that take part."""
        return {"n_steps": self._n_steps, "masks_shown": self._masks_shown, "playing": self._playing}

    def load_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a state (see :meth:`checkpoint_state`)."""
        self._n_steps, self._masks_shown = state["n_steps"], state["masks_shown"]
        self._playing = state["playing"]
        self.was_evaluated = False

    def reset(self) -> dict[str, Array]:
        """Start new episodes in all games and return the Dict observation of all rows."""
        self._playing = np.zeros_like(self._playing)
        self.was_evaluated = False
        return self._joint_observation(self.venv.reset())

    def step_async(self, actions: Array) -> None:
        """
        Start the step of all games.

        :raises RuntimeError: if an evaluation has played the games, so that the actions belong to others
        """
        if self.was_evaluated:
            raise RuntimeError(
                "an evaluation has played these games: what their model saw last is of episodes that are gone. Give "
                "evaluations games of their own, sb3_saf.make_team_env(...), or begin new episodes: "
                "model.set_env(model.get_env()) before learn(..., reset_num_timesteps=False), else env.reset()"
            )
        self._taken = actions
        super().step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """
        Wait for the step of all games.

        :return: Dict observation, rewards (B,), dones (B,) bool, infos; ``terminal_observation`` is a complete Dict.
            With ``time_limit="bootstrap"``, the row of an agent that a time limit stops before its team is done then
        :raises ValueError: for NaN or infinity, dones that differ within a team, agents without a legal action, and
            missing terminal observations
        """
        if self._n_steps == 0:
            self._warn_of_unused_masks()
        obs, rewards, dones, infos = self.venv.step_wait()
        self._n_steps += 1
        self._warn_of_unread_masks()
        check_finite("rewards", rewards, self.n_agents, self._n_steps)
        ended = team_dones(dones, self.n_agents)
        infos = self._complete_infos(infos, ended)
        self._playing = self._playing * ~ended[:, np.newaxis]
        joint, row_dones = self._joint_observation(obs), np.repeat(ended, self.n_agents)
        if self.time_limit == "bootstrap" and self.team_spaces.has_active:
            self._end_alone(joint, row_dones, infos)
        # Copies, because SB3 adds bootstrapped values to the rewards in place.
        return joint, np.array(rewards), row_dones, infos

    def _end_alone(
        self, joint: dict[str, Array], row_dones: npt.NDArray[np.bool_], infos: list[dict[str, Any]]
    ) -> None:
        """
        End the rows of agents that a time limit has stopped before their team, so that algorithms bootstrap them.

        Their ``terminal_observation`` has their own last observation beside the present ones of their team.
        """
        for row, info in enumerate(infos):
            if row_dones[row] or not info.get(TRUNCATED) or info.get(TERMINAL_OBSERVATION) is None:
                continue
            agent = row % self.n_agents
            last_row = info[TERMINAL_OBSERVATION]
            if self._normalization is not None:  # which normalises those of done rows only
                last_row = self._normalization.normalize_obs(last_row)
            entries = self._raw.entries(last_row, "terminal observations")
            own = np.asarray(entries[OBS_KEY], dtype=self._raw.own.dtype)
            last = {key: part[row].copy() for key, part in joint.items()}
            last[OBS_KEY] = own if own.shape == self.team_spaces.own_shape else np.moveaxis(own, -1, 0)
            last[TEAM_KEY][agent], last[ACTIVE_KEY][agent] = last[OBS_KEY], 1
            # SB3 would count a success in a done row as an episode; the team's monitor has noted it.
            rest = {key: value for key, value in info.items() if key != IS_SUCCESS}
            row_dones[row], infos[row] = True, {**rest, TERMINAL_OBSERVATION: TerminalRow(last, row)}

    def _warn_of_unused_masks(self) -> None:
        """Warn if games have action masks that are neither in the rows nor queried."""
        if self.team_spaces.action_mask is not None or self._has_asked_for_masks:
            return
        has_masks = False
        with suppress(AttributeError):  # VecEnvs of others may not know has_attr
            has_masks = self.has_attr(_ACTION_MASKS)
        if has_masks:
            warnings.warn(
                "the games have action_masks(), which nobody has asked for: illegal actions may be taken. Train with "
                'sb3_contrib.MaskablePPO("SAFPolicy", env), which asks (sb3_saf.train: -params algorithm:MaskablePPO), '
                f"or give masks in infos[agent][{ACTION_MASK_KEY!r}], which every policy of sb3_saf reads",
                UserWarning,
                stacklevel=3,
            )

    def _warn_of_unread_masks(self) -> None:
        """Warn once if agents that take part have taken actions that the masks in their rows forbid."""
        if self._masks_shown is None or self._taken is None or self._has_warned["masks"]:
            return
        forbidden = ~are_allowed(self._taken, self._masks_shown, self.action_space) & (self._playing.reshape(-1) == 1)
        if forbidden.any():
            self._has_warned["masks"] = True
            row = int(np.flatnonzero(forbidden)[0])
            warnings.warn(
                f"agent {row % self.n_agents} of game {row // self.n_agents} took an action that its "
                f"{ACTION_MASK_KEY!r} forbids, {self._taken[row]}: Stable-Baselines3's own policies do not read masks. "
                'Those of sb3_saf do, as in PPO("SAFPolicy", env)',
                UserWarning,
                stacklevel=3,
            )

    def _joint_observation(self, obs: object) -> dict[str, Array]:
        parts = self._checked_parts(obs, "observations")
        if ACTIVE_KEY in parts:
            # Rows of agents that take no part may hold a copy of another's, see the games' fill_idle_rows.
            parts[OBS_KEY][parts[ACTIVE_KEY].reshape(-1) == 0] = 0
        teams = parts[OBS_KEY].reshape(self.n_games, *self.team_spaces.team.shape)
        joint = {**parts, TEAM_KEY: np.repeat(teams, self.n_agents, axis=0), AGENT_KEY: self._agents.copy()}
        joint[EPISODE_START_KEY] = (self._playing == 0).reshape(-1).astype(np.int64)
        self._playing = parts.get(ACTIVE_KEY, np.ones_like(self._playing))
        if ACTIVE_KEY in parts:
            joint[ACTIVE_KEY] = np.repeat(parts[ACTIVE_KEY], self.n_agents, axis=0)
        self._masks_shown = parts.get(ACTION_MASK_KEY)
        return joint

    def _checked_parts(self, obs: Any, what: str, games: Sequence[int] | None = None) -> dict[str, Array]:
        """
        Check and copy the parts of the rows of all games, or of some whose episodes ended.

        :return: own observations (B, *shape); if present, active agents (E, N), action masks (B, A), states (B, *state)
        """
        raw, team = self._raw, self.team_spaces
        entries = raw.entries(obs, what)
        parts = {OBS_KEY: self._rows(entries[OBS_KEY], raw.own, team.own, what, games)}
        if raw.has_active:
            parts[ACTIVE_KEY] = np.asarray(entries[ACTIVE_KEY]).reshape(-1, self.n_agents).astype(np.int8)
        if raw.n_masked_actions is not None:
            parts[ACTION_MASK_KEY] = self._masks(entries[ACTION_MASK_KEY], parts.get(ACTIVE_KEY), games is not None)
        if raw.state is not None:
            assert team.state is not None
            parts[STATE_KEY] = self._rows(entries[STATE_KEY], raw.state, team.state, f"states in {what}", games)
        return parts

    def _rows(
        self, obs: object, raw: spaces.Space[Any], stored: spaces.Space[Any], what: str, games: Sequence[int] | None
    ) -> Array:
        """Check and copy one entry of rows, channels first: (B, *raw shape) -> (B, *shape)."""
        rows = np.asarray(obs)
        expected = (self.num_envs if games is None else len(games) * self.n_agents, *(raw.shape or ()))
        if rows.shape != expected or not np.can_cast(rows.dtype, raw.dtype or rows.dtype, "same_kind"):
            raise ValueError(
                f"expected {what} of shape {expected} and dtype {raw.dtype} as in {raw}, got "
                f"shape {rows.shape} and dtype {rows.dtype}; make the environment return what its space promises"
            )
        check_finite(what, rows, self.n_agents, self._n_steps, games)
        if raw is not stored:
            rows = np.moveaxis(rows, -1, 1)
        return np.array(rows, dtype=raw.dtype, order="C")

    def _masks(self, masks: object, active: Array | None, are_last: bool) -> Array:
        """Check and copy action masks. Inactive rows get action 0, last observations without masks all actions."""
        rows = np.array(masks, dtype=np.int8)
        idle = np.zeros(len(rows), dtype=bool) if active is None else active.reshape(-1) == 0
        stuck = ~idle & allows_nothing(rows, self.action_space)
        if not are_last and stuck.any():
            row = int(np.flatnonzero(stuck)[0])
            raise ValueError(
                f"expected at least one legal action in the {ACTION_MASK_KEY!r} of an agent that takes part, got none "
                f"at step {self._n_steps} for agent {row % self.n_agents} of game {row // self.n_agents}; give agents "
                "that have to wait for their turn one action that does nothing"
            )
        rows[stuck] = 1
        rows[idle] = first_choices(self.action_space)
        return rows

    def _complete_infos(self, infos: list[dict[str, Any]], ended: npt.NDArray[np.bool_]) -> list[dict[str, Any]]:
        infos = list(infos)
        if not ended.any():
            return infos
        rows = np.flatnonzero(ended.repeat(self.n_agents))
        self._warn_of_missing_limits(infos, rows)
        last = self._terminal_parts([infos[row] for row in rows.tolist()], np.flatnonzero(ended).tolist())
        of_games = last.keys() & {TEAM_KEY, ACTIVE_KEY}
        by_row = [
            (one for one in part for _ in range(self.n_agents)) if key in of_games else part
            for key, part in last.items()
        ]
        is_limit_an_end = self.time_limit == "terminal"
        for row, *entries in zip(rows.tolist(), *by_row, strict=True):
            info = {**infos[row], TERMINAL_OBSERVATION: TerminalRow(zip(last, entries, strict=True), row)}
            if is_limit_an_end and TRUNCATED in info:
                info[TRUNCATED] = False
            infos[row] = info
        return infos

    def _warn_of_missing_limits(self, infos: list[dict[str, Any]], rows: npt.NDArray[np.int64]) -> None:
        """Warn once if time limits are to be bootstrapped and ends do not tell whether they are one."""
        if self.time_limit == "terminal" or self._has_warned["limits"] or any(TRUNCATED in infos[row] for row in rows):
            return
        self._has_warned["limits"] = True
        warnings.warn(
            f"time_limit='bootstrap' without {TRUNCATED!r} in the infos of an ended episode: no value is added, as if "
            "it had terminated. Let the environment set it as SB3's VecEnvs do, or use sb3_saf.make_team_env",
            UserWarning,
            stacklevel=4,
        )

    def _terminal_parts(self, infos: list[dict[str, Any]], games: list[int]) -> dict[str, Array]:
        """Return the parts of the last observations of ended games: (G * N, ...), or (G, ...) if they are of a game."""
        observations: list[Any] = [info.get(TERMINAL_OBSERVATION) for info in infos]
        missing = [divmod(index, self.n_agents) for index, seen in enumerate(observations) if seen is None]
        if missing:
            first = missing[0][0]
            raise ValueError(
                f"expected infos[row]['{TERMINAL_OBSERVATION}'] for all {self.n_agents} agents of game {games[first]}, "
                f"whose episode ended at step {self._n_steps}, got none for agents "
                f"{[agent for game, agent in missing if game == first]}; every row of a done team must carry its last "
                "observation, as SB3's VecEnvs do"
            )
        stacked: Any = observations
        if self._raw.is_dict:
            entries = [self._raw.entries(observation, "terminal observations") for observation in observations]
            stacked = {key: np.array([entry[key] for entry in entries]) for key in entries[0]}
        parts = self._checked_parts(stacked, "terminal observations", games)
        return {
            **parts,
            TEAM_KEY: parts[OBS_KEY].reshape(len(games), *self.team_spaces.team.shape),
            AGENT_KEY: np.tile(self._agents[: self.n_agents], len(games)),
            EPISODE_START_KEY: (self._playing[games] == 0).reshape(-1).astype(np.int64),
        }


class Untransposed(VecTransposeImage):
    """Layer below which SB3 transposes nothing that only looks like channel-last images: it adds one such layer."""

    def __init__(self, venv: VecEnv) -> None:
        VecEnvWrapper.__init__(self, venv)  # not the base class's constructor, which looks for images

    def reset(self) -> Any:
        """Start new episodes in all games."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for the step of all games."""
        return self.venv.step_wait()
