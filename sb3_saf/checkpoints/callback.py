"""The callback that writes checkpoints."""

from __future__ import annotations

import os
import uuid
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_saf.callbacks.game_steps import game_steps
from sb3_saf.checkpoints.callbacks import all_callbacks, callback_states
from sb3_saf.checkpoints.data import Tree, encode
from sb3_saf.checkpoints.environments import environment_state
from sb3_saf.checkpoints.errors import CheckpointError
from sb3_saf.checkpoints.generators import generator_states
from sb3_saf.checkpoints.logs import logger_state
from sb3_saf.checkpoints.models import description, is_off_policy, model_state, require_resumable
from sb3_saf.checkpoints.software import software
from sb3_saf.checkpoints.store import CheckpointFolder
from sb3_saf.envs.teams import check_count, require_n_agents

#: The run that a model is in: its name is in every checkpoint, so that no other run goes on in the folder.
_RUNS: weakref.WeakKeyDictionary[BaseAlgorithm, str] = weakref.WeakKeyDictionary()


def enter_run(model: BaseAlgorithm, run: str) -> None:
    """Say that a model goes on with a run."""
    _RUNS[model] = run


class TeamCheckpointCallback(BaseCallback):
    """
    Write checkpoints from which :func:`sb3_saf.resume` goes on exactly.

    The state is taken at the start of a rollout: the update before is done, and the buffer is empty. The end of
    training writes one, too. Between them the last state waits in memory, which :meth:`write_last` puts on the disk.

    A rollout of QPLEX is one step of all games, and its state holds the replay buffer: a copy of it at every step would
    cost more than learning. So its state is taken only where it is written, and who wants to stop a run says so with
    :meth:`stop_soon`.

    Give it as the first of several callbacks, for what others do at the start of a rollout comes again on resuming.

    :param folder: for the checkpoints of this run alone
    :param every_game_steps: **game steps**, summed over all parallel games, between checkpoints. They are made at the
        first start of a rollout after that many
    :param keep: newest checkpoints to keep
    :param others: all other callbacks of the run, whose state goes along
    :param exact: False makes checkpoints of environments that cannot give their state, too: on resuming, they begin
        new episodes, and the weights will not be those of the undisturbed run
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
        exact: bool = True,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        self.every_game_steps = check_count("every_game_steps", every_game_steps)
        self.store = CheckpointFolder(folder, check_count("keep", keep))
        self.others = list(all_callbacks(others))
        self.exact = exact
        self._run = ""
        self._between_rollouts = False
        self._last: tuple[int, bytes] | None = None
        self._written: int | None = None
        self._stop: Callable[[], NoReturn] | None = None

    def _init_callback(self) -> None:
        require_resumable(self.model)
        require_n_agents(self.training_env)
        self.store.acquire()
        self._run = _RUNS.setdefault(self.model, uuid.uuid4().hex)
        newest = self.store.newest()
        if newest is not None and newest.tree["run"] != self._run:
            raise CheckpointError(
                f"{self.store.path} has checkpoints of another run ({newest.path.name}): go on with it by "
                "sb3_saf.resume(folder, model, callbacks), or give this run a folder of its own"
            )
        self._written = None if newest is None else newest.tree["game_steps"]

    def _on_rollout_start(self) -> None:
        self._between_rollouts = True  # until the first step
        is_due = self._written is None or self._game_steps() - self._written >= self.every_game_steps
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
        self._between_rollouts = True  # at the end of training the update is done as well

    def _on_training_end(self) -> None:
        if self._between_rollouts:
            self._take()
        self.write_last()
        self.store.release()

    def can_stop_at_once(self) -> bool:
        """Whether the last state between rollouts is at hand at any moment."""
        return not is_off_policy(self.model)

    def stop_soon(self, stop: Callable[[], NoReturn]) -> None:
        """
        End training before the next rollout, with the state of that moment at hand for :meth:`write_last`.

        :param stop: raises what shall end it
        """
        self._stop = stop

    def _game_steps(self) -> int:
        steps = game_steps(self.model)
        assert steps is not None, "_init_callback has checked that the environment is made of teams"
        return steps

    def _take(self) -> None:
        self._last = (self._game_steps(), encode(self._state(), software()["sb3_saf"]))

    def _state(self) -> Tree:
        return {
            "run": self._run,
            "game_steps": self._game_steps(),
            "software": software(),
            "description": description(self.model),
            "model": model_state(self.model),
            "environment": environment_state(self.training_env) if self.exact else None,
            "callbacks": callback_states(self.others) if self.exact else None,
            "generators": generator_states(self.model.action_space),
            "logger": logger_state(self.model.logger),
        }

    def write_last(self) -> Path | None:
        """
        Write the last state between rollouts, unless it is written already.

        :return: the file; None if there is nothing new
        :raises CheckpointError: if it cannot be written
        """
        if self._last is None or self._last[0] == self._written:
            return None
        steps, data = self._last
        path = self.store.write(data, steps)
        self._written = steps
        if is_off_policy(self.model):
            self._last = None  # memory for as much as the replay buffer
        if self.verbose >= 1:
            print(f"Checkpoint {path}")
        return path
