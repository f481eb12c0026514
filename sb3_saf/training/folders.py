"""
Log folders in RL-Zoo3's layout, so that its plotting commands can read them.

A run is ``FOLDER/ALGO/NAME_NUMBER``, where FOLDER is the option ``-f`` and NAME the environment's name in file names,
with the model ``NAME.zip`` and its settings in ``NAME/``.
"""

from __future__ import annotations

import platform
import re
import uuid
from collections.abc import Mapping
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import yaml

from sb3_saf.checkpoints.store import CheckpointFolder
from sb3_saf.teams.errors import CheckpointError
from sb3_saf.training.environments import TeamEnvironment
from sb3_saf.training.run import CHECKPOINTS
from sb3_saf.training.settings import Settings
from sb3_saf.training.yaml_files import load_yaml

#: Options that affect a run's results but are not in ``config.yml``.
_DECIDING: Final = ("eval_freq", "eval_episodes", "n_eval_envs", "eval_env_kwargs", "deterministic_eval", "save_freq")
#: Packages whose versions can change a result.
_PACKAGES: Final = (
    *("sb3-saf", "stable-baselines3", "sb3-contrib", "rl_zoo3", "optuna", "torch"),
    *("numpy", "numba", "gymnasium", "pettingzoo", "supersuit"),
)
_UUID: Final = r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}"
_SAVED_MODEL: Final = re.compile(r"rl_model_(\d+)_steps\.zip")


def run_number(folder: Path, name: str) -> int | None:
    """Return the number of a run from its folder's name; None if it is no run of that environment."""
    found = re.fullmatch(rf"{re.escape(name)}_(\d+)(?:_{_UUID})?", folder.name)
    return int(found[1]) if found else None


def runs_of(log_folder: Path, algo: str, name: str) -> list[tuple[int, Path]]:
    """List the runs of an algorithm on an environment, with their numbers, in order."""
    folder = log_folder / algo
    runs = [(run_number(run, name), run) for run in folder.iterdir()] if folder.is_dir() else []
    return sorted((number, run) for number, run in runs if number is not None and run.is_dir())


def make_run_folder(log_folder: Path, algo: str, name: str, *, unique: bool = False) -> Path:
    """Create the folder of a new run atomically; ``unique`` adds a unique id to its name."""
    ending = f"_{uuid.uuid4()}" if unique else ""
    while True:
        number = max((number for number, _ in runs_of(log_folder, algo, name)), default=0) + 1
        folder = log_folder / algo / f"{name}_{number}{ending}"
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:  # another process was faster
            if folder.parent.is_dir():
                continue
            raise


def write_run(folder: Path, settings: Settings, seed: int, options: Mapping[str, Any], command: str) -> None:
    """Write the description of a run: ``config.yml``, ``args.yml``, ``versions.yml``, ``command.txt``."""
    place = folder / settings.environment.folder_name
    place.mkdir(exist_ok=True)
    contents = {
        "config.yml": {**settings.as_dict(), "seed": seed},
        "args.yml": {**options, "seed": seed},
        "versions.yml": software_versions(),
    }
    for name, content in contents.items():
        (place / name).write_text(yaml.safe_dump(_plain(content), sort_keys=False), encoding="utf-8")
    (place / "command.txt").write_text(command + "\n", encoding="utf-8")


def software_versions() -> dict[str, str]:
    """Return the versions of Python, the system, and installed packages that can change a result."""
    versions = {"python": platform.python_version(), "system": platform.platform()}
    for package in _PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    return versions


def read_run(folder: Path, name: str) -> dict[str, Any]:
    """Read the settings of a run, ``config.yml``; ValueError if the folder is not that of a run."""
    path = folder / name / "config.yml"
    if not path.is_file():
        raise ValueError(f"{folder} is no run of sb3_saf.train: there is no {path}")
    config = load_yaml(path.read_text("utf-8"), str(path))
    if not isinstance(config, dict) or "seed" not in config:
        raise ValueError(f"{path} does not hold the settings of a run of sb3_saf.train")
    return config


def find_unfinished(
    settings: Settings, seed: int | None, options: Mapping[str, Any], log_folder: Path
) -> tuple[Path, int] | None:
    """
    Find the latest unfinished run (one with checkpoints) of the same settings and options that no other process uses.

    :param seed: seed of the run; None for any
    :return: its folder and seed; None if there is none
    """
    name, wanted = settings.environment.folder_name, _plain(settings.as_dict())
    for _, folder in reversed(runs_of(log_folder, settings.algo, name)):
        try:
            saved, given = (
                read_run(folder, name),
                load_yaml((folder / name / "args.yml").read_text("utf-8"), "args.yml"),
            )
        except ValueError:  # the run was killed before they were written
            continue
        found = saved.pop("seed")
        same = saved == wanted and all(given.get(key) == _plain(options.get(key)) for key in _DECIDING)
        if same and seed in (None, found) and _can_go_on(folder / CHECKPOINTS):
            return folder, int(found)
    return None


def _plain(content: object) -> Any:
    """Convert content to what YAML gives back: tuples become lists."""
    if isinstance(content, Mapping):
        return {str(key): _plain(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_plain(value) for value in content]
    return str(content) if isinstance(content, Path) else content


def _can_go_on(folder: Path) -> bool:
    store = CheckpointFolder(folder)
    if not store.checkpoints():
        return False
    try:
        store.acquire()
    except CheckpointError:  # another process uses it
        return False
    store.release()
    return True


def find_model(
    log_folder: Path, algo: str, environment: TeamEnvironment, number: int = 0, which: str | int | None = None
) -> tuple[Path, Path]:
    """
    Find a trained model.

    :param number: number of the run; 0 for the latest
    :param which: None for the final model, "best", "last" for the last saved one, or the game steps of a saved one
    :return: the run's folder, and the model's file
    :raises ValueError: if there is none, with a fix
    """
    name = environment.folder_name
    how = f"train first: python -m sb3_saf.train --algo {algo} --env {environment.id} -f {log_folder}"
    if not (log_folder / algo).is_dir():
        raise ValueError(f"there is no folder {log_folder / algo}; {how}")
    runs = dict(runs_of(log_folder, algo, name))
    if not runs:
        raise ValueError(f"there is no run of {environment.id} in {log_folder / algo}; {how}")
    if number and number not in runs:
        raise ValueError(f"there is no run {number} of {environment.id} in {log_folder / algo}; there are {[*runs]}")
    folder = runs[number or max(runs)]
    path = _model_file(folder, name, which)
    if path is None or not path.is_file():
        raise ValueError(
            f"{folder} has no {'saved model' if path is None else path.name}; --save-freq and --eval-freq of "
            "sb3_saf.train save models on the way"
        )
    return folder, path


def _model_file(folder: Path, name: str, which: str | int | None) -> Path | None:
    if which == "best":
        return folder / "best_model.zip"
    if which != "last":
        return folder / (f"{name}.zip" if which is None else f"rl_model_{which}_steps.zip")
    saved = [(int(found[1]), path) for path in folder.iterdir() if (found := _SAVED_MODEL.fullmatch(path.name))]
    return max(saved)[1] if saved else None
