"""Going on from a checkpoint."""

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
from sb3_saf.checkpoints.callback import Run, TeamCheckpointCallback, enter_run, newest_checkpoint
from sb3_saf.checkpoints.callback_states import all_callbacks, check_callback_states, load_callback_states
from sb3_saf.checkpoints.checks import refused
from sb3_saf.checkpoints.data import Tree
from sb3_saf.checkpoints.environments import check_environment_state, load_environment_state
from sb3_saf.checkpoints.generators import check_generator_states, load_generator_states
from sb3_saf.checkpoints.logs import check_logger_state, continue_logs
from sb3_saf.checkpoints.models import check_model_state, is_off_policy, load_model_state, require_resumable
from sb3_saf.checkpoints.runs import check_descriptions, check_software, warn_of_differences
from sb3_saf.checkpoints.store import CheckpointFolder
from sb3_saf.envs.game_copies import ForeignGamesError, pickled_games, sign_games
from sb3_saf.envs.teams import require_n_agents
from sb3_saf.errors import CheckpointError, NonFiniteError

#: Torch's own words for distributions of actions that weights too large have made of NaN.
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
    Load the newest good checkpoint into a model, its environment and its callbacks.

    They are made by the caller as for the first start, so nothing is unpickled. The checkpoint is compared with them,
    and checked, before anything is touched. Then
    ``model.learn(total_timesteps - model.num_timesteps, callback, reset_num_timesteps=False)`` goes on, with the
    ``total_timesteps`` of the first start: schedules depend on it. Do nothing in between that draws random numbers.

    :param folder: of a TeamCheckpointCallback
    :param model: made as for the first start, with its environment
    :param callback: all callbacks, in the order of the first start; a TeamCheckpointCallback among them is left out
    :param exact: True refuses a checkpoint whose games cannot go on; else they begin new episodes, with a warning
    :param trust_games: whether to unpickle games that this user has not written: **this runs code from the file**
    :return: the file that was loaded
    :raises CheckpointError: if there is no good checkpoint, or model, environment, callbacks or seeds differ from those
        of the first start, naming the first difference
    """
    require_resumable(model)
    loaded = newest_checkpoint(CheckpointFolder(folder))
    if loaded is None:
        raise CheckpointError(f"expected checkpoints of sb3_saf.TeamCheckpointCallback in {folder}, found none")
    others = [one for one in all_callbacks(callback) if not isinstance(one, TeamCheckpointCallback)]
    tree = loaded.tree
    if trust_games:
        sign_games([tree["environment"], tree["callbacks"]])
    try:
        _check(model, others, tree)
    except ForeignGamesError as error:
        if exact:
            raise
        warnings.warn(f"{error}. Now new episodes begin; all else goes on", UserWarning, stacklevel=2)
        tree = {**tree, "environment": None, "callbacks": None}
        _check(model, others, tree)
    warn_of_differences(tree["software"])
    _load(model, others, tree)
    games = "new episodes begin" if tree["environment"] is None else "the games go on where they were, bit for bit"
    if any(pickled_games([tree["environment"], tree["callbacks"]])):
        games += "; they were unpickled from it, as this user signed them"
    model.logger.log(f"Resumed from {loaded.path}: {games}")
    return loaded.path


def _check(model: BaseAlgorithm, others: Sequence[BaseCallback], tree: Tree) -> None:
    """Check everything before anything is touched; a CheckpointError names the first difference."""
    assert model.env is not None
    check_descriptions(model, others, tree["description"], tree["callback_descriptions"])
    check_software(tree["software"])
    check_model_state(model, tree["model"])
    if tree["model"]["counters"]["num_timesteps"] != tree["game_steps"] * require_n_agents(model.env):
        raise refused("num_timesteps", "those of the game steps", tree["model"]["counters"]["num_timesteps"])
    if tree["environment"] is not None:
        check_environment_state(model.env, tree["environment"])
        check_callback_states(others, tree["callbacks"])
    check_generator_states(tree["generators"], model.action_space)
    check_logger_state(tree["logger"])


def _load(model: BaseAlgorithm, others: Sequence[BaseCallback], tree: Tree) -> None:
    assert model.env is not None
    load_model_state(model, tree["model"])
    if tree["environment"] is not None:
        load_callback_states(others, tree["callbacks"])
        load_environment_state(model.env, tree["environment"])
    else:
        # Other games than the first ones: those were played already.
        model.env.seed(int(np.random.SeedSequence([model.seed or 0, model.num_timesteps]).generate_state(1)[0]))
        model._last_obs = None
    continue_logs(model, tree["logger"])
    enter_run(model, Run(tree["run"], tree["description"]))
    load_generator_states(tree["generators"], model.action_space)  # last: nothing of the above shall draw from them


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
    ``model.learn`` with checkpoints: started again after whatever ended it, the same script goes on where it was.

    Ctrl-C and SIGTERM write the last state between two rollouts before the process ends. So does NaN or infinity in
    observations, rewards, losses or gradients, which ends training.

    :param model: made the same way at every start
    :param total_timesteps: agents' steps of the whole run, as SB3 counts them
    :param folder: for the checkpoints of this run
    :param callback: callbacks, made the same way at every start
    :param every_game_steps: see :class:`TeamCheckpointCallback`
    :param keep: see :class:`TeamCheckpointCallback`
    :param exact: see :class:`TeamCheckpointCallback`
    :param trust_games: see :func:`resume`
    :param finite: whether to look for NaN and infinity, see :class:`~sb3_saf.FiniteCallback`
    :param again: what a message after Ctrl-C and SIGTERM tells to do
    :param learn_arguments: of ``model.learn``
    :return: the model
    :raises CheckpointError: see :func:`resume`; also if another run is at work in the folder
    :raises NonFiniteError: at NaN or infinity, naming the step, what it is in, and the last good checkpoint
    """
    others = list(all_callbacks(callback))
    given = [] if callback is None else [callback] if isinstance(callback, BaseCallback) else list(callback)
    checkpoints = TeamCheckpointCallback(folder, every_game_steps, keep, others, exact, verbose=model.verbose)
    # First: what is written has been looked at.
    before: list[BaseCallback] = [FiniteCallback(), GameStepsCallback()] if finite else [GameStepsCallback()]
    checkpoints.store.acquire()
    try:
        if checkpoints.store.checkpoints():
            path = resume(folder, model, given, exact=exact, trust_games=trust_games)
            if model.verbose >= 1:
                print(f"Going on from {path}")
            learn_arguments["reset_num_timesteps"] = False
            total_timesteps -= model.num_timesteps
        with _saved_on_interrupt(checkpoints, is_off_policy(model), again):
            model.learn(total_timesteps, [*before, checkpoints, *given], **learn_arguments)
    finally:
        checkpoints.store.release()
    return model


@contextmanager
def _saved_on_interrupt(checkpoints: TeamCheckpointCallback, at_rollout: bool, again: str) -> Iterator[None]:
    """
    Save when something stops training.

    :param at_rollout: signals stop it at the start of the next rollout only, where its state can be taken
    :param again: how to go on
    """
    signals = {signal.SIGTERM, signal.SIGINT} if at_rollout else {signal.SIGTERM}
    with _handled(signals, _stopper(checkpoints, at_rollout)):
        try:
            yield
        except (KeyboardInterrupt, SystemExit):
            checkpoints.write_last()
            newest = checkpoints.store.checkpoints()
            if newest:
                print(f"\nStopped. {newest[0]} is saved; {again}", flush=True)
            raise
        except ValueError as error:
            if not isinstance(error, NonFiniteError) and not _OF_TORCH.match(str(error)):
                raise
            checkpoints.write_last()  # of before this rollout
            newest = checkpoints.store.checkpoints()
            last = f"the last good checkpoint is {newest[0]}" if newest else "there is no checkpoint yet"
            what = str(error).partition("\n")[0].rstrip(":")
            raise NonFiniteError(f"{what}; {last}") from error


def _stopper(checkpoints: TeamCheckpointCallback, at_rollout: bool) -> Callable[[int, FrameType | None], None]:
    """Return what a signal does: it stops at once or at the start of the next rollout; the second one at once."""
    waits = at_rollout

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal waits
        if not waits:
            _stop(number)
        waits = False
        checkpoints.stop_soon(partial(_stop, number))

    return handle


def _stop(number: int) -> NoReturn:
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise SystemExit(128 + number)


@contextmanager
def _handled(numbers: Iterable[signal.Signals], handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():  # only there may handlers be set
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, kept in before.items():
            signal.signal(number, kept)
