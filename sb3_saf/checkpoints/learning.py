"""Resuming from a checkpoint."""

from __future__ import annotations

import os
import re
import signal
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, Final, NoReturn

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_saf.callbacks.finite import FiniteCallback
from sb3_saf.callbacks.game_steps import GameStepsCallback
from sb3_saf.checkpoints.callback import Run, TeamCheckpointCallback, enter_run
from sb3_saf.checkpoints.models import (
    continue_logs,
    is_off_policy,
    load_generator_states,
    load_model_state,
    require_resumable,
    settings_restored_on_error,
)
from sb3_saf.checkpoints.runs import check_description, description, software, warn_of_differences
from sb3_saf.checkpoints.states import all_callbacks, load_callback_states, load_environment_state
from sb3_saf.checkpoints.store import CheckpointFolder
from sb3_saf.envs.game_copies import ForeignGamesError, check_signatures, pickled_games, sign_games
from sb3_saf.teams.errors import CheckpointError, NonFiniteError

#: Torch's error message for action distributions with NaN parameters.
_OF_TORCH: Final = re.compile(r"Expected parameter \w+ .*invalid values", re.DOTALL)


def resume(
    folder: str | os.PathLike[str],
    model: BaseAlgorithm,
    callback: BaseCallback | Sequence[BaseCallback] | None = None,
    *,
    exact: bool | None = None,
    trust_games: bool = False,
) -> Path:
    """
    Load the newest valid checkpoint into a model, its environment and its callbacks.

    These are made by the caller as for the first start, so nothing is unpickled but games with this user's signature.
    The description in the checkpoint is compared with theirs before they are modified. Afterwards
    ``model.learn(total_timesteps - model.num_timesteps, callback, reset_num_timesteps=False)`` continues, with the
    ``total_timesteps`` of the first start, on which schedules depend. Draw no random numbers in between.

    :param folder: folder of a TeamCheckpointCallback
    :param model: made as for the first start, with its environment
    :param callback: all callbacks, in the order of the first start; a TeamCheckpointCallback among them is ignored
    :param exact: True raises CheckpointError if the checkpoint lacks the games' state; otherwise they begin new
        episodes, with a warning
    :param trust_games: whether to unpickle games without this user's signature: **this runs code from the file**
    :return: the file that was loaded
    :raises CheckpointError: if there is no valid checkpoint, or model, environment, callbacks or seeds differ from
        those of the first start, naming the first difference
    """
    require_resumable(model)
    env = model.get_env()
    assert env is not None
    loaded = CheckpointFolder(folder).newest()
    if loaded is None:
        raise CheckpointError(f"expected checkpoints of sb3_saf.TeamCheckpointCallback in {folder}, found none")
    others = [one for one in all_callbacks(callback) if not isinstance(one, TeamCheckpointCallback)]
    tree = loaded.tree
    check_description(tree["description"], description(model, others))
    if exact and tree["environment"] is None:
        raise CheckpointError(f"expected the state of the games with exact=True, got {loaded.path} without it")
    games = [tree["environment"], tree["callbacks"]]
    if trust_games:
        sign_games(games)
    try:
        check_signatures(games)
    except ForeignGamesError as error:
        if exact:
            raise
        warnings.warn(f"{error}. New episodes begin; everything else continues", UserWarning, stacklevel=2)
        tree = {**tree, "environment": None, "callbacks": None}
    warn_of_differences(tree["software"], software(model))
    try:
        load_model_state(model, tree["model"])
        if tree["environment"] is not None:
            load_callback_states(others, tree["callbacks"])
            load_environment_state(env, tree["environment"])
        else:
            # Not the seeds of the first start, whose games were played already.
            env.seed(int(np.random.SeedSequence([model.seed or 0, model.num_timesteps]).generate_state(1)[0]))
            model._last_obs = None
        continue_logs(model, tree["logger"])
        enter_run(model, Run(tree["run"], tree["description"]))
        load_generator_states(tree["generators"], model)  # last: the calls above may draw from them
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        reason = f"it lacks {error}" if isinstance(error, KeyError) else error
        raise CheckpointError(f"the checkpoint {loaded.path} does not fit: {reason}; make a new model") from error
    message = "new episodes begin" if tree["environment"] is None else "the games go on where they were, bit for bit"
    if any(pickled_games([tree["environment"], tree["callbacks"]])):
        message += "; they were unpickled from it, as this user signed them"
    model.logger.log(f"Resumed from {loaded.path}: {message}")
    return loaded.path


def resumable_learn(
    model: BaseAlgorithm,
    total_timesteps: int,
    folder: str | os.PathLike[str],
    callback: BaseCallback | Sequence[BaseCallback] | None = None,
    *,
    every_game_steps: int = 100_000,
    keep: int = 3,
    exact: bool | None = None,
    trust_games: bool = False,
    finite: bool = True,
    again: str = "start the same command again to go on from there",
    **learn_arguments: Any,
) -> BaseAlgorithm:
    """
    Call ``model.learn`` with checkpoints: after an interruption, the same script continues the run.

    On Ctrl-C and SIGTERM the last state between two rollouts is written before the process ends; also on NaN or
    infinity in observations, rewards, losses or gradients, which ends training.

    :param model: made the same way at every start
    :param total_timesteps: agent steps of the whole run, as SB3 counts them
    :param folder: folder for the checkpoints of this run
    :param callback: callbacks, made the same way at every start
    :param every_game_steps: see :class:`TeamCheckpointCallback`
    :param keep: see :class:`TeamCheckpointCallback`
    :param exact: see :class:`TeamCheckpointCallback`
    :param trust_games: see :func:`resume`
    :param finite: whether to check for NaN and infinity, see :class:`~sb3_saf.FiniteCallback`
    :param again: advice in the message after Ctrl-C and SIGTERM
    :param learn_arguments: further arguments of ``model.learn``
    :return: the model
    :raises CheckpointError: see :func:`resume`; also if another run uses the folder
    :raises NonFiniteError: at NaN or infinity, naming the step, the tensor, and the last valid checkpoint
    """
    others = list(all_callbacks(callback))
    given = [] if callback is None else [callback] if isinstance(callback, BaseCallback) else list(callback)
    checkpoints = TeamCheckpointCallback(folder, every_game_steps, keep, others, exact, verbose=model.verbose)
    # First, so that data are checked before they are written.
    before: list[BaseCallback] = [FiniteCallback(), GameStepsCallback()] if finite else [GameStepsCallback()]
    checkpoints.store.acquire()
    try:
        if checkpoints.store.checkpoints():
            path = resume(folder, model, given, exact=exact, trust_games=trust_games)
            if model.verbose >= 1:
                print(f"Going on from {path}")
            learn_arguments["reset_num_timesteps"] = False
            total_timesteps -= model.num_timesteps
        with settings_restored_on_error(model), _saved_on_interrupt(checkpoints, is_off_policy(model), again):
            model.learn(total_timesteps, [*before, checkpoints, *given], **learn_arguments)
    finally:
        checkpoints.store.release()
    return model


@contextmanager
def _saved_on_interrupt(checkpoints: TeamCheckpointCallback, at_rollout: bool, again: str) -> Iterator[None]:
    """
    Save when training is interrupted.

    :param at_rollout: whether the first signal stops it only at the start of the next rollout, where its state can be
        copied; a second one always stops it now
    """
    waits = at_rollout

    def stop(number: int) -> NoReturn:
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + number)

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal waits
        if not waits:
            stop(number)
        waits = False
        checkpoints.stop_soon(partial(stop, number))

    def newest() -> Path | None:
        checkpoints.write_last()  # the state before this rollout
        return next(iter(checkpoints.store.checkpoints()), None)

    with handled({signal.SIGTERM, signal.SIGINT} if at_rollout else {signal.SIGTERM}, handle):
        try:
            yield
        except (KeyboardInterrupt, SystemExit):
            if path := newest():
                print(f"\nStopped. {path} is saved; {again}", flush=True)
            raise
        except ValueError as error:
            if not isinstance(error, NonFiniteError) and not _OF_TORCH.match(str(error)):
                raise
            last = f"the last good checkpoint is {path}" if (path := newest()) else "there is no checkpoint yet"
            what = str(error).partition("\n")[0].rstrip(":")
            raise NonFiniteError(f"{what}; {last}") from error


@contextmanager
def handled(numbers: Iterable[signal.Signals], handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Set a handler of signals; none outside of the main thread."""
    if threading.current_thread() is not threading.main_thread():  # only it may set handlers
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, kept in before.items():
            signal.signal(number, kept)
