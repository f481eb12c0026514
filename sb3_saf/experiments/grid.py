"""Cells of an experiment: trainings, their test levels, and levels that do not fit."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from sb3_saf.experiments.definitions import METHODS, RANDOM, Experiment, Level, find_method
from sb3_saf.teams.checks import unknown_name
from sb3_saf.teams.files import plain
from sb3_saf.training.commands import option_words
from sb3_saf.training.settings import ALGOS, Settings, load_settings
from sb3_saf.training.yaml_files import Size

#: Algorithm whose settings define the environment of the random team; it is the same for all algorithms.
_ANY_ALGORITHM = "ippo"


@dataclass(frozen=True)
class Cell:
    """
    One training and its tests.

    The name of its folder identifies the training. Experiments in one folder share cells.

    :param method: name of the method (``definitions.METHODS``) or algorithm, or ``"random"`` for the untrained team
    :param env: the environment, as in ``sb3_saf.train --env``
    """

    method: str
    env: str
    level: Level
    seed: int
    tests: tuple[Level, ...] = ()

    @property
    def task(self) -> str:
        """Environment without its version."""
        return self.env.removesuffix("-v0")

    @property
    def id(self) -> str:
        """Folder of the cell below ``cells``, with slashes."""
        return f"{re.sub(r'[^A-Za-z0-9_.]', '-', self.task)}-{self.level.slug}/{self.method}/seed-{self.seed}"

    @property
    def is_trained(self) -> bool:
        """Whether the method is trained, not random."""
        return self.method != RANDOM

    def __str__(self) -> str:
        return f"{self.method} {self.task} {self.level} seed {self.seed}"


@dataclass(frozen=True)
class RunConfig:
    """
    Configuration of all cells of a folder.

    :param size: size of the settings in ``zoo_configs``
    :param overrides: replace settings of ``zoo_configs``, with the same keys: ``{"game_steps": 1000, "n_envs": 8}``
    :param episodes: team episodes of each test of a trained model
    :param eval_freq: game steps between evaluations during training; None for 20 per run
    :param eval_episodes: team episodes of each evaluation
    """

    size: Size
    overrides: Mapping[str, Any] = field(default_factory=dict)
    episodes: int = 512
    eval_freq: int | None = None
    eval_episodes: int = 32

    def words(self, cell: Cell | None = None) -> list[str]:
        """Return the command line options for the settings, without a cell those of all cells."""
        overrides = dict(self.overrides) if cell is None else self._overrides(cell, cell.level)
        words = ["--size", self.size]
        if "game_steps" in overrides:
            words += ["--game-steps", str(overrides.pop("game_steps"))]
        words += option_words("--env-kwargs", overrides.pop("env_kwargs", {}))
        words += option_words("--hyperparams", overrides)
        if self.eval_freq is not None:
            words += ["--eval-freq", str(self.eval_freq)]
        return [*words, "--eval-episodes", str(self.eval_episodes)]

    def _overrides(self, cell: Cell, level: Level) -> dict[str, Any]:
        """Return what replaces settings of ``zoo_configs`` in a cell; a random team needs the environment only."""
        overrides = {key: value for key, value in self.overrides.items() if cell.is_trained or key == "env_kwargs"}
        overrides["env_kwargs"] = {**overrides.get("env_kwargs", {}), **level.env_kwargs}
        if of_method := find_method(cell.method).policy_kwargs:
            overrides["policy_kwargs"] = {**overrides.get("policy_kwargs", {}), **of_method}
        return overrides

    def settings(self, cell: Cell, level: Level | None = None) -> Settings:
        """
        Return the settings of a cell.

        :param level: level of a test; None for the level of the training
        :raises ValueError: for unknown names, levels that cannot be built, and ``normalize``
        """
        algo = find_method(cell.method).algo if cell.is_trained else _ANY_ALGORITHM
        overrides = self._overrides(cell, cell.level if level is None else level)
        settings = load_settings(algo, cell.env, self.size, overrides=overrides)
        if settings.as_dict().get("normalize"):
            raise ValueError(
                "experiments do not keep the statistics of normalize, which tests would need; leave it out, or train "
                "with sb3_saf.train"
            )
        return settings

    def describe(self, cell: Cell) -> dict[str, Any]:
        """Return everything that determines a cell's result, as plain data: settings, seed and options of its run."""
        settings = self.settings(cell).as_dict()
        if not cell.is_trained:
            settings = {"algo": cell.method, "env": settings["env"], "env_kwargs": settings["env_kwargs"]}
        evaluation = {"eval_freq": self.eval_freq, "eval_episodes": self.eval_episodes} if cell.is_trained else {}
        options = {"method": cell.method, "level": cell.level.env_kwargs, "episodes": self.episodes, **evaluation}
        return plain({"settings": settings, "seed": cell.seed, "options": options})


class LeftOut(NamedTuple):
    """A level that does not fit the size, for training or for a test, and the reason."""

    task: str
    level: Level
    test: Level
    reason: str

    def __str__(self) -> str:
        where = "training" if self.test == self.level else f"the test at {self.test} after training"
        return f"{self.task}: {where} at {self.level} is left out: {self.reason}"


class Grid(NamedTuple):
    """All cells of an experiment, ordered so that every section has all methods, and the levels that do not fit."""

    cells: list[Cell]
    left_out: list[LeftOut]


@dataclass(frozen=True)
class Selection:
    """
    Part of an experiment.

    :param methods: empty for the experiment's methods
    :param envs: empty for the experiment's environments
    :param levels: positions on the experiment's axes, as text; empty for all of them
    :raises ValueError: for methods that are not algorithms
    """

    seeds: tuple[int, ...]
    methods: tuple[str, ...] = ()
    envs: tuple[str, ...] = ()
    levels: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for method in self.methods:
            if method not in (known := {**METHODS, **ALGOS}):
                raise unknown_name("method", method, known)

    def has(self, cell: Cell, experiment: Experiment) -> bool:
        """Return whether a cell belongs to this part; empty fields select everything. The random team always does."""
        tests = experiment.at(self.levels).tests()
        levels = set(tests) if cell.is_trained else {level for group in tests.values() for level in group}
        return (
            (not self.seeds or cell.seed in self.seeds)
            and (not self.envs or cell.env in self.envs)
            and (not self.methods or cell.method in self.methods or not cell.is_trained)
            and cell.level in levels
        )


def expand(experiment: Experiment, selection: Selection, config: RunConfig) -> Grid:
    """
    Return the grid of an experiment: its methods and a random team, at every level that fits.

    :raises ValueError: for levels that the experiment lacks, or if none fits
    """
    methods = selection.methods or experiment.methods
    left_out: list[LeftOut] = []
    trained: list[Cell] = []
    fitting: list[tuple[str, Level, tuple[Level, ...]]] = []
    for env in selection.envs or experiment.envs:
        for level, tests in experiment.at(selection.levels).tests().items():
            bad: dict[Level, str] = {}
            for one in {level, *tests}:
                try:
                    config.settings(Cell(RANDOM, env, one, 0))
                except ValueError as error:  # it cannot be built
                    bad[one] = str(error)
            wrong = [level] if level in bad else [test for test in tests if test in bad]
            left_out += [LeftOut(env.removesuffix("-v0"), level, test, bad[test]) for test in wrong]
            if level not in bad:
                fitting.append((env, level, tuple(test for test in tests if test not in bad)))
    if not fitting:
        raise ValueError(f"no level of {experiment.name} fits the size {config.size!r}: {left_out[0].reason}")
    for seed in selection.seeds:
        trained += [Cell(method, env, level, seed, tests) for env, level, tests in fitting for method in methods]
    random = [Cell(RANDOM, cell.env, level, cell.seed, (level,)) for cell in trained for level in cell.tests]
    return Grid(merge([*trained, *random]), left_out)


def merge(cells: Iterable[Cell]) -> list[Cell]:
    """Return each training once, with all its requested tests."""
    merged: dict[str, Cell] = {}
    for cell in cells:
        known = merged.setdefault(cell.id, cell)
        merged[cell.id] = replace(known, tests=tuple(dict.fromkeys((*known.tests, *cell.tests))))
    return list(merged.values())


class Shard(NamedTuple):
    """One of several parts of a grid, counted from 1, for machines that do not share a folder."""

    number: int = 1
    parts: int = 1

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Parse text such as ``3/8``; ValueError for an invalid part."""
        number, slash, parts = text.partition("/")
        if not (slash and number.isdecimal() and parts.isdecimal() and 1 <= int(number) <= int(parts)):
            raise ValueError(f"expected a part such as 3/8 (the third of eight), got {text!r}")
        return cls(int(number), int(parts))

    def of(self, cells: Sequence[Cell]) -> list[Cell]:
        """
        Return the cells of this part: a section, so that each part has cheap and expensive methods.

        :param cells: the whole grid, finished cells included, the same for all parts
        """
        part = []
        for is_trained in (True, False):
            group = [cell for cell in cells if cell.is_trained == is_trained]
            first, end = ((number * len(group)) // self.parts for number in (self.number - 1, self.number))
            part += group[first:end]
        return part

    def __str__(self) -> str:
        return f"{self.number}/{self.parts}"
