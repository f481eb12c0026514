"""State of a vector environment, layer by layer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, VecTransposeImage

from sb3_saf.checkpoints.checks import check_array, check_keys, check_like, check_list, check_observations, check_real
from sb3_saf.checkpoints.data import Tree
from sb3_saf.envs.curriculum import Curriculum
from sb3_saf.teams.errors import CheckpointError
from sb3_saf.teams.vec_env import layers


@runtime_checkable
class Stateful(Protocol):
    """
    Interface of a VecEnv, a wrapper or a callback whose state is stored in checkpoints.

    States are plain data, for a layer or callback with the same arguments. An optional method
    ``check_checkpoint_state(state)`` raises ValueError for an invalid state, naming the first mismatch. All parts of a
    run are checked before the first one is loaded.
    """

    def checkpoint_state(self) -> Mapping[str, Any]:
        """Return the complete state as plain data."""
        ...

    def load_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of :meth:`checkpoint_state`."""
        ...


def environment_state(venv: VecEnv) -> list[Tree]:
    """Return the state of every layer, outermost first; a CheckpointError names a layer without one, and a fix."""
    return [{"class": type(layer).__name__, "state": _layer_state(layer)} for layer in layers(venv)]


def check_environment_state(venv: VecEnv, states: Tree) -> None:
    """Check layers, arguments and states; a CheckpointError names the first difference."""
    check_list(states, "the state of the environment")
    for state in states:
        check_keys(state, ("class", "state"), "the state of a layer of the environment")
    found, saved = [type(layer).__name__ for layer in layers(venv)], [state["class"] for state in states]
    if found != saved:
        raise CheckpointError(
            f"the checkpoint's environment is {' of '.join(map(str, saved))}, got {' of '.join(found)}; make it the "
            "same way"
        )
    layer = venv
    for state in states:
        if is_stateful(layer):
            check_stateful(layer, state["state"], f"the environment's {type(layer).__name__}")
        elif isinstance(layer, VecNormalize):
            _check_normalize_state(layer, state["state"])
        if isinstance(layer, Curriculum):
            layer = layer.venv_in(state["state"])  # the saved stage may differ from the present one
        elif isinstance(layer, VecEnvWrapper):
            layer = layer.venv


def load_environment_state(venv: VecEnv, states: list[Tree]) -> None:
    """Restore states that passed :func:`check_environment_state`."""
    for layer, state in zip(layers(venv), states, strict=True):
        if isinstance(layer, Stateful) and is_stateful(layer):
            layer.load_checkpoint_state(state["state"])
        elif isinstance(layer, VecNormalize):
            _load_normalize_state(layer, state["state"])


def is_stateful(part: object) -> bool:
    """Return whether a part implements :class:`Stateful`; checked on its class, since wrappers forward attributes."""
    return issubclass(type(part), Stateful)


def check_stateful(part: object, state: Tree, where: str) -> None:
    """Call the part's own check of its state, if any; raise CheckpointError if it fails."""
    check = getattr(type(part), "check_checkpoint_state", None)
    if not isinstance(state, dict):
        raise CheckpointError(f"the checkpoint does not fit {where}: expected a dict, got {type(state).__name__}")
    if check is None:
        return
    try:
        check(part, state)
    except CheckpointError:
        raise
    except (ValueError, KeyError, TypeError) as error:
        said = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise CheckpointError(f"the checkpoint does not fit {where}: {said}") from error


def _layer_state(layer: VecEnv) -> Tree:
    if isinstance(layer, Stateful) and is_stateful(layer):
        return dict(layer.checkpoint_state())
    if isinstance(layer, VecNormalize):
        return _normalize_state(layer)
    if isinstance(layer, VecTransposeImage):
        return {}
    raise CheckpointError(
        f"{type(layer).__name__} cannot give the state of its games, so a run on it cannot be resumed exactly; "
        "HECOGrid with backend='native' can, and a VecEnv or wrapper of your own with the methods "
        "checkpoint_state() and load_checkpoint_state(state). "
        "TeamCheckpointCallback(..., exact=False) begins new episodes on resuming instead"
    )


def _statistics(layer: VecNormalize) -> dict[str, RunningMeanStd]:
    found = {"ret": layer.ret_rms}
    if layer.norm_obs:
        own = layer.obs_rms if isinstance(layer.obs_rms, dict) else {"": layer.obs_rms}
        found |= {f"obs {key}": statistics for key, statistics in own.items()}
    return found


def _normalize_state(layer: VecNormalize) -> dict[str, Tree]:
    return {
        "returns": layer.returns,
        "old_reward": layer.old_reward,
        "old_obs": getattr(layer, "old_obs", None),
        **{name: [np.asarray(s.mean), np.asarray(s.var), float(s.count)] for name, s in _statistics(layer).items()},
    }


def _check_normalize_state(layer: VecNormalize, state: Tree) -> None:
    own = _normalize_state(layer)
    check_keys(state, own, "the state of VecNormalize")
    check_array(state["returns"], (layer.num_envs,), np.float64, "the returns of VecNormalize")
    if state["old_obs"] is not None:
        rewards, space = "the last rewards of VecNormalize", layer.venv.observation_space
        check_like(np.zeros(np.shape(state["old_reward"])), np.zeros(layer.num_envs), rewards)
        check_observations(state["old_obs"], space, layer.num_envs, "the last observations of VecNormalize")
    for name in _statistics(layer):
        check_like(state[name], own[name], f"the statistics {name!r} of VecNormalize")
        check_real(state[name][2], f"the statistics {name!r} of VecNormalize")


def _load_normalize_state(layer: VecNormalize, state: Tree) -> None:
    layer.returns, layer.old_reward, layer.old_obs = state["returns"], state["old_reward"], state["old_obs"]
    for name, statistics in _statistics(layer).items():
        statistics.mean, statistics.var, statistics.count = state[name]
