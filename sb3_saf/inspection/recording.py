"""
Recording of team episodes: observations, actions and network outputs of every step as plain arrays.

Figures, films, TensorBoard and reports read recordings only. Letters: T game steps, E games, N agents, B = E N rows, A
actions, U policies, L slots, P parameters of an action distribution.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_saf.envs.joint_observation import TERMINAL_OBSERVATION, TRUNCATED
from sb3_saf.evaluation import PlayedStep, play
from sb3_saf.inspection.calibration import lambda_returns
from sb3_saf.inspection.games import Picture, ZoneFunction, Zones, draws_pictures, picture, zone_function, zones_now
from sb3_saf.inspection.reading import (
    OurPolicy,
    PolicyReader,
    QReader,
    Replacement,
    StepReading,
    reader_of,
    require_our_policy,
)
from sb3_saf.policies.base import TeamMaskablePolicy
from sb3_saf.teams.checks import check_count
from sb3_saf.teams.randomness import own_randomness
from sb3_saf.teams.rows import ACTIVE_KEY, OBS_KEY
from sb3_saf.teams.vec_env import require_n_agents

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]


class EpisodeRecording(NamedTuple):
    """
    Team episodes, step by step. Rows count while their agent takes part in a recorded episode.

    :param n_agents: N; row ``e * N + i`` is agent ``i`` of game ``e``
    :param of_team: whether values and rewards are the team's, equal in all its rows, instead of the agent's own
    :param gamma: discount factor of the returns
    :param observations: (T, B, *shape) own observations; None if not recorded
    :param actions: (T, B, ...) actions passed to the games
    :param action_probabilities: (T, B, A); None unless actions are Discrete
    :param counted: (T, B) whether the row counts
    :param rewards: (T, B) rewards from which the critic learns
    :param ends: (T, B) whether the episode ended with this step, or (unless values are the team's) the agent's own part
    :param last_values: (T, B) value of the last observation at a time limit that is no true end, else 0
    :param values: (T, B)
    :param returns: (T, B) discounted returns
    :param zones: (T, B), -1 for none; None if there are no zones
    :param pool_weights: (T, B, U) selection probability of each policy; None without a pool
    :param pool_actions: (T, B, U, P) parameters of each policy's action distribution; None without a pool
    :param write_attention: (T, E, L, N) attention of slots over agents; None without a knowledge source
    :param read_attention: (T, E, N, L) attention of agents over slots; None without a knowledge source
    :param message_strengths: (T, B) norm of the message that each agent read; None without a knowledge source
    :param values_without: (T, B) each, values with a replaced message
    :param episode_returns: team return of each episode
    :param episode_lengths: game steps of each episode
    :param pictures: pictures of the first game's first episode, one per step
    """

    n_agents: int
    of_team: bool
    gamma: float
    observations: npt.NDArray[Any] | None
    actions: npt.NDArray[Any]
    action_probabilities: Floats | None
    counted: Bools
    rewards: Floats
    ends: Bools
    last_values: Floats
    values: Floats
    returns: Doubles
    zones: Ints | None
    pool_weights: Floats | None
    pool_actions: Floats | None
    write_attention: Floats | None
    read_attention: Floats | None
    message_strengths: Floats | None
    values_without: dict[Replacement, Floats]
    episode_returns: list[float]
    episode_lengths: list[int]
    pictures: list[Picture]


@th.no_grad()
def record_episodes(
    policy: BasePolicy,
    env: VecEnv,
    n_eval_episodes: int = 16,
    seed: int = 20_000,
    deterministic: bool = False,
    *,
    gamma: float = 1.0,
    zones: Zones = None,
    normalizer: VecNormalize | None = None,
    observations: bool = True,
    pictures: bool = True,
) -> EpisodeRecording:
    """
    Play a fixed set of team episodes and record them, without changing training's random generators.

    Episodes are divided over the games as in ``evaluate_team``.

    :param policy: policy of this package
    :param env: environment of teams
    :param n_eval_episodes: team episodes to play
    :param seed: seed of games and actions
    :param deterministic: whether the policy takes its most likely actions
    :param gamma: discount factor of the returns
    :param zones: as in :class:`~sb3_saf.InspectionCallback`
    :param normalizer: normaliser of the critic's rewards; None for raw rewards
    :param observations: whether to record the agents' own observations
    :param pictures: whether to draw the first game, if its render mode allows it
    :raises ValueError: if the policy is not of this package or ``env`` has no teams
    """
    ours = require_our_policy(policy)
    check_count("n_eval_episodes", n_eval_episodes)
    reader = reader_of(ours, env.num_envs, deterministic)
    recorder = _Recorder(env, reader, zone_function(env, zones), normalizer, observations)
    was_training = ours.training
    ours.set_training_mode(False)
    try:
        with own_randomness(seed, ours.device):
            recorder.play(n_eval_episodes, seed, pictures and draws_pictures(env))
    finally:
        ours.set_training_mode(was_training)
    return recorder.recording(gamma)


class _Recorder:
    """Recorder that plays episodes and collects the results of every step."""

    def __init__(
        self,
        env: VecEnv,
        reader: PolicyReader | QReader,
        zones: ZoneFunction | None,
        normalizer: VecNormalize | None,
        observations: bool,
    ) -> None:
        self.env, self.reader, self.zones, self.normalizer = env, reader, zones, normalizer
        self.keeps_observations = observations
        self.n_agents = require_n_agents(env)
        n_games = env.num_envs // self.n_agents
        self.returns_now, self.lengths_now = np.zeros(n_games), np.zeros(n_games, dtype=np.int64)
        self.returns: list[float] = []
        self.lengths: list[int] = []
        self.pictures: list[Picture] = []
        self.readings: list[StepReading] = []
        self.columns: dict[str, list[npt.NDArray[Any]]] = {}

    def play(self, n_episodes: int, seed: int, draw: bool) -> None:
        """Play episodes, and collect the results of every step."""
        self.env.seed(seed)
        is_first = draw and n_episodes >= len(self.lengths_now)

        def act(obs: Any, starts: Bools) -> npt.NDArray[Any]:
            if is_first and (frame := picture(self.env)) is not None:
                self.pictures.append(frame)
            if self.zones is not None:
                self._keep("zones", zones_now(self.zones, self.env))
            policy = self.reader.policy
            masks = get_action_masks(self.env) if asks_for_masks else None
            self.readings.append(self.reader.step(_tensors(policy, obs), starts, masks))
            return self.readings[-1].actions

        asks_for_masks = isinstance(self.reader.policy, TeamMaskablePolicy) and is_masking_supported(self.env)
        for step in play(self.env, act, n_episodes):
            self._collect(step)
            is_first = is_first and bool(step.counted[0]) and not step.ended[0]

    def _collect(self, step: PlayedStep) -> None:
        counted = np.repeat(step.counted, self.n_agents) & _active(step.observations, self.n_agents)
        raw = self.env.get_original_reward() if isinstance(self.env, VecNormalize) else np.array(step.rewards)
        learned = raw if self.normalizer is None else self.normalizer.normalize_reward(raw)
        of_team, dones = self.reader.of_team, step.dones
        self._keep("counted", counted)
        self._keep("rewards", self._team_sums(learned) if of_team else learned)
        # An agent's return ends with its own end, as in TeamRolloutBuffer.
        self._keep("ends", dones if of_team else dones | ~_active(step.following, self.n_agents))
        self._keep("last_values", _last_values(self.reader, dones, step.infos))
        if self.keeps_observations:
            self._keep("observations", np.array(step.observations[OBS_KEY]))
        playing = counted.reshape(-1, self.n_agents).any(axis=1)
        self.returns_now += raw.reshape(-1, self.n_agents).sum(axis=1, dtype=np.float64)
        self.lengths_now += 1
        self.returns += self.returns_now[step.ended & playing].tolist()
        self.lengths += self.lengths_now[step.ended & playing].tolist()
        self.returns_now[step.ended], self.lengths_now[step.ended] = 0, 0

    def _keep(self, name: str, column: npt.NDArray[Any]) -> None:
        self.columns.setdefault(name, []).append(column)

    def _team_sums(self, rewards: Floats) -> Floats:
        """Return the team's reward in each of its rows, (B,)."""
        teams: Floats = rewards.reshape(-1, self.n_agents).sum(axis=1, keepdims=True)
        return np.repeat(teams, self.n_agents, axis=1).reshape(-1)

    def recording(self, gamma: float) -> EpisodeRecording:
        """Return the recording of all steps so far."""
        columns = {name: np.stack(column) for name, column in self.columns.items()}
        pools = [reading.pool for reading in self.readings if reading.pool]
        sources = [reading.source for reading in self.readings if reading.source]
        probabilities = [r.probabilities for r in self.readings if r.probabilities is not None]
        values = _stack([reading.values for reading in self.readings])
        return EpisodeRecording(
            n_agents=self.n_agents,
            of_team=self.reader.of_team,
            gamma=gamma,
            observations=columns.get("observations"),
            actions=np.stack([reading.actions for reading in self.readings]),
            action_probabilities=_stack(probabilities) if probabilities else None,
            counted=columns["counted"],
            rewards=columns["rewards"],
            ends=columns["ends"],
            last_values=columns["last_values"],
            values=values,
            returns=lambda_returns(columns["rewards"], columns["ends"], columns["last_values"], values, gamma),
            zones=columns.get("zones"),
            pool_weights=_stack([pool.weights for pool in pools]) if pools else None,
            pool_actions=_stack([pool.actions for pool in pools]) if pools else None,
            write_attention=_stack([source.write for source in sources]) if sources else None,
            read_attention=_stack([source.read for source in sources]) if sources else None,
            message_strengths=_stack([source.strengths for source in sources]) if sources else None,
            values_without={
                name: _stack([source.values[name] for source in sources])
                for name in (sources[0].values if sources else ())
            },
            episode_returns=self.returns,
            episode_lengths=self.lengths,
            pictures=self.pictures,
        )


def _stack(tensors: list[th.Tensor]) -> Floats:
    return th.stack(tensors).cpu().numpy()


def _tensors(policy: OurPolicy, obs: Any) -> dict[str, th.Tensor]:
    tensors, _ = policy.obs_to_tensor(obs)
    assert isinstance(tensors, dict)
    return tensors


def _active(obs: Any, n_agents: int) -> Bools:
    """Return whether the row's agent takes part, (B,)."""
    if ACTIVE_KEY not in obs:
        return np.ones(len(obs[OBS_KEY]), dtype=bool)
    return np.asarray(obs[ACTIVE_KEY][::n_agents]).reshape(-1) != 0


def _last_values(reader: PolicyReader | QReader, dones: Bools, infos: list[dict[str, Any]]) -> Floats:
    """Compute values (B,) of last observations at time limits that are no true ends, as SB3 bootstraps them."""
    values = np.zeros(len(infos), dtype=np.float32)
    rows = np.array([row for row in np.flatnonzero(dones) if infos[row].get(TRUNCATED)], dtype=np.int64)
    if len(rows):
        last = [infos[row][TERMINAL_OBSERVATION] for row in rows]
        obs = {key: np.stack([observation[key] for observation in last]) for key in last[0]}
        values[rows] = reader.last_values(_tensors(reader.policy, obs), rows).cpu().numpy()
    return values
