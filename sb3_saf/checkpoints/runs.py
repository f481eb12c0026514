"""
Description of a run, compared by name before a checkpoint is used.

Versions and hardware, which affect only the last bits of a run, may differ.
"""

from __future__ import annotations

import platform
import warnings
from collections.abc import Iterable
from typing import Final

import numpy as np
import stable_baselines3
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import (
    BaseCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.callbacks.entropy import EntropySchedule
from sb3_saf.checkpoints.checks import check_keys, check_list, check_text, refused
from sb3_saf.checkpoints.data import Tree
from sb3_saf.teams import package_version
from sb3_saf.teams.errors import CheckpointError
from sb3_saf.teams.vec_env import game_seeds_of

#: Arguments that must equal those of the first start. Schedules are compared by their values.
_ARGUMENTS: Final = (
    *("seed", "n_envs", "n_steps", "batch_size", "n_epochs", "gamma", "gae_lambda", "normalize_advantage", "ent_coef"),
    *("vf_coef", "max_grad_norm", "target_kl", "use_sde", "sde_sample_freq"),
    # TRPO's
    *("cg_max_steps", "cg_damping", "line_search_shrinking_factor", "line_search_max_iter", "n_critic_updates"),
    "sub_sampling_factor",
    # QPLEX's
    *("buffer_size", "learning_starts", "tau", "update_interval", "gradient_steps", "target_update_interval"),
    *("exploration_fraction", "exploration_initial_eps", "exploration_final_eps"),
)
_SCHEDULES: Final = ("lr_schedule", "clip_range", "clip_range_vf")
#: Arguments of callbacks.
_OF_CALLBACKS: Final[dict[type[BaseCallback], tuple[str, ...]]] = {
    EvalCallback: ("n_eval_episodes", "eval_freq", "deterministic"),
    EntropySchedule: ("end",),
    EveryNTimesteps: ("n_steps",),
    StopTrainingOnMaxEpisodes: ("max_episodes",),
    StopTrainingOnNoModelImprovement: ("max_no_improvement_evals", "min_evals"),
    StopTrainingOnRewardThreshold: ("reward_threshold",),
}


def description(model: BaseAlgorithm) -> dict[str, Tree]:
    """
    Describe how a model and its games were made.

    Schedules are functions, described by their values at five points of training.
    """
    env = model.get_env()
    assert env is not None
    values = {name: getattr(model, name, None) for name in _ARGUMENTS}
    for name in _SCHEDULES:
        schedule = getattr(model, name, None)
        values[name] = [float(schedule(i / 4)) for i in range(5)] if callable(schedule) else None
    return {
        "algorithm": type(model).__name__,
        "policy": type(model.policy).__name__,
        "observation_space": str(model.observation_space),
        "action_space": str(model.action_space),
        **{f"{name}_class": _class_name(getattr(model, name, None)) for name in ("rollout_buffer", "replay_buffer")},
        **values,
        **{f"policy's {name}": _plain(value) for name, value in model.policy_kwargs.items()},
        **{f"parameter {name}": [str(p.dtype), *p.shape] for name, p in model.policy.state_dict().items()},
        "the seeds of the games": _game_seeds(env),
    }


def callback_descriptions(callbacks: Iterable[BaseCallback]) -> list[Tree]:
    """Describe how callbacks and the games of evaluation were made."""
    return [{"class": type(one).__name__, "arguments": _callback_arguments(one)} for one in callbacks]


def _callback_arguments(callback: BaseCallback) -> dict[str, Tree]:
    names = [name for kind, names in _OF_CALLBACKS.items() if isinstance(callback, kind) for name in names]
    found = {name: _plain(getattr(callback, name)) for name in names}
    if isinstance(callback, EvalCallback):
        found["number of rows"] = callback.eval_env.num_envs
        found["seeds of the games"] = _game_seeds(callback.eval_env)
    return found


def check_descriptions(
    model: BaseAlgorithm, callbacks: Iterable[BaseCallback], saved: Tree, saved_callbacks: Tree
) -> None:
    """
    Compare a run with the run of a checkpoint.

    :param model: model with its environment
    :param callbacks: callbacks of the run
    :param saved: result of :func:`description` at the first start
    :param saved_callbacks: result of :func:`callback_descriptions` at the first start
    :raises CheckpointError: naming the first difference
    """
    own = description(model)
    if not isinstance(saved, dict):
        raise CheckpointError(f"expected a dict that describes the model in the checkpoint, got {saved!r}")
    for name in dict.fromkeys([*saved, *own]):
        if repr(own.get(name)) != repr(saved.get(name)):
            raise CheckpointError(
                f"the checkpoint is of a model made in another way: {name} is {saved.get(name)!r} there and "
                f"{own.get(name)!r} in the model; make the model as for the first start, or give this run a folder "
                "of its own"
            )
    _check_callbacks(callback_descriptions(callbacks), saved_callbacks)


def _check_callbacks(own: list[Tree], saved: Tree) -> None:
    check_list(saved, "the descriptions of callbacks")
    for one in saved:
        check_keys(one, ("class", "arguments"), "the description of a callback")
        check_text(one["class"], "the class of a callback")
    names, saved_names = [one["class"] for one in own], [one["class"] for one in saved]
    if names != saved_names:
        raise CheckpointError(
            f"the checkpoint was made with the callbacks {saved_names}, got {names}; pass them in the same order"
        )
    for one, other in zip(own, saved, strict=True):
        check_keys(other["arguments"], one["arguments"], f"the arguments of {one['class']}")
        for name, value in one["arguments"].items():
            if repr(value) != repr(other["arguments"][name]):
                raise CheckpointError(
                    f"the checkpoint was made with another {one['class']}: its {name} is "
                    f"{other['arguments'][name]!r} there and {value!r} here; make it as for the first start, or give "
                    "this run a folder of its own"
                )


def _game_seeds(venv: VecEnv) -> list[int | None] | None:
    seeds = game_seeds_of(venv)
    return None if seeds is None else [None if seed is None else int(seed) for seed in seeds]


def _class_name(value: object) -> str | None:
    return None if value is None else type(value).__name__


def _plain(value: object) -> Tree:
    """Convert a value to what JSON gives back; classes and functions to their names."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    return str(getattr(value, "__qualname__", type(value).__qualname__))


def software() -> dict[str, str]:
    """Return versions and the number of threads."""
    return {
        "sb3_saf": package_version(),
        "stable_baselines3": stable_baselines3.__version__,
        "torch": th.__version__,
        "numpy": np.__version__,
        "processor": platform.machine(),
        "torch threads": str(th.get_num_threads()),
    }


def check_software(saved: Tree) -> None:
    """Check that saved versions have the form of :func:`software`."""
    if not isinstance(saved, dict):
        raise refused("the versions of software", "a dict", repr(saved)[:80])
    for name, value in saved.items():
        check_text(name, "the name of a software")
        check_text(value, f"the version of {name}")


def warn_of_differences(saved: dict[str, str]) -> None:
    """Warn about differences that may change the last bits of the weights."""
    own = software()
    different = [f"{name} {saved.get(name)} there, {own[name]} here" for name in own if own[name] != saved.get(name)]
    if different:
        warnings.warn(
            f"the checkpoint was made under other conditions ({'; '.join(different)}): the run goes on, but its "
            "weights may differ from those of the undisturbed run",
            UserWarning,
            stacklevel=3,
        )
