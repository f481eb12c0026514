"""
Folders of runs and of published teams (``docs/zoo.md``, "Output of a run" and "Trained teams"): one writer, one reader,
one list of their files.
"""

from __future__ import annotations

import os
import platform
import re
import shlex
import shutil
import socket
import subprocess
import sys
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import numpy.typing as npt
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.checkpoints.learning import CheckpointFolder
from sb3_saf.evaluation import EvaluationResult, confidence_interval, evaluate_team
from sb3_saf.export.writer import load_weights
from sb3_saf.suites.registry import HOME, TeamEnvironment, folder_name, suites
from sb3_saf.teams.checks import CheckpointError, ExportError, evaluation_seed, unknown_name
from sb3_saf.teams.files import digest, plain, read_json, write_json, write_text
from sb3_saf.training.settings import Settings, saved_settings

if TYPE_CHECKING:
    import pandas as pd

RUN_FILE: Final = "run.json"
MONITOR: Final = "monitor.csv"
CURVE: Final = "curve.csv"
FINISHED: Final = "finished.json"
CHECKPOINTS: Final = "checkpoints"
#: Files that may change or go after a run is finished.
_UNLISTED: Final = (MONITOR, FINISHED)

#: Source of scores: evaluation games, or training games.
Source = Literal["evaluation", "training"]
#: Maximum number of points of a learning curve.
CURVE_POINTS: Final = 100

#: Packages whose versions can change a result.
_PACKAGES: Final = (
    *("sb3-saf", "stable-baselines3", "sb3-contrib", "rl_zoo3", "optuna", "torch"),
    *("numpy", "numba", "gymnasium", "pettingzoo", "supersuit"),
)
_NUMBERED: Final = re.compile(r"(.+)_(\d+)")
SAVED_MODEL: Final = re.compile(r"rl_model_(\d+)_steps\.zip")


# --- writing ----------------------------------------------------------------------------------------------------------


def write_run(
    folder: Path, settings: Mapping[str, Any], seed: int, command: str, options: Mapping[str, Any] | None = None
) -> None:
    """
    Write what determines a run, before it begins, and remove the end of an earlier run in the folder.

    :param settings: from :meth:`Settings.as_dict`
    :param command: the command line that makes this run
    :param options: what else affects its results
    """
    content = {"settings": settings, "seed": seed, "options": options or {}}
    for name in (FINISHED, CURVE):  # of an earlier run in this folder
        (folder / name).unlink(missing_ok=True)
    write_json(folder / RUN_FILE, {**content, "command": command, "versions": software_versions()})


def finish_run(folder: Path, **cost: Any) -> None:
    """
    Write the list of a run's files with their digests, and its cost.

    :param cost: ``wall_seconds``, ``processor_seconds``, ...; left out keeps those of an earlier call
    """
    path = folder / FINISHED
    if not cost:
        cost = {name: value for name, value in read_json(path).items() if name != "files"}
    files = [one for one in (*folder.iterdir(), *folder.glob("tests/*")) if one.is_file()]
    listed = sorted(one for one in files if one.name not in _UNLISTED and not one.name.startswith("."))
    write_json(path, {**cost, "files": {one.relative_to(folder).as_posix(): digest(one) for one in listed}})


def software_versions() -> dict[str, str]:
    """Return the versions of Python, the system, installed packages that can change a result, commit, and computer."""
    versions = {"python": platform.python_version(), "system": platform.platform()}
    versions["processor"] = platform.processor() or platform.machine()
    with suppress(OSError):
        names = re.findall(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), flags=re.MULTILINE)
        versions["processor"] = next(iter(names), versions["processor"])
    for package in _PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    commit = "unknown"
    with suppress(OSError, subprocess.SubprocessError):
        words = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
        done = subprocess.run(words, cwd=Path(__file__).parent, capture_output=True, text=True, check=True, timeout=10)
        commit = done.stdout.strip()
    return {**versions, "commit": commit, "host": socket.gethostname()}


# --- reading ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """The folder of a run."""

    folder: Path

    @cached_property
    def description(self) -> dict[str, Any]:
        """Content of ``run.json``; ValueError if it is not that of a run."""
        content = read_json(self.folder / RUN_FILE)
        kinds = {"settings": dict, "seed": int, "options": dict, "command": str, "versions": dict}
        wrong = [name for name, kind in kinds.items() if not isinstance(content.get(name), kind)]
        if wrong:
            raise ValueError(f"{self.folder / RUN_FILE} has no {', '.join(wrong)}")
        return content

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return int(self.description["seed"])

    @cached_property
    def settings(self) -> Settings:
        """Settings of the run."""
        return saved_settings(self.description["settings"])

    @property
    def number(self) -> int:
        """Number of the run in a log folder."""
        numbered = _NUMBERED.fullmatch(self.folder.name)
        return int(numbered[2]) if numbered else 0

    def finished(self) -> dict[str, Any]:
        """Return cost and files of a finished run; ValueError if it is not finished."""
        content = read_json(self.folder / FINISHED)
        if not isinstance(content.get("files"), dict):
            raise ValueError(f"{self.folder / FINISHED} lists no files")
        return content

    def damage(self, name: str) -> str | None:
        """Return what happened to a file since the run was finished; None if nothing did."""
        path, files = self.folder / name, self.finished()["files"]
        if name not in files:
            return f"{path} is not in the list of {FINISHED}"
        if not path.is_file():
            return f"{path} is missing"
        return None if digest(path) == files[name] else f"{path} has changed since the run was finished"

    def curve(self, source: Source) -> pd.DataFrame:
        """
        Return the learning curve of team returns.

        :return: columns ``game_steps`` and ``score``; for training also ``episodes``, and ``processor_seconds`` of a
            finished run
        :raises ValueError: if there is none, or it has no point
        """
        if source == "training":
            curve = read_curve(self.folder)
            if curve.empty:
                raise ValueError(f"no episode has ended in {self.folder}; train longer")
            return curve
        import pandas as pd

        path = self.folder / "evaluations.npz"
        if not path.is_file():
            raise ValueError(f"{self.folder} has no evaluations; train with --eval-freq, or plot --source training")
        try:
            with np.load(path, allow_pickle=False) as arrays:
                return pd.DataFrame({"game_steps": arrays["game_steps"], "score": arrays["results"].mean(axis=1)})
        except (EOFError, KeyError, ValueError, OSError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path} is not what sb3_saf.train writes: {error}") from error


def training_curve(monitor: str | Path, n_points: int = CURVE_POINTS) -> pd.DataFrame:
    """
    Return the learning curve of the training games, from the file of a TeamMonitor.

    :param monitor: a ``monitor.csv``, or the ``monitor_dir`` of ``make_team_env``
    :param n_points: maximum number of points, means over about equal numbers of episodes
    :return: columns ``game_steps``, at the end of the point's episodes, ``score``, mean team return, and ``episodes``
    :raises ValueError: if no episode has ended
    """
    import pandas as pd

    path = Path(monitor)
    curve = pd.DataFrame(_condensed(path / MONITOR if path.is_dir() else path, n_points))
    if curve.empty:
        raise ValueError(f"no episode has ended in {path}; train longer")
    return curve


def read_curve(folder: Path) -> pd.DataFrame:
    """Return the learning curve of a run's training games, finished or not, as :func:`training_curve`."""
    import pandas as pd

    path = folder / CURVE
    if not path.is_file():
        return training_curve(folder / MONITOR)
    try:
        return pd.read_csv(path, dtype=float)[["game_steps", "processor_seconds", "score", "episodes"]]
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path} is no learning curve: {error}") from error


def write_curve(folder: Path, clock: npt.NDArray[np.float64], n_games: int) -> None:
    """
    Write ``curve.csv``, the learning curve of ``monitor.csv``, which may have hundreds of thousands of lines.

    :param clock: (K, 2) game steps, and the processor seconds until then
    :param n_games: E, the minimum number of episodes of a point
    """
    curve = _condensed(folder / MONITOR, CURVE_POINTS, n_games)
    seconds = np.interp(curve["game_steps"], clock[:, 0], clock[:, 1])
    rows = zip(curve["game_steps"], seconds, curve["score"], curve["episodes"], strict=True)
    lines = [f"{int(end)},{second:.3f},{float(score)!r},{int(count)}" for end, second, score, count in rows]
    write_text(folder / CURVE, "\n".join(["game_steps,processor_seconds,score,episodes", *lines]) + "\n")


def _condensed(monitor: Path, n_points: int, fewest_episodes: int = 1) -> dict[str, npt.NDArray[Any]]:
    """Return game steps at the end, mean return and number of episodes of equal parts of a monitor's file."""
    try:
        with monitor.open(encoding="utf-8") as file:
            head = [file.readline() for _ in range(2)]
            if not head[1].startswith("r,l,"):
                raise ValueError(f"expected the columns r,l,t in its second line, got {head[1]!r}")
            lines = [line for line in file if line.strip()]
        episodes = np.loadtxt(lines, delimiter=",", usecols=(0, 1), ndmin=2) if lines else np.empty((0, 2))
    except (OSError, ValueError) as error:
        raise ValueError(f"{monitor} is not what sb3_saf.train writes: {error}") from error
    game_steps = np.cumsum(episodes[:, 1]).astype(np.int64)
    parts = np.array_split(np.arange(len(episodes)), max(1, min(n_points, len(episodes) // fewest_episodes)))
    parts = [part for part in parts if len(part)]
    return {
        "game_steps": np.array([game_steps[part[-1]] for part in parts], dtype=np.int64),
        "score": np.array([episodes[part, 0].mean() for part in parts], dtype=np.float64),
        "episodes": np.array([len(part) for part in parts], dtype=np.int64),
    }


# --- runs of sb3_saf.train --------------------------------------------------------------------------------------------


def python_command(module: str) -> str:
    """Return the begin of a command that runs as printed, with this interpreter: ``.venv/bin/python -m MODULE``."""
    active, own = shutil.which("python"), sys.executable
    if active is not None and Path(active).parent == Path(own).parent:
        return f"python -m {module}"
    with suppress(ValueError):  # another drive
        own = min(own, os.path.relpath(own), key=len)
    return f"{shlex.quote(own) if os.name == 'posix' else subprocess.list2cmdline([own])} -m {module}"


def runs_of(log_folder: Path, algo: str, name: str) -> list[tuple[int, Path]]:
    """List the runs of an algorithm on an environment, with their numbers, in order."""
    folder = log_folder / algo
    paths = [path for path in folder.iterdir() if path.is_dir()] if folder.is_dir() else []
    numbered = [(match, path) for path in paths if (match := _NUMBERED.fullmatch(path.name))]
    return sorted((int(match[2]), path) for match, path in numbered if match[1] == name)


def make_run_folder(log_folder: Path, algo: str, name: str) -> Path:
    """Create the folder of a new run atomically."""
    while True:
        number = max((number for number, _ in runs_of(log_folder, algo, name)), default=0) + 1
        folder = log_folder / algo / f"{name}_{number}"
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:  # another process was faster
            if not folder.parent.is_dir():
                raise


def find_unfinished(
    settings: Settings, seed: int | None, options: Mapping[str, Any], log_folder: Path
) -> tuple[Path, int] | None:
    """
    Find the latest unfinished run (one with checkpoints) of the same settings and options that no other process uses.

    :param seed: seed of the run; None for any
    :param options: as given to :func:`write_run`
    :return: its folder and seed; None if there is none
    :raises ValueError: if that run began with another model than ``options["initial_model"]``
    :raises CheckpointError: if there are only runs that another process, or another user, writes to
    """
    not_free: CheckpointError | None = None
    wanted = plain({"settings": settings.as_dict(), "options": options})
    for _, folder in reversed(runs_of(log_folder, settings.algo, settings.environment.folder_name)):
        try:
            found = Run(folder).description
        except ValueError:  # the run was killed before it was written
            continue
        theirs, ours = dict(found["options"]), dict(wanted["options"])
        began_with, begins_with = (one.pop("initial_model", None) for one in (theirs, ours))
        same = found["settings"] == wanted["settings"] and theirs == ours and seed in (None, found["seed"])
        store = CheckpointFolder(folder / CHECKPOINTS)
        if not same or (folder / FINISHED).exists() or not store.checkpoints():
            continue
        try:
            store.acquire()
        except CheckpointError as error:
            not_free = not_free or error
            continue
        store.release()
        if (began_with and began_with["sha256"]) != (begins_with and begins_with["sha256"]):
            models = [f"the model {one['path']}" if one else "a new model" for one in (began_with, begins_with)]
            raise ValueError(
                f"{folder} began with {models[0]}, got {models[1]}: give the -i of that run, or leave --resume out"
            )
        return folder, int(found["seed"])
    if not_free is not None:
        raise not_free
    return None


def find_model(
    log_folder: Path, algo: str, environment: TeamEnvironment, number: int = 0, which: str | int | None = None
) -> tuple[Run, Path]:
    """
    Find a trained model.

    :param number: number of the run; 0 for the latest
    :param which: None for the final model, "best", or the game steps of a saved one
    :return: the run, and the model's file
    :raises ValueError: if there is none, with a fix
    """
    name = environment.folder_name
    how = f"train first: {python_command('sb3_saf.train')} --algo {algo} --env {environment.id} -f {log_folder}"
    if not (log_folder / algo).is_dir():
        raise ValueError(f"there is no folder {log_folder / algo}; {how}")
    runs = dict(runs_of(log_folder, algo, name))
    if not runs:
        raise ValueError(f"there is no run of {environment.id} in {log_folder / algo}; {how}")
    if number and number not in runs:
        raise ValueError(f"there is no run {number} of {environment.id} in {log_folder / algo}; there are {[*runs]}")
    folder = runs[number or max(runs)]
    names: dict[object, str] = {None: f"{name}.zip", "best": "best_model.zip"}
    path = folder / names.get(which, f"rl_model_{which}_steps.zip")
    if not path.is_file():
        raise ValueError(
            f"{folder} has no {path.name}; --save-freq and --eval-freq of sb3_saf.train save models on the way"
        )
    run = Run(folder)
    if (of := run.description["settings"].get("env")) != environment.id:
        raise ValueError(f"{folder} has a run of {of}, not of {environment.id}")
    return run, path


# --- published teams --------------------------------------------------------------------------------------------------


WEIGHTS: Final = "weights.safetensors"
#: The teams in a clone of the repository.
TEAMS: Final = Path(__file__).resolve().parents[2] / "trained_teams"
#: Games of a test that are played at once.
TEST_GAMES: Final = 32
#: A check fails by chance in one of a thousand teams.
_CONFIDENCE: Final = 0.999
#: On another kind of processor networks are rounded otherwise, and an action is drawn otherwise in one game of many.
EQUAL_GAMES: Final = 0.9
_FIX: Final = "restore the team from the repository, or publish it again if a change of the code is meant to change it"
#: Settings that import by name when games are made; callbacks, which only training makes, are not among them.
_CODE: Final = ("env_wrapper", "vec_env_wrapper")


def load_team(env: str, method: str, folder: str | Path | None = None, *, device: str = "auto") -> BaseAlgorithm:
    """
    Load a published team, without running code from its files.

    The model has as many games as in its training, none of which it was trained on; the first ones are those of its
    row, but of VMAS, which draws all games at once: ``evaluate_team(model, model.get_env(), 100)``,
    ``model.predict(own_observation)``.

    :param env: task and level, such as ``"TeamSupport-c2-h1"``, or ``"smax/2s3z"``
    :param method: such as ``"saf"``
    :param folder: folder of teams; None for ``trained_teams`` of the repository
    :param device: as in SB3
    :raises ValueError: for an unknown team, naming the nearest; if the package of its suite is not installed
    :raises ExportError: for changed files, or a team that this version cannot build, naming both versions
    """
    run = find_team(f"{env}/{method}", folder)
    with version_in_errors(run):
        games = run.settings.make_env(run.seed, evaluation=True)
        model = run.settings.make_model(games, run.seed, device=device)
        load_weights(model, run.folder / WEIGHTS)
        if hasattr(model, "exploration_rate"):
            model.exploration_rate = 0.0  # a new model explores with every action
        games.seed(evaluation_seed(run.seed, test=0))  # an algorithm seeds its games for training
    return model


def team_names(folder: str | Path | None = None) -> list[str]:
    """Return the names of all teams of a folder, such as ``"TeamSupport-c2-h1/saf"``; ValueError if there is none."""
    folder = TEAMS if folder is None else Path(folder)
    files = [path for name in (WEIGHTS, RUN_FILE, FINISHED) for path in folder.glob(f"*/*/{name}")]
    names = sorted({path.parent.relative_to(folder).as_posix() for path in files})
    if not names:
        raise ValueError(f"expected teams in {folder}, got none; name the folder trained_teams of the repository")
    return names


def find_team(name: str, folder: str | Path | None = None) -> Run:
    """Return the run of a team whose files are as published; arguments and errors as those of :func:`load_team`."""
    env, _, method = name.rpartition("/")
    known, name = team_names(folder), f"{folder_name(env)}/{method}" if env else method
    if name not in known:
        raise unknown_name("team", name, known)
    return published_run((TEAMS if folder is None else Path(folder)) / name)


def published_run(folder: Path) -> Run:
    """Return the run of a team's folder; ExportError if its files have changed, or name code to run."""
    run = Run(folder)
    try:
        damage = run.damage(WEIGHTS) or run.damage(RUN_FILE)
    except ValueError as error:
        damage = str(error)
    if damage:
        raise ExportError(f"{damage}; {_FIX}")
    check_runs_no_code(run.description["settings"], folder)
    return run


def missing_package(name: str, folder: str | Path | None = None) -> str | None:
    """Return which package the games of a published team need that is not installed; None if they can be played."""
    description = Run((TEAMS if folder is None else Path(folder)) / name).description
    suite = suites().get(str(description["settings"].get("env")).partition("/")[0])
    return None if suite is None else suite.problem()


def check_runs_no_code(settings: Mapping[str, Any], folder: Path) -> None:
    """Check that saved settings name games of suites only, and nothing else to import; otherwise raise ExportError."""
    env = str(settings.get("env"))
    prefix, _, task = env.partition("/") if "/" in env else (HOME, "", env)
    suite = suites().get(prefix)
    named = [key for key in _CODE if settings.get(key)]
    if named or suite is None or suite.find_task(task) is None:
        raise ExportError(
            f"{folder} must be a team on the games of a suite (python -m sb3_saf.suites lists them) without "
            f"{', '.join(_CODE)}, since names could run code; got {', '.join(named) or env}"
        )


@contextmanager
def version_in_errors(run: Run) -> Iterator[None]:
    """Add to errors the version that trained a run, and this one."""
    try:
        yield
    except ValueError as error:
        versions = run.description["versions"], software_versions()
        then, now = (f"sb3-saf {one.get('sb3-saf')} at commit {one.get('commit')}" for one in versions)
        raise ExportError(f"{error} ({run.folder} was trained with {then}; this is {now})") from error


def play_test(
    player: PolicyPredictor, env: VecEnv, seed: int, episodes: int, deterministic: bool = False
) -> EvaluationResult:
    """
    Play the test games of a run, which neither training nor its evaluations have.

    :param env: games for evaluation, at most ``TEST_GAMES``
    :param seed: seed of the run
    :param episodes: team episodes
    """
    set_random_seed(seed)  # drawn actions must not depend on the training or on other tests
    parts = []
    for batch, first in enumerate(range(0, episodes, TEST_GAMES)):
        env.seed(evaluation_seed(seed, test=batch))
        parts.append(evaluate_team(player, env, min(TEST_GAMES, episodes - first), deterministic))
    return EvaluationResult.joined(parts)


def check_team(name: str, folder: str | Path | None = None, batches: int | None = None) -> str:
    """
    Play the games of a team's row again, with one thread on the CPU, and compare the returns.

    :param name: such as ``"TeamSupport-c2-h1/saf"``
    :param batches: only the first games, in batches of 32; None for all
    :return: the outcome
    :raises ValueError: if fewer than 90 % of HECOGrid's games have equal returns, or the mean of any games differs by
        more than chance (99.9 %, Student's t over the games)
    """
    run = find_team(name, folder)
    row = run.description["row"]
    env, _, method = name.rpartition("/")
    th.set_num_threads(1)
    model = load_team(env, method, folder, device="cpu")
    games_of_training = model.get_env()
    assert games_of_training is not None
    games_of_training.close()
    expected = [float(text) for text in row["returns"].split()][: None if batches is None else TEST_GAMES * batches]
    with closing(run.settings.make_env(run.seed, evaluation=True, n_envs=min(TEST_GAMES, row["episodes"]))) as games:
        result = play_test(model, games, run.seed, len(expected), row["actions"] != "drawn")
    equal = float(np.mean(np.equal(result.returns, expected)))
    means = (
        f"{name}: mean team return of {len(expected)} games {result.mean:.4g}, in its row {np.mean(expected):.4g}; "
        f"{equal:.0%} of the games are equal"
    )
    if "/" not in run.settings.env_id and equal < EQUAL_GAMES:  # HECOGrid's, the games of this repository
        raise ValueError(f"{means}, expected {EQUAL_GAMES:.0%}; {_FIX}")
    low, high = confidence_interval(np.subtract(result.returns, expected), _CONFIDENCE)
    if not low <= 0 <= high:
        raise ValueError(f"{means}; expected no difference but by chance, got {low:.4g} to {high:.4g}; {_FIX}")
    return means
