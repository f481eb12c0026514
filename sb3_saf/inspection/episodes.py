"""
Evaluation episodes, played with the policy's insides in view.

Letters: T game steps, E games, N agents, B = E N rows, U policies, L slots, P parameters of an action distribution.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_saf.envs.joint_observation import TERMINAL_OBSERVATION, TRUNCATED
from sb3_saf.envs.teams import ACTIVE_KEY, require_n_agents, team_dones
from sb3_saf.inspection.doors import Picture, ZoneFunction, draws_pictures, picture, zones_now
from sb3_saf.inspection.insides import Insides, Replacement, StepView, takes_masks
from sb3_saf.inspection.kinds import OurPolicy, insides_of
from sb3_saf.inspection.q_insides import QInsides

Floats = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]


class Played(NamedTuple):
    """
    What was seen of all games, step by step. Rows count while their agent takes part in an episode of the set.

    :param n_agents: N
    :param of_team: whether values and rewards are the team's, the same in all its rows, not the agent's own
    :param counted: (T, B) whether the row counts
    :param rewards: (T, B) as the critic learns them
    :param ends: (T, B) whether the episode ended with this step, or (unless values are the team's) the agent's own part
    :param last_values: (T, B) value of what follows a time limit that is no true end, else 0
    :param values: (T, B)
    :param zones: (T, B), -1 for none; None where there are no zones
    :param weights: (T, B, U) how likely each policy of the pool is chosen; None without a pool
    :param actions: (T, B, U, P) parameters of each policy's action distribution; None without a pool
    :param write: (T, E, L, N) attention of slots over agents; None without a knowledge source
    :param read: (T, E, N, L) attention of agents over slots; None without a knowledge source
    :param values_without: (T, B) values with another message in the place of the one read
    :param returns: team return of each episode
    :param lengths: game steps of each episode
    :param pictures: of the first game's first episode, one per step
    """

    n_agents: int
    of_team: bool
    counted: Bools
    rewards: Floats
    ends: Bools
    last_values: Floats
    values: Floats
    zones: Ints | None
    weights: Floats | None
    actions: Floats | None
    write: Floats | None
    read: Floats | None
    values_without: dict[Replacement, Floats]
    returns: list[float]
    lengths: list[int]
    pictures: list[Picture]


class Player:
    """
    Plays a fixed set of team episodes: each game its share, as ``evaluate_team`` divides them.

    :param env: rows of teams; its games start from ``seed`` at every :meth:`play`
    :param n_episodes: team episodes
    :param seed: of the games
    :param deterministic: whether the policy takes its most likely actions
    :param zones: tells the zone of each row's agent; None for no zones
    """

    def __init__(
        self, env: VecEnv, n_episodes: int, seed: int, deterministic: bool, zones: ZoneFunction | None
    ) -> None:
        self.env = env
        self.n_agents = require_n_agents(env)
        self.n_games = env.num_envs // self.n_agents
        self.n_episodes = n_episodes
        self.seed = seed
        self.deterministic = deterministic
        self.zones = zones

    @th.no_grad()
    def play(self, policy: OurPolicy, training: VecNormalize | None = None, draw: bool = False) -> Played:
        """
        Play all episodes.

        :param policy: to play and to look into
        :param training: what normalises the rewards that the critic learns from, if anything does
        :param draw: whether to draw the first game
        """
        share = (self.n_episodes + np.arange(self.n_games)) // self.n_games
        self.env.seed(self.seed)
        obs = self.env.reset()
        insides = insides_of(policy, self.env.num_envs, self.deterministic)
        steps, pictures = _Steps(self.n_games, self.n_agents, insides.of_team), []
        draw = draw and draws_pictures(self.env)
        starts = np.ones(self.env.num_envs, dtype=bool)
        while (steps.episodes < share).any():
            first = int(np.flatnonzero(share)[0])
            if draw and first == 0 and steps.episodes[0] == 0:
                pictures.append(picture(self.env))
            playing = np.repeat(steps.episodes < share, self.n_agents)
            zones = None if self.zones is None else zones_now(self.zones, self.env)
            view = insides.look(_tensors(policy, obs), starts, self._action_masks(policy))
            active = _takes_part(obs, self.n_agents)
            obs, rewards, dones, infos = self.env.step(view.actions)
            learned, raw = self._rewards(rewards, training)
            last = _last_values(insides, dones, infos)
            steps.add(view, playing & active, learned, raw, dones, last, zones, _takes_part(obs, self.n_agents))
            starts = np.asarray(dones, dtype=bool)
        return steps.played([frame for frame in pictures if frame is not None])

    def _action_masks(self, policy: OurPolicy) -> Bools | None:
        return get_action_masks(self.env) if takes_masks(policy) and is_masking_supported(self.env) else None

    def _rewards(self, rewards: Floats, training: VecNormalize | None) -> tuple[Floats, Floats]:
        """(B,) as the critic learns them, and as the games gave them."""
        raw = self.env.get_original_reward() if isinstance(self.env, VecNormalize) else np.array(rewards)
        return (raw if training is None else training.normalize_reward(raw)), raw


class _Steps:
    """
    Collects steps.

    :param n_games: E
    :param n_agents: N
    :param of_team: whether values are the team's
    """

    def __init__(self, n_games: int, n_agents: int, of_team: bool) -> None:
        self.n_agents = n_agents
        self.of_team = of_team
        self.episodes = np.zeros(n_games, dtype=np.int64)
        self._returns_now = np.zeros(n_games)
        self._lengths_now = np.zeros(n_games, dtype=np.int64)
        self._returns: list[float] = []
        self._lengths: list[int] = []
        self._views: list[StepView] = []
        self._columns: dict[str, list[npt.NDArray[Any]]] = {}

    def add(
        self,
        view: StepView,
        counted: Bools,
        learned: Floats,
        raw: Floats,
        dones: Bools,
        last: Floats,
        zones: Ints | None,
        active_next: Bools,
    ) -> None:
        """Store a step; the arrays are those of :class:`Played`, ``raw`` rewards are for team returns."""
        dones = np.asarray(dones, dtype=bool)
        self._views.append(view)
        if self.of_team:
            learned, ends = self._sums(learned), dones
        else:
            # Nothing that comes after an agent's own end counts for it, as in TeamRolloutBuffer.
            ends = dones | ~active_next
        columns = {"counted": counted, "rewards": learned, "ends": ends, "last_values": last}
        if zones is not None:
            columns["zones"] = zones
        for name, column in columns.items():
            self._columns.setdefault(name, []).append(column)
        playing = counted.reshape(-1, self.n_agents).any(axis=1)
        self._returns_now += raw.reshape(-1, self.n_agents).sum(axis=1, dtype=np.float64)
        self._lengths_now += 1
        ended = team_dones(dones, self.n_agents)
        self._returns += self._returns_now[ended & playing].tolist()
        self._lengths += self._lengths_now[ended & playing].tolist()
        self._returns_now[ended] = 0
        self._lengths_now[ended] = 0
        self.episodes += ended

    def _sums(self, rewards: Floats) -> Floats:
        """(B,) the team's reward in each of its rows."""
        teams: Floats = rewards.reshape(-1, self.n_agents).sum(axis=1, keepdims=True)
        return np.repeat(teams, self.n_agents, axis=1).reshape(-1)

    def played(self, pictures: list[Picture]) -> Played:
        """Everything so far."""
        columns = {name: np.stack(column) for name, column in self._columns.items()}
        first, views = self._views[0], self._views
        sources = [view.source for view in views if view.source]
        names = [] if first.source is None else list(first.source.values)
        return Played(
            n_agents=self.n_agents,
            of_team=self.of_team,
            counted=columns["counted"],
            rewards=columns["rewards"],
            ends=columns["ends"],
            last_values=columns["last_values"],
            values=_stack([view.values for view in views]),
            zones=columns.get("zones"),
            weights=_stack([view.pool.weights for view in views if view.pool]) if first.pool else None,
            actions=_stack([view.pool.actions for view in views if view.pool]) if first.pool else None,
            write=_stack([source.write for source in sources]) if sources else None,
            read=_stack([source.read for source in sources]) if sources else None,
            values_without={name: _stack([source.values[name] for source in sources]) for name in names},
            returns=self._returns,
            lengths=self._lengths,
            pictures=pictures,
        )


def _stack(tensors: list[th.Tensor]) -> Floats:
    stacked: Floats = th.stack(tensors).cpu().numpy()
    return stacked


def _tensors(policy: OurPolicy, obs: Any) -> dict[str, th.Tensor]:
    tensors, _ = policy.obs_to_tensor(obs)
    assert isinstance(tensors, dict)
    return tensors


def _takes_part(obs: Any, n_agents: int) -> Bools:
    """(B,) whether the row's agent takes part."""
    if ACTIVE_KEY not in obs:
        return np.ones(len(obs["agent"]), dtype=bool)
    return np.asarray(obs[ACTIVE_KEY][::n_agents]).reshape(-1) != 0


def _last_values(insides: Insides | QInsides, dones: Bools, infos: list[dict[str, Any]]) -> Floats:
    """(B,) values of last observations where a time limit is no true end, as SB3 bootstraps them."""
    values = np.zeros(len(infos), dtype=np.float32)
    rows = np.array([row for row in np.flatnonzero(dones) if infos[row].get(TRUNCATED)], dtype=np.int64)
    if len(rows):
        last = [infos[row][TERMINAL_OBSERVATION] for row in rows]
        obs = {key: np.stack([observation[key] for observation in last]) for key in last[0]}
        values[rows] = insides.last_values(_tensors(insides.policy, obs), rows).cpu().numpy()
    return values
