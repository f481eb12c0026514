"""Plain YAML values as constructor arguments: numbers, schedules, and classes by registered names."""

from __future__ import annotations

import inspect
import math
import reprlib
import types
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, Final, Union, get_args, get_origin, get_type_hints

import msgspec
import torch as th
from msgspec import Meta
from stable_baselines3.common import vec_env
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import LinearSchedule
from torch import nn

from sb3_saf.buffers.rollout import TeamRolloutBuffer
from sb3_saf.networks.encoders import LightEncoder, MLPEncoder, NatureEncoder, ObservationEncoder, PaperCNN
from sb3_saf.teams.checks import unknown_name

#: Classes by name for each key that takes a class. Names are looked up here only; nothing is imported or evaluated.
CLASSES: Final[dict[str, dict[str, type]]] = {
    "rollout_buffer_class": {"TeamRolloutBuffer": TeamRolloutBuffer},
    "features_extractor_class": {
        encoder.__name__: encoder for encoder in (LightEncoder, MLPEncoder, NatureEncoder, ObservationEncoder, PaperCNN)
    },
    "activation_fn": {
        "tanh": nn.Tanh,
        "relu": nn.ReLU,
        "elu": nn.ELU,
        "gelu": nn.GELU,
        "silu": nn.SiLU,
        "leaky_relu": nn.LeakyReLU,
    },
    "optimizer_class": {"Adam": th.optim.Adam, "AdamW": th.optim.AdamW, "RMSprop": th.optim.RMSprop},
}

#: Ranges that the algorithms' constructors do not check.
RANGES: Final[dict[str, Meta]] = {
    **dict.fromkeys(("gamma", "gae_lambda", "tau"), Meta(ge=0, le=1)),
    **dict.fromkeys(("exploration_fraction", "exploration_initial_eps", "exploration_final_eps"), Meta(ge=0, le=1)),
    **dict.fromkeys(("learning_rate", "ent_coef", "vf_coef", "learning_starts"), Meta(ge=0)),
    **dict.fromkeys(("clip_range", "max_grad_norm", "target_kl"), Meta(gt=0)),
    **dict.fromkeys(("n_steps", "n_epochs", "batch_size", "n_minibatches", "game_steps"), Meta(ge=1)),
    **dict.fromkeys(("buffer_size", "train_freq", "target_update_interval", "stats_window_size"), Meta(ge=1)),
    "n_envs": Meta(ge=1, le=100_000),
    "frame_stack": Meta(ge=1, le=1_000),
}

#: Constructor arguments that are set by the run, not by its settings.
_RUN_ARGUMENTS: Final = {
    *("self", "policy", "env", "policy_kwargs", "tensorboard_log", "verbose", "seed", "device", "_init_setup_model")
}
_POLICY_RUN_ARGUMENTS: Final = {"self", "observation_space", "action_space", "lr_schedule", "args", "kwargs"}


def convert(name: str, value: object, hint: Any) -> Any:
    """
    Convert a plain value to a constructor argument.

    Numbers may be text, since YAML 1.1 reads ``7e-4`` as text. ``lin_0.001`` is RL-Zoo3's schedule, linear from 0.001
    to 0.

    :param name: the argument's name, which selects its classes and its range
    :param value: value from YAML or a command line; classes and functions are returned unchanged
    :raises ValueError: for a wrong type or range
    """
    members = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    is_schedule = any(get_origin(member) is Callable for member in members)
    if isinstance(value, str):
        if name in CLASSES:
            if value not in CLASSES[name]:
                raise unknown_name(name, value, CLASSES[name])
            return CLASSES[name][value]
        if is_schedule and value.startswith("lin_"):
            return LinearSchedule(convert(name, value.removeprefix("lin_"), float), 0.0, 1.0)
    if Any in members or callable(value):
        return value
    kinds = [member for member in members if get_origin(member) not in (Callable, type)]
    if name in RANGES:
        kinds = [Annotated[kind, RANGES[name]] if kind in (int, float) else kind for kind in kinds]
    try:
        if not kinds:
            raise ValueError(f"expected one of {', '.join(CLASSES.get(name, ()))}")
        result = msgspec.convert(value, Union[tuple(kinds)], strict=False)  # noqa: UP007 (made of a list)
        if isinstance(result, float) and not math.isfinite(result):
            raise ValueError("expected a finite number")
        return result
    except ValueError as error:
        schedules = " (or a schedule such as 'lin_7e-4')" if is_schedule else ""
        raise ValueError(f"invalid setting {name}={reprlib.repr(value)}: {error}{schedules}") from None


def algorithm_arguments(algorithm: type[BaseAlgorithm]) -> dict[str, Any]:
    """Return the valid settings of an algorithm with types: its constructor's arguments but for the run's."""
    return _init_hints(algorithm, _RUN_ARGUMENTS)


def policy_arguments(policy: type[BasePolicy]) -> dict[str, Any]:
    """
    Return the valid ``policy_kwargs`` with types: the arguments of the constructors of the policy and of its base
    classes, and the fields of its parts.
    """
    arguments: dict[str, Any] = {}
    for base in reversed(policy.__mro__):
        if issubclass(base, BasePolicy) and "__init__" in vars(base):
            arguments |= _init_hints(base, _POLICY_RUN_ARGUMENTS)
    parts = getattr(policy, "parts_class", None)
    if parts is not None and is_dataclass(parts):
        hints = get_type_hints(parts)
        arguments |= {field.name: hints[field.name] for field in fields(parts)}
    return arguments


def _init_hints(owner: type, without: set[str]) -> dict[str, Any]:
    init = owner.__init__  # type: ignore[misc]
    hints = get_type_hints(init, localns=vars(vec_env) | {"vec_env": vec_env})  # of SB3's type of environments
    return {name: hints.get(name, Any) for name in inspect.signature(init).parameters if name not in without}
