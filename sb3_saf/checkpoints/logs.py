"""Continuation of logs on resuming."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat, configure

from sb3_saf.callbacks.game_steps import game_steps
from sb3_saf.teams.trees import Tree


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
        model.set_logger(_continued_logger(model, state["tensorboard"]))
    for name, value, excluded, count in state["numbers"]:
        model.logger.name_to_value[name] = value
        model.logger.name_to_excluded[name] = tuple(excluded)
        model.logger.name_to_count[name] = count


def _continued_logger(model: BaseAlgorithm, name: str | None) -> Logger:
    from tensorboard.compat.proto.event_pb2 import Event, SessionLog

    formats = ["stdout"] if model.verbose >= 1 else [""]
    if name is None or model.tensorboard_log is None:
        return configure(None, formats)
    folder = os.path.join(model.tensorboard_log, os.path.basename(name))
    logger = configure(folder, formats)
    board = TensorBoardOutputFormat(folder)
    # TensorBoard hides entries written after the checkpoint, which are written again.
    start = SessionLog(status=SessionLog.START)
    file_writer: Any = board.writer.file_writer
    file_writer.add_event(Event(step=(game_steps(model) or 0) + 1, session_log=start))
    logger.output_formats.append(board)
    return logger
