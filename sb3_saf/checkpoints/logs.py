"""Logs that go on where they were."""

from __future__ import annotations

import os

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat, configure
from torch.utils.tensorboard import SummaryWriter

from sb3_saf.checkpoints.data import Tree


class _ContinuedTensorBoard(TensorBoardOutputFormat):
    """
    More events for a run: those of steps after the checkpoint, which come again, are hidden by TensorBoard.

    :param folder: of the run
    :param last_step: of the checkpoint
    """

    def __init__(self, folder: str, last_step: int) -> None:
        self.writer = SummaryWriter(log_dir=folder, purge_step=last_step + 1)
        self._is_closed = False


def logger_state(logger: Logger) -> Tree:
    """Where the logs are, and the numbers that were recorded and not written yet."""
    numbers = {
        name: value for name, value in logger.name_to_value.items() if isinstance(value, (int, float, np.number))
    }
    return {
        "folder": logger.get_dir(),
        "tensorboard": any(isinstance(output, TensorBoardOutputFormat) for output in logger.output_formats),
        "numbers": [[name, value, logger.name_to_excluded[name] or ()] for name, value in numbers.items()],
        "counts": {name: logger.name_to_count[name] for name in numbers},
    }


def continue_logs(model: BaseAlgorithm, state: Tree) -> None:
    """Give the model a logger that goes on in the same folder; one that the caller has set stays."""
    if not model._custom_logger:
        model.set_logger(_continued_logger(model, state))
    for name, value, excluded in state["numbers"]:
        model.logger.name_to_value[name] = value
        model.logger.name_to_excluded[name] = excluded
        model.logger.name_to_count[name] = state["counts"][name]


def _continued_logger(model: BaseAlgorithm, state: Tree) -> Logger:
    formats = ["stdout"] if model.verbose >= 1 else [""]
    if not state["tensorboard"] or model.tensorboard_log is None:
        return configure(None, formats)
    # Below the model's folder, which may have been moved since.
    folder = os.path.join(model.tensorboard_log, os.path.basename(state["folder"]))
    logger = configure(folder, formats)
    logger.output_formats.append(_ContinuedTensorBoard(folder, model.num_timesteps))
    return logger
