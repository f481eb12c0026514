"""Evaluation by team episodes: SB3's loop with one row per game instead of one row per agent."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, cast, overload

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3.common.evaluation import evaluate_policy as evaluate_rows
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, is_vecenv_wrapped
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_saf.envs.monitor import TeamMonitor
from sb3_saf.teams.checks import check_count
from sb3_saf.teams.rows import ACTION_MASK_KEY, AGENT_KEY, IS_SUCCESS, STAGGERED, Array
from sb3_saf.teams.vec_env import chosen_indices, find_n_agents, team_dones

Observation = npt.NDArray[Any] | dict[str, npt.NDArray[Any]]
State = tuple[npt.NDArray[Any], ...] | None
EvaluationCallback = Callable[[dict[str, Any], dict[str, Any]], None]


class Interval(NamedTuple):
    """
    A confidence interval.

    :param low: lower end
    :param high: upper end
    """

    low: float
    high: float


class EvaluationResult(NamedTuple):
    """
    Returns and lengths of team episodes.

    :param returns: team return of each episode, the sum of the rewards of all agents over all steps
    :param lengths: game steps of each episode
    :param successes: whether each episode was won; empty if the games do not report it (``"is_success"`` in the last
        info of agent 0)
    """

    returns: list[float]
    lengths: list[int]
    successes: tuple[bool, ...] = ()

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

    def interval(self, confidence: float = 0.95) -> Interval:
        """Return Student's t interval of the mean team return."""
        return confidence_interval(self.returns, confidence)

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
    Baseline with uniformly random actions, legal ones only if observations have an ``action_mask``.

    :param action_space: one agent's action space, a Box must be bounded; or the environment that has it, for instance
        from ``make_team_env``
    :param seed: seed of its generator; None for a random one
    :raises ValueError: for an unbounded Box or another kind of space
    """

    def __init__(
        self, action_space: spaces.Space[Any] | VecEnv | ParallelEnv[Any, Any, Any], seed: int | None = None
    ) -> None:
        if not isinstance(action_space, spaces.Space):
            action_space = _action_space_of(action_space)
        if isinstance(action_space, spaces.Box) and not action_space.is_bounded():
            raise ValueError(f"a uniform policy needs a bounded action space, got {action_space}; rescale the actions")
        if not isinstance(action_space, (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Box)):
            raise ValueError(
                f"the action space must be Discrete, MultiDiscrete, MultiBinary or Box, got {action_space}"
            )
        self.action_space = action_space
        self._rng = np.random.default_rng(seed)

    def predict(
        self,
        observation: Observation,
        state: State = None,
        episode_start: npt.NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[Array, State]:
        """
        Draw an action for each row; see SB3's ``predict``.

        :param observation: observations of B rows, of which only number and masks are used
        :param state: returned unchanged
        :param episode_start: unused
        :param deterministic: unused, a random policy has no most likely action
        :return: actions (B, ...), and ``state``
        """
        if isinstance(observation, dict) and ACTION_MASK_KEY in observation:
            return self._draw_legal(observation[ACTION_MASK_KEY]), state
        rows = observation[AGENT_KEY] if isinstance(observation, dict) else observation
        return self._draw(len(rows)), state

    def _draw_legal(self, masks: Array) -> Array:
        """Draw actions (B,) of a Discrete(A) space, each uniform over the ones in its row of masks (B, A)."""
        assert isinstance(self.action_space, spaces.Discrete)
        keys = np.where(masks, self._rng.random(masks.shape), -1.0)
        return keys.argmax(axis=1) + self.action_space.start

    def _draw(self, n_rows: int) -> Array:
        space, rng = self.action_space, self._rng
        shape = (n_rows, *(space.shape or ()))
        if isinstance(space, spaces.Discrete):
            return rng.integers(space.start, space.start + space.n, size=shape)
        if isinstance(space, spaces.MultiDiscrete):
            return rng.integers(space.start, space.start + space.nvec, size=shape)
        if isinstance(space, spaces.MultiBinary):
            return rng.integers(0, 2, size=shape).astype(space.dtype)
        assert isinstance(space, spaces.Box)
        if space.dtype is not None and space.dtype.kind in "iu":
            return rng.integers(space.low, space.high, size=shape, endpoint=True, dtype=space.dtype)
        return rng.uniform(space.low, space.high, size=shape).astype(space.dtype)


def _action_space_of(env: Any) -> spaces.Space[Any]:
    """Return the action space of a vector environment, or of another environment with one space for all agents."""
    space = getattr(env, "action_space", None)
    if callable(space) and (agents := getattr(env, "possible_agents", None)):  # PettingZoo's
        space = space(agents[0])
    if isinstance(space, spaces.Space):
        return space
    raise ValueError(
        f"expected one agent's action space, or an environment that has it, got {type(env).__name__}; pass "
        "env.action_space of the environment from sb3_saf.make_team_env"
    )


class _GameRows(VecEnvWrapper):
    """
    Wrapper with unchanged rows of observations and actions, but rewards, dones and infos per game, so that code that
    counts episodes by dones, such as SB3's ``evaluate_policy``, treats a game as an environment.

    :param venv: rows of flattened teams
    :param n_agents: N
    """

    def __init__(self, venv: VecEnv, n_agents: int) -> None:
        super().__init__(venv)
        self._n_agents = n_agents
        self.num_envs = venv.num_envs // n_agents
        self._monitored = is_vecenv_wrapped(venv, TeamMonitor)

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        returns = rewards.reshape(-1, self._n_agents).sum(axis=1, dtype=np.float64)
        of_games = [_whole(info) for info in infos[:: self._n_agents]]
        return obs, returns, team_dones(dones, self._n_agents), of_games

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return True for SB3's Monitor if there is a TeamMonitor, so that SB3 uses its unmodified episodes."""
        return [self._monitored and wrapper_class is Monitor for _ in chosen_indices(indices, self.num_envs)]


def _whole(info: dict[str, Any]) -> dict[str, Any]:
    """Return the info without its episode if that was cut short: only whole episodes count."""
    return {key: value for key, value in info.items() if key != "episode"} if STAGGERED in info else info


class _GamePredictor:
    """
    Model wrapper that expands episode starts from games to rows, as recurrent policies need.

    :param model: any object with SB3's ``predict``
    :param n_agents: N
    """

    def __init__(self, model: PolicyPredictor, n_agents: int) -> None:
        self._model = model
        self._n_agents = n_agents

    def predict(
        self,
        observation: Observation,
        state: State = None,
        episode_start: npt.NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[Array, State]:
        if episode_start is not None:
            episode_start = np.repeat(episode_start, self._n_agents)
        return self._model.predict(observation, state, episode_start, deterministic)


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
    Play team episodes.

    Episodes are divided evenly over the games beforehand, as in SB3; taking the first to finish would favour short
    ones.

    :param model: any object with SB3's ``predict``, for instance an algorithm, a policy or a ``RandomPolicy``
    :param env: vector environment of teams, for instance from ``make_team_env``
    :param n_eval_episodes: team episodes to play
    :param deterministic: whether the model takes its most likely actions
    :param render: whether to render after each step
    :param callback: called with ``locals(), globals()`` for each game after each step, as in SB3; ``info`` is agent
        0's, ``reward`` the team's
    :param warn: warn if there is no TeamMonitor, so that returns are those of the outermost wrapper
    :return: team returns and lengths in game steps, in the order in which the episodes ended
    :raises ValueError: if ``env`` has no teams
    """
    check_count("n_eval_episodes", n_eval_episodes)
    n_agents = _team_size(env)
    if warn and not is_vecenv_wrapped(env, TeamMonitor):
        warnings.warn(
            "The environment has no TeamMonitor: returns and lengths are counted as the outermost wrapper gives them. "
            "Build it with sb3_saf.make_team_env, or put sb3_saf.TeamMonitor around the flattened teams.",
            UserWarning,
            stacklevel=2,
        )
    successes: list[bool] = []

    def note_success(local: dict[str, Any], of_module: dict[str, Any]) -> None:
        if local["done"] and (won := local["info"].get(IS_SUCCESS)) is not None:
            successes.append(bool(won))
        if callback is not None:
            callback(local, of_module)

    returns, lengths = evaluate_rows(
        cast(PolicyPredictor, _GamePredictor(model, n_agents)),
        _GameRows(env, n_agents),
        n_eval_episodes,
        deterministic=deterministic,
        render=render,
        callback=note_success,
        return_episode_rewards=True,
        warn=False,
    )
    return EvaluationResult([float(value) for value in returns], [int(value) for value in lengths], tuple(successes))  # type: ignore[union-attr]


def _team_size(env: VecEnv) -> int:
    n_agents = find_n_agents(env) if isinstance(env, VecEnv) else None
    if n_agents is None:
        raise ValueError(
            f"expected a VecEnv of teams (with an attribute n_agents), got {type(env).__name__}; build it with "
            "sb3_saf.make_team_env(...), or use stable_baselines3.common.evaluation.evaluate_policy for single agents"
        )
    return n_agents


@overload
def evaluate_policy(
    model: PolicyPredictor,
    env: VecEnv,
    n_eval_episodes: int = ...,
    deterministic: bool = ...,
    render: bool = ...,
    callback: EvaluationCallback | None = ...,
    reward_threshold: float | None = ...,
    return_episode_rewards: Literal[False] = ...,
    warn: bool = ...,
) -> tuple[float, float]: ...


@overload
def evaluate_policy(
    model: PolicyPredictor,
    env: VecEnv,
    n_eval_episodes: int = ...,
    deterministic: bool = ...,
    render: bool = ...,
    callback: EvaluationCallback | None = ...,
    reward_threshold: float | None = ...,
    *,
    return_episode_rewards: Literal[True],
    warn: bool = ...,
) -> tuple[list[float], list[int]]: ...


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
    Evaluate a policy as SB3's ``evaluate_policy``, but by team episodes and team returns.

    :param model: see :func:`evaluate_team`
    :param env: see :func:`evaluate_team`
    :param n_eval_episodes: team episodes to play
    :param deterministic: see :func:`evaluate_team`
    :param render: see :func:`evaluate_team`
    :param callback: see :func:`evaluate_team`
    :param reward_threshold: lower limit of the mean team return
    :param return_episode_rewards: return the lists instead of their mean and standard deviation
    :param warn: see :func:`evaluate_team`
    :return: mean and standard deviation of the team return, or the list of team returns and that of lengths
    :raises ValueError: if ``env`` has no teams or the mean is not above ``reward_threshold``
    """
    result = evaluate_team(model, env, n_eval_episodes, deterministic, render, callback, warn)
    if reward_threshold is not None and result.mean <= reward_threshold:
        raise ValueError(f"expected a mean team return above {reward_threshold}, got {result}")
    if return_episode_rewards:
        return result.returns, result.lengths
    return result.mean, result.std
