"""Checks of arguments, errors of this package, and errors for unknown names typed by users."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from numbers import Integral
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:  # actors are played without Stable-Baselines3
    from stable_baselines3.common.callbacks import BaseCallback

#: Largest seed of a run: the limit of NumPy's global generator, which SB3 seeds.
MAX_SEED: Final = 2**32 - 1

#: Branches in the tree of a run's seeds: games of evaluations during training, and of the tests after it.
_EVALUATION, _TEST = 1, 2


def check_seed(seed: object) -> int:
    """Return the seed of a run if it is an integer from 0 to 2**32 - 1; otherwise raise ValueError."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or not 0 <= seed <= MAX_SEED:
        raise ValueError(f"seed must be a whole number from 0 to {MAX_SEED}, got {seed!r}")
    return int(seed)


def evaluation_seed(seed: int, test: int | None = None) -> int:
    """
    Return the seed from which the seeds of a run's evaluation games are derived, from 2**62 to 2**63 - 1.

    It is a separate branch in the run's tree of seeds, with the top bit of 63 set, which no run can have as its seed.

    :param test: number of a batch of test games, which no evaluation during training has; None for the latter
    """
    branch = (_EVALUATION,) if test is None else (_TEST, test)
    word = np.random.SeedSequence(check_seed(seed), spawn_key=branch).generate_state(1, np.uint64)[0]
    return (int(word) >> 2) | (1 << 62)


def unknown_name(kind: str, name: object, known: Iterable[str]) -> ValueError:
    """Return an error for an unknown name of a kind, such as ``"algorithm"``."""
    names = list(known)
    return ValueError(f"unknown {kind} {name!r}{_did_you_mean(name, names)}; there is {', '.join(names)}")


def _did_you_mean(name: object, known: Iterable[str]) -> str:
    nearest = get_close_matches(str(name), list(known), n=1)
    return f" (did you mean {nearest[0]!r}?)" if nearest else ""


def check_count(name: str, value: object) -> int:
    """Check that a value is an integer of at least 1; the ValueError contains ``name``."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Integral) or value < 1:
        raise ValueError(f"{name} must be an integer of at least 1, got {value!r}")
    return int(value)


def check_flag(name: str, value: object) -> None:
    """Check that an argument is True or False; the ValueError contains ``name``."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} must be True or False, got {value!r}")


def check_choice(name: str, value: object, choices: Sequence[object]) -> None:
    """Check that an argument is one of ``choices``; the ValueError lists them."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r}")


def check_whole_teams(n_rows: int, n_agents: int, fix: str = "pass the right n_agents") -> int:
    """Return E = B / N; raise ValueError unless the rows are a whole number of teams."""
    if n_rows % n_agents:
        raise ValueError(
            f"expected rows of whole teams, a multiple of n_agents={n_agents}, got {n_rows} rows "
            f"({n_rows // n_agents} teams and {n_rows % n_agents} rows over); {fix}"
        )
    return n_rows // n_agents


def import_by_name(module: str, name: str, what: str, hint: str = "") -> Any:
    """Import a callable from a module; the ValueError contains ``what``, and ``hint`` if the module lacks it."""
    callables: list[str] = []
    try:
        imported = importlib.import_module(module)
        callables += [key for key, value in vars(imported).items() if callable(value)]
        value = getattr(imported, name, None)
    except (ImportError, AttributeError, TypeError, ValueError) as error:  # SuperSuit's, too, for names that it lacks
        fix = _did_you_mean(name, callables) or "; install the package, or set PYTHONPATH to the folder that has it"
        raise ValueError(f"{what}: cannot import {module!r} ({error}){fix}") from error
    if not callable(value):
        fix = hint or ("" if value is not None else _did_you_mean(name, callables))
        raise ValueError(f"{what}: expected a function or class, got {module}.{name} = {value!r}{fix}")
    return value


def check_form(name: str, value: Mapping[str, Any], like: Mapping[str, npt.NDArray[Any]]) -> None:
    """Check names, shapes and dtypes of arrays by name; the ValueError is of the first difference."""
    if value.keys() != like.keys():
        raise ValueError(f"expected {name} to have the entries {list(like)}, got {list(value)}")
    for key, part in like.items():
        shape, dtype = value[key].shape, value[key].dtype
        if shape != part.shape or dtype != part.dtype:
            raise ValueError(
                f"expected {name}[{key!r}] of shape {part.shape} and {part.dtype}, got {shape} and {dtype}"
            )


class ExportError(ValueError):
    """Raised for an invalid or untrusted file, or a model that cannot be exported."""


class SettingsError(ValueError):
    """Raised for settings that do not fit the model."""


def check_hears_rollouts(callback: BaseCallback) -> None:
    """Check that a callback is not within another one, which passes on steps only; otherwise raise SettingsError."""
    if callback.parent is not None:
        within, callback.parent = type(callback.parent).__name__, None  # so that it may be given to learn then
        raise SettingsError(
            f"{type(callback).__name__} must hear of rollouts, which {within} does not pass on: give it to learn "
            "itself, alone or in a list"
        )


class NonFiniteError(ValueError):
    """Raised for NaN or infinity in training data, losses or gradients."""


class CheckpointError(ValueError):
    """Raised for a checkpoint that cannot be written, read, or used with the given model."""


class DamagedCheckpointError(CheckpointError):
    """Raised for a truncated or changed file, whose checksum does not match."""
