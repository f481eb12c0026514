"""The folder of checkpoints, the callback that writes them, and resuming from them."""

from __future__ import annotations

import os
import re
import signal
import threading
import uuid
import warnings
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import zip_longest
from pathlib import Path
from types import FrameType
from typing import Any, BinaryIO, Final, NamedTuple, NoReturn

import filelock
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_saf.callbacks import FiniteCallback, GameStepsCallback, show_game_steps, team_steps
from sb3_saf.checkpoints.states import (
    all_callbacks,
    callback_states,
    continue_logs,
    description,
    environment_state,
    generator_states,
    is_off_policy,
    load_callback_states,
    load_environment_state,
    load_generator_states,
    load_model_state,
    logger_state,
    model_state,
    require_resumable,
    settings_restored_on_error,
    software,
)
from sb3_saf.envs.game_copies import ForeignGamesError, check_signatures, pickled_games, sign_games
from sb3_saf.teams.checks import (
    CheckpointError,
    DamagedCheckpointError,
    NonFiniteError,
    check_count,
    check_hears_rollouts,
)
from sb3_saf.teams.files import (
    Tree,
    atomic_file,
    differences,
    encode,
    read_tree,
    remove_leftovers,
    try_lock,
    write_tree,
)
from sb3_saf.teams.vec_env import require_n_agents


class Loaded(NamedTuple):
    """A checkpoint that was read."""

    path: Path
    tree: Tree


class CheckpointFolder:
    """
    Checkpoints of one run, named by their game steps.

    :param path: the folder, created at the first write
    :param keep: number of newest checkpoints to keep
    """

    def __init__(self, path: str | os.PathLike[str], keep: int = 3) -> None:
        self.path = Path(path)
        self.keep = keep
        self._lock: filelock.BaseFileLock | None = None

    def checkpoints(self) -> list[Path]:
        """Return the files of all checkpoints, newest first."""
        return sorted(self.path.glob(f"checkpoint-{12 * '[0-9]'}.ckpt"), reverse=True)

    def write(self, content: Callable[[BinaryIO], object], game_steps: int) -> Path:
        """
        Add a checkpoint, then remove all but the newest ``keep``.

        A run killed here leaves the previous checkpoints and perhaps a temporary file, which the next write removes.

        :param game_steps: game steps, for the file's name
        :raises CheckpointError: if it cannot be written, for instance because the disk is full
        """
        target = self.path / f"checkpoint-{game_steps:012d}.ckpt"
        try:
            remove_leftovers(self.path)
            with atomic_file(target) as file:
                content(file)
        except OSError as error:
            older = self.checkpoints()
            last = f"the last good one is {older[0]}" if older else "there is no earlier one"
            raise CheckpointError(
                f"cannot write the checkpoint {target}: {error}; {last}. Make room or choose another "
                "folder, then resume"
            ) from error
        # Newer ones are damaged, otherwise this run would have resumed from them.
        older = [path for path in self.checkpoints() if path.name <= target.name]
        for path in older[self.keep :]:
            path.unlink(missing_ok=True)
        return target

    def newest(self) -> Loaded | None:
        """
        Read the newest undamaged checkpoint, with a warning for each newer one.

        :return: None if there is no checkpoint
        :raises CheckpointError: if all are damaged, or the newest undamaged one has another format
        """
        paths = self.checkpoints()
        for path, older in zip_longest(paths, paths[1:]):
            try:
                with path.open("rb") as file:
                    return Loaded(path, read_tree(file))
            except (DamagedCheckpointError, OSError) as error:
                if older is None:
                    raise DamagedCheckpointError(
                        f"no checkpoint in {self.path} can be read; the last one tried, {path}: {error}"
                    ) from error
                warnings.warn(
                    f"the checkpoint {path} cannot be read: {error}. Going back to {older}", UserWarning, stacklevel=2
                )
            except CheckpointError as error:
                raise CheckpointError(f"cannot use the checkpoint {path}: {error}") from None
        return None

    def acquire(self) -> None:
        """
        Lock the folder until :meth:`release` or the end of this process.

        :raises CheckpointError: if the folder cannot be created, or another run uses it
        """
        if self._lock is not None:
            return
        try:
            self._lock = try_lock(self.path / "lock")
        except OSError as error:
            raise CheckpointError(
                f"cannot keep checkpoints in {self.path}: {error}; give the run a folder that it may write to"
            ) from error
        if self._lock is None:
            raise CheckpointError(
                f"another run writes checkpoints to {self.path}; wait for its end, or give this run a folder of its own"
            )

    def release(self) -> None:
        """Unlock the folder."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None


#: Of each model in training, what all checkpoints of its run have in common: ``run``, a name, so that no other run
#: continues in the folder, and ``description``, of model, games and callbacks at the first start.
_RUNS: weakref.WeakKeyDictionary[BaseAlgorithm, dict[str, Tree]] = weakref.WeakKeyDictionary()


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
        self._between_rollouts = False
        self._last: tuple[int, bytes] | None = None
        self._written: int | None = None
        self._stop: Callable[[], NoReturn] | None = None
        #: Whether the folder is free after the training's end, before other callbacks have ended.
        self._releases = True

    def _init_callback(self) -> None:
        check_hears_rollouts(self)
        require_resumable(self.model)
        require_n_agents(self.training_env)
        show_game_steps(self.model)
        self.store.acquire()
        if self.model not in _RUNS:
            _RUNS[self.model] = {"run": uuid.uuid4().hex, "description": description(self.model, self.others)}
        newest = self.store.newest()
        if newest is not None and newest.tree["run"] != _RUNS[self.model]["run"]:
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
                f"{str(error).partition(';')[0]}. If this run is interrupted, it goes on from its last checkpoint and "
                "begins new episodes"
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
        if self._releases:
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
            **_RUNS[self.model],
            "game_steps": team_steps(self.model),
            "software": software(self.model),
            "model": model_state(self.model),
            "environment": environment_state(self.training_env, bool(self.exact)),
            "callbacks": callback_states(self.others, bool(self.exact)),
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
    if different := differences(tree["description"], description(model, others)):
        raise CheckpointError(
            f"the checkpoint is of another run: {different}; make model, games and callbacks as for the first start, "
            "or give this run a folder of its own"
        )
    environments = [tree["environment"], *(one["eval_env"] for one in tree["callbacks"] if one["eval_env"])]
    if exact and any(None in states for states in environments):
        raise CheckpointError(f"expected the state of the games with exact=True, got {loaded.path} without it")
    if trust_games:
        sign_games(environments)
    try:
        check_signatures(environments)
    except ForeignGamesError as error:
        if exact:
            raise
        warnings.warn(f"{error}. New episodes begin; everything else continues", UserWarning, stacklevel=2)
        for states in environments:
            states[:] = [None if any(pickled_games(state)) else state for state in states]
    if different := differences(tree["software"], software(model)):
        warnings.warn(
            f"the checkpoint was made under other conditions ({different}): the run goes on, but its weights may "
            "differ from those of the undisturbed run",
            UserWarning,
            stacklevel=2,
        )
    try:
        load_model_state(model, tree["model"])
        begins_anew = None in tree["environment"]
        if begins_anew:  # not with the seeds of the first start, whose games were played already
            env.seed(int(np.random.SeedSequence([model.seed or 0, model.num_timesteps]).generate_state(1)[0]))
            model._last_obs = None
        load_callback_states(others, tree["callbacks"])
        load_environment_state(env, tree["environment"])
        continue_logs(model, tree["logger"])
        _RUNS[model] = {name: tree[name] for name in ("run", "description")}
        load_generator_states(tree["generators"], model)  # last: the calls above may draw from them
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        reason = f"it lacks {error}" if isinstance(error, KeyError) else error
        raise CheckpointError(f"the checkpoint {loaded.path} does not fit: {reason}; make a new model") from error
    message = "new episodes begin" if begins_anew else "the games go on where they were, bit for bit"
    if any(pickled_games(environments)):
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
    :param again: advice in the message after Ctrl-C and SIGTERM
    :param learn_arguments: further arguments of ``model.learn``
    :return: the model
    :raises CheckpointError: see :func:`resume`; also if another run uses the folder
    :raises ValueError: for ``reset_num_timesteps=False``
    :raises NonFiniteError: at NaN or infinity, naming the step, the tensor, and the last valid checkpoint
    """
    if not learn_arguments.pop("reset_num_timesteps", True):
        raise ValueError(
            "leave out reset_num_timesteps: total_timesteps counts the whole run, which begins at 0 also with a "
            "trained model"
        )
    given = [] if callback is None else [callback] if isinstance(callback, BaseCallback) else list(callback)
    checkpoints = TeamCheckpointCallback(folder, every_game_steps, keep, given, exact, verbose=model.verbose)
    checkpoints.store.acquire()
    checkpoints._releases = False
    try:
        if checkpoints.store.checkpoints():
            path = resume(folder, model, given, exact=exact, trust_games=trust_games)
            if model.verbose >= 1:
                print(f"Going on from {path}")
            learn_arguments["reset_num_timesteps"] = False
            total_timesteps -= model.num_timesteps
        with settings_restored_on_error(model), _saved_on_interrupt(checkpoints, is_off_policy(model), again):
            # The check is first, so that data are checked before they are written.
            model.learn(
                total_timesteps, [FiniteCallback(), GameStepsCallback(), checkpoints, *given], **learn_arguments
            )
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

    def stop(number: int) -> NoReturn:
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + number)

    def handle(number: int, frame: FrameType | None) -> None:
        if not at_rollout or checkpoints._stop is not None:
            stop(number)
        checkpoints.stop_soon(partial(stop, number))

    def newest() -> Path | None:
        checkpoints.write_last()  # the state before this rollout
        return next(iter(checkpoints.store.checkpoints()), None)

    with handled({signal.SIGTERM, signal.SIGINT} if at_rollout else {signal.SIGTERM}, handle):
        try:
            yield
            if checkpoints._stop is not None:  # heard after the start of the last rollout
                checkpoints._stop()
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
