"""SuperSuit's own vector environments, in this process or in several, behind one small interface."""

from __future__ import annotations

import atexit
import os
import pickle
import time
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from itertools import pairwise
from multiprocessing import connection
from typing import Any, NamedTuple

import supersuit
from supersuit.vector import ProcConcatVec
from supersuit.vector.multiproc_vec import decompress_info, numpy_deepcopy

from hecogrid_envs.supersuit_blueprint import Blueprint
from hecogrid_envs.supersuit_copies import dumps
from hecogrid_envs.supersuit_game import LETTERS, Failure, Game, Info, Letter

#: Seconds that worker processes get to close their games before they are killed.
CLOSE_TIMEOUT = 10.0
#: Seconds that the others get to end after one of them died.
CRASH_TIMEOUT = 1.0


class Step(NamedTuple):
    """What SuperSuit returns for a step of all B rows."""

    observations: Any
    rewards: Any
    terminations: Any
    truncations: Any
    infos: Sequence[Info]


def build_stack(blueprint: Blueprint, n_games: int, n_cpus: int) -> Stack:
    """
    Put games on top of each other with SuperSuit.

    :param blueprint: how to build a game
    :param n_games: E, number of games
    :param n_cpus: number of worker processes, 1 for this process
    """
    flat = supersuit.pettingzoo_env_to_vec_env_v1(Game(blueprint))
    venv = supersuit.concat_vec_envs_v1(flat, n_games, num_cpus=n_cpus, base_class="gymnasium")
    return WorkerStack(venv, n_games) if isinstance(venv, ProcConcatVec) else Stack(venv, n_games)


def no_reply(game: Game) -> None:
    """Letter to a game of which nothing is wanted."""


class Stack:
    """
    SuperSuit's games in this process.

    :param venv: SuperSuit's vector environment
    :param n_games: E, number of games
    """

    def __init__(self, venv: Any, n_games: int):
        self._venv = venv
        self.n_games = n_games
        #: why nothing can be asked any more
        self.closed: str | None = None

    def exchange(self, letters: Sequence[Letter]) -> tuple[Any, Sequence[Info]]:
        """
        Give each game its letter.

        :param letters: E letters
        :return: observations and infos of all B rows; a game's reply is in the info of its first row
        """
        observations, infos = self._venv.reset(seed=0, options={LETTERS: list(letters)})
        return observations, infos

    def unpack(self, reply: Any, game: int) -> Any:
        """
        Unpack a reply.

        :param reply: as it was in the infos
        :param game: the game that it came from
        :raises BaseException: what went wrong in the game
        """
        if isinstance(reply, Failure):
            raise reply.error
        return reply

    def step_async(self, actions: Any) -> None:
        """
        Start a step.

        :param actions: of the B rows
        """
        self._venv.step_async(actions)

    def step_wait(self) -> Step:
        """Finish a step."""
        return Step(*self._venv.step_wait())

    def close(self) -> Sequence[Info]:
        """
        Close all games.

        :return: infos with the games' replies
        """
        self.closed = "it was closed"
        infos = self.exchange([Game.close] * self.n_games)[1]
        self._venv.close()
        return infos


class WorkerStack(Stack):
    """
    SuperSuit's games in several processes.

    :param venv: SuperSuit's vector environment
    :param n_games: E, number of games
    """

    def __init__(self, venv: ProcConcatVec, n_games: int):
        super().__init__(venv, n_games)
        n_agents = venv.num_envs // n_games
        firsts = [row // n_agents for row in venv.idx_starts]
        #: the games of each worker process
        self._games = [slice(first, end) for first, end in pairwise(firsts)]
        self._replies_due = 0
        # Python waits at its exit for worker processes, and nobody else would tell them to end.
        self._close_at_exit = partial(_close_at_exit, weakref.ref(self), os.getpid())
        atexit.register(self._close_at_exit)

    def exchange(self, letters: Sequence[Letter]) -> tuple[Any, Sequence[Info]]:
        """
        Give each game its letter (see base class).

        SuperSuit's ``reset`` would send all processes the same letters and overlapping seeds.
        """
        parcels = [dumps(letter) for letter in letters]
        with self._watched():
            for pipe, games in zip(self._venv.pipes, self._games, strict=True):
                pipe.send(_envelope(parcels[games]))
            compressed = self._venv._receive_info()
        infos: Sequence[Info] = decompress_info(self._venv.num_envs, self._venv.idx_starts, compressed)
        return numpy_deepcopy(self._venv.observations_buffers), infos

    def unpack(self, reply: Any, game: int) -> Any:
        """Unpack a reply (see base class)."""
        content = pickle.loads(reply) if isinstance(reply, bytes) else reply
        if isinstance(content, Failure):
            raise content.error from RuntimeError(f"in the worker process of game {game}:\n{content.trace}")
        return content

    def step_async(self, actions: Any) -> None:
        """Start a step (see base class)."""
        with self._watched():
            self._venv.step_async(actions)
        self._replies_due = 1

    def step_wait(self) -> Step:
        """Finish a step (see base class)."""
        with self._watched():
            step = Step(*self._venv.step_wait())
        self._replies_due = 0
        return step

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """Turn whatever stops a worker process, or the waiting for it, into the end of the whole stack."""
        try:
            yield
        except Exception as error:
            # A process that died silently shows as a broken pipe; one that could still speak sent its exception.
            cause = "" if isinstance(error, (EOFError, OSError)) else f": {error!r}"
            self._end(self._whose_end() + cause, time.monotonic() + CRASH_TIMEOUT)
            raise RuntimeError(f"{self.closed}; the vector environment is closed, make a new one") from error
        except BaseException:
            self._end("it was interrupted while it waited for its worker processes", time.monotonic() + CRASH_TIMEOUT)
            raise

    def _whose_end(self) -> str:
        processes = self._venv.procs
        dead = connection.wait([process.sentinel for process in processes], timeout=CLOSE_TIMEOUT)
        for number, (process, games) in enumerate(zip(processes, self._games, strict=True)):
            if process.sentinel in dead:
                process.join()
                which = f"games {games.start} to {games.stop - 1}, pid {process.pid}"
                return f"worker process {number} ({which}) ended with exit code {process.exitcode}"
        return "a worker process stopped answering"

    def close(self) -> Sequence[Info]:
        """Close all games and end the processes (see base class)."""
        self.closed = "it was closed"
        deadline = time.monotonic() + CLOSE_TIMEOUT
        for pipe in self._venv.pipes:
            with suppress(OSError):  # a process may be gone; the others still have games to close
                pipe.send(_envelope([dumps(Game.close)] * self.n_games))
        compressed = [self._last_reply(pipe, deadline) for pipe in self._venv.pipes]
        self._end(self.closed, deadline)
        infos: Sequence[Info] = decompress_info(self._venv.num_envs, self._venv.idx_starts, compressed)
        return infos

    def _last_reply(self, pipe: Any, deadline: float) -> list[tuple[int, Info]]:
        """The reply to the last letter, behind that to a step that nobody waited for."""
        reply: Any = []
        with suppress(EOFError, OSError):
            for _ in range(self._replies_due + 1):
                if not pipe.poll(max(0.0, deadline - time.monotonic())):
                    return []
                reply = pipe.recv()
        return reply if isinstance(reply, list) else []

    def _end(self, reason: str, deadline: float) -> None:
        """End the processes, by force those that do not within the deadline."""
        self.closed = reason
        atexit.unregister(self._close_at_exit)
        for pipe in self._venv.pipes:
            with suppress(OSError):
                # SuperSuit's own "close" is a message that its workers do not understand.
                pipe.send("terminate")
        for process in self._venv.procs:
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()
        self._venv.close()


def _envelope(parcels: Sequence[bytes]) -> Any:
    """SuperSuit's message for a worker's reset, with the letters to its games; see :class:`Game` for the seed."""
    return "reset", (0, {LETTERS: parcels})


def _close_at_exit(reference: weakref.ref[WorkerStack], owner: int) -> None:
    stack = reference()
    if stack is not None and os.getpid() == owner:
        stack.close()
