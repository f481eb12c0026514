"""Games in several processes: Stable-Baselines3's ``SubprocVecEnv`` over groups of games."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import time
import traceback
import weakref
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple, NoReturn

import cloudpickle
import gymnasium
from gymnasium import spaces
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_saf.envs.game_reader import GameReader
from sb3_saf.envs.supersuit_games import TeamConcatVecEnv

#: Time limit in seconds for a worker process to close its games.
CLOSE_TIMEOUT = 10.0


class Failure(NamedTuple):
    """An exception of a worker process."""

    error: BaseException
    trace: str


class GameProcess(gymnasium.Env[Any, Any]):
    """
    Group of games in a worker process, as one environment of a SubprocVecEnv.

    Only the method :meth:`run` is used: rows of a group do not fit into the scalar rewards and dones of an environment.
    Payloads are pickled by cloudpickle, which supports lambdas, and exceptions are returned, so that a game's error
    does not end the process.
    """

    observation_space = action_space = spaces.Discrete(1)

    def __init__(self, make_games: Callable[[], TeamConcatVecEnv]) -> None:
        self._make_games = make_games
        self._games: TeamConcatVecEnv | None = None
        for number in (signal.SIGINT, signal.SIGTERM):  # terminals and clusters signal all processes: the owner decides
            signal.signal(number, signal.SIG_IGN)
        threading.Thread(target=_end_with_owner, daemon=True).start()

    def run(self, payload: bytes) -> bytes:
        """Call a method of the games: pickled name and arguments to pickled result or :class:`Failure`."""
        try:
            if self._games is None:
                self._games = self._make_games()
            name, args = pickle.loads(payload)
            result = getattr(self._games, name)(*args)
        except (Exception, SystemExit) as error:
            return _packed_failure(error)
        try:
            return bytes(cloudpickle.dumps(result))
        except Exception as error:
            refusal = TypeError(
                f"this reply cannot leave its worker process ({error}), it is {result!r}; "
                "make it something that can be pickled, or use n_cpus=1"
            )
            return _packed_failure(refusal)


class WorkerGames:
    """
    Games in several processes.

    :param n_cpus: maximum number of processes, started with the default start method of :mod:`multiprocessing`
    """

    def __init__(self, make_game: Callable[[], Any], reader: GameReader, n_games: int, n_cpus: int) -> None:
        size = -(-n_games // n_cpus)
        self._groups = [range(first, min(first + size, n_games)) for first in range(0, n_games, size)]
        #: Why the processes have ended, None while they run.
        self.ended: str | None = None
        makes = [partial(TeamConcatVecEnv, make_game, reader, group, is_worker=True) for group in self._groups]
        self._venv = SubprocVecEnv(
            [partial(GameProcess, make) for make in makes], start_method=multiprocessing.get_start_method()
        )
        self._watch = _Watch(self._venv.processes, [_named(group) for group in self._groups])
        self._watch.start()
        # Runs at the interpreter's exit, or when the environment is garbage collected.
        self._finalizer = weakref.finalize(self, _close_workers, self._venv, os.getpid())
        self.run("ask", (), len)  # the first call makes the games

    def __reduce__(self) -> NoReturn:
        """Refuse copies and pickles, which would share the pipes of this object and end its processes."""
        raise TypeError(
            "games in worker processes cannot be copied or pickled: make another environment in the same way, or use "
            "n_cpus=1"
        )

    def run(self, name: str, *args: Any) -> list[Any]:
        """Call a method of :class:`TeamConcatVecEnv` in all processes; return their results."""
        if self.ended is not None:
            raise RuntimeError(f"the vector environment is closed ({self.ended}); make a new one")
        try:
            replies = self._venv.env_method("run", cloudpickle.dumps((name, args)))
        except (EOFError, OSError) as error:  # the watch has ended all processes
            self._watch.join(CLOSE_TIMEOUT)
            self._end(self._watch.first_end or "a worker process stopped answering")
            raise RuntimeError(f"{self.ended}; the vector environment is closed, make a new one") from error
        except BaseException:
            self._end("it was interrupted while it waited for its worker processes")
            raise
        return self._results(replies)

    def close(self) -> None:
        """Close all games and end the processes; then raise the first error of a game."""
        self._finalizer.detach()
        if self.ended is None:
            self.ended = "it was closed"
            self._results(_close_workers(self._venv, os.getpid()))

    def _results(self, replies: Sequence[bytes]) -> list[Any]:
        results = [pickle.loads(reply) for reply in replies]
        for result, group in zip(results, self._groups, strict=False):
            if isinstance(result, Failure):
                where = f"in the worker process of {_named(group)}:\n{result.trace}"
                raise result.error from RuntimeError(where)
        return results

    def _end(self, reason: str) -> None:
        self.ended = reason
        self._finalizer.detach()
        _kill(self._venv.processes)


class _Watch(threading.Thread):
    """
    Thread that ends all processes when one has ended.

    Forked processes hold copies of each other's pipes, so the pipe of a dead process would never report its end.
    """

    def __init__(self, processes: Sequence[BaseProcess], names: Sequence[str]) -> None:
        super().__init__(daemon=True)
        self._processes, self._names = processes, names
        #: Message about the first process that ended.
        self.first_end: str | None = None

    def run(self) -> None:
        """Wait until a process ends, then end the others."""
        ended = connection.wait([process.sentinel for process in self._processes])
        number = next(n for n, process in enumerate(self._processes) if process.sentinel in ended)
        process = self._processes[number]
        while (code := process.exitcode) is None:  # another thread may be about to set it
            time.sleep(0.001)
        self.first_end = (
            f"worker process {number} ({self._names[number]}, pid {process.pid}) ended with exit code {code}"
        )
        _kill(self._processes)


def _end_with_owner() -> None:
    """
    End this process when the one that started it has ended, killed ones included.

    Pipes would not report it: processes that were forked later hold copies of them. They end first, the last one first.
    """
    owner = multiprocessing.parent_process()
    assert owner is not None
    owner.join()
    os._exit(1)


def _named(group: range) -> str:
    return f"games {group.start} to {group.stop - 1}" if len(group) > 1 else f"game {group.start}"


def _packed_failure(error: BaseException) -> bytes:
    trace = traceback.format_exc()
    try:
        pickled = cloudpickle.dumps(Failure(error, trace))
        pickle.loads(pickled)  # some exceptions cannot be unpickled
        return bytes(pickled)
    except Exception:
        return bytes(cloudpickle.dumps(Failure(RuntimeError(f"{type(error).__name__}: {error}"), trace)))


def _close_workers(venv: SubprocVecEnv, owner: int) -> list[bytes]:
    """Close the games of all running processes and end these; return their replies."""
    if os.getpid() != owner:  # a copy in a forked process
        return []
    replies: list[bytes] = []
    with suppress(EOFError, OSError):
        replies = venv.env_method("run", cloudpickle.dumps(("close", ())))
        venv.close()
    _kill(venv.processes)
    return replies


def _kill(processes: Sequence[BaseProcess]) -> None:
    for process in processes:
        process.kill()
    for process in processes:
        process.join()
