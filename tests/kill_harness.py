"""
Kill training runs with SIGKILL, resume them, and compare the results bit for bit with uninterrupted runs::

    python -m tests.kill_harness --algo saf --kills 20

Kills cycle through these kinds, each at a random moment:

=========== ==================================================================================================
rollout     after a step of the games, before SB3 has stored it
update      after a step of the optimiser, in the middle of an update
writing     around the syncing and renaming of a checkpoint, including a half-written file
clock       at any moment of the run's time; the run's phase at that moment is reported
=========== ==================================================================================================

All kinds but the last are counted inside the run, so the same seed kills at the same moments on every machine.
``--command`` kills the processes of a command by the clock.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import multiprocessing as mp
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path
from shutil import rmtree
from typing import Any, Final, NamedTuple
from unittest import mock

import numpy as np
import torch as th

import sb3_saf
from sb3_saf.checkpoints.learning import CheckpointFolder, TeamCheckpointCallback
from sb3_saf.export.writer import read_weights
from tests.killed_runs import ALGOS, GAMES, ROLLOUT, Games, Run, make_run

#: Events that are counted in a run.
KINDS: Final = ("rollout", "update", "writing")
CLOCK: Final = "clock"
#: Phases of a run, by the number that it writes to shared memory.
PHASES: Final = ("between", "rollout", "update", "writing", "evaluation")


class Moment(NamedTuple):
    """
    The moment of a kill.

    :param kind: one of KINDS, or CLOCK
    :param when: number of events of this kind since the process started, or seconds
    """

    kind: str
    when: float


class Watch:
    """
    The state of a run in shared memory, which outlives it; also kills the run.

    :param moment: of the kill; None for none
    """

    def __init__(self, moment: Moment | None = None) -> None:
        self.moment = moment
        self._counts = mp.RawArray(ctypes.c_long, len(KINDS))
        self._phase = mp.RawValue(ctypes.c_int, 0)

    @property
    def counts(self) -> dict[str, int]:
        """Events by their kind."""
        return dict(zip(KINDS, self._counts, strict=True))

    @property
    def phase(self) -> str:
        """The last phase of the run."""
        return PHASES[self._phase.value]

    def event(self, kind: str, last_words: Callable[[], object] | None = None) -> None:
        """
        Count an event; kill the process if the moment has come.

        :param last_words: called just before the kill
        """
        self._counts[KINDS.index(kind)] += 1
        if self.moment == (kind, self.counts[kind]):
            if last_words is not None:
                last_words()
            os.kill(os.getpid(), signal.SIGKILL)

    def during(self, phase: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a function that is one phase."""

        def watched(*args: Any, **kwargs: Any) -> Any:
            before, self._phase.value = self._phase.value, PHASES.index(phase)
            try:
                return function(*args, **kwargs)
            finally:
                self._phase.value = before

        return watched

    @contextmanager
    def on(self, run: Run) -> Iterator[None]:
        """Watch a run."""
        model, kind, env = run.model, type(run.model), run.model.env
        step = env.step_wait

        def counted_step() -> Any:
            result = step()
            self.event("rollout")
            return result

        model.policy.optimizer.register_step_post_hook(lambda *_: self.event("update"))
        with (
            mock.patch.object(env, "step_wait", counted_step),
            # Of the class, since models are saved with their attributes.
            mock.patch.object(kind, "collect_rollouts", self.during("rollout", kind.collect_rollouts)),
            mock.patch.object(kind, "train", self.during("update", kind.train)),
            mock.patch.object(run.evaluation, "_evaluate", self.during("evaluation", run.evaluation._evaluate)),
            mock.patch.object(TeamCheckpointCallback, "_take", self.during("writing", TeamCheckpointCallback._take)),
            mock.patch.object(CheckpointFolder, "write", self.during("writing", CheckpointFolder.write)),
            self._on_files(),
        ):
            yield

    @contextmanager
    def _on_files(self) -> Iterator[None]:
        fsync, replace = os.fsync, os.replace

        def counted_fsync(file: int) -> None:
            self.event("writing", lambda: _halve(file))
            fsync(file)
            self.event("writing")

        def counted_replace(source: Any, target: Any) -> None:
            self.event("writing")
            replace(source, target)
            self.event("writing")

        with mock.patch.object(os, "fsync", counted_fsync), mock.patch.object(os, "replace", counted_replace):
            yield


def _halve(file: int) -> None:
    """Truncate a temporary file, as a power cut may do before it is synced."""
    if Path(os.readlink(f"/proc/self/fd/{file}")).name.startswith(".writing-"):
        os.ftruncate(file, os.fstat(file).st_size // 2)


# --- one run ----------------------------------------------------------------------------------------------------------


def train(algo: str, games: Games, folder: Path, rollouts: int, watch: Watch) -> None:
    """Train; started again in the same folder, it resumes."""
    th.set_num_threads(1)
    run = make_run(algo, folder, games)
    with watch.on(run):
        sb3_saf.resumable_learn(
            run.model, rollouts * ROLLOUT, folder / "checkpoints", run.evaluation, every_game_steps=run.every
        )
    np.savez(folder / "weights.npz", allow_pickle=False, **run.arrays())


def start(algo: str, games: Games, folder: Path, rollouts: int, watch: Watch) -> BaseProcess:
    """Start the run in a separate process; if forked, it has all imports already."""
    context = mp.get_context(games.start_method)
    process = context.Process(target=train, args=(algo, games, folder, rollouts, watch))  # type: ignore[attr-defined]
    process.start()
    return process


def finish(algo: str, games: Games, folder: Path, rollouts: int) -> Watch:
    """
    Start the run and wait for its end.

    :raises RuntimeError: if it fails
    """
    watch = Watch()
    process = start(algo, games, folder, rollouts, watch)
    process.join()
    if process.exitcode:
        raise RuntimeError(f"the run in {folder} failed with exit code {process.exitcode}")
    return watch


def kill(algo: str, games: Games, folder: Path, rollouts: int, moment: Moment) -> str | None:
    """
    Start the run and kill it.

    :return: its phase; None if it finished before the moment
    """
    watch = Watch(None if moment.kind == CLOCK else moment)
    process = start(algo, games, folder, rollouts, watch)
    if moment.kind == CLOCK:
        time.sleep(moment.when)
        process.kill()
    process.join()
    return watch.phase if process.exitcode == -signal.SIGKILL else None


#: Files that are written last.
_LAST: Final = ("weights.npz", "finished.json")


def results_of(folder: Path) -> dict[str, Any]:
    """
    Return what all finished runs in a folder left, by file: settings, weights, a script's replay buffer, evaluations,
    episodes and test returns, without times.

    A command that was killed before its first checkpoint, or after its end, begins another run, in another folder with
    the next number. Numbers are left out of the names, so that all of these runs must be equal.
    """
    results: dict[str, Any] = {}
    for path in sorted(folder.rglob("[!.]*")):  # without what a kill left half-written
        content: Any = None
        if path.suffix == ".zip":
            content = {key: value.numpy().tobytes() for key, value in read_weights(path).items()}
        elif path.suffix == ".npz":
            with np.load(path) as arrays:
                content = {key: arrays[key].tobytes() for key in arrays.files}
        elif path.name == "monitor.csv":
            content = [line.rsplit(",", 1)[0] for line in path.read_text().splitlines()[1:]]
        elif path.name == "run.json":
            content = json.loads(path.read_text())["settings"]
        elif path.parent.name == "tests":
            content = json.loads(path.read_text())
            for play in content["plays"]:
                del play["wall_seconds"]
        if content is not None and any((parent / name).exists() for parent in path.parents for name in _LAST):
            name = re.sub(r"_\d+(?=/)", "", str(path.relative_to(folder)))
            results[name] = content if results.get(name, content) == content else "runs differ"
    return results


# --- many kills -------------------------------------------------------------------------------------------------------


def kill_in_a_row(algo: str, games: Games, rollouts: int, moments: Sequence[Moment]) -> tuple[list[str | None], bool]:
    """
    Kill one run several times, then let it finish.

    :return: the phase at each kill, and whether the result equals the uninterrupted run's
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        finish(algo, games, folder / "undisturbed", rollouts)
        doing = [kill(algo, games, folder / "killed", rollouts, moment) for moment in moments]
        finish(algo, games, folder / "killed", rollouts)
        return doing, results_of(folder / "undisturbed") == results_of(folder / "killed") != {}


def kill_one_by_one(algo: str, games: Games, rollouts: int, kills: int, seed: int) -> tuple[Counter[str], Counter[str]]:
    """
    Kill several runs, each once, at random moments; resume and compare each.

    :return: numbers of kills and of bit-equal results, by kind
    """
    rng = random.Random(seed)
    done, equal = Counter[str](), Counter[str]()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        began = time.monotonic()
        counts = finish(algo, games, folder / "undisturbed", rollouts).counts
        seconds = time.monotonic() - began
        print(f"{algo}, undisturbed: {seconds:.1f} s, {counts}", flush=True)
        while sum(done.values()) < kills:
            kind = (*KINDS, CLOCK)[sum(done.values()) % 4]
            when = rng.uniform(0, seconds) if kind == CLOCK else rng.randint(1, counts[kind])
            doing = kill(algo, games, folder / "killed", rollouts, Moment(kind, when))
            newest = sorted(folder.glob("killed/checkpoints/checkpoint-*"))[-1:]
            finish(algo, games, folder / "killed", rollouts)
            is_equal = results_of(folder / "undisturbed") == results_of(folder / "killed") != {}
            if doing is not None:
                done[kind] += 1
                equal[kind] += is_equal
                from_ = newest[0].name if newest else "the start"
                print(
                    f"{algo} killed at {kind} {when:.5g} ({doing}), went on from {from_}: "
                    f"{'bit-equal' if is_equal else 'DIFFERENT'}",
                    flush=True,
                )
            rmtree(folder / "killed")
    return done, equal


# --- commands ---------------------------------------------------------------------------------------------------------

_GAME: Final = ("--size", "smoke", "-n", "600", "--env-kwargs", "max_cycles:20")
_TRAIN: Final = ("-m", "sb3_saf.train", "--env", "TeamSupport", *_GAME, "--seed", "3", "--resume", "-f", "{folder}")
_EVALUATED: Final = ("--eval-freq", "100", "--eval-episodes", "2", "--checkpoint-freq", "100")
#: Commands that go on when they are repeated, by name; ``grid`` has two worker processes.
COMMANDS: Final = {
    "train": (*_TRAIN, *_EVALUATED, "--algo", "saf"),
    "train-normalize": (*_TRAIN, *_EVALUATED, "--algo", "mappo", "-params", "normalize:true"),
    "train-memory": (*_TRAIN, *_EVALUATED, "--algo", "qplex-gru"),
    "grid": (
        *("-m", "sb3_saf.experiments", "run", "--env", "TeamSupport", *_GAME, "-f", "{folder}"),
        *("--methods", "saf", "mappo-gru", "--seeds", "0", "1", "--episodes", "8", "--workers", "2"),
    ),
}


def kill_command(name: str, kills: int, seed: int) -> tuple[int, int]:
    """
    Kill a command at random moments after it has begun to write, each time in a new folder; repeat and compare it.

    :return: numbers of kills and of bit-equal results
    :raises RuntimeError: if a repeated command fails, or a killed one leaves processes behind
    """
    rng, equal, done = random.Random(seed), 0, 0
    with tempfile.TemporaryDirectory() as root:
        began = time.monotonic()
        process, whole = _start_command(name, Path(root, "whole"))
        begun = time.monotonic()
        if process.wait():
            raise RuntimeError(f"{name} failed with exit code {process.returncode}")
        print(f"{name}, undisturbed: {begun - began:.1f} s until it writes, {time.monotonic() - begun:.1f} s after it")
        seconds, result = time.monotonic() - begun, results_of(whole)
        if not result:
            raise RuntimeError(f"{name} left no finished run in {whole}")
        while done < kills:
            process, folder = _start_command(name, Path(root, "killed"))
            when = rng.uniform(0, seconds)
            time.sleep(when)
            if process.poll() is None:
                process.kill()
                process.wait()
                _wait_for_children(process.pid)
                done += 1
                process, _ = _start_command(name, folder)
                if process.wait():
                    raise RuntimeError(
                        f"{name} failed with exit code {process.returncode} after a kill at {when:.2f} s"
                    )
                is_equal = results_of(folder) == result
                equal += is_equal
                print(f"{name} killed after {when:.2f} s: {'bit-equal' if is_equal else 'DIFFERENT'}", flush=True)
            rmtree(folder)
    return done, equal


def _start_command(name: str, folder: Path) -> tuple[subprocess.Popen[bytes], Path]:
    """Start a command in a session of its own, and wait until it has written something."""
    words = [word.format(folder=folder) for word in COMMANDS[name]]
    with Path(f"{folder}.log").open("ab") as log:
        process = subprocess.Popen([sys.executable, *words], stdout=log, stderr=log, start_new_session=True)
    while process.poll() is None and not any(folder.rglob("run.json")):
        time.sleep(0.05)
    return process, folder


def _wait_for_children(session: int, seconds: float = 30) -> None:
    """Wait until no process of a session is left."""
    ends = time.monotonic() + seconds
    while True:
        try:
            os.killpg(session, 0)
        except ProcessLookupError:
            return
        if time.monotonic() > ends:
            raise RuntimeError(f"processes of session {session} are left {seconds:g} s after it was killed")
        time.sleep(0.1)


def main() -> None:
    """Run the harness."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").strip().splitlines()[0])
    parser.add_argument("--algo", choices=ALGOS, default="saf")
    parser.add_argument("--game", choices=GAMES, default="hecogrid")
    parser.add_argument("--cpus", type=int, default=1, help="worker processes of games of others")
    parser.add_argument("--command", choices=COMMANDS, help="kill this command in place of a script's run")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--rollouts", type=int, default=40, help="length of the run")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    options = parser.parse_args()
    if options.command is not None:
        kills, equal_ones = kill_command(options.command, options.kills, options.seed)
        print(f"{options.command}: {equal_ones} of {kills} end bit-equal")
        sys.exit(equal_ones != kills)
    games = Games(options.game, options.cpus)
    if games.start_method == "fork":
        make_run(options.algo, None, games).warm_up()  # they inherit compiled code
    done, equal = kill_one_by_one(options.algo, games, options.rollouts, options.kills, options.seed)
    for kind in (*KINDS, CLOCK):
        print(f"{options.algo}, {kind}: {equal[kind]} of {done[kind]} end bit-equal")
    sys.exit(equal != done)


if __name__ == "__main__":
    main()
