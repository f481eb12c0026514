"""State of the parts around a model: layers of vector environments, and callbacks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final, Protocol, TypeGuard, runtime_checkable

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
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, VecTransposeImage

from sb3_saf.callbacks.evaluation import TeamEvalCallback
from sb3_saf.envs.monitor import SharedReward
from sb3_saf.teams.errors import CheckpointError
from sb3_saf.teams.rows import OBS_KEY
from sb3_saf.teams.trees import Tree
from sb3_saf.teams.vec_env import layers

#: Wrappers that remember nothing from step to step.
_WITHOUT_STATE: Final = (VecTransposeImage, SharedReward)
_STATISTICS: Final = ("mean", "var", "count")
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


@runtime_checkable
class Stateful(Protocol):
    """
    Interface of a VecEnv, a wrapper or a callback whose state is stored in checkpoints.

    States are plain data, for a layer or callback with the same arguments.
    """

    def checkpoint_state(self) -> Mapping[str, Any]:
        """Return the complete state as plain data."""
        ...

    def load_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of :meth:`checkpoint_state`; a ValueError says why it does not fit."""
        ...


# --- environments -----------------------------------------------------------------------------------------------------


def environment_state(venv: VecEnv) -> list[Tree]:
    """Return the state of every layer, outermost first; a CheckpointError names a layer without one, and a fix."""
    return [_layer_state(layer) for layer in layers(venv)]


def _is_stateful(layer: VecEnv) -> TypeGuard[Stateful]:
    """Return whether the layer's class is :class:`Stateful`: wrappers forward the attributes of inner layers."""
    return issubclass(type(layer), Stateful)


def _layer_state(layer: VecEnv) -> Tree:
    if _is_stateful(layer):
        return dict(layer.checkpoint_state())
    if isinstance(layer, VecNormalize):
        last = {"returns": layer.returns, "old_reward": layer.old_reward, "old_obs": getattr(layer, "old_obs", None)}
        return {**last, "statistics": normalization_statistics(layer)}
    if isinstance(layer, _WITHOUT_STATE):
        return {}
    raise CheckpointError(
        f"{type(layer).__name__} cannot give the state of its games, so a run on it cannot be resumed exactly; "
        "HECOGrid with backend='native' can, and a VecEnv or wrapper of your own with the methods "
        "checkpoint_state() and load_checkpoint_state(state). "
        "TeamCheckpointCallback(..., exact=False) begins new episodes on resuming instead"
    )


def load_environment_state(venv: VecEnv, states: list[Tree]) -> None:
    """Restore the states of all layers; a curriculum's own state determines the games below it."""
    for layer, state in zip(layers(venv), states, strict=True):
        if _is_stateful(layer):
            layer.load_checkpoint_state(state)
        elif isinstance(layer, VecNormalize):
            layer.returns, layer.old_reward, layer.old_obs = state["returns"], state["old_reward"], state["old_obs"]
            load_normalization_statistics(layer, state["statistics"])


def normalization_statistics(layer: VecNormalize) -> dict[str, np.ndarray]:
    """Return mean, variance and count of the returns, and of the entries of observations that are normalised."""
    return {
        f"{name} {part}": np.array(getattr(statistics, part))
        for name, statistics in _running_statistics(layer).items()
        for part in _STATISTICS
    }


def load_normalization_statistics(layer: VecNormalize, arrays: Mapping[str, np.ndarray]) -> None:
    """Restore :func:`normalization_statistics`; ValueError for those of other observations."""
    own = normalization_statistics(layer)
    if {name: array.shape for name, array in own.items()} != {name: arrays[name].shape for name in arrays}:
        raise ValueError(f"expected statistics {', '.join(own)} of observations of the same shape, got others")
    for name, statistics in _running_statistics(layer).items():
        mean, var, count = (np.array(arrays[f"{name} {part}"]) for part in _STATISTICS)
        statistics.mean, statistics.var, statistics.count = mean, var, float(count)


def _running_statistics(layer: VecNormalize) -> dict[str, RunningMeanStd]:
    if not layer.norm_obs:
        return {"returns": layer.ret_rms}
    of_observations = layer.obs_rms if isinstance(layer.obs_rms, dict) else {OBS_KEY: layer.obs_rms}
    return {"returns": layer.ret_rms, **of_observations}


# --- callbacks --------------------------------------------------------------------------------------------------------


def all_callbacks(callback: Callbacks) -> Iterator[BaseCallback]:
    """Yield callbacks, also nested ones, except those that only show: these may be added or removed on resuming."""
    if callback is None or isinstance(callback, ProgressBarCallback) or getattr(type(callback), "only_shows", False):
        return
    if isinstance(callback, CallbackList):
        callback = callback.callbacks
    if not isinstance(callback, BaseCallback):
        for each in callback:
            yield from all_callbacks(each)
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
            "counters": {name: getattr(callback, name) for name in _counters(callback)},
            "own": dict(callback.checkpoint_state()) if isinstance(callback, Stateful) else None,
            "eval_env": environment_state(callback.eval_env) if isinstance(callback, EvalCallback) else None,
        }
        for callback in callbacks
    ]


def load_callback_states(callbacks: Iterable[BaseCallback], states: list[Tree]) -> None:
    """Restore states of :func:`callback_states`."""
    for callback, state in zip(callbacks, states, strict=True):
        for name in _counters(callback):
            setattr(callback, name, state["counters"][name])
        if isinstance(callback, Stateful):
            callback.load_checkpoint_state(state["own"])
        if isinstance(callback, EvalCallback):
            load_environment_state(callback.eval_env, state["eval_env"])


def _counters(callback: BaseCallback) -> list[str]:
    return [name for kind, names in _COUNTERS.items() if isinstance(callback, kind) for name in names]
