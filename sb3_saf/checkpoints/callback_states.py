"""States of callbacks: named counters for those of SB3 and of this package, methods for others."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Final, Literal

import numpy as np
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
from sb3_saf.callbacks.game_steps import GameStepsCallback
from sb3_saf.checkpoints.checks import check_keys, check_list, check_real, check_whole, refused
from sb3_saf.checkpoints.data import Tree
from sb3_saf.checkpoints.environments import (
    Stateful,
    check_environment_state,
    check_stateful,
    environment_state,
    is_stateful,
    load_environment_state,
)
from sb3_saf.inspection.callback import InspectionCallback

#: Kinds of counters: an integer, any number, a list of integers, a list of evaluations, the same for each agent.
_Kind = Literal["whole", "real", "steps", "results", "agents"]

#: Counters of callbacks, the only attributes that a checkpoint sets.
_COUNTERS: Final[dict[Any, dict[str, _Kind]]] = {
    BaseCallback: {"n_calls": "whole"},
    EvalCallback: {
        "best_mean_reward": "real",
        "last_mean_reward": "real",
        "evaluations_results": "results",
        "evaluations_timesteps": "steps",
        "evaluations_length": "results",
        "evaluations_successes": "results",
    },
    TeamEvalCallback: {
        "evaluations_game_steps": "steps",
        "evaluations_agent_results": "agents",
        "_next_evaluation": "whole",
    },
    EveryNTimesteps: {"last_time_trigger": "whole"},
    StopTrainingOnMaxEpisodes: {"n_episodes": "whole"},
    StopTrainingOnNoModelImprovement: {"last_best_mean_reward": "real", "no_improvement_evals": "whole"},
}

#: Display-only callbacks, which may be added or removed on resuming.
_ONLY_SHOWING: Final = (ProgressBarCallback, InspectionCallback, GameStepsCallback)

Callbacks = BaseCallback | Iterable[BaseCallback] | None


def all_callbacks(callback: Callbacks) -> Iterator[BaseCallback]:
    """Yield callbacks, also nested ones, except display-only ones."""
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
    """Return the states of callbacks; CheckpointError if an evaluation environment has no state."""
    return [
        {
            "counters": {name: getattr(one, name) for name in _kinds(one)},
            "own": dict(one.checkpoint_state()) if isinstance(one, Stateful) else None,
            "eval_env": environment_state(one.eval_env) if isinstance(one, EvalCallback) else None,
        }
        for one in callbacks
    ]


def check_callback_states(callbacks: Iterable[BaseCallback], states: Tree) -> None:
    """Check that states are valid for callbacks; a CheckpointError names the first mismatch."""
    callbacks = list(callbacks)
    check_list(states, "the states of callbacks", len(callbacks))
    for one, state in zip(callbacks, states, strict=True):
        where = f"the state of {type(one).__name__}"
        check_keys(state, ("counters", "own", "eval_env"), where)
        check_keys(state["counters"], _kinds(one), f"the counters in {where}")
        for name, kind in _kinds(one).items():
            _check_counter(one, state["counters"][name], kind, name)
        if is_stateful(one):
            check_stateful(one, state["own"], type(one).__name__)
        if isinstance(one, EvalCallback):
            check_environment_state(one.eval_env, state["eval_env"])


def load_callback_states(callbacks: Iterable[BaseCallback], states: list[Tree]) -> None:
    """Restore states that passed :func:`check_callback_states`."""
    for one, state in zip(callbacks, states, strict=True):
        for name in _kinds(one):
            setattr(one, name, state["counters"][name])
        if isinstance(one, Stateful):
            one.load_checkpoint_state(state["own"])
        if isinstance(one, EvalCallback):
            load_environment_state(one.eval_env, state["eval_env"])


def _kinds(callback: BaseCallback) -> dict[str, _Kind]:
    """Return the callback's counters."""
    return {name: k for kind, names in _COUNTERS.items() if isinstance(callback, kind) for name, k in names.items()}


def _check_counter(callback: BaseCallback, value: Tree, kind: _Kind, name: str) -> None:
    if kind == "whole":
        check_whole(value, name)
    elif kind == "real":
        check_real(value, name, finite=False)
    else:
        check_list(value, name)
        for entry in value:
            if kind == "steps":
                check_whole(entry, name)
            elif kind == "agents":
                check_list(entry, name)
            else:
                _check_evaluation(callback, entry, name)


def _check_evaluation(callback: BaseCallback, entry: Tree, name: str) -> None:
    """Check one evaluation: a number for each of its episodes."""
    assert isinstance(callback, EvalCallback)
    check_list(entry, name)
    if name != "evaluations_successes" and len(entry) != callback.n_eval_episodes:
        raise refused(name, f"lists of {callback.n_eval_episodes} episodes", f"one of {len(entry)}")
    for number in entry:
        check_real(float(number) if isinstance(number, (bool, np.bool_)) else number, name, finite=False)
