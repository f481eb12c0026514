"""What ``-optimize`` tries: the search space of these algorithms, through the same door as ``overrides``."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any, Final

import optuna

from sb3_saf.training.algorithms import AlgorithmSpec
from sb3_saf.training.values import algorithm_arguments, policy_arguments

_Suggest = Callable[[optuna.Trial, str], Any]


def _log(low: float, high: float) -> _Suggest:
    return lambda trial, name: trial.suggest_float(name, low, high, log=True)


def _choice(*values: Any) -> _Suggest:
    return lambda trial, name: trial.suggest_categorical(name, values)


def _count(low: int, high: int) -> _Suggest:
    return lambda trial, name: trial.suggest_int(name, low, high)


#: Arguments of algorithms; those that an algorithm does not have are left out.
_SEARCH: Final[dict[str, _Suggest]] = {
    "learning_rate": _log(1e-4, 3e-3),
    "gamma": _choice(0.95, 0.98, 0.99, 0.995),
    "gae_lambda": _choice(0.9, 0.95, 0.98, 1.0),
    "ent_coef": _log(1e-4, 0.05),
    "vf_coef": _log(0.1, 1.0),
    "clip_range": _choice(0.1, 0.2, 0.3),
    "max_grad_norm": _log(0.5, 10.0),
    "n_epochs": _count(2, 10),
    "n_minibatches": _choice(1, 2, 4, 8),
}
#: Arguments of policies.
_POLICY_SEARCH: Final[dict[str, _Suggest]] = {
    "n_policies": _count(2, 8),
    "n_slots": _count(2, 8),
}


def sample_overrides(trial: optuna.Trial, spec: AlgorithmSpec, fixed: Mapping[str, Any]) -> dict[str, Any]:
    """
    Ask a trial for settings.

    :param trial: the trial
    :param spec: the algorithm
    :param fixed: what the user has given, which is not searched
    :return: overrides for ``load_settings``
    """
    known = set(algorithm_arguments(spec.algorithm))
    if {"n_steps", "batch_size"} <= known and "batch_size" not in fixed:
        known.add("n_minibatches")
    for name in _open(_SEARCH, known, fixed):
        _SEARCH[name](trial, name)
    settled = {**spec.policy_kwargs, **fixed.get("policy_kwargs", {})}
    if settled.get("knowledge_source") is False:
        settled["n_slots"] = None  # there are none
    for name in _open(_POLICY_SEARCH, policy_arguments(spec.policy_class), settled):
        _POLICY_SEARCH[name](trial, name)
    return to_overrides(trial.params)


def _open(search: Mapping[str, _Suggest], known: Collection[str], settled: Mapping[str, Any]) -> list[str]:
    return [name for name in search if name in known and name not in settled]


def to_overrides(params: Mapping[str, Any]) -> dict[str, Any]:
    """
    Settings that a trial stands for.

    :param params: ``trial.params``
    :return: overrides for ``load_settings``, where those of the policy join the other ``policy_kwargs``
    """
    of_policy = {name: value for name, value in params.items() if name in _POLICY_SEARCH}
    others = {name: value for name, value in params.items() if name not in _POLICY_SEARCH}
    return {**others, "policy_kwargs": of_policy} if of_policy else others
