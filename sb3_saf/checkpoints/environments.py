"""State of a vector environment, layer by layer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, VecTransposeImage

from sb3_saf.envs.joint_observation import DictRows
from sb3_saf.envs.monitor import SharedReward
from sb3_saf.teams.errors import CheckpointError
from sb3_saf.teams.rows import OBS_KEY
from sb3_saf.teams.trees import Tree
from sb3_saf.teams.vec_env import layers

#: Wrappers that remember nothing from step to step.
_WITHOUT_STATE: Final = (VecTransposeImage, DictRows, SharedReward)
_STATISTICS: Final = ("mean", "var", "count")


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


def is_stateful(part: object) -> bool:
    """Return whether a part implements :class:`Stateful`; checked on its class, since wrappers forward attributes."""
    return issubclass(type(part), Stateful)


def environment_state(venv: VecEnv) -> list[Tree]:
    """Return the state of every layer, outermost first; a CheckpointError names a layer without one, and a fix."""
    return [_layer_state(layer) for layer in layers(venv)]


def _layer_state(layer: VecEnv) -> Tree:
    if isinstance(layer, Stateful) and is_stateful(layer):
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
        if isinstance(layer, Stateful) and is_stateful(layer):
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
