"""
Recording of team episodes: observations, actions and network outputs of every step as plain arrays.

Figures, films, TensorBoard and reports read recordings only. Games may have these attributes, which are read through
``get_attr`` and ``env_method``:

================ ======================= ==============================================================================
attribute        form                    meaning
================ ======================= ==============================================================================
``agent_zones``  (N,) integers           present zone of each agent, from 0; -1 for none
``zone_colours`` Z times (r, g, b)       colour of each zone, 0 to 255
``return_unit``  str                     unit of the team return, such as ``"treasures"``
``best_return``  number                  the largest possible team return
``action_names`` A times str             name of each action
``render_mode``  ``"rgb_array"``         the method ``render`` then returns a picture, (height, width, 3) uint8
================ ======================= ==============================================================================

A game on a grid may have two methods for :func:`~sb3_saf.replay`: ``grid_scene()`` returns the data for a drawing (see
``HECOGridEnv``), ``replica()`` another game that plays the same episode from the same seed.

Letters: T game steps, E games, N agents, B = E N rows, A actions, U policies or heads, L slots, P parameters of an
action distribution.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, ClassVar, Final, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_saf.evaluation import PlayedStep, check_trained_on, play
from sb3_saf.networks.actor import PolicyPool
from sb3_saf.networks.distributions import mixture_log_probs
from sb3_saf.policies.base import TeamMaskablePolicy, TeamPolicy
from sb3_saf.policies.memory import RunningMemory
from sb3_saf.policies.saf import SAFCritic
from sb3_saf.qplex.learning import greedy_q_tot
from sb3_saf.qplex.policies import QPLEXPolicy, State
from sb3_saf.teams.checks import check_count
from sb3_saf.teams.randomness import own_randomness
from sb3_saf.teams.rows import (
    ACTIVE_KEY,
    EPISODE_START_KEY,
    OBS_KEY,
    TERMINAL_OBSERVATION,
    TRUNCATED,
    TerminalRow,
)
from sb3_saf.teams.vec_env import require_n_agents, share_of_sum

Tensors = dict[str, th.Tensor]
#: Policies of this package.
OurPolicy = TeamPolicy | QPLEXPolicy

#: Replacement of a message: zeros, or the message of the same agent in another game at the same step.
Replacement = Literal["zero", "shuffled"]
REPLACEMENTS: Final[tuple[Replacement, ...]] = get_args(Replacement)


def require_our_policy(policy: BasePolicy) -> OurPolicy:
    """Return the policy; ValueError if it is not of this package and cannot be inspected."""
    if isinstance(policy, (TeamPolicy, QPLEXPolicy)):
        return policy
    raise ValueError(
        "expected a policy of sb3_saf such as 'SAFPolicy', 'MAPPOPolicy', 'IPPOPolicy' or 'QPLEXPolicy', got "
        f"{type(policy).__name__}"
    )


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

    def step(self, obs: Tensors, action_masks: Bools | None = None) -> Tensors:
        """
        Act in one step, and return what the policy has of the entries of :class:`EpisodeRecording`, without T; values
        with a replaced message are called ``values_`` and the :data:`Replacement`.

        :param obs: rows of whole teams, game-major
        :param action_masks: (B, M) for policies of MaskablePPO
        """
        policy, arguments = self.policy, {} if action_masks is None else {"action_masks": action_masks}
        latents, before = policy.extract_features(obs), self._memory.actor
        with policy.remembering(self._memory):
            actions, values, _ = policy(obs, deterministic=self.deterministic, **arguments)
            values = values.flatten()
        if policy.actor_memory is not None:
            latents, _ = policy.remember(latents, before, obs[EPISODE_START_KEY] != 0)
        log_weights, parameters = policy.evaluate_pool(obs, latents, action_masks)
        reading = {"actions": actions, "values": values}
        if isinstance(policy.action_space, spaces.Discrete):
            reading["action_probabilities"] = mixture_log_probs(log_weights, parameters).exp()
        if isinstance(policy.actor, PolicyPool):
            reading |= {"pool_weights": log_weights.exp(), "pool_actions": parameters}
        return reading if self.source is None else reading | self._messages(self.source, obs)

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

    def _messages(self, source: SAFCritic, obs: Tensors) -> Tensors:
        policy = self.policy
        _, teams = policy.encode_teams(obs)
        _, exchanged = source.communicate(teams.features, teams.members, teams.active)
        # In rows that are not whole teams in order, equal teams are computed once; expand them to games.
        n_agents = policy.team_spaces.n_agents
        team = th.arange(len(exchanged.read)) if teams.rows is None else teams.rows[::n_agents] // n_agents
        values: Tensors = {}
        for name in REPLACEMENTS if len(team) > 1 else REPLACEMENTS[:1]:
            with _other_messages(source, name):
                if policy.actor_memory is None:
                    values[f"values_{name}"] = policy.predict_values(obs).flatten()
                else:
                    with policy.remembering(self._without[name]):
                        values[f"values_{name}"] = policy(obs, deterministic=True)[1].flatten()
        return values | {
            "write_attention": exchanged.write_attention[team],
            "read_attention": exchanged.read_attention[team],
            "message_strengths": exchanged.read[team].norm(dim=2).flatten(),
        }


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

    def step(self, obs: Tensors, action_masks: Bools | None = None) -> Tensors:
        """See :class:`PolicyReader`; ``action_masks`` is unused: legal actions are part of the rows."""
        values, latents, self._state = self.policy.evaluate(obs, self._state)
        best = values.argmax(dim=1)
        probabilities = th.nn.functional.one_hot(best, values.shape[1]).to(values.dtype)
        reading = {
            "actions": best,
            "values": greedy_q_tot(self.policy, obs, values),
            "action_probabilities": probabilities,
        }
        if not isinstance(self.policy.actor, PolicyPool):
            return reading
        # The weights with which training samples heads, and each head's best action with probability 1.
        log_weights, of_heads = self.policy.actor.evaluate(latents)
        of_heads = of_heads.masked_fill(values.isneginf().unsqueeze(1), -th.inf)  # illegal actions
        is_best = of_heads == of_heads.max(dim=2, keepdim=True).values
        pool_actions = th.zeros_like(of_heads).masked_fill(~is_best, -th.inf)
        return reading | {"pool_weights": log_weights.exp(), "pool_actions": pool_actions}

    def last_values(self, obs: Tensors, rows: npt.NDArray[np.int64]) -> th.Tensor:
        """See :class:`PolicyReader`."""
        state = None if self._state is None else tuple(part[rows] for part in self._state)
        return greedy_q_tot(self.policy, obs, self.policy.evaluate(obs, state)[0])


Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Picture = npt.NDArray[np.uint8]


class ReturnScale(NamedTuple):
    """The unit of team returns, such as ``"treasures"``, and the largest possible one; None if unknown."""

    unit: str | None
    best: float | None


def zones_by_attribute(env: VecEnv) -> Ints:
    """Return the games' attribute ``agent_zones``, (B,)."""
    of_games = env.get_attr("agent_zones", indices=range(0, env.num_envs, require_n_agents(env)))
    return np.concatenate([np.asarray(zones, dtype=np.int64) for zones in of_games])


def zone_colours(env: VecEnv) -> list[tuple[float, float, float]] | None:
    """Return the colours of the zones, 0 to 1; None if the environment has none."""
    if not env.has_attr("zone_colours"):
        return None
    return [(red / 255, green / 255, blue / 255) for red, green, blue in env.get_attr("zone_colours", indices=[0])[0]]


def return_scale(env: VecEnv) -> ReturnScale:
    """Return the unit of team returns."""
    unit, best = (
        env.get_attr(name, indices=[0])[0] if env.has_attr(name) else None for name in ("return_unit", "best_return")
    )
    return ReturnScale(None if unit is None else str(unit), None if best is None else float(best))


def picture(frame: object) -> Picture:
    """Return what ``render`` gave, (height, width, 3), without transparency; ValueError if it is no picture."""
    got = repr(frame)
    if isinstance(frame, np.ndarray):
        if frame.dtype == np.uint8 and frame.ndim == 3 and frame.shape[2] in (3, 4):
            return frame[..., :3]
        got = f"{frame.dtype} of shape {frame.shape}"
    raise ValueError(
        "expected pictures, uint8 of shape (height, width, 3), from render() with render_mode='rgb_array', got "
        f"{got:.90}"
    )


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
    :param team_rewards: (T, E) rewards of the teams, as in their returns
    :param ends: (T, B) whether the episode ended with this step, or the agent was bootstrapped before its team
    :param last_values: (T, B) value of the last observation at a time limit that is no true end, else 0
    :param values: (T, B)
    :param zones: (T, B), -1 for none; None if there are no zones
    :param pool_weights: (T, B, U) selection probability of each policy; None without a pool
    :param pool_actions: (T, B, U, P) parameters of each policy's action distribution, illegal actions masked; None
        without a pool
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
    actions: npt.NDArray[Any]
    counted: Bools
    rewards: Floats
    team_rewards: Doubles
    ends: Bools
    last_values: Floats
    values: Floats
    episode_returns: list[float]
    episode_lengths: list[int]
    pictures: list[Picture]
    values_without: dict[Replacement, Floats]
    observations: npt.NDArray[Any] | None = None
    action_probabilities: Floats | None = None
    zones: Ints | None = None
    pool_weights: Floats | None = None
    pool_actions: Floats | None = None
    write_attention: Floats | None = None
    read_attention: Floats | None = None
    message_strengths: Floats | None = None

    @property
    def counted_games(self) -> Bools:
        """Whether a game was in a recorded episode, (T, E)."""
        return np.any(self.counted.reshape(len(self.counted), -1, self.n_agents), axis=2)

    @property
    def returns(self) -> Doubles:
        """Discounted returns, (T, B)."""
        return self.targets(1.0)

    def targets(self, lam: float) -> Doubles:
        """
        Compute TD(lambda) targets (T, B), from which the critic learns; with ``lam=1`` they are the discounted returns.

        ::

            R_t = r_t + gamma last_t                                          if the episode ends with step t
            R_t = r_t + gamma ((1 - lam) V_{t+1} + lam R_{t+1})               otherwise

        ``last`` is the value of the last observation if the time limit is no true end (``time_limit="bootstrap"``),
        else 0. These are SB3's advantages by GAE plus values. Where an agent does not take part, V is what its rows
        hold later, as in :class:`~sb3_saf.TeamRolloutBuffer`. Rows of unfinished episodes must be excluded.
        """
        targets: Doubles = np.zeros(self.rewards.shape)
        values = np.asarray(self.values, dtype=np.float64)
        ahead = next_value = np.zeros_like(values[0])
        for t in reversed(range(len(targets))):
            ends, reward = self.ends[t], self.rewards[t]
            last, going_on = self.last_values[t], (1 - lam) * next_value + lam * ahead
            ahead = targets[t] = reward + self.gamma * np.where(ends, last, going_on)
            paid = reward + self.gamma * np.where(ends, last, next_value)
            next_value = values[t] if self.of_team else np.where(self.counted[t], values[t], paid)
        return targets


@th.no_grad()
def record_episodes(
    policy: BasePolicy,
    env: VecEnv,
    n_eval_episodes: int = 16,
    seed: int = 20_000,
    deterministic: bool = False,
    *,
    gamma: float = 1.0,
    normalizer: VecNormalize | None = None,
    observations: bool = True,
    pictures: bool = True,
) -> EpisodeRecording:
    """
    Play a fixed set of team episodes and record them, without changing training's random generators.

    Episodes are divided over the games as in ``evaluate_team``.

    :param deterministic: whether the policy takes its most likely actions
    :param normalizer: normaliser of the critic's rewards; None for raw rewards
    :param observations: whether to record the agents' own observations
    :param pictures: whether to draw the first game, if its render mode allows it
    :raises ValueError: if the policy is not of this package or ``env`` has no teams
    """
    ours = require_our_policy(policy)
    check_trained_on(ours, env, same_size=True)
    check_count("n_eval_episodes", n_eval_episodes)
    reader = QReader(ours) if isinstance(ours, QPLEXPolicy) else PolicyReader(ours, deterministic)
    recorder = _Recorder(env, reader, normalizer, observations)
    draws = pictures and env.render_mode == "rgb_array"
    was_training = ours.training
    ours.set_training_mode(False)
    try:
        with own_randomness(seed, ours.device):
            env.seed(seed)
            recorder.play(n_eval_episodes, draws)
    finally:
        ours.set_training_mode(was_training)
    return recorder.recording(gamma)


class _Recorder:
    """Recorder that plays episodes and collects the results of every step."""

    def __init__(
        self, env: VecEnv, reader: PolicyReader | QReader, normalizer: VecNormalize | None, observations: bool
    ) -> None:
        self.env, self.reader, self.normalizer, self.keeps_observations = env, reader, normalizer, observations
        self.n_agents, self.share_of_sum = require_n_agents(env), share_of_sum(env)
        n_games = env.num_envs // self.n_agents
        self.returns_now, self.lengths_now = np.zeros(n_games), np.zeros(n_games, dtype=np.int64)
        self.returns: list[float] = []
        self.lengths: list[int] = []
        self.pictures: list[Picture] = []
        self.columns: dict[str, list[npt.NDArray[Any]]] = defaultdict(list)

    def play(self, n_episodes: int, draws: bool) -> None:
        """Play episodes, and collect the results of every step."""
        policy = self.reader.policy
        asks_for_masks = isinstance(policy, TeamMaskablePolicy) and is_masking_supported(self.env)
        has_zones = self.env.has_attr("agent_zones")
        is_first = draws and n_episodes >= len(self.lengths_now)  # else the first game may count no episode

        def act(obs: Any, _: Bools) -> npt.NDArray[Any]:
            if is_first:
                frame = self.env.env_method("render", indices=[0])[0]
                with suppress(ValueError):
                    self.pictures.append(picture(frame))
            if has_zones:
                self.columns["zones"].append(zones_by_attribute(self.env))
            masks = get_action_masks(self.env) if asks_for_masks else None
            tensors: Any = policy.obs_to_tensor(obs)[0]
            reading = {name: of.cpu().numpy() for name, of in self.reader.step(tensors, masks).items()}
            if isinstance(policy.action_space, spaces.Box):  # as SB3 does
                reading["actions"] = reading["actions"].clip(policy.action_space.low, policy.action_space.high)
            for name, array in reading.items():
                self.columns[name].append(array)
            return reading["actions"]

        for step in play(self.env, act, n_episodes):
            self._collect(step)
            is_first = is_first and bool(step.counted[0]) and not step.ended[0]

    def _collect(self, step: PlayedStep) -> None:
        n_agents, of_team, columns = self.n_agents, self.reader.of_team, self.columns
        counted = np.repeat(step.counted, n_agents)
        if ACTIVE_KEY in step.observations:
            counted &= np.asarray(step.observations[ACTIVE_KEY][::n_agents]).reshape(-1) != 0
        layer = unwrap_vec_normalize(self.env)
        raw = np.array(step.rewards) if layer is None else layer.get_original_reward()
        rewards = raw if self.normalizer is None else self.normalizer.normalize_reward(raw)
        if of_team:  # the team's reward, in each of its rows
            rewards = np.repeat(rewards.reshape(-1, n_agents).sum(axis=1), n_agents)
        of_teams = raw.reshape(-1, n_agents).sum(axis=1, dtype=np.float64) * self.share_of_sum
        columns["team_rewards"].append(of_teams)
        columns["counted"].append(counted)
        columns["rewards"].append(rewards)
        ends = np.repeat(step.ended, n_agents) if of_team else step.dones
        columns["ends"].append(ends)
        columns["last_values"].append(_last_values(self.reader, ends, step.infos, n_agents))
        if self.keeps_observations:
            columns["observations"].append(np.array(step.observations[OBS_KEY]))
        self.returns_now += of_teams
        self.lengths_now += 1
        self.returns += self.returns_now[step.finished].tolist()
        self.lengths += self.lengths_now[step.finished].tolist()
        self.returns_now[step.ended], self.lengths_now[step.ended] = 0, 0

    def recording(self, gamma: float) -> EpisodeRecording:
        """Return the recording of all steps so far."""
        columns: dict[str, Any] = {name: np.stack(column) for name, column in self.columns.items()}
        replaced = {name: columns.pop(f"values_{name}", None) for name in REPLACEMENTS}
        return EpisodeRecording(
            n_agents=self.n_agents,
            of_team=self.reader.of_team,
            gamma=gamma,
            episode_returns=self.returns,
            episode_lengths=self.lengths,
            pictures=self.pictures,
            values_without={name: values for name, values in replaced.items() if values is not None},
            **columns,
        )


def _last_values(reader: PolicyReader | QReader, ends: Bools, infos: list[dict[str, Any]], n_agents: int) -> Floats:
    """Compute values (B,) of last observations at time limits that are no true ends, as SB3 bootstraps them."""
    values = np.zeros(len(infos), dtype=np.float32)
    limited = np.array([bool(info.get(TRUNCATED)) for info in infos])
    if reader.of_team:  # the value is that of all rows, also of agents that ended before
        limited = limited.reshape(-1, n_agents).any(axis=1).repeat(n_agents)
    rows = np.flatnonzero(ends & limited)
    if len(rows):
        last = [infos[row][TERMINAL_OBSERVATION] for row in rows]
        obs = {key: np.stack([observation[key] for observation in last]) for key in last[0]}
        tensors: Any = reader.policy.obs_to_tensor(obs)[0]
        values[rows] = reader.last_values(tensors, rows).cpu().numpy()
    return values
