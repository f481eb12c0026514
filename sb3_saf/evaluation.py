"""Play and evaluation of team episodes. Letters: E games, N agents, B = E N rows."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from inspect import signature
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from pettingzoo import ParallelEnv
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, is_vecenv_wrapped, unwrap_vec_wrapper

from sb3_saf.envs.joint_observation import CentralizedValueWrapper
from sb3_saf.envs.monitor import TeamMonitor
from sb3_saf.policies.rows import TeamRowsPolicy
from sb3_saf.teams.checks import check_count
from sb3_saf.teams.rows import (
    ACTION_MASK_KEY,
    AGENT_KEY,
    FIXED_SHAPE,
    IS_SUCCESS,
    OBS_KEY,
    STAGGERED,
    Array,
    NormalizedSpace,
    bounds_of,
    choices_of,
)
from sb3_saf.teams.vec_env import episode_value, layers, require_n_agents, share_of_sum, team_dones

Observation = npt.NDArray[Any] | dict[str, npt.NDArray[Any]]
State = tuple[npt.NDArray[Any], ...] | None
EvaluationCallback = Callable[[dict[str, Any], dict[str, Any]], None]
#: Returns the actions (B, ...) of all rows, from their observations and whether an episode starts, (B,).
Act = Callable[[Any, npt.NDArray[np.bool_]], Array]
#: Steps of one game after which a warning says that it may never end.
_LONG: Final = 10_000


class Interval(NamedTuple):
    """A confidence interval."""

    low: float
    high: float


class EvaluationResult(NamedTuple):
    """
    Returns and lengths of team episodes.

    :param returns: team return of each episode, the sum of the rewards of all agents over all steps
    :param lengths: game steps of each episode
    :param successes: whether each episode was won; empty if the games do not report it (``"is_success"`` in the last
        infos)
    :param agent_returns: (episodes, N) own return of each agent, the sum of its rewards
    """

    returns: list[float]
    lengths: list[int]
    successes: tuple[bool, ...] = ()
    agent_returns: tuple[tuple[float, ...], ...] = ()

    @classmethod
    def joined(cls, parts: Sequence[EvaluationResult]) -> EvaluationResult:
        """Return the episodes of several results as one."""
        return cls(
            [value for part in parts for value in part.returns],
            [value for part in parts for value in part.lengths],
            tuple(value for part in parts for value in part.successes),
            tuple(value for part in parts for value in part.agent_returns),
        )

    @property
    def mean(self) -> float:
        """Mean team return."""
        return float(np.mean(self.returns))

    @property
    def std(self) -> float:
        """Standard deviation of the team returns, as SB3 reports it (division by the number of episodes)."""
        return float(np.std(self.returns))

    @property
    def success_rate(self) -> float | None:
        """Fraction of episodes won; None if the games do not report it."""
        return float(np.mean(self.successes)) if self.successes else None

    @property
    def scores(self) -> dict[str, float]:
        """The result by unit: ``won``, the fraction of episodes won, if the games report it, and ``return``."""
        won = {} if self.success_rate is None else {"won": self.success_rate}
        return {**won, "return": self.mean}

    @property
    def agent_means(self) -> tuple[float, ...]:
        """(N,) mean return of each agent."""
        return tuple(float(value) for value in np.mean(self.agent_returns, axis=0)) if self.agent_returns else ()

    def interval(self) -> Interval:
        """Return the 95 % interval (Student's t) of the mean team return."""
        return confidence_interval(self.returns)

    def __str__(self) -> str:
        low, high = self.interval()
        won = "" if self.success_rate is None else f", {100 * self.success_rate:.0f} % won"
        return f"{self.mean:.2f} [{low:.2f}, {high:.2f}] (95 %, Student's t, {len(self.returns)} team episodes{won})"


def confidence_interval(values: npt.ArrayLike, confidence: float = 0.95) -> Interval:
    """
    Compute the confidence interval of the mean of independent values by Student's t distribution.

    mean -+ t * s / sqrt(n), with sample standard deviation s and two-sided quantile t for n - 1 degrees of freedom.

    :param values: (n,) for instance team returns
    :param confidence: above 0, below 1
    :return: both ends; infinite for a single value
    :raises ValueError: if there are no values or the confidence is out of range
    """
    sample = np.asarray(values, dtype=np.float64).reshape(-1)
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be above 0 and below 1, got {confidence!r}")
    if len(sample) == 0:
        raise ValueError("an interval needs at least one value, got none")
    if len(sample) == 1:
        return Interval(-math.inf, math.inf)
    mean = float(sample.mean())
    from scipy.special import stdtrit  # imported here, since it takes a tenth of a second

    t = float(stdtrit(len(sample) - 1, (1 + confidence) / 2))
    margin = t * float(sample.std(ddof=1)) / math.sqrt(len(sample))
    return Interval(mean - margin, mean + margin)


class RandomPolicy:
    """
    Baseline with uniformly random actions, legal ones only if observations have an ``action_mask`` or masks are given.

    :param action_space: one agent's action space, a Box must be bounded; or the environment that has it, for instance
        from ``make_team_env``
    :param seed: seed of its generator; None for a random one
    :raises ValueError: for an unbounded Box or another kind of space
    """

    def __init__(
        self, action_space: spaces.Space[Any] | VecEnv | ParallelEnv[Any, Any, Any], seed: int | None = None
    ) -> None:
        joint: Any = None
        if not isinstance(action_space, spaces.Space):
            env: Any = action_space
            joint = getattr(env, "observation_space", None)
            action_space = getattr(env, "action_space", None)
            if callable(action_space) and (agents := getattr(env, "possible_agents", None)):  # PettingZoo's
                action_space = action_space(agents[0])
            if not isinstance(action_space, spaces.Space):
                raise ValueError(
                    f"expected one agent's action space, or an environment that has it, got {type(env).__name__}; pass "
                    "env.action_space of the environment from sb3_saf.make_team_env"
                )
        if isinstance(action_space, spaces.Box) and not action_space.is_bounded():
            raise ValueError(f"a uniform policy needs a bounded action space, got {action_space}; rescale the actions")
        if not isinstance(action_space, FIXED_SHAPE):
            raise ValueError(
                f"the action space must be Discrete, MultiDiscrete, MultiBinary or Box, got {action_space}"
            )
        self.action_space = action_space
        #: (N, ...), bounds of the agents' own Box actions.
        self._bounds: tuple[Array, Array] | None = None
        agents = joint.spaces.get(AGENT_KEY) if isinstance(joint, spaces.Dict) else None
        conversions = getattr(agents, "conversions", None)
        if isinstance(action_space, spaces.Box) and conversions is not None:
            low, high = zip(*(one.action_bounds for one in conversions), strict=True)
            self._bounds = np.stack(low), np.stack(high)
        self._rng = np.random.default_rng(seed)

    def predict(
        self,
        observation: Observation,
        state: State = None,
        episode_start: npt.NDArray[Any] | None = None,
        deterministic: bool = False,
        action_masks: Array | None = None,
    ) -> tuple[Array, State]:
        """
        Draw an action for each row; see SB3's ``predict``.

        :param observation: observations of B rows, of which only number and masks are used
        :param action_masks: (B, M) as for MaskablePPO: one flag per choice, those of each action dimension in turn
        :return: actions (B, ...), and ``state`` unchanged; the other arguments have no effect
        """
        masks = action_masks
        if isinstance(observation, dict) and ACTION_MASK_KEY in observation:
            rows = observation[ACTION_MASK_KEY]
            masks = rows if masks is None else np.logical_and(rows, masks)
        if masks is not None:
            return self._draw_legal(np.asarray(masks)), state
        rows = observation[AGENT_KEY] if isinstance(observation, dict) else observation
        if self._bounds is not None and isinstance(observation, dict):
            return self._draw_box(*(bound[rows] for bound in self._bounds)), state
        return self._draw(len(rows)), state

    def _draw_legal(self, masks: Array) -> Array:
        """Draw actions (B, ...), in each dimension uniform over the choices allowed by its part of masks (B, M)."""
        space = self.action_space
        assert not isinstance(space, spaces.Box), "Box actions have no masks"
        keys = np.where(masks, self._rng.random(masks.shape), -1.0)
        sizes = space.nvec.reshape(-1) if isinstance(space, spaces.MultiDiscrete) else choices_of(space)
        parts = np.split(keys, np.cumsum(sizes)[:-1], axis=1)
        actions = np.stack([part.argmax(axis=1) for part in parts], axis=1).reshape(len(masks), *(space.shape or ()))
        return (actions + getattr(space, "start", 0)).astype(space.dtype)

    def _draw(self, n_rows: int) -> Array:
        space, (low, high) = self.action_space, bounds_of(self.action_space)
        shape = (n_rows, *low.shape)
        if isinstance(space, spaces.Box):
            return self._draw_box(np.broadcast_to(low, shape), np.broadcast_to(high, shape))
        return self._rng.integers(low, high, endpoint=True, size=shape).astype(space.dtype)

    def _draw_box(self, low: Array, high: Array) -> Array:
        """Draw actions between bounds (B, ...)."""
        dtype = self.action_space.dtype
        if dtype is not None and dtype.kind in "iu":
            return self._rng.integers(low, high, endpoint=True, dtype=dtype)
        return self._rng.uniform(low, high).astype(dtype)


class PlayedStep(NamedTuple):
    """
    One step of all games.

    :param observations: of the B rows, in which the agents acted
    :param rewards: (B,) as the outermost wrapper gives them
    :param dones: (B,) bool
    :param infos: of the B rows
    :param ended: (E,) bool, games whose episode ended with this step
    :param counted: (E,) bool, games whose episode counts: each plays its share of the episodes
    :param finished: (E,) bool, games whose episode counts and ended with this step, not cut short
    """

    observations: Any
    rewards: Array
    dones: npt.NDArray[np.bool_]
    infos: list[dict[str, Any]]
    ended: npt.NDArray[np.bool_]
    counted: npt.NDArray[np.bool_]
    finished: npt.NDArray[np.bool_]


def play(env: VecEnv, act: Act, n_episodes: int) -> Iterator[PlayedStep]:
    """
    Play team episodes step by step; everything that plays games of teams does it here.

    Episodes are divided evenly over the games beforehand, as in SB3: taking the first to finish would favour short
    ones. Episodes that were cut short (``make_team_env(..., stagger=True)``) are not counted.

    :param act: returns the actions (B, ...) of all rows, from their observations and whether an episode starts, (B,)
    """
    n_agents = require_n_agents(env)
    n_games = env.num_envs // n_agents
    remaining = (n_episodes + np.arange(n_games)) // n_games
    observations: Any = env.reset()
    starts, lengths = np.ones(env.num_envs, dtype=np.bool_), np.zeros(n_games, dtype=np.int64)
    try:
        while remaining.any():
            following, rewards, row_dones, infos = env.step(act(observations, starts))
            dones = np.asarray(row_dones, dtype=np.bool_)
            ended = team_dones(dones, n_agents, alone=True)
            lengths = np.where(ended, 0, lengths + 1)
            if lengths.max() == _LONG:
                warnings.warn(
                    f"a game has not ended in {_LONG:,} steps; if it never ends, give it a time limit, and if the most "
                    "likely actions lead nowhere, evaluate with deterministic=False",
                    UserWarning,
                    stacklevel=3,
                )
            counted, is_whole = remaining > 0, np.array([STAGGERED not in info for info in infos[::n_agents]])
            finished = ended & counted & is_whole
            yield PlayedStep(observations, rewards, dones, infos, ended, counted, finished)
            remaining = remaining - finished
            observations, starts = following, dones
    finally:  # whoever trains on these games holds observations of episodes that are gone
        if (joint := unwrap_vec_wrapper(env, CentralizedValueWrapper)) is not None:
            joint.was_evaluated = True


def actions_of(model: PolicyPredictor, env: VecEnv, deterministic: bool = False) -> Act:
    """
    Return the function for :func:`play` by which a model acts, with memory, and with the games' action masks.

    :param model: any object with SB3's ``predict``; masks are passed if ``predict`` has ``action_masks``
    :param deterministic: whether the model takes its most likely actions
    """
    check_trained_on(model, env)
    policy = getattr(model, "policy", model)
    takes_masks = isinstance(policy, MaskableActorCriticPolicy) or (
        not isinstance(policy, TeamRowsPolicy) and "action_masks" in signature(model.predict).parameters
    )
    asks_for_masks = takes_masks and is_masking_supported(env)
    state: State = None

    def act(observations: Any, starts: npt.NDArray[np.bool_]) -> Array:
        nonlocal state
        masks = {"action_masks": get_action_masks(env)} if asks_for_masks else {}
        actions, state = model.predict(observations, state, starts, deterministic, **masks)
        return actions

    return act


def check_trained_on(model: Any, env: VecEnv, name: str = "the model", same_size: bool = False) -> None:
    """
    Check that a model was trained on games like these.

    :param model: an algorithm or a policy; anything else passes
    :param same_size: whether the number of agents must be equal, too: critics depend on it, actors do not, unless they
        read the agent's index
    :raises ValueError: if observations, actions, normalisation or, where it matters, the number of agents differ
    """
    policy, n_agents = getattr(model, "policy", model), require_n_agents(env)
    if not isinstance(policy, TeamRowsPolicy):
        return
    trained, space = policy.team_spaces, env.observation_space
    own = space.spaces.get(OBS_KEY, space) if isinstance(space, spaces.Dict) else space
    expected, got = (
        f"observations of shape {shape}, actions {actions} and {n} agents"
        for shape, actions, n in (
            (trained.own.shape, policy.action_space, trained.n_agents),
            (own.shape, env.action_space, n_agents),
        )
    )
    is_other_size = n_agents != trained.n_agents and (same_size or policy.acts_by_index)
    if own.shape != trained.own.shape or env.action_space != policy.action_space or is_other_size:
        raise ValueError(
            f"expected games like those on which {name} was trained, with {expected}, got {got}; make them as for its "
            "training" + ("" if not is_other_size else f", with {trained.n_agents} agents")
        )
    games = model.get_env() if isinstance(model, BaseAlgorithm) else None
    there, here = ([] if one is None else _normalizers(one) for one in (games, env))
    if games is not None and (len(there) != len(here) or sum(there) > sum(here)):
        raise ValueError(
            f"expected observations normalised as in the training of {name}, by {len(there)} VecNormalize "
            f"({sum(there)} with statistics), got {len(here)} ({sum(here)}); wrap the games alike, training=False, "
            "and copy the statistics: stable_baselines3.common.vec_env.sync_envs_normalization(model.get_env(), env)"
        )
    is_normalized, were_normalized = (isinstance(one, NormalizedSpace) for one in (own, trained.own))
    is_empty = were_normalized and not all(here) and isinstance(model, BaseAlgorithm) and model.num_timesteps > 0
    if (
        is_normalized != were_normalized and own != trained.own
    ) or is_empty:  # as of a model that comes without its games
        raise ValueError(
            f"expected observations {'' if were_normalized else 'not '}normalised by VecNormalize, as in the training "
            f"of {name}, got {own}{', without statistics' if is_empty else ''}; wrap the games alike, training=False, "
            "with the statistics of the training"
        )
    agent = space.spaces.get(AGENT_KEY) if isinstance(space, spaces.Dict) else None
    names = getattr(agent, "names", None)
    if policy.acts_by_index and names and trained.names and names != trained.names:
        raise ValueError(
            f"expected the agents in the order of the games on which {name} was trained, {list(trained.names)}, since "
            f"its actors read who acts, got {list(names)}; list possible_agents in that order"
        )


def _normalizers(env: VecEnv) -> list[bool]:
    """Return, for each VecNormalize that normalises observations, whether it has statistics."""
    found = [layer.obs_rms for layer in layers(env) if isinstance(layer, VecNormalize) and layer.norm_obs]
    return [min(one.count for one in (rms.values() if isinstance(rms, dict) else [rms])) >= 1 for rms in found]


def evaluate_team(
    model: PolicyPredictor,
    env: VecEnv,
    n_eval_episodes: int = 10,
    deterministic: bool = True,
    render: bool = False,
    callback: EvaluationCallback | None = None,
    warn: bool = True,
) -> EvaluationResult:
    """
    Play team episodes (see :func:`play`), with the action masks of the games.

    :param model: any object with SB3's ``predict``, for instance an algorithm, a policy or a ``RandomPolicy``. If the
        games have masks outside their observations (``action_masks()``), they go to ``predict(...,
        action_masks=...)`` of models that take them, such as those of MaskablePPO. Teams of another size than the
        trained one can be played unless the actor depends on the agent's index (``heads="per_agent"``,
        ``actor_identity``, QPLEX with memory)
    :param env: vector environment of teams, for instance from ``make_team_env``. Training cannot go on in these games
        before they are reset, since what its model saw last would be of other episodes
    :param n_eval_episodes: team episodes to play
    :param deterministic: whether the model takes its most likely actions
    :param render: whether to render after each step
    :param callback: called with ``locals(), globals()`` for each game after each step, as in SB3; ``i`` is the game,
        ``info`` agent 0's, ``reward`` the team's, ``done`` whether the episode ended
    :param warn: warn if there is no TeamMonitor, so that returns are those of the outermost wrapper
    :return: team returns and lengths in game steps, in the order in which the episodes ended
    :raises ValueError: if ``env`` has no teams or a VecMonitor around them, or the model was trained on another game
    """
    check_count("n_eval_episodes", n_eval_episodes)
    n_agents = require_n_agents(env)
    monitored = is_vecenv_wrapped(env, TeamMonitor)
    if warn and not monitored:
        warnings.warn(
            "The environment has no TeamMonitor: returns and lengths are counted as the outermost wrapper gives them. "
            "Build it with sb3_saf.make_team_env, or put sb3_saf.TeamMonitor around the flattened teams.",
            UserWarning,
            stacklevel=2,
        )
    n_games, share = env.num_envs // n_agents, share_of_sum(env)
    returns: list[float] = []
    lengths: list[int] = []
    successes: list[bool] = []
    agent_returns: list[tuple[float, ...]] = []
    returns_now, lengths_now = np.zeros((n_games, n_agents)), np.zeros(n_games, dtype=np.int64)
    for step in play(env, actions_of(model, env, deterministic), n_eval_episodes):
        rewards = step.rewards.reshape(n_games, n_agents).astype(np.float64)
        returns_now += rewards
        lengths_now += 1
        for i in np.flatnonzero(step.counted).tolist():
            infos = step.infos[i * n_agents : (i + 1) * n_agents]
            info, reward, done = infos[0], float(rewards[i].sum() * share), bool(step.ended[i])
            if callback is not None:
                callback(locals(), globals())
            if not step.finished[i]:
                continue
            episode = {"r": returns_now[i].sum(), "l": lengths_now[i], "agents": returns_now[i].tolist()}
            if monitored:
                episode = info["episode"]
            if n_agents > 1 and "agents" not in episode:
                raise ValueError(
                    "expected episodes of TeamMonitor in infos, got those of a VecMonitor around it, which counts each "
                    "agent for a game: leave it out, TeamMonitor counts episodes and writes monitor.csv as it does"
                )
            returns.append(float(episode["r"]))
            lengths.append(int(episode["l"]))
            agent_returns.append(tuple(episode.get("agents", (episode["r"],))))
            if (won := episode_value(infos, IS_SUCCESS)) is not None:
                successes.append(won)
        returns_now[step.ended], lengths_now[step.ended] = 0, 0
        if render:
            env.render()
    return EvaluationResult(returns, lengths, tuple(successes), tuple(agent_returns))


def evaluate_policy(
    model: PolicyPredictor,
    env: VecEnv,
    n_eval_episodes: int = 10,
    deterministic: bool = True,
    render: bool = False,
    callback: EvaluationCallback | None = None,
    reward_threshold: float | None = None,
    return_episode_rewards: bool = False,
    warn: bool = True,
) -> tuple[float, float] | tuple[list[float], list[int]]:
    """
    Evaluate as SB3's ``evaluate_policy``, but by team episodes and team returns; see :func:`evaluate_team`.

    :param reward_threshold: lower limit of the mean team return
    :param return_episode_rewards: return the lists instead of their mean and standard deviation
    :return: mean and standard deviation of the team return, or the list of team returns and that of lengths
    :raises ValueError: if ``env`` has no teams or the mean is not above ``reward_threshold``
    """
    result = evaluate_team(model, env, n_eval_episodes, deterministic, render, callback, warn)
    if reward_threshold is not None and result.mean <= reward_threshold:
        raise ValueError(f"expected a mean team return above {reward_threshold}, got {result}")
    if return_episode_rewards:
        return result.returns, result.lengths
    return result.mean, result.std
