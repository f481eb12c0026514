"""States of callbacks: those of SB3 and of this package by the names of their counters, others by their methods."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Final

from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EvalCallback,
    EventCallback,
    EveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)

from sb3_saf.callbacks.evaluation import TeamEvalCallback
from sb3_saf.checkpoints.data import Tree
from sb3_saf.checkpoints.environments import Stateful, environment_state, load_environment_state
from sb3_saf.checkpoints.errors import CheckpointError
from sb3_saf.inspection.callback import InspectionCallback

_COUNTERS: Final[dict[Any, tuple[str, ...]]] = {
    BaseCallback: ("n_calls",),
    EvalCallback: (
        *("best_mean_reward", "last_mean_reward", "evaluations_results", "evaluations_timesteps"),
        *("evaluations_length", "evaluations_successes"),
    ),
    TeamEvalCallback: ("evaluations_game_steps", "_next_evaluation"),
    EveryNTimesteps: ("last_time_trigger",),
    StopTrainingOnMaxEpisodes: ("n_episodes",),
    StopTrainingOnNoModelImprovement: ("last_best_mean_reward", "no_improvement_evals"),
}

#: A run may go on without them, or with them: progress bars of a terminal, looks into the policy.
_ONLY_SHOWING: Final = (ProgressBarCallback, InspectionCallback)

Callbacks = BaseCallback | Iterable[BaseCallback] | None


def all_callbacks(callback: Callbacks) -> Iterator[BaseCallback]:
    """Callbacks in lists, and those that others call, but for those that only show something."""
    if callback is None or isinstance(callback, _ONLY_SHOWING):
        return
    if not isinstance(callback, BaseCallback):
        for one in callback:
            yield from all_callbacks(one)
        return
    if isinstance(callback, CallbackList):
        yield from all_callbacks(callback.callbacks)
        return
    yield callback
    if isinstance(callback, EventCallback):
        yield from all_callbacks(callback.callback)
    if isinstance(callback, EvalCallback):
        yield from all_callbacks(callback.callback_on_new_best)


def callback_states(callbacks: Iterable[BaseCallback]) -> list[Tree]:
    """
    States of callbacks.

    :raises CheckpointError: if an environment for evaluation cannot give its state
    """
    return [{"class": type(one).__name__, "state": _state(one)} for one in callbacks]


def load_callback_states(callbacks: Iterable[BaseCallback], states: list[Tree]) -> None:
    """
    Go on from there.

    :raises CheckpointError: if the callbacks are not those of the checkpoint
    """
    callbacks = list(callbacks)
    found, saved = [type(one).__name__ for one in callbacks], [state["class"] for state in states]
    if found != saved:
        raise CheckpointError(
            f"the checkpoint was made with the callbacks {saved}, got {found}; pass them in the same order"
        )
    for one, state in zip(callbacks, states, strict=True):
        _load(one, state["state"])


def _names(callback: BaseCallback) -> list[str]:
    return [name for kind, names in _COUNTERS.items() if isinstance(callback, kind) for name in names]


def _state(callback: BaseCallback) -> Tree:
    return {
        "counters": {name: getattr(callback, name) for name in _names(callback)},
        "own": dict(callback.checkpoint_state()) if isinstance(callback, Stateful) else None,
        "eval_env": environment_state(callback.eval_env) if isinstance(callback, EvalCallback) else None,
    }


def _load(callback: BaseCallback, state: Tree) -> None:
    for name, value in state["counters"].items():
        setattr(callback, name, value)
    if isinstance(callback, Stateful) and state["own"] is not None:
        callback.load_checkpoint_state(state["own"])
    if isinstance(callback, EvalCallback) and state["eval_env"] is not None:
        load_environment_state(callback.eval_env, state["eval_env"])
