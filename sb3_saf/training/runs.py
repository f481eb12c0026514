"""Runs in a log folder, ``FOLDER/ALGO/ENV_NUMBER``: their settings, and their results as tidy tables."""

from __future__ import annotations

import zipfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pandas as pd

from sb3_saf.teams.checks import unknown_name
from sb3_saf.training.environments import folder_name
from sb3_saf.training.folders import read_run, run_number
from sb3_saf.training.settings import Settings, load_settings, saved_settings

#: Source of scores: evaluation games, or training games.
Source = Literal["evaluation", "training"]

#: Points of a curve of training episodes.
_N_POINTS: Final = 50
#: Maximum number of changed settings in a method's name.
_MOST_NAMED: Final = 2
#: Last fraction of training whose episodes are its result.
_FINAL_PART: Final = 0.1


@dataclass(frozen=True)
class Run:
    """A run folder of ``sb3_saf.train``: its path, the environment's name in folders, and its number."""

    folder: Path
    name: str
    number: int

    @cached_property
    def config(self) -> Mapping[str, Any]:
        """Content of ``config.yml``."""
        return read_run(self.folder, self.name)

    @cached_property
    def settings(self) -> Settings:
        """Settings of the run."""
        return saved_settings(self.config)

    def curve(self, source: Source) -> pd.DataFrame:
        """Return the learning curve of team returns, columns ``game_steps``, ``score``."""
        return self._evaluations() if source == "evaluation" else self._training()

    def final_score(self, source: Source) -> float:
        """Return the mean team return of the last evaluation, or of the last tenth of training."""
        curve = self.curve(source)
        if source == "evaluation":
            return float(curve["score"].iloc[-1])
        late = curve["game_steps"] > (1 - _FINAL_PART) * curve["game_steps"].iloc[-1]
        return float(curve["score"][late].mean())

    def _evaluations(self) -> pd.DataFrame:
        path = self.folder / "evaluations.npz"
        if not path.is_file():
            raise ValueError(f"{self.folder} has no evaluations; train with --eval-freq, or plot --source training")
        try:
            with np.load(path, allow_pickle=False) as arrays:
                return pd.DataFrame({"game_steps": arrays["game_steps"], "score": arrays["results"].mean(axis=1)})
        except (KeyError, ValueError, OSError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path} is not what sb3_saf.train writes: {error}") from error

    def _training(self) -> pd.DataFrame:
        path = self.folder / "monitor.csv"
        if not path.is_file():
            raise ValueError(f"{self.folder} has no monitor.csv; train with sb3_saf.train")
        return training_curve(path)


def training_curve(monitor: str | Path, n_points: int = _N_POINTS) -> pd.DataFrame:
    """
    Return the learning curve of the training games: ``game_steps``, and ``score``, the mean team return.

    :param monitor: a ``monitor.csv``, or the ``monitor_dir`` of ``make_team_env``
    :param n_points: number of means, over about equal numbers of episodes
    :raises ValueError: if no episode has ended
    """
    path = Path(monitor)
    if path.is_dir():
        path /= "monitor.csv"
    try:
        episodes = pd.read_csv(path, comment="#")[["r", "l"]].astype(float)
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path} is not what sb3_saf.train writes: {error}") from error
    if episodes.empty:
        raise ValueError(f"no episode has ended in {path.parent}; train longer")
    steps = episodes["l"].cumsum()
    bins = np.ceil(steps / steps.iloc[-1] * n_points).astype(int)
    means = episodes["r"].groupby(bins).mean()
    return pd.DataFrame({"game_steps": means.index * steps.iloc[-1] / n_points, "score": means.to_numpy()})


def find_runs(folder: Path, algos: Collection[str] = (), env_ids: Collection[str] = ()) -> list[Run]:
    """Find the runs in a log folder, of the given algorithms and environments, or of all if none are given."""
    if not folder.is_dir():
        raise ValueError(f"there is no folder {folder}; give the -f that sb3_saf.train was given")
    names = {folder_name(env_id) for env_id in env_ids}
    found: dict[str, list[Run]] = {}
    for algo_folder in sorted(path for path in folder.iterdir() if path.is_dir()):
        for run_folder in sorted(path for path in algo_folder.iterdir() if path.is_dir()):
            for name in (config.parent.name for config in run_folder.glob("*/config.yml")):
                number = run_number(run_folder, name)
                if number is not None and (not names or name in names):
                    found.setdefault(algo_folder.name, []).append(Run(run_folder, name, number))
    if not found:
        of = f" of {', '.join(env_ids)}" if env_ids else ""
        raise ValueError(f"there are no runs{of} in {folder}; train some: python -m sb3_saf.train -f {folder}")
    for algo in algos:
        if algo not in found:
            raise unknown_name(f"algorithm among the runs in {folder}:", algo, found)
    runs = [run for algo in (algos or found) for run in found[algo]]
    return sorted(runs, key=lambda run: run.number)


def describe(runs: Sequence[Run]) -> pd.DataFrame:
    """
    Describe runs in a table.

    :return: columns ``run``, ``method``, ``changes``, ``seed``, ``env``, ``size`` and the parameters of the game. A
        method's name contains its differences from the zoo's settings and from other runs, or a number if these are too
        many; ``changes`` lists them. Of runs that differ only in their number, the table has the latest
    """
    rows = []
    for run in runs:
        settings = run.settings
        identity = {"env": settings.env_id, "size": settings.size, "seed": run.config["seed"]}
        rows.append({**identity, **settings.env_kwargs, "run": run})
    table = pd.DataFrame(rows)
    table["changes"] = _changes(runs)
    table["method"] = _method_names([run.settings.algo for run in runs], list(table["changes"]))
    repeated = [column for column in table.columns if column != "run"]
    return table.drop_duplicates(repeated, keep="last", ignore_index=True)


def _changes(runs: Sequence[Run]) -> list[str]:
    """Return differences from the zoo's settings that not all runs of the algorithm at that size share."""
    own = [_different_from_the_zoo(run.settings) for run in runs]
    kinds = [(run.settings.algo, run.settings.size, run.settings.env_id) for run in runs]
    texts = []
    for kind, different in zip(kinds, own, strict=True):
        others = [other for of, other in zip(kinds, own, strict=True) if of == kind]
        named = [key for key, value in different.items() if any(other.get(key) != value for other in others)]
        texts.append(" ".join(f"{key}={different[key]}" for key in sorted(named)))
    return texts


def _different_from_the_zoo(settings: Settings) -> dict[str, str]:
    """Return settings that differ from the zoo's present ones for the same game, as text."""
    zoo = load_settings(settings.algo, settings.env_id, settings.size, settings.env_kwargs)
    ours, theirs = _flat(settings), _flat(zoo)
    keys = [key for key in {**theirs, **ours} if repr(ours.get(key)) != repr(theirs.get(key))]
    return {key: _short(ours.get(key, "default")) for key in keys}


def _flat(settings: Settings) -> dict[str, Any]:
    own = {"n_envs": settings.n_envs, "game_steps": settings.game_steps, **settings.plain, **settings.wrapping}
    of_policy = own.pop("policy_kwargs", {})
    return {**own, **of_policy}


def _short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _method_names(algos: Sequence[str], changes: Sequence[str]) -> list[str]:
    """Name methods by the algorithm with its changes, or with a number if these are too many for a legend."""
    numbers: dict[str, dict[str, int]] = {}
    names = []
    for algo, text in zip(algos, changes, strict=True):
        if text.count("=") <= _MOST_NAMED:
            names.append(f"{algo} {text}".rstrip())
        else:
            known = numbers.setdefault(algo, {})
            names.append(f"{algo}, variant {known.setdefault(text, len(known) + 1)}")
    return names


def setting_names(table: pd.DataFrame, without: Collection[str] = ()) -> list[str]:
    """Name the games of each row of :func:`describe`: the environment, and the parameters in which the rows differ."""
    named = {"method", "changes", "seed", "env", "run", *without}
    varying = [column for column in table.columns if column not in named and table[column].nunique() > 1]
    return [
        ", ".join([row["env"].removesuffix("-v0"), *(f"{c} {row[c]}" for c in varying if not pd.isna(row[c]))])
        for _, row in table.iterrows()
    ]
