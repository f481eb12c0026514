"""States of callbacks: named counters for those of SB3 and of this package, methods for others."""

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
from sb3_saf.checkpoints.environments import Stateful, environment_state, load_environment_state
from sb3_saf.teams.trees import Tree

#: Counters of callbacks, the only attributes that a checkpoint sets.
_COUNTERS: Final[dict[Any, tuple[str, ...]]] = {
    BaseCallback: ("n_calls",),
    EvalCallback: (
        *("best_mean_reward", "last_mean_reward", "evaluations_results", "evaluations_timesteps"),
        *("evaluations_length", "evaluations_successes"),
    ),
    TeamEvalCallback: ("evaluations_game_steps", "evaluations_agent_results", "_next_evaluation"),
    EveryNTimesteps: ("last_time_trigger",),
    StopTrainingOnMaxEpisodes: ("n_episodes",),
    StopTrainingOnNoModelImprovement: ("last_best_mean_reward", "no_improvement_evals"),
}

Callbacks = BaseCallback | Iterable[BaseCallback] | None


def all_callbacks(callback: Callbacks) -> Iterator[BaseCallback]:
    """Yield callbacks, also nested ones, except those that only show: these may be added or removed on resuming."""
    if callback is None or isinstance(callback, ProgressBarCallback) or getattr(type(callback), "only_shows", False):
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
            "counters": {name: getattr(one, name) for name in _counters(one)},
            "own": dict(one.checkpoint_state()) if isinstance(one, Stateful) else None,
            "eval_env": environment_state(one.eval_env) if isinstance(one, EvalCallback) else None,
        }
        for one in callbacks
    ]


def load_callback_states(callbacks: Iterable[BaseCallback], states: list[Tree]) -> None:
    """Restore states of :func:`callback_states`."""
    for one, state in zip(callbacks, states, strict=True):
        for name in _counters(one):
            setattr(one, name, state["counters"][name])
        if isinstance(one, Stateful):
            one.load_checkpoint_state(state["own"])
        if isinstance(one, EvalCallback):
            load_environment_state(one.eval_env, state["eval_env"])


def _counters(callback: BaseCallback) -> list[str]:
    return [name for kind, names in _COUNTERS.items() if isinstance(callback, kind) for name in names]
