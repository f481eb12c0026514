"""
Published teams: the folder of a run (``training/folders.py``) with plain data only, which anybody can play.

    trained_teams/TeamSupport-c2-h1/saf/
        run.json             settings, seed, versions; ``row``: the row of its table, with the return of each test game
        weights.safetensors  the best policy by the evaluations
        replay.html          one episode, if the game is drawn from its state and the page is small
        finished.json        cost, and the digests of these files

``python -m sb3_saf.experiments publish`` writes them, ``python -m sb3_saf.experiments teams`` checks them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.evaluation import EvaluationResult, confidence_interval, evaluate_team
from sb3_saf.export.weights import load_weights
from sb3_saf.suites.registry import HOME, folder_name, suites
from sb3_saf.teams.checks import ExportError, evaluation_seed, unknown_name
from sb3_saf.training.folders import Run, software_versions

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
#: Settings that import by name.
_CODE: Final = ("env_wrapper", "vec_env_wrapper", "callback")


def load_team(env: str, method: str, folder: str | Path | None = None, *, device: str = "auto") -> BaseAlgorithm:
    """
    Load a published team, without running code from its files.

    The model has as many games as in its training, none of which it was trained on: ``evaluate_team(model,
    model.get_env(), 100)``, ``model.predict(own_observation)``.

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
    return model


def team_names(folder: str | Path | None = None) -> list[str]:
    """Return the names of all teams of a folder, such as ``"TeamSupport-c2-h1/saf"``; ValueError if there is none."""
    folder = TEAMS if folder is None else Path(folder)
    names = sorted(path.parent.relative_to(folder).as_posix() for path in folder.glob(f"*/*/{WEIGHTS}"))
    if not names:
        raise ValueError(f"expected teams in {folder}, got none; name the folder trained_teams of the repository")
    return names


def find_team(name: str, folder: str | Path | None = None) -> Run:
    """Return the run of a team whose files are as published; arguments and errors as those of :func:`load_team`."""
    env, _, method = name.rpartition("/")
    known, name = team_names(folder), f"{folder_name(env)}/{method}"
    if name not in known:
        raise unknown_name("team", name, known)
    run = Run((TEAMS if folder is None else Path(folder)) / name)
    if damage := run.damage(WEIGHTS):
        raise ExportError(f"{damage}; restore it from the repository: git checkout {run.folder}")
    check_runs_no_code(run.description["settings"], run.folder)
    return run


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
