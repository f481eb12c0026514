"""JaxMARL's environments by name, each compiled once for equal arguments."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, Final

from sb3_saf.suites.engines.batch import ResumableBatchVecEnv
from sb3_saf.suites.engines.jaxmarl import JaxGames, JaxPrograms
from sb3_saf.suites.engines.jaxmarl_package import MABRAX_AVAILABLE, SUBMODULE_ENVIRONMENTS, jaxmarl
from sb3_saf.suites.engines.jaxmarl_rules import rules_of

#: Environments that need another package (brax, jaxrobotarium), or a trained enemy.
_BRAX: Final = ("ant_4x2", "halfcheetah_6x1", "hopper_3x1", "humanoid_9|8", "walker2d_2x3")
_NEEDS_A_POLICY: Final = "LearnedPolicyEnemySMAX"
#: Environments whose observations and rewards are not by agent name.
_NOT_BY_AGENT: Final = ("storm", "storm_2p", "storm_np")
#: Maximum number of cached compiled environments; one takes tens of MB.
_N_KEPT: Final = 8


def registered() -> list[str]:
    """Return the names of the supported environments."""
    missing = {_NEEDS_A_POLICY, *_NOT_BY_AGENT}
    if not MABRAX_AVAILABLE:
        missing.update(_BRAX)
    names = [name for name in jaxmarl.registered_envs if name not in missing]
    return [name for name in names if SUBMODULE_ENVIRONMENTS or not name.startswith("JaxRobotarium")]


class _Params:
    """Arguments of an environment, compared by value; arrays are compared by identity."""

    def __init__(self, params: Mapping[str, Any]) -> None:
        self.params = dict(params)
        self._key = tuple(sorted((name, _identity(value)) for name, value in self.params.items()))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Params) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


def _identity(value: Any) -> str:
    return repr(value) if isinstance(value, (bool, int, float, str, tuple, type(None))) else str(id(value))


@lru_cache(_N_KEPT)
def _programs(name: str, params: _Params, with_state: bool) -> JaxPrograms:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Overcooked recommends its second version
        env = jaxmarl.make(name, **params.params)
    return JaxPrograms(env, rules_of(name), with_state)


def vec_env(
    name: str,
    n_envs: int,
    seed: int | None,
    *,
    state: bool = False,
    render_mode: str | None = None,
    stagger: bool = False,
    reward_shaping: float = 0.0,
    reward_shaping_steps: int | None = None,
    fixed: Mapping[str, Any] | None = None,
    **params: Any,
) -> ResumableBatchVecEnv:
    """
    Make games of an environment.

    :param render_mode: None or ``"rgb_array"``
    :param reward_shaping: weight of the shaped rewards, if the environment has any
    :param reward_shaping_steps: game steps, summed over games, over which that weight decreases to 0; None for never
    :param fixed: arguments of the environment that the task sets
    :raises ValueError: if the state, picture or reward is missing, or the environment has no teams of named agents
    """
    programs = _programs(name, _Params({**params, **(fixed or {})}), state)
    if reward_shaping and programs.rules.extra_reward is None:
        raise ValueError(f"{name} has no rewards for steps on the way, got reward_shaping={reward_shaping}")
    if render_mode is not None and programs.rules.draw is None:
        raise ValueError(f"JaxMARL draws no pictures of {name}; leave render_mode={render_mode!r} out")
    games = JaxGames(programs, n_envs, reward_shaping, reward_shaping_steps)
    return ResumableBatchVecEnv(games, seed, render_mode, stagger)
