"""State of a vector environment, layer by layer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Protocol, runtime_checkable

from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, VecTransposeImage

from sb3_saf.checkpoints.data import Tree
from sb3_saf.checkpoints.errors import CheckpointError
from sb3_saf.envs.joint_observation import CentralizedValueWrapper


@runtime_checkable
class Stateful(Protocol):
    """What a VecEnv, a wrapper or a callback has to offer for its state to be in checkpoints."""

    def checkpoint_state(self) -> Mapping[str, Any]:
        """All that the future depends on, as plain data."""
        ...

    def load_checkpoint_state(self, state: Mapping[str, Any]) -> None:
        """Go on from there."""
        ...


def layers(venv: VecEnv) -> Iterator[VecEnv]:
    """The environment's wrappers, outermost first, and what they wrap."""
    yield venv
    while isinstance(venv, VecEnvWrapper):
        venv = venv.venv
        yield venv


def environment_state(venv: VecEnv) -> list[Tree]:
    """
    State of every layer, outermost first.

    :raises CheckpointError: if a layer cannot give its state, saying what to do
    """
    return [{"class": type(layer).__name__, "state": _layer_state(layer)} for layer in layers(venv)]


def load_environment_state(venv: VecEnv, states: list[Tree]) -> None:
    """
    Go on from there.

    :raises CheckpointError: if the layers or their arguments differ, naming the first difference
    """
    found, saved = [type(layer).__name__ for layer in layers(venv)], [state["class"] for state in states]
    if found != saved:
        raise CheckpointError(
            f"the checkpoint's environment is {' of '.join(saved)}, got {' of '.join(found)}; make it the same way"
        )
    for layer, state in zip(layers(venv), states, strict=True):
        try:
            _load_layer_state(layer, state["state"])
        except ValueError as error:
            raise CheckpointError(
                f"the checkpoint does not fit the environment's {type(layer).__name__}: {error}"
            ) from error


def _is_stateful(layer: VecEnv) -> bool:
    # Of the class: a wrapper answers for what it wraps when its attributes are asked for.
    return issubclass(type(layer), Stateful)


def _layer_state(layer: VecEnv) -> Tree:
    if isinstance(layer, Stateful) and _is_stateful(layer):
        return dict(layer.checkpoint_state())
    if isinstance(layer, VecNormalize):
        return _normalize_state(layer)
    if isinstance(layer, CentralizedValueWrapper):
        return {"n_steps": layer._n_steps, "masks_shown": layer._masks_shown}
    if isinstance(layer, VecTransposeImage):
        return {}
    raise CheckpointError(
        f"{type(layer).__name__} cannot give the state of its games, so a run on it cannot be resumed exactly. "
        "HECOGrid with backend='native' can; a VecEnv or wrapper of your own can with the methods "
        "checkpoint_state() and load_checkpoint_state(state). "
        "TeamCheckpointCallback(..., exact=False) begins new episodes on resuming instead"
    )


def _load_layer_state(layer: VecEnv, state: Tree) -> None:
    if isinstance(layer, Stateful) and _is_stateful(layer):
        layer.load_checkpoint_state(state)
    elif isinstance(layer, VecNormalize):
        _load_normalize_state(layer, state)
    elif isinstance(layer, CentralizedValueWrapper):
        layer._n_steps, layer._masks_shown = state["n_steps"], state["masks_shown"]


def _statistics(layer: VecNormalize) -> dict[str, RunningMeanStd]:
    found = {"ret": layer.ret_rms}
    if layer.norm_obs:
        own = layer.obs_rms if isinstance(layer.obs_rms, dict) else {"": layer.obs_rms}
        found |= {f"obs {key}": statistics for key, statistics in own.items()}
    return found


def _normalize_state(layer: VecNormalize) -> Tree:
    return {
        "returns": layer.returns,
        "old_reward": layer.old_reward,
        "old_obs": layer.old_obs,
        **{name: [s.mean, s.var, float(s.count)] for name, s in _statistics(layer).items()},
    }


def _load_normalize_state(layer: VecNormalize, state: Tree) -> None:
    layer.returns, layer.old_reward, layer.old_obs = state["returns"], state["old_reward"], state["old_obs"]
    for name, statistics in _statistics(layer).items():
        if name not in state:
            raise ValueError(f"expected the statistics {name!r}, got {sorted(state)}")
        statistics.mean, statistics.var, statistics.count = state[name]
