"""Going on from a checkpoint."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_saf.checkpoints.callback import TeamCheckpointCallback, enter_run
from sb3_saf.checkpoints.callbacks import all_callbacks, load_callback_states
from sb3_saf.checkpoints.data import Tree
from sb3_saf.checkpoints.environments import load_environment_state
from sb3_saf.checkpoints.errors import CheckpointError
from sb3_saf.checkpoints.generators import load_generator_states
from sb3_saf.checkpoints.logs import continue_logs
from sb3_saf.checkpoints.models import check_description, load_model_state
from sb3_saf.checkpoints.software import warn_of_differences
from sb3_saf.checkpoints.store import CheckpointFolder


def resume(
    folder: str | os.PathLike[str],
    model: OnPolicyAlgorithm,
    callback: BaseCallback | Sequence[BaseCallback] | None = None,
) -> Path:
    """
    Load the newest good checkpoint into a model, its environment and its callbacks.

    They are made by the caller as for the first start, so nothing is unpickled. Then
    ``model.learn(total_timesteps - model.num_timesteps, callback, reset_num_timesteps=False)`` goes on, with the
    ``total_timesteps`` of the first start: schedules depend on it. Do nothing in between that draws random numbers.

    :param folder: of a TeamCheckpointCallback
    :param model: made as for the first start, with its environment
    :param callback: all callbacks, in the order of the first start; a TeamCheckpointCallback among them is left out
    :return: the file that was loaded
    :raises CheckpointError: if there is no good checkpoint, or model, environment or callbacks differ from those of the
        first start, naming the first difference
    """
    loaded = CheckpointFolder(folder).newest()
    if loaded is None:
        raise CheckpointError(f"expected checkpoints of sb3_saf.TeamCheckpointCallback in {folder}, found none")
    tree = loaded.tree
    check_description(model, tree["description"])
    warn_of_differences(tree["software"])
    others = [one for one in all_callbacks(callback) if not isinstance(one, TeamCheckpointCallback)]
    if tree["callbacks"] is not None:
        load_callback_states(others, tree["callbacks"])
    load_model_state(model, tree["model"])
    _load_environment(model, tree["environment"])
    continue_logs(model, tree["logger"])
    enter_run(model, tree["run"])
    load_generator_states(tree["generators"], model.action_space)  # last: nothing of the above shall draw from them
    return loaded.path


def _load_environment(model: OnPolicyAlgorithm, state: Tree) -> None:
    assert model.env is not None
    if state is not None:
        load_environment_state(model.env, state)
        return
    # Other games than the first ones: those were played already.
    model.env.seed(int(np.random.SeedSequence([model.seed or 0, model.num_timesteps]).generate_state(1)[0]))
    model._last_obs = None


def resumable_learn(
    model: OnPolicyAlgorithm,
    total_timesteps: int,
    folder: str | os.PathLike[str],
    callback: BaseCallback | Sequence[BaseCallback] | None = None,
    *,
    every_game_steps: int = 100_000,
    keep: int = 3,
    exact: bool = True,
    **learn_arguments: Any,
) -> OnPolicyAlgorithm:
    """
    ``model.learn`` with checkpoints: started again after whatever ended it, the same script goes on where it was.

    Ctrl-C and SIGTERM write the last state between two rollouts before the process ends.

    :param model: made the same way at every start
    :param total_timesteps: agents' steps of the whole run, as SB3 counts them
    :param folder: for the checkpoints of this run
    :param callback: callbacks, made the same way at every start
    :param every_game_steps: see :class:`TeamCheckpointCallback`
    :param keep: see :class:`TeamCheckpointCallback`
    :param exact: see :class:`TeamCheckpointCallback`
    :param learn_arguments: of ``model.learn``
    :return: the model
    :raises CheckpointError: see :func:`resume`; also if another run is at work in the folder
    """
    others = list(all_callbacks(callback))
    given = [] if callback is None else [callback] if isinstance(callback, BaseCallback) else list(callback)
    checkpoints = TeamCheckpointCallback(folder, every_game_steps, keep, others, exact, verbose=model.verbose)
    checkpoints.store.acquire()
    try:
        if checkpoints.store.checkpoints():
            path = resume(folder, model, given)
            if model.verbose >= 1:
                print(f"Going on from {path}")
            learn_arguments["reset_num_timesteps"] = False
            total_timesteps -= model.num_timesteps
        with _saved_on_interrupt(checkpoints):
            model.learn(total_timesteps, [checkpoints, *given], **learn_arguments)
    finally:
        checkpoints.store.release()
    return model


@contextmanager
def _saved_on_interrupt(checkpoints: TeamCheckpointCallback) -> Iterator[None]:
    with _sigterm_raises():
        try:
            yield
        except (KeyboardInterrupt, SystemExit):
            checkpoints.write_last()
            newest = checkpoints.store.checkpoints()
            if newest:
                print(f"\nStopped. {newest[0]} is saved; start the same command again to go on from there.", flush=True)
            raise


def _stop(number: int, frame: FrameType | None) -> NoReturn:
    raise SystemExit(128 + number)


@contextmanager
def _sigterm_raises() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():  # only there may handlers be set
        yield
        return
    before = signal.signal(signal.SIGTERM, _stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
