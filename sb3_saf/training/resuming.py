"""Runs of the zoo that were ended before their time, and how they go on."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from rl_zoo3.utils import get_latest_run_id
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_saf.checkpoints.errors import CheckpointError
from sb3_saf.checkpoints.learning import resumable_learn
from sb3_saf.checkpoints.store import CheckpointFolder
from sb3_saf.errors import NonFiniteError
from sb3_saf.training.commands import CommandError
from sb3_saf.training.request import Request
from sb3_saf.training.yaml_files import load_yaml

CHECKPOINTS: Final = "checkpoints"
#: Checkpoints of a run unless it is told otherwise.
_PER_RUN: Final = 10
#: Options that, beside the settings, decide what a run leaves; ``config.yml`` does not have them.
_DECIDING: Final = ("eval_freq", "eval_episodes", "n_eval_envs", "eval_env_kwargs", "deterministic_eval", "save_freq")


def checkpoint_interval(request: Request) -> int:
    """
    Game steps between the checkpoints of a run.

    :return: 0 for none
    """
    if request.checkpoint_freq is None:
        return max(1, request.settings().game_steps // _PER_RUN)
    return max(0, request.checkpoint_freq)


def find_unfinished(request: Request, log_folder: str) -> tuple[Path, int] | None:
    """
    The latest run of the same settings that has checkpoints left, which a finished one has not, and is not at work.

    :param log_folder: as given with ``-f``
    :return: its folder and seed; None if there is none
    """
    runs = Path(log_folder, request.algo)
    wanted = _plain(request.settings().as_dict())
    for number in range(get_latest_run_id(str(runs), request.env_id), 0, -1):
        folder = runs / f"{request.env_id}_{number}"
        saved, options = (_read(folder / request.env_id / name) for name in ("config.yml", "args.yml"))
        seed = saved.pop("seed", None)
        same = saved == wanted and all(options.get(name) == request.options.get(name) for name in _DECIDING)
        if same and request.seed in (None, seed) and _can_go_on(folder / CHECKPOINTS):
            return folder, int(str(seed))
    return None


def _plain(content: object) -> Any:
    """As YAML gives it back: tuples are lists."""
    if isinstance(content, Mapping):
        return {str(key): _plain(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_plain(value) for value in content]
    return content


def _read(path: Path) -> dict[str, Any]:
    """A file of a run; empty if the run was killed before it was written."""
    try:
        content = load_yaml(path.read_text(encoding="utf-8"), str(path))
    except (OSError, ValueError):
        return {}
    return _plain(content) if isinstance(content, dict) else {}


def _can_go_on(folder: Path) -> bool:
    store = CheckpointFolder(folder)
    if not store.checkpoints():
        return False
    try:
        store.acquire()
    except CheckpointError:  # another process is at it
        return False
    store.release()
    return True


def learn_with_checkpoints(
    model: BaseAlgorithm,
    total_timesteps: int,
    folder: Path,
    callbacks: Sequence[BaseCallback],
    request: Request,
    **learn_arguments: Any,
) -> None:
    """
    Train, with checkpoints in the run's folder; if there are any, from the newest on.

    :param model: made as at the first start
    :param total_timesteps: of the whole run
    :param folder: of the run
    :param callbacks: of the run
    :param request: what the user asked for
    :param learn_arguments: of ``model.learn``
    :raises CommandError: if a checkpoint cannot be written or read, or training stops at NaN or infinity
    """
    with _errors_in_one_line():
        resumable_learn(
            model,
            total_timesteps,
            folder / CHECKPOINTS,
            list(callbacks),
            every_game_steps=checkpoint_interval(request),
            keep=2,
            again=f"go on from there with: {_resuming(request)}",
            **learn_arguments,
        )


def _resuming(request: Request) -> str:
    """The command that goes on."""
    given = request.command
    return given if "--resume" in shlex.split(given) else f"{given} --resume"


@contextmanager
def _errors_in_one_line() -> Iterator[None]:
    try:
        yield
    except (CheckpointError, NonFiniteError) as error:
        raise CommandError(str(error)) from error


def forget_checkpoints(folder: Path) -> None:
    """
    Remove the checkpoints of a run that is finished and saved.

    :param folder: of the run
    """
    shutil.rmtree(folder / CHECKPOINTS, ignore_errors=True)
