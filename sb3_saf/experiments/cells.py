"""From an experiment to its cells: what is trained, where it is tested, and what does not fit."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from hecogrid_envs.task import TaskName
from sb3_saf.experiments.definitions import RANDOM, Experiment, Level
from sb3_saf.training.algorithms import ALGOS
from sb3_saf.training.names import unknown_name
from sb3_saf.training.settings import Settings, load_settings
from sb3_saf.training.yaml_files import Size

#: An algorithm whose settings give the random team its environment, which is the same for all.
_ANY_ALGORITHM = "ippo"


@dataclass(frozen=True)
class Cell:
    """
    One training: its folder's name tells everything that the dials can change.

    Cells do not know their experiment, so experiments in one folder share them.

    :param method: name of the algorithm, or ``"random"`` for the untrained team
    :param task: the game
    :param level: trained at
    :param seed: of the run
    :param tests: levels to test at
    :param n_agents: N where it is not the size's own
    """

    method: str
    task: TaskName
    level: Level
    seed: int
    tests: tuple[Level, ...]
    n_agents: int | None = None

    @property
    def id(self) -> str:
        """Folder of the cell below ``cells``, with slashes."""
        agents = "" if self.n_agents is None else f"-n{self.n_agents}"
        return f"{self.task}-{self.level.slug}{agents}/{self.method}/seed-{self.seed}"

    @property
    def is_trained(self) -> bool:
        """Whether there is anything to learn."""
        return self.method != RANDOM

    def env_kwargs(self, level: Level) -> dict[str, int]:
        """Parameters of the game at a level, as the cell changes them."""
        agents = {} if self.n_agents is None else {"n_agents": self.n_agents}
        return {"coordination": level.coordination, "heterogeneity": level.heterogeneity, **agents}

    def __str__(self) -> str:
        return f"{self.method} {self.task} {self.level} seed {self.seed}"


@dataclass(frozen=True)
class Protocol:
    """
    What is the same for all cells of a folder.

    :param size: which settings of the zoo
    :param overrides: what replaces the zoo's settings, with its keys: ``{"game_steps": 1000, "n_envs": 8}``
    :param episodes: team episodes of each test
    :param deterministic: whether tests take the most likely actions
    """

    size: Size
    overrides: Mapping[str, Any] = field(default_factory=dict)
    episodes: int = 32
    deterministic: bool = False

    def settings(self, cell: Cell, level: Level | None = None) -> Settings:
        """
        The zoo's settings for a cell.

        :param cell: for its method and task
        :param level: where it is tested; None for where it is trained
        """
        algo = cell.method if cell.is_trained else _ANY_ALGORITHM
        # Games are all that a random team needs.
        overrides = {key: value for key, value in self.overrides.items() if cell.is_trained or key == "env_kwargs"}
        overrides["env_kwargs"] = {**overrides.get("env_kwargs", {}), **cell.env_kwargs(level or cell.level)}
        return load_settings(algo, f"{cell.task}-v0", self.size, overrides=overrides)


class LeftOut(NamedTuple):
    """
    Levels that a size has no room for.

    :param task: the game
    :param level: trained at
    :param test: the level that does not fit, the trained one or a tested one
    :param reason: why
    """

    task: TaskName
    level: Level
    test: Level
    reason: str

    def __str__(self) -> str:
        where = "training" if self.test == self.level else f"the test at {self.test} after training"
        return f"{self.task}: {where} at {self.level} is left out: {self.reason}"


class Grid(NamedTuple):
    """
    All cells of an experiment.

    :param cells: in an order in which every stretch has all methods
    :param left_out: what does not fit
    """

    cells: list[Cell]
    left_out: list[LeftOut]


@dataclass(frozen=True)
class Choice:
    """
    The part of an experiment that somebody wants.

    :param seeds: seeds of the runs
    :param methods: empty for the experiment's own
    :param tasks: empty for the experiment's own
    :param levels: positions on the experiment's dials; empty for all of them
    """

    seeds: tuple[int, ...]
    methods: tuple[str, ...] = ()
    tasks: tuple[TaskName, ...] = ()
    levels: tuple[int, ...] = ()


def expand(experiment: Experiment, choice: Choice, protocol: Protocol) -> Grid:
    """
    The grid of an experiment: its methods and a random team, at every level that fits.

    :raises ValueError: for methods that are no algorithms, levels that it does not have, or if nothing fits
    """
    methods = check_methods(experiment, choice.methods)
    experiment = experiment.at(choice.levels)
    tasks = choice.tasks or experiment.tasks
    left_out: list[LeftOut] = []
    fitting: list[tuple[TaskName, Level, tuple[Level, ...]]] = []
    for task in tasks:
        for setting in experiment.settings:
            bad = dict(_misfits(task, {setting.train, *setting.tests}, experiment.n_agents, protocol))
            wrong = [setting.train] if setting.train in bad else [level for level in setting.tests if level in bad]
            left_out += [LeftOut(task, setting.train, level, bad[level]) for level in wrong]
            if setting.train not in bad:
                fitting.append((task, setting.train, tuple(level for level in setting.tests if level not in bad)))
    if not fitting:
        raise ValueError(f"no level of {experiment.name} fits the size {protocol.size!r}: {left_out[0].reason}")
    trained = [
        Cell(method, task, level, seed, tests, experiment.n_agents)
        for seed in choice.seeds
        for task, level, tests in fitting
        for method in methods
    ]
    return Grid(merge([*trained, *_random_teams(trained)]), left_out)


def _random_teams(trained: Iterable[Cell]) -> list[Cell]:
    """An untrained team for every tested level."""
    return [
        Cell(RANDOM, cell.task, level, cell.seed, (level,), cell.n_agents) for cell in trained for level in cell.tests
    ]


def merge(cells: Iterable[Cell]) -> list[Cell]:
    """Each training once, with all tests that anybody wants of it."""
    merged: dict[str, Cell] = {}
    for cell in cells:
        known = merged.setdefault(cell.id, cell)
        merged[cell.id] = replace(known, tests=tuple(dict.fromkeys((*known.tests, *cell.tests))))
    return list(merged.values())


def check_methods(experiment: Experiment, methods: Sequence[str]) -> tuple[str, ...]:
    """
    The methods of a run.

    :raises ValueError: for names that are no algorithms
    """
    for method in methods:
        if method not in ALGOS:
            raise unknown_name("method", method, ALGOS)
    missing = [method for method in experiment.methods if method not in ALGOS]
    if missing and not methods:
        raise ValueError(
            f"the experiment {experiment.name!r} needs the algorithms {', '.join(missing)}, which this installation "
            f"does not have; name others with --methods (there are {', '.join(ALGOS)})"
        )
    return tuple(dict.fromkeys(methods)) or experiment.methods


def _misfits(
    task: TaskName, levels: Iterable[Level], n_agents: int | None, protocol: Protocol
) -> Iterator[tuple[Level, str]]:
    """The levels that cannot be built, with the reason."""
    for level in levels:
        try:
            protocol.settings(Cell(RANDOM, task, level, 0, (), n_agents))
        except ValueError as error:
            yield level, str(error)


class Shard(NamedTuple):
    """
    One of several parts of a grid, for machines that know nothing of each other.

    :param index: from 1
    :param count: parts
    """

    index: int = 1  # type: ignore[assignment]  # hides methods of tuples that nobody needs here
    count: int = 1  # type: ignore[assignment]

    @classmethod
    def parse(cls, text: str) -> Shard:
        """
        Read ``3/8``.

        :raises ValueError: for anything that is no part
        """
        index, slash, count = text.partition("/")
        if not (slash and index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count)):
            raise ValueError(f"expected a part such as 3/8 (the third of eight), got {text!r}")
        return cls(int(index), int(count))

    def of(self, cells: Sequence[Cell]) -> list[Cell]:
        """
        Its cells: a stretch, so that each part has cheap and expensive methods alike.

        :param cells: the whole grid; the same for all parts, whatever is finished
        """
        trained = [cell for cell in cells if cell.is_trained]
        others = [cell for cell in cells if not cell.is_trained]
        return [cell for group in (trained, others) for cell in group[self._part(len(group))]]

    def _part(self, n: int) -> slice:
        return slice((self.index - 1) * n // self.count, self.index * n // self.count)

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"
