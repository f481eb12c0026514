"""Conversion of plain YAML values to constructor arguments: numbers, schedules, and classes by registered names."""

from __future__ import annotations

import inspect
import math
import types
from collections.abc import Callable, Mapping
from collections.abc import Callable as AbstractCallable
from dataclasses import fields, is_dataclass
from typing import Any, Final, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import LinearSchedule
from torch import nn

from sb3_saf.buffers.rollout import TeamRolloutBuffer
from sb3_saf.policies.extractors import LightEncoder, MLPEncoder, NatureEncoder, ObservationEncoder, PaperCNN
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

#: Constructor arguments that are set by the run, not by its settings.
_RUN_ARGUMENTS: Final = {
    "self",
    "policy",
    "env",
    "policy_kwargs",
    "tensorboard_log",
    "verbose",
    "seed",
    "device",
    "_init_setup_model",
}
_POLICY_RUN_ARGUMENTS: Final = {"self", "observation_space", "action_space", "lr_schedule", "args", "kwargs"}


class Range(NamedTuple):
    """Valid range of an argument; ``above`` excludes ``low`` itself; ``high`` None means no limit."""

    low: float
    high: float | None = None
    above: bool = False

    def __contains__(self, value: object) -> bool:
        assert isinstance(value, (int, float))
        return (value > self.low if self.above else value >= self.low) and (self.high is None or value <= self.high)

    def __str__(self) -> str:
        if self.high is not None:
            return f"from {self.low} to {self.high}"
        return f"larger than {self.low}" if self.above else f"at least {self.low}"


#: Ranges that the algorithms do not check, or only after the first rollout.
RANGES: Final[dict[str, Range]] = {
    **dict.fromkeys(("gamma", "gae_lambda", "tau"), Range(0, 1)),
    **dict.fromkeys(("exploration_fraction", "exploration_initial_eps", "exploration_final_eps"), Range(0, 1)),
    **dict.fromkeys(("learning_rate", "ent_coef", "vf_coef", "learning_starts"), Range(0)),
    **dict.fromkeys(("clip_range", "max_grad_norm", "target_kl"), Range(0, above=True)),
    **dict.fromkeys(("n_steps", "n_epochs", "batch_size", "n_minibatches", "game_steps"), Range(1)),
    **dict.fromkeys(("buffer_size", "train_freq", "target_update_interval", "stats_window_size"), Range(1)),
    "n_envs": Range(1, 100_000),
    "frame_stack": Range(1, 1_000),
}


class Kind(NamedTuple):
    """
    Kind of value of an argument: whether a type hint allows it, the conversion (``_NO`` for values of another kind),
    and its description in errors.
    """

    accepts: Callable[[Any], bool]
    convert: Callable[[Any], Any]
    words: str


_NO: Final = object()


def _number(value: object) -> Any:
    """Return a float; YAML 1.1 reads ``7e-4`` as a string."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return _NO
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return _NO
    return number if math.isfinite(number) else _NO


def _whole_number(value: object) -> Any:
    number = _number(value)
    return int(number) if number is not _NO and number == int(number) else _NO


def _schedule(value: object) -> Any:
    """Return the schedule of RL-Zoo3's ``lin_0.001``: linear from 0.001 to 0."""
    if not isinstance(value, str) or not value.startswith("lin_"):
        return _NO
    start = _number(value.removeprefix("lin_"))
    return _NO if start is _NO else LinearSchedule(start, 0.0, 1.0)


def _as_tuple(value: object) -> Any:
    return tuple(value) if isinstance(value, (list, tuple)) else _NO


def _instance(*classes: type) -> Callable[[Any], Any]:
    return lambda value: value if isinstance(value, classes) else _NO


_KINDS: Final = (
    Kind(lambda hint: hint is type(None), lambda value: None if value is None else _NO, "null"),
    Kind(lambda hint: hint is bool, _instance(bool), "true or false"),
    Kind(lambda hint: hint is int, _whole_number, "a whole number"),
    Kind(lambda hint: hint is float, _number, "a number"),
    Kind(lambda hint: get_origin(hint) is AbstractCallable, _schedule, "a schedule such as 'lin_7e-4'"),
    Kind(lambda hint: hint is str, _instance(str), "a string"),
    Kind(lambda hint: get_origin(hint) in (dict, Mapping), _instance(dict), "a mapping, written {key: value}"),
    Kind(lambda hint: get_origin(hint) is list, _instance(list), "a list"),
    Kind(lambda hint: get_origin(hint) is tuple, _as_tuple, "a list"),
)


def resolve(name: str, value: object, hint: object) -> Any:
    """
    Convert a plain value to a constructor argument; raise ValueError for a wrong type or range.

    :param name: the argument's name, which selects the table of classes
    :param value: value from YAML or a command line; objects that are not plain data are returned unchanged
    :param hint: the argument's type
    """
    resolved = _resolve_type(name, value, hint)
    number = resolved.start if isinstance(resolved, LinearSchedule) else resolved
    if name in RANGES and isinstance(number, (int, float)) and number not in RANGES[name]:
        raise ValueError(f"{name} must be {RANGES[name]}, got {value!r}")
    return resolved


def _resolve_type(name: str, value: object, hint: object) -> Any:
    if name in CLASSES and isinstance(value, str):
        if value not in CLASSES[name]:
            raise unknown_name(name, value, CLASSES[name])
        return CLASSES[name][value]
    if not isinstance(value, (bool, int, float, str, list, tuple, dict, type(None))):
        return value
    hints = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    choices = [choice for hint in hints if get_origin(hint) is Literal for choice in get_args(hint)]
    if value in choices or Any in hints:
        return value
    kinds = [kind for kind in _KINDS if any(kind.accepts(hint) for hint in hints)]
    for kind in kinds:
        converted = kind.convert(value)
        if converted is not _NO:
            return converted
    words = [*map(repr, choices), *(kind.words for kind in kinds), *CLASSES.get(name, [])]
    raise ValueError(f"{name} must be {' or '.join(words) or hint}, got {value!r}")


def algorithm_arguments(algorithm: type[BaseAlgorithm]) -> dict[str, Any]:
    """Return the valid settings of an algorithm with types: its constructor's arguments without those of a run."""
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
    init = vars(owner).get("__init__") or owner.__init__  # type: ignore[misc]
    annotations = {name: parameter.annotation for name, parameter in inspect.signature(init).parameters.items()}
    # One by one: SB3's type of environments, never used in settings, has an unresolvable forward reference.
    return {name: _hint(annotations[name], init.__globals__) for name in annotations if name not in without}


def _hint(annotation: Any, names: dict[str, Any]) -> Any:
    if annotation is inspect.Parameter.empty:
        return Any
    return get_type_hints(types.SimpleNamespace(__annotations__={"argument": annotation}), names)["argument"]
