"""Callback that writes checkpoints."""

from __future__ import annotations

import os
import uuid
import warnings
import weakref
from collections.abc import Callable, Sequence
from typing import BinaryIO, NamedTuple, NoReturn

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_saf.callbacks.game_steps import show_game_steps, team_steps
from sb3_saf.checkpoints.models import (
    generator_states,
    is_off_policy,
    logger_state,
    model_state,
    require_resumable,
)
from sb3_saf.checkpoints.runs import description, software
from sb3_saf.checkpoints.states import all_callbacks, callback_states, environment_state
from sb3_saf.checkpoints.store import CheckpointFolder
from sb3_saf.teams.checks import check_count
from sb3_saf.teams.errors import CheckpointError
from sb3_saf.teams.trees import Tree, encode, write_tree
from sb3_saf.teams.vec_env import require_n_agents


class Run(NamedTuple):
    """
    Run of a model.

    :param name: stored in every checkpoint, so that no other run continues in the folder
    :param description: of model, games and callbacks at the first start
    """

    name: str
    description: dict[str, Tree]


_RUNS: weakref.WeakKeyDictionary[BaseAlgorithm, Run] = weakref.WeakKeyDictionary()


def enter_run(model: BaseAlgorithm, run: Run) -> None:
    """Set the run that a model continues."""
    _RUNS[model] = run


class TeamCheckpointCallback(BaseCallback):
    """
    Write checkpoints from which :func:`sb3_saf.resume` continues exactly.

    The state is copied at the start of a rollout, after the previous update and with an empty buffer, and kept in
    memory, from where :meth:`write_last` writes it to disk. A checkpoint is also written at the end of training.

    A rollout of QPLEX is one step of all games, and the replay buffer is too large to copy at every step. Its state is
    therefore written directly to disk; use :meth:`stop_soon` to stop such a run.

    Pass it before other callbacks, because what these do at the start of a rollout is repeated on resuming.

    :param folder: folder for the checkpoints of this run only
    :param every_game_steps: **game steps**, summed over all parallel games, between checkpoints, which are written at
        the next start of a rollout
    :param keep: number of newest checkpoints to keep
    :param others: all other callbacks of the run, whose state is included
    :param exact: None resumes exactly if the environment provides its state, and otherwise warns at the start: a
        resumed run then begins new episodes, and its weights differ from those of an uninterrupted run. True raises
        CheckpointError for such environments, False never stores their state
    :param verbose: 1 to print the files' names
    :raises ValueError: if a number is not at least 1
    """

    model: BaseAlgorithm

    def __init__(
        self,
        folder: str | os.PathLike[str],
        every_game_steps: int = 100_000,
        keep: int = 3,
        others: BaseCallback | Sequence[BaseCallback] | None = None,
        exact: bool | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        self.every_game_steps = check_count("every_game_steps", every_game_steps)
        self.store = CheckpointFolder(folder, check_count("keep", keep))
        self.others = list(all_callbacks(others))
        self.exact = exact
        self._run = Run("", {})
        self._between_rollouts = False
        self._last: tuple[int, bytes] | None = None
        self._written: int | None = None
        self._stop: Callable[[], NoReturn] | None = None

    def _init_callback(self) -> None:
        require_resumable(self.model)
        require_n_agents(self.training_env)
        show_game_steps(self.model)
        self.store.acquire()
        if self.model not in _RUNS:
            enter_run(self.model, Run(uuid.uuid4().hex, description(self.model, self.others)))
        self._run = _RUNS[self.model]
        newest = self.store.newest()
        if newest is not None and newest.tree["run"] != self._run.name:
            self.store.release()
            raise CheckpointError(
                f"{self.store.path} has checkpoints of another run ({newest.path.name}): go on with it by "
                "sb3_saf.resume(folder, model, callbacks), or give this run a folder of its own"
            )
        self._written = None if newest is None else newest.tree["game_steps"]
        if self.exact is not None:
            return
        self.exact = True
        try:
            environment_state(self.training_env)
            callback_states(self.others)
        except CheckpointError as error:
            self.exact = False
            message = (
                f"{str(error).partition(';')[0]}. If this run is interrupted, it goes on with the weights, optimiser "
                "and counters of its last checkpoint and begins new episodes"
            )
            warnings.warn(message, UserWarning, stacklevel=2)
            self.logger.log(message)

    def _on_rollout_start(self) -> None:
        self._between_rollouts = True  # until the first step
        is_due = self._written is None or team_steps(self.model) - self._written >= self.every_game_steps
        if is_due or self._stop is not None or not is_off_policy(self.model):
            self._take()
        if is_due:
            self.write_last()
        if self._stop is not None:
            self._stop()

    def _on_step(self) -> bool:
        self._between_rollouts = False
        return True

    def _on_rollout_end(self) -> None:
        self._between_rollouts = True  # at the end of training the last update is done

    def _on_training_end(self) -> None:
        if self._between_rollouts:
            self._take()
        self.write_last()
        self.store.release()

    def stop_soon(self, stop: Callable[[], NoReturn]) -> None:
        """
        End training before the next rollout, with its state available to :meth:`write_last`.

        :param stop: raises the exception that ends training
        """
        self._stop = stop

    def _take(self) -> None:
        """Copy the present state; with a replay buffer, to disk."""
        steps = team_steps(self.model)
        if not is_off_policy(self.model):
            self._last = (steps, encode(self._state()))
        elif steps != self._written:
            self._write(lambda file: write_tree(file, self._state()), steps)

    def _state(self) -> dict[str, Tree]:
        return {
            "run": self._run.name,
            "game_steps": team_steps(self.model),
            "software": software(self.model),
            "description": self._run.description,
            "model": model_state(self.model),
            "environment": environment_state(self.training_env) if self.exact else None,
            "callbacks": callback_states(self.others) if self.exact else None,
            "generators": generator_states(self.model),
            "logger": logger_state(self.model.logger),
        }

    def write_last(self) -> None:
        """Write the last state between rollouts, unless already written; raise CheckpointError if that fails."""
        if self._last is not None and self._last[0] != self._written:
            steps, data = self._last
            self._write(lambda file: file.write(data), steps)

    def _write(self, content: Callable[[BinaryIO], object], steps: int) -> None:
        path = self.store.write(content, steps)
        self._written = steps
        if self.verbose >= 1:
            print(f"Checkpoint {path}")
