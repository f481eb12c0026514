"""
State of a run between two rollouts (model, logger, random generators, layers of vector environments, callbacks), and
the description of the run, which is compared by name before a checkpoint is used.

Model, layers and callbacks are described by the arguments of their constructors that they keep under the same name;
games by :meth:`sb3_saf.teams.vec_env.TeamVecEnv.settings`. Versions and hardware, which affect only the last bits of a
run, may differ. SB3 has no public interface to set most of a model's state: its ``load`` sets the attributes from an
unpickled file, and ``save`` omits some. Only this module reads and sets them.
"""

from __future__ import annotations

import os
import platform
import random
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from inspect import signature
from typing import Any, Final, Protocol, TypeGuard, runtime_checkable

import numpy as np
import stable_baselines3
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
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
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat, configure
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.utils import get_latest_run_id
from stable_baselines3.common.vec_env import VecCheckNan, VecEnv, VecNormalize, VecTransposeImage

from sb3_saf.buffers.replay import TeamReplayBuffer
from sb3_saf.callbacks import TeamEvalCallback, game_steps
from sb3_saf.envs.curriculum import Curriculum
from sb3_saf.envs.monitor import SharedReward
from sb3_saf.policies.memory import RememberingPolicy
from sb3_saf.qplex.qplex import QPLEX
from sb3_saf.teams import package_version
from sb3_saf.teams.checks import CheckpointError
from sb3_saf.teams.files import Tree
from sb3_saf.teams.rows import OBS_KEY
from sb3_saf.teams.vec_env import TeamVecEnv, game_seeds_of, layers

#: Wrappers that remember nothing from step to step.
_WITHOUT_STATE: Final = (VecTransposeImage, VecCheckNan, SharedReward)
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


def environment_state(venv: VecEnv, with_games: bool = True) -> list[Tree]:
    """
    Return the state of every layer, outermost first.

    :param with_games: False to have None for the games, and for wrappers without a state
    :raises CheckpointError: naming a layer without a state, and a fix
    """
    *wrappers, games = layers(venv)
    states = [_layer_state(layer, is_needed=with_games) for layer in wrappers]
    return [*states, _layer_state(games, is_needed=True) if with_games else None]


def _is_stateful(layer: VecEnv) -> TypeGuard[Stateful]:
    """Return whether the layer's class is :class:`Stateful`: wrappers forward the attributes of inner layers."""
    return issubclass(type(layer), Stateful)


def _layer_state(layer: VecEnv, is_needed: bool) -> Tree:
    if _is_stateful(layer):
        return dict(layer.checkpoint_state())
    if isinstance(layer, VecNormalize):
        last = {"returns": layer.returns, "old_reward": layer.old_reward, "old_obs": getattr(layer, "old_obs", None)}
        return {**last, "statistics": normalization_statistics(layer)}
    if isinstance(layer, _WITHOUT_STATE):
        return {}
    if not is_needed:
        return None
    raise CheckpointError(
        f"{type(layer).__name__} cannot give the state of its games, so a run on it cannot be resumed exactly; "
        "HECOGrid with backend='native' can, and a VecEnv or wrapper of your own with the methods "
        "checkpoint_state() and load_checkpoint_state(state). "
        "TeamCheckpointCallback(..., exact=False) begins new episodes on resuming instead"
    )


def load_environment_state(venv: VecEnv, states: list[Tree]) -> None:
    """Restore the states of all layers that have one; a curriculum's own state determines the games below it."""
    for layer, state in zip(layers(venv), states, strict=True):
        if state is None:
            continue
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
    forms = [{name: (one.shape, one.dtype) for name, one in statistics.items()} for statistics in (own, arrays)]
    if forms[0] != forms[1]:
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


def callback_states(callbacks: Iterable[BaseCallback], with_games: bool = True) -> list[Tree]:
    """Return the states of callbacks and, as :func:`environment_state` does, of their evaluation environments."""
    return [
        {
            "counters": {name: getattr(callback, name) for name in _counters(callback)},
            "own": dict(callback.checkpoint_state()) if isinstance(callback, Stateful) else None,
            "eval_env": environment_state(callback.eval_env, with_games)
            if isinstance(callback, EvalCallback)
            else None,
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


#: Arguments that do not change what is learned, or are described otherwise.
_NOT_COMPARED: Final = frozenset(
    {"self", "env", "venv", "eval_env", "policy", "verbose", "render", "render_mode", "warn", "device"}
    | {"tensorboard_log", "stats_window_size", "num_envs", "observation_space", "action_space", "n_cpus"}
)
#: Ends of the names of arguments that are places, which may be moved.
_PLACES: Final = ("path", "dir", "folder", "file", "filename")
#: Arguments of models that are functions of the remaining part of training, and their attributes.
_SCHEDULES: Final = {"learning_rate": "lr_schedule", "clip_range": "clip_range", "clip_range_vf": "clip_range_vf"}
#: Points of training at which they are compared.
_N_POINTS: Final = 21


# --- description of a run ---------------------------------------------------------------------------------------------


def description(model: BaseAlgorithm, callbacks: Iterable[BaseCallback]) -> dict[str, Tree]:
    """
    Describe how a model, its games and callbacks were made, as plain data with dotted names.

    :param callbacks: callbacks of the run, without those that only show
    """
    env = model.get_env()
    assert env is not None
    of_model = {
        "algorithm": type(model).__name__,
        "policy": type(model.policy).__name__,
        "n_envs": model.n_envs,
        "observation_space": str(model.observation_space),
        "action_space": str(model.action_space),
        **_arguments(model),
        "parameters": {name: [str(p.dtype), *p.shape] for name, p in model.policy.state_dict().items()},
    }
    for argument, attribute in _SCHEDULES.items():
        if callable(schedule := getattr(model, attribute, None)):
            of_model[argument] = [float(schedule(i / (_N_POINTS - 1))) for i in range(_N_POINTS)]
    callbacks = list(callbacks)
    return {
        "model": of_model,
        "environment": _layers(env),
        "callbacks": {
            "order": [type(one).__name__ for one in callbacks],
            **_by_class(
                callbacks,
                lambda one: (
                    _arguments(one) | ({"environment": _layers(one.eval_env)} if isinstance(one, EvalCallback) else {})
                ),
            ),
        },
    }


def _of_layer(layer: VecEnv) -> dict[str, Tree]:
    if isinstance(layer, Curriculum):
        stages = {f"stage {number}": _layers(stage) for number, stage in enumerate(layer.stages)}
        return {"ends": list(layer.ends), **stages}
    games = layer.settings() if isinstance(layer, TeamVecEnv) else {}
    return {"num_envs": layer.num_envs, **_arguments(layer), **games}


def _layers(venv: VecEnv) -> dict[str, Tree]:
    seeds = game_seeds_of(venv)
    numbers = None if seeds is None else [None if seed is None else int(seed) for seed in seeds]
    return {"seeds of the games": numbers, **_by_class(layers(venv), _of_layer)}


def _by_class(parts: Iterable[Any], describe: Callable[[Any], dict[str, Tree]]) -> dict[str, Tree]:
    """Describe parts under the names of their classes, numbered from the second one of a class on."""
    result: dict[str, Tree] = {}
    for part in parts:
        name = type(part).__name__
        number = sum(other.partition(" ")[0] == name for other in result) + 1
        result[name if number == 1 else f"{name} {number}"] = describe(part)
    return result


def _arguments(part: object) -> dict[str, Tree]:
    """Return the arguments of a part's constructors that are attributes of the same name, perhaps private ones."""
    result = {}
    for kind in reversed(type(part).__mro__):
        for name in constructor_arguments(kind):
            if name in _NOT_COMPARED or name.startswith("_") or name.rpartition("_")[2] in _PLACES:
                continue
            for attribute in (name, f"_{name}"):
                if attribute in vars(part):
                    result[name] = _plain(vars(part)[attribute])
                    break
    return result


def constructor_arguments(kind: type) -> list[str]:
    """Return the names of the arguments of a class's own constructor; empty if it inherits one."""
    return [*signature(vars(kind)["__init__"]).parameters] if "__init__" in vars(kind) else []


def _plain(value: object) -> Tree:
    """Convert a value to plain data; classes and functions to their names."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, partial):
        return {"function": _plain(value.func), "args": _plain(value.args), "keywords": _plain(value.keywords)}
    return str(getattr(value, "__qualname__", type(value).__qualname__))


def software(model: BaseAlgorithm) -> dict[str, str]:
    """Return versions, device and the number of threads."""
    return {
        "sb3_saf": package_version(),
        "stable_baselines3": stable_baselines3.__version__,
        "torch": th.__version__,
        "numpy": np.__version__,
        "processor": platform.machine(),
        "device": model.device.type,
        "torch threads": str(th.get_num_threads()),
    }


_MODEL_COUNTERS: Final = (
    *("num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "_episode_num", "_n_updates"),
    *("_current_progress_remaining", "exploration_rate"),
)
_LAST: Final = ("_last_obs", "_last_original_obs", "_last_episode_starts")
_INFO_BUFFERS: Final = ("ep_info_buffer", "ep_success_buffer")


def require_resumable(model: BaseAlgorithm) -> None:
    """Raise CheckpointError for algorithms whose complete state is not accessible, naming the supported ones."""
    if not isinstance(model, (OnPolicyAlgorithm, QPLEX)):
        raise CheckpointError(
            "exact resume is for PPO, A2C, TRPO, MaskablePPO and QPLEX, got "
            f"{type(model).__name__}; train it with model.learn and SB3's CheckpointCallback, which begins new episodes"
        )


def is_off_policy(model: BaseAlgorithm) -> bool:
    """Return whether the algorithm is off-policy: its state has a replay buffer, too large to copy at every rollout."""
    return isinstance(model, QPLEX)


def model_state(model: BaseAlgorithm) -> dict[str, Tree]:
    """Return weights, optimiser, counters, last observations, memories, averages and replay at a rollout's start."""
    replay = getattr(model, "replay_buffer", None)
    return {
        "weights": dict(model.policy.state_dict()),
        "optimizer": model.policy.optimizer.state_dict(),
        "counters": {name: getattr(model, name) for name in _MODEL_COUNTERS if hasattr(model, name)},
        "last": {name: getattr(model, name) for name in _LAST},
        "memory": model.policy.checkpoint_state() if isinstance(model.policy, RememberingPolicy) else None,
        "agent_state": getattr(model, "agent_state", None),
        "replay": None if replay is None else replay.checkpoint_state(),
        **{name: [dict(i) if isinstance(i, dict) else i for i in getattr(model, name) or ()] for name in _INFO_BUFFERS},
        "info_buffer_size": None if model.ep_info_buffer is None else model.ep_info_buffer.maxlen,
    }


def load_model_state(model: BaseAlgorithm, state: Tree) -> None:
    """Restore a state of :func:`model_state` of a model with the same description."""
    model.policy.load_state_dict(state["weights"])
    model.policy.optimizer.load_state_dict(state["optimizer"])
    for name in _MODEL_COUNTERS:
        if hasattr(model, name):
            setattr(model, name, state["counters"][name])
    for name in _LAST:
        setattr(model, name, state["last"][name])
    for name in _INFO_BUFFERS:
        setattr(model, name, deque(state[name], maxlen=state["info_buffer_size"]))
    if isinstance(model, QPLEX):
        assert isinstance(model.replay_buffer, TeamReplayBuffer)
        model.replay_buffer.load_checkpoint_state(state["replay"])
        model.agent_state = state["agent_state"]
    if isinstance(model.policy, RememberingPolicy):
        model.policy.load_checkpoint_state(state["memory"])


@contextmanager
def settings_restored_on_error(model: BaseAlgorithm) -> Iterator[None]:
    """
    Restore the model's settings if training ends by an exception, such as Ctrl-C within an update.

    Callbacks may change settings for a while, as :class:`~sb3_saf.EntropySchedule` does, and are not called then.
    """
    names = {name for kind in type(model).__mro__ for name in constructor_arguments(kind)} - {"policy", "env"}
    before = {name: value for name, value in vars(model).items() if name in names}
    try:
        yield
    except BaseException:
        vars(model).update(before)
        raise


def generator_states(model: BaseAlgorithm) -> dict[str, Tree]:
    """Return the states of Python's, NumPy's and torch's global generators and of the action space's generator."""
    version, words, gauss = random.getstate()
    return {
        "python": [version, np.array(words, dtype=np.uint32), gauss],
        "numpy": np.random.get_state(legacy=False),  # noqa: NPY002 - SB3 draws from it
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
        "action_space": model.action_space.np_random.bit_generator.state,
    }


def load_generator_states(states: Tree, model: BaseAlgorithm) -> None:
    """Restore the states of all generators; those of GPUs if there are as many as before."""
    version, words, gauss = states["python"]
    random.setstate((version, tuple(words.tolist()), gauss))
    np.random.set_state(states["numpy"])  # noqa: NPY002
    th.set_rng_state(states["torch"])
    if th.cuda.is_available() and len(states["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all(states["cuda"])
    model.action_space.np_random.bit_generator.state = states["action_space"]


def logger_state(logger: Logger) -> Tree:
    """Return the name of the log folder, and the recorded values not yet written."""
    numbers = {
        name: value for name, value in logger.name_to_value.items() if isinstance(value, (int, float, np.number))
    }
    has_tensorboard = any(isinstance(output, TensorBoardOutputFormat) for output in logger.output_formats)
    return {
        # Relative to the model's log folder, which may have been moved on resuming.
        "tensorboard": os.path.basename(logger.get_dir() or "") if has_tensorboard else None,
        "numbers": [
            [name, value, list(logger.name_to_excluded[name] or ()), logger.name_to_count[name]]
            for name, value in numbers.items()
        ],
    }


def continue_logs(model: BaseAlgorithm, state: Tree) -> None:
    """Set a logger that continues in the same folder; a logger set by the caller is kept."""
    if not hasattr(model, "logger"):
        formats = ["stdout"] if model.verbose >= 1 else [""]
        if model.tensorboard_log is None:
            model.set_logger(configure(None, formats))
        else:
            from tensorboard.compat.proto.event_pb2 import Event, SessionLog

            new = f"resumed_{get_latest_run_id(model.tensorboard_log, 'resumed') + 1}"
            folder = os.path.join(model.tensorboard_log, os.path.basename(state["tensorboard"] or new))
            logger, board = configure(folder, formats), TensorBoardOutputFormat(folder)
            logger.output_formats.append(board)
            # TensorBoard hides entries written after the checkpoint, which are written again.
            file_writer: Any = board.writer.file_writer
            start = SessionLog(status=SessionLog.START)
            file_writer.add_event(Event(step=(game_steps(model) or 0) + 1, session_log=start))
            model.set_logger(logger)
    for name, value, excluded, count in state["numbers"]:
        model.logger.name_to_value[name] = value
        model.logger.name_to_excluded[name] = tuple(excluded)
        model.logger.name_to_count[name] = count
