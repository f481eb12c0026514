"""
Description of a run, compared by name before a checkpoint is used.

Model, layers of the environments and callbacks are described by the arguments of their constructors that they keep
under the same name; games by :meth:`sb3_saf.teams.vec_env.TeamVecEnv.settings`. Versions and hardware, which affect
only the last bits of a run, may differ.
"""

from __future__ import annotations

import platform
import warnings
from collections.abc import Callable, Iterable
from functools import partial
from inspect import signature
from typing import Any, Final

import numpy as np
import stable_baselines3
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.envs.curriculum import Curriculum
from sb3_saf.teams import package_version
from sb3_saf.teams.errors import CheckpointError
from sb3_saf.teams.files import differences
from sb3_saf.teams.trees import Tree
from sb3_saf.teams.vec_env import TeamVecEnv, game_seeds_of, layers

#: Arguments that do not change what is learned, or are described otherwise.
_NOT_COMPARED: Final = frozenset(
    {"self", "env", "venv", "eval_env", "policy", "verbose", "render", "render_mode", "warn", "device"}
    | {"tensorboard_log", "stats_window_size", "num_envs", "observation_space", "action_space", "n_cpus"}
)
#: Ends of the names of arguments that are places, which may be moved.
_PLACES: Final = ("path", "dir", "folder", "file", "filename")
#: Arguments of models that are functions of the remaining part of training, and their attributes.
_SCHEDULES: Final = {"learning_rate": "lr_schedule", "clip_range": "clip_range", "clip_range_vf": "clip_range_vf"}
#: Points of training at which they are compared.
_N_POINTS: Final = 21


def description(model: BaseAlgorithm, callbacks: Iterable[BaseCallback]) -> dict[str, Tree]:
    """
    Describe how a model, its games and callbacks were made, as plain data with dotted names.

    :param callbacks: callbacks of the run, without those that only show
    """
    env = model.get_env()
    assert env is not None
    of_model = {
        "algorithm": type(model).__name__,
        "policy": type(model.policy).__name__,
        "n_envs": model.n_envs,
        "observation_space": str(model.observation_space),
        "action_space": str(model.action_space),
        **_arguments(model),
        "parameters": {name: [str(p.dtype), *p.shape] for name, p in model.policy.state_dict().items()},
    }
    for argument, attribute in _SCHEDULES.items():
        if callable(schedule := getattr(model, attribute, None)):
            of_model[argument] = [float(schedule(i / (_N_POINTS - 1))) for i in range(_N_POINTS)]
    callbacks = list(callbacks)
    return {
        "model": of_model,
        "environment": _layers(env),
        "callbacks": {
            "order": [type(one).__name__ for one in callbacks],
            **_by_class(callbacks, _of_callback),
        },
    }


def check_description(found: Tree, own: dict[str, Tree]) -> None:
    """
    Compare a run with the run of a checkpoint.

    :raises CheckpointError: naming the first differences
    """
    if different := differences(found, own):
        raise CheckpointError(
            f"the checkpoint is of another run: {different}; make model, games and callbacks as for the first start, "
            "or give this run a folder of its own"
        )


def _of_callback(callback: BaseCallback) -> dict[str, Tree]:
    environment = {"environment": _layers(callback.eval_env)} if isinstance(callback, EvalCallback) else {}
    return {**_arguments(callback), **environment}


def _of_layer(layer: VecEnv) -> dict[str, Tree]:
    if isinstance(layer, Curriculum):
        stages = {f"stage {number}": _layers(stage) for number, stage in enumerate(layer.stages)}
        return {"ends": list(layer.ends), **stages}
    games = layer.settings() if isinstance(layer, TeamVecEnv) else {}
    return {"num_envs": layer.num_envs, **_arguments(layer), **games}


def _layers(venv: VecEnv) -> dict[str, Tree]:
    seeds = game_seeds_of(venv)
    numbers = None if seeds is None else [None if seed is None else int(seed) for seed in seeds]
    return {"seeds of the games": numbers, **_by_class(layers(venv), _of_layer)}


def _by_class(parts: Iterable[Any], describe: Callable[[Any], dict[str, Tree]]) -> dict[str, Tree]:
    """Describe parts under the names of their classes, numbered from the second one of a class on."""
    result: dict[str, Tree] = {}
    for part in parts:
        name = type(part).__name__
        number = sum(other.partition(" ")[0] == name for other in result) + 1
        result[name if number == 1 else f"{name} {number}"] = describe(part)
    return result


def _arguments(part: object) -> dict[str, Tree]:
    """Return the arguments of a part's constructors that are attributes of the same name, perhaps private ones."""
    result = {}
    for kind in reversed(type(part).__mro__):
        for name in constructor_arguments(kind):
            if name in _NOT_COMPARED or name.startswith("_") or name.rpartition("_")[2] in _PLACES:
                continue
            for attribute in (name, f"_{name}"):
                if attribute in vars(part):
                    result[name] = _plain(vars(part)[attribute])
                    break
    return result


def constructor_arguments(kind: type) -> list[str]:
    """Return the names of the arguments of a class's own constructor; empty if it inherits one."""
    return [*signature(vars(kind)["__init__"]).parameters] if "__init__" in vars(kind) else []


def _plain(value: object) -> Tree:
    """Convert a value to plain data; classes and functions to their names."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, partial):
        return {"function": _plain(value.func), "args": _plain(value.args), "keywords": _plain(value.keywords)}
    return str(getattr(value, "__qualname__", type(value).__qualname__))


def software(model: BaseAlgorithm) -> dict[str, str]:
    """Return versions, device and the number of threads."""
    return {
        "sb3_saf": package_version(),
        "stable_baselines3": stable_baselines3.__version__,
        "torch": th.__version__,
        "numpy": np.__version__,
        "processor": platform.machine(),
        "device": model.device.type,
        "torch threads": str(th.get_num_threads()),
    }


def warn_of_differences(found: dict[str, str], own: dict[str, str]) -> None:
    """Warn about differences in software that may change the last bits of the weights."""
    if different := differences(found, own):
        warnings.warn(
            f"the checkpoint was made under other conditions ({different}): the run goes on, but its weights may "
            "differ from those of the undisturbed run",
            UserWarning,
            stacklevel=3,
        )
