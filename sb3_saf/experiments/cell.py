"""Worker code: training and testing of one cell in the folder of its job, and the check of a finished cell."""

from __future__ import annotations

import shlex
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from hashlib import sha256
from itertools import product
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import get_device

from sb3_saf import RandomPolicy
from sb3_saf.checkpoints.learning import CheckpointFolder
from sb3_saf.experiments.definitions import Cell, Level, RunConfig, find_method
from sb3_saf.experiments.results import (
    BEST,
    BEST_MODEL,
    DRAWN,
    EVALUATIONS,
    LAST,
    MODEL,
    MOST_LIKELY,
    LevelResult,
    Play,
    Results,
    write_evaluations,
)
from sb3_saf.export.writer import load_weights, read_weights
from sb3_saf.teams.checks import CheckpointError, NonFiniteError
from sb3_saf.teams.files import differences, read_json, remove_leftovers, write_json, write_text
from sb3_saf.training.enjoy import make_policy
from sb3_saf.training.folders import (
    CHECKPOINTS,
    CURVE,
    FINISHED,
    MONITOR,
    RUN_FILE,
    TEST_GAMES,
    Run,
    finish_run,
    play_test,
    software_versions,
    write_run,
)
from sb3_saf.training.run import RunOptions, train

#: Checkpoints of a training, from which another worker continues if this one is killed.
CHECKPOINTS_PER_CELL: Final = 20


@dataclass(frozen=True)
class Job:
    """
    Job of a worker.

    :param cell: cell to train, unless the folder has its model, and to test
    :param tensorboard: whether to keep TensorBoard logs of the training
    """

    cell: Cell
    config: RunConfig
    device: str = "auto"
    threads: int = 1
    tensorboard: bool = False

    def write(self, folder: Path) -> None:
        """Write the job into its folder."""
        write_text(folder / "job.json", msgspec.json.encode(self).decode())

    @classmethod
    def read(cls, folder: Path) -> Job:
        """Read the job of a folder; ValueError if there is none."""
        try:
            return msgspec.json.decode((folder / "job.json").read_bytes(), type=cls)
        except (OSError, ValueError) as error:
            raise ValueError(f"{folder} has no job.json of an unfinished cell of `experiments run`: {error}") from None


def run_job(folder: Path) -> None:
    """
    Do the job in ``FOLDER/job.json``: train, unless ``FOLDER/model.zip`` exists, and test.

    A killed job continues on the next call: from the last checkpoint, or with the trained model.

    :param folder: folder of the job; the run of the cell, or only its further tests, is in ``FOLDER/result``
    """
    job = Job.read(folder)
    th.set_num_threads(job.threads)
    cell, result = job.cell, folder / "result"
    models = folder if (folder / MODEL).exists() else result
    (result / "tests").mkdir(parents=True, exist_ok=True)
    remove_leftovers(result / "tests")
    if not cell.is_trained:
        write_run(result, **job.config.describe(cell), command="")
        finish_run(result, wall_seconds=0.0, processor_seconds=0.0, threads=job.threads)
    elif models == result:
        _train(job, result)
    for level in cell.tests:
        path = result / "tests" / f"{level.slug}.json"
        if not path.exists():
            write_json(path, asdict(play(job, level, models)))
    if (result / RUN_FILE).exists():
        # Only the curves are kept: monitor.csv has hundreds of thousands of lines at the paper's size.
        (result / MONITOR).unlink(missing_ok=True)
        finish_run(result)


def _train(job: Job, folder: Path) -> None:
    """Train and evaluate a model in the folder of its run, unless that is finished."""
    cell, settings = job.cell, job.config.settings(job.cell)
    if not (folder / FINISHED).exists():
        begun = None
        try:
            begun = CheckpointFolder(folder / CHECKPOINTS).newest()
        except CheckpointError as error:  # this version cannot read any of them
            print(f"Beginning anew: {error}")
            shutil.rmtree(folder / CHECKPOINTS)
        if begun is None:  # else the versions are those of the run's beginning
            words = ["python", "-m", "sb3_saf.train", "--algo", find_method(cell.method).algo, "--env", cell.env]
            command = shlex.join([*words, *job.config.words(cell), "--seed", str(cell.seed)])
            write_run(folder, **job.config.describe(cell), command=command)
        options = RunOptions(
            eval_freq=job.config.eval_freq,
            eval_episodes=job.config.eval_episodes,
            checkpoint_freq=max(1, settings.game_steps // CHECKPOINTS_PER_CELL),
            tensorboard_log=folder / "tb" if job.tensorboard else None,
            device=job.device,
        )
        train(settings, cell.seed, folder, options)
    shutil.rmtree(folder / CHECKPOINTS, ignore_errors=True)
    write_evaluations(folder)


def play(job: Job, level: Level, models: Path) -> LevelResult:
    """
    Test the best and the last policy at a level, with drawn and with most likely actions.

    The games depend on the cell's seed and the level only, so all methods play the same ones; neither training nor its
    evaluations have them.

    :param models: folder of the models of a trained cell
    :raises NonFiniteError: if a return is not finite
    """
    cell, config, settings = job.cell, job.config, job.config.settings(job.cell, level)
    env = settings.make_env(cell.seed, evaluation=True, n_envs=min(TEST_GAMES, config.episodes))
    plays = []
    player: RandomPolicy | BasePolicy
    if cell.is_trained:
        player = make_policy(config.settings(cell), models / MODEL).to(get_device(job.device))
    else:
        player = RandomPolicy(env, seed=cell.seed)
    draws = (DRAWN, MOST_LIKELY) if settings.spec.draws_actions else (MOST_LIKELY,)
    for policy, actions in product((BEST, LAST), draws) if cell.is_trained else [(BEST, DRAWN)]:
        if isinstance(player, BasePolicy) and actions == draws[0]:
            load_weights(player, models / (BEST_MODEL if policy == BEST else MODEL))
        clock = time.perf_counter()
        result = play_test(player, env, cell.seed, config.episodes, actions == MOST_LIKELY)
        if not np.isfinite(result.returns).all():
            raise NonFiniteError(f"team returns must be finite, got {result.returns} at {level}; repair the game")
        measured = result.returns, result.lengths, list(result.successes), list(result.agent_means)
        plays.append(Play(policy, actions, *measured, time.perf_counter() - clock))
    env.close()
    return LevelResult(level.env_kwargs, settings.n_agents, settings.n_treasures, plays)


# --- check ------------------------------------------------------------------------------------------------------------


class Check(NamedTuple):
    """Results equal bit for bit and different in a second run, and differing versions."""

    equal: list[str]
    different: list[str]
    software: str


def check_cell(folder: Path, device: str = "auto") -> Check:
    """
    Train and test a cell again in a temporary folder, and compare with its results.

    :param folder: folder of a finished cell, ``RESULTS/cells/TASK-LEVEL/METHOD/seed-N``
    :param device: as in SB3
    :raises ValueError: if there is no finished cell, or its settings have changed since
    """
    try:
        run, results = Run(folder), Results(folder.resolve().parents[3])
        settings, options, cost = run.description["settings"], run.description["options"], run.finished()
        levels = [Level.of(**read_json(path)["level"]) for path in sorted(folder.glob("tests/[!.]*.json"))]
        cell = Cell(options["method"], settings["env"], Level.of(**options["level"]), run.seed, tuple(levels))
        config = results.config()
        if config is None:
            raise ValueError(f"{results.folder} has no settings.json")
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise ValueError(
            f"{folder} is no finished cell; expected RESULTS/cells/TASK-LEVEL/METHOD/seed-N: {error}"
        ) from None
    results.agree(config, [cell])
    different = [text for name in cost["files"] if (text := run.damage(name)) is not None]
    equal: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        Job(cell, config, device, int(cost.get("threads", 1))).write(Path(name))
        run_job(Path(name))
        for what, difference in _compare(cell, folder, Path(name, "result")):
            (different if difference else equal).append(f"{what}: {difference}" if difference else what)
    then, now = run.description["versions"], software_versions()
    common = {name: value for name, value in then.items() if name in now and name != "host"}
    return Check(equal, different, differences(common, {name: now[name] for name in common}, most=10))


def _compare(cell: Cell, before: Path, after: Path) -> Iterator[tuple[str, str]]:
    """Yield what was compared, and the difference, empty if there is none."""
    for level in cell.tests:
        old, new = (read_json(folder / "tests" / f"{level.slug}.json") for folder in (before, after))
        for play_of in (*old["plays"], *new["plays"]):
            play_of.pop("wall_seconds")
        yield f"returns at {level}", "" if repr(old) == repr(new) else differences(old, new)
    if not cell.is_trained:
        return
    for what, name, times in (("learning curve", CURVE, [1]), ("evaluations", EVALUATIONS, [])):
        curves = []
        for path in (before / name, after / name):
            lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
            curves.append([[text for i, text in enumerate(line.split(",")) if i not in times] for line in lines])
        yield what, "" if curves[0] == curves[1] else "differs"
    for what, name in (("best weights", BEST_MODEL), ("weights", MODEL)):
        try:
            yield what, differences(_described(before / name), _described(after / name))
        except ValueError as error:
            yield what, str(error)


def _described(path: Path) -> dict[str, str]:
    """Return form and digest of each tensor of a model's file."""
    return {
        name: f"{tensor.dtype} of shape {tuple(tensor.shape)}, {sha256(tensor.numpy().tobytes()).hexdigest()[:16]}"
        for name, tensor in read_weights(path).items()
    }
