"""
State of an SB3 algorithm between two rollouts: the model, its logger, and the random generators of the process.

SB3 has no public interface to set most of it: its ``load`` sets the attributes from an unpickled file, and ``save``
omits some. Only this module reads and sets them.
"""

from __future__ import annotations

import os
import random
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat, configure
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_saf.buffers.replay import TeamReplayBuffer
from sb3_saf.callbacks.game_steps import game_steps
from sb3_saf.checkpoints.states import constructor_arguments
from sb3_saf.policies.memory import RememberingPolicy
from sb3_saf.qplex.qplex import QPLEX
from sb3_saf.teams.errors import CheckpointError
from sb3_saf.teams.trees import Tree

_COUNTERS: Final = (
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
        "counters": {name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)},
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
    for name in _COUNTERS:
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
        if state["tensorboard"] is None or model.tensorboard_log is None:
            model.set_logger(configure(None, formats))
        else:
            from tensorboard.compat.proto.event_pb2 import Event, SessionLog

            folder = os.path.join(model.tensorboard_log, os.path.basename(state["tensorboard"]))
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
