"""
RL-Zoo3's ``env_wrapper``, ``vec_env_wrapper``, ``frame_stack``, ``normalize`` and ``callback``, for teams, and
``curriculum``.

Wrappers are imported by name, so a settings file with them can run code: use such files from trusted sources only.
Wrappers of games are PettingZoo's and SuperSuit's, those of vector environments SB3's; the latter are placed between
the monitor and the joint observation, where each row is one agent's own observation.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, unwrap_vec_normalize

from sb3_saf.checkpoints.states import load_normalization_statistics, normalization_statistics
from sb3_saf.envs.curriculum import Stage
from sb3_saf.envs.joint_observation import CentralizedValueWrapper
from sb3_saf.envs.monitor import SharedReward, TeamMonitor, TeamReward
from sb3_saf.networks.encoders import has_pictures
from sb3_saf.teams.checks import import_by_name
from sb3_saf.teams.files import atomic_file
from sb3_saf.teams.rows import OBS_KEY

_NAMES = str | list[Any] | dict[str, Any] | None
#: Optional settings for wrappers and callbacks, with their types.
WRAPPER_KEYS: Final[dict[str, Any]] = {
    "env_wrapper": _NAMES,
    "vec_env_wrapper": _NAMES,
    "frame_stack": int,
    "normalize": bool | dict[str, Any],
    "callback": _NAMES,
    "curriculum": list[Any],
    "team_reward": TeamReward,
    "state": bool,
    "stagger": bool,
    "algorithm": str,
}
NORMALIZATION_SUFFIX: Final = ".vecnormalize.npz"


def _named(wrapping: Mapping[str, Any], key: str) -> Iterator[tuple[Any, Callable[..., Any]]]:
    """
    Import the objects of a key in RL-Zoo3's format: a dotted name, a mapping of it to arguments, or a list.

    :return: pairs of an object and a function that calls it, with the arguments of the file behind the given ones
    """
    value = wrapping.get(key)
    for item in value if isinstance(value, list) else [value] if value is not None else []:
        name, arguments = next(iter(item.items())) if isinstance(item, Mapping) and len(item) == 1 else (item, {})
        module, _, function = name.rpartition(".") if isinstance(name, str) else ("", "", "")
        if not module or not isinstance(arguments or {}, Mapping):
            raise ValueError(
                f"{key} must be a dotted name such as package.Class, {{name: {{key: value}}}}, got {item!r}"
            )
        found = import_by_name(module, function, key)
        yield found, partial(_called, key, found, dict(arguments or {}))


def _called(key: str, function: Callable[..., Any], arguments: Mapping[str, Any], *given: Any) -> Any:
    """Call a function; its errors name the key of the settings."""
    try:
        return function(*given, **arguments)
    except (TypeError, ValueError, AssertionError, AttributeError) as error:
        raise ValueError(f"{key}: {error}") from error


def wrap_game(game: Any, wrapping: Mapping[str, Any]) -> Any:
    """Wrap one game, a ParallelEnv, by ``env_wrapper`` and ``frame_stack``."""
    for wrapper, wrap in _named(wrapping, "env_wrapper"):
        game = wrap(game)
        if not isinstance(game, ParallelEnv):
            raise ValueError(f"env_wrapper must give a PettingZoo ParallelEnv, {wrapper} gave a {type(game).__name__}")
    if "frame_stack" in wrapping:
        import supersuit

        for agent in game.possible_agents:
            if not isinstance(space := game.observation_space(agent), spaces.Box):
                raise ValueError(
                    f"frame_stack expects observations that are Boxes, {agent} has {space}; use policy_kwargs "
                    "{memory: gru} instead, or stack them in an env_wrapper of your own"
                )
        game = supersuit.frame_stack_v1(game, wrapping["frame_stack"])
    return game


def wrap_rows(
    env: CentralizedValueWrapper, wrapping: Mapping[str, Any], gamma: float, is_training: bool
) -> CentralizedValueWrapper:
    """
    Wrap vector environments by ``vec_env_wrapper`` and ``normalize``.

    :param gamma: discount of the algorithm, for the normalisation of rewards
    :param is_training: whether statistics are updated and rewards normalised
    :return: ``env`` itself if there is nothing to do
    """
    normalize = wrapping.get("normalize", False)  # {} for the defaults of VecNormalize, as True
    if "vec_env_wrapper" not in wrapping and normalize is False:
        return env
    rows: VecEnv = env
    while not isinstance(rows, (TeamMonitor, SharedReward)):
        assert isinstance(rows, VecEnvWrapper), "make_team_env monitors its games"
        rows = rows.venv
    for wrapper, wrap in _named(wrapping, "vec_env_wrapper"):
        if not isinstance(wrapper, type) or not issubclass(wrapper, VecEnvWrapper):
            raise ValueError(f"vec_env_wrapper must be a class of SB3's VecEnvWrapper, got {wrapper}")
        if issubclass(wrapper, VecNormalize):
            raise ValueError("vec_env_wrapper cannot be VecNormalize, whose statistics must be kept; use normalize")
        rows = wrap(rows)
    if normalize is not False:
        space = rows.observation_space
        own = space.spaces[OBS_KEY] if isinstance(space, spaces.Dict) and OBS_KEY in space.spaces else space
        # Pictures and tile codes are not normalised, since encoders scale them.
        norm_obs = isinstance(own, spaces.Box) and not has_pictures(own)
        arguments = {"gamma": gamma, "norm_obs": norm_obs, **({} if normalize is True else normalize)}
        if own is not space and arguments["norm_obs"]:
            arguments.setdefault("norm_obs_keys", [OBS_KEY])
        if not is_training:
            arguments |= {"training": False, "norm_reward": False}
        rows = _called("normalize", VecNormalize, arguments, rows)
    return CentralizedValueWrapper(rows, time_limit=env.time_limit)


def stages_of(wrapping: Mapping[str, Any], game_steps: int) -> list[Stage]:
    """
    Read ``curriculum``: a list of stages, each a mapping of ``share``, its fraction of the run, and of the differing
    parameters of the game, ``[{share: 0.2, coordination: 1}, {share: 0.4, coordination: 2}]``.

    :param game_steps: game steps of the run
    :raises ValueError: for any other value
    """
    stages, total = [], 0.0
    for entry in wrapping.get("curriculum") or []:
        share = entry.get("share") if isinstance(entry, Mapping) else None
        if isinstance(share, bool) or not isinstance(share, (int, float)) or not 0 < share < 1 or len(entry) < 2:
            raise ValueError(
                "curriculum must list levels with share, between 0 and 1, and what differs in them, such as "
                f"{{share: 0.2, coordination: 1}}, got {entry!r}"
            )
        total += share
        params = {name: value for name, value in entry.items() if name != "share"}
        stages.append(Stage(max(1, round(game_steps * share)), params))
    if total >= 1:
        raise ValueError(
            f"the shares of a curriculum must leave game steps for the level itself, got {total:g} of the run"
        )
    return stages


def make_callbacks(wrapping: Mapping[str, Any]) -> list[BaseCallback]:
    """Make the callbacks of the key ``callback``."""
    callbacks: list[BaseCallback] = []
    for kind, make in _named(wrapping, "callback"):
        if not isinstance(kind, type) or not issubclass(kind, BaseCallback):
            raise ValueError(f"callback must name classes of SB3's BaseCallback, got {kind}")
        callbacks.append(make())
    return callbacks


# --- statistics of VecNormalize as arrays instead of SB3's pickle -----------------------------------------------------


def save_normalization(env: VecEnv, model: Path) -> None:
    """Write the statistics of a VecNormalize, if any, beside a model: ``NAME.vecnormalize.npz`` for ``NAME.zip``."""
    layer = unwrap_vec_normalize(env)
    if layer is not None:
        arrays: dict[str, Any] = normalization_statistics(layer)
        with atomic_file(model.with_suffix(NORMALIZATION_SUFFIX)) as file:
            np.savez(file, **arrays)


def load_normalization(env: VecEnv, model: Path) -> None:
    """
    Read the statistics beside a model, if the environment has a VecNormalize.

    :raises ValueError: if they cannot be read, or if there are some and the environment has none
    """
    layer, path = unwrap_vec_normalize(env), model.with_suffix(NORMALIZATION_SUFFIX)
    if layer is None:
        if path.is_file():
            raise ValueError(f"{model} was trained with normalize; give it the same setting: -params normalize:True")
        return
    try:
        with np.load(path, allow_pickle=False) as arrays:
            load_normalization_statistics(layer, dict(arrays))
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"cannot read the statistics of normalize in {path}: {error}; games must have the observations of "
            f"its training, and no normalize if {model} was trained without"
        ) from error
