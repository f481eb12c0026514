"""What the paper's experiments are: methods, tasks and levels by name. No code here trains anything."""

from __future__ import annotations

from collections.abc import Collection
from typing import Final, NamedTuple

from hecogrid_envs.task import TaskName
from sb3_saf.training.names import unknown_name
from sb3_saf.training.yaml_files import Size

#: Seeds of a run that names none. The spec asks for at least three; smoke is for tests.
DEFAULT_SEEDS: Final[dict[Size, tuple[int, ...]]] = {"paper": (0, 1, 2), "small": (0, 1, 2), "smoke": (0, 1)}

#: The untrained team that every experiment has beside its methods.
RANDOM: Final = "random"


class Level(NamedTuple):
    """
    How hard a task is.

    :param coordination: c, agents that one treasure needs
    :param heterogeneity: h, zones with different dynamics
    """

    coordination: int
    heterogeneity: int

    def __str__(self) -> str:
        return f"c={self.coordination}, h={self.heterogeneity}"

    @property
    def slug(self) -> str:
        """For names of files and folders."""
        return f"c{self.coordination}-h{self.heterogeneity}"


class Setting(NamedTuple):
    """
    One level to train at, and the levels to test at.

    :param train: trained at
    :param tests: tested at
    """

    train: Level
    tests: tuple[Level, ...]


class View(NamedTuple):
    """
    One row of levels: what a bar chart shows.

    :param axis: the dial that is turned, as figures name it
    :param levels: tested at
    :param train: trained at; None where every level is trained at itself
    """

    axis: str
    levels: tuple[Level, ...]
    train: Level | None = None

    def position(self, level: Level) -> int:
        """Where a level is on the axis."""
        return level.heterogeneity if self.axis == HETEROGENEITY else level.coordination

    def at(self, positions: Collection[int]) -> View:
        """The same with fewer levels to test at: those whose position is among the given ones."""
        return self._replace(levels=tuple(level for level in self.levels if self.position(level) in positions))

    def shows(self, train: Level, test: Level) -> bool:
        """Whether something trained and tested at these levels belongs to it."""
        return test in self.levels and train == (self.train or test)

    @property
    def settings(self) -> list[Setting]:
        """What has to be trained and tested for it."""
        if self.train is not None:
            return [Setting(self.train, self.levels)]
        return [Setting(level, (level,)) for level in self.levels]

    def __str__(self) -> str:
        levels = "; ".join(map(str, self.levels))
        return f"levels {levels}" if self.train is None else f"trained at {self.train}, tested at {levels}"


class Experiment(NamedTuple):
    """
    One row of the paper's list.

    :param name: as the commands know it
    :param question: what it asks
    :param tasks: the games
    :param methods: algorithms as in ``--algo``
    :param views: levels
    :param n_agents: N where it is not the size's own
    """

    name: str
    question: str
    tasks: tuple[TaskName, ...] = ()
    methods: tuple[str, ...] = ()
    views: tuple[View, ...] = ()
    n_agents: int | None = None

    @property
    def is_grid(self) -> bool:
        """Whether there is anything to train."""
        return bool(self.views)

    @property
    def settings(self) -> list[Setting]:
        """Each level that is trained at, once, with where it is tested."""
        return list(dict.fromkeys(setting for view in self.views for setting in view.settings))

    def at(self, positions: Collection[int]) -> Experiment:
        """
        The part of it at some positions of its dials.

        :param positions: such as 1, 3, 5; empty for all of it
        :raises ValueError: for a position that none of its dials has
        """
        if not positions:
            return self
        known = sorted({view.position(level) for view in self.views for level in view.levels})
        for position in positions:
            if position not in known:
                raise ValueError(
                    f"{self.name} has no level {position} on its dials; there are {', '.join(map(str, known))}"
                )
        views = (view.at(positions) for view in self.views)
        return self._replace(views=tuple(view for view in views if view.levels))


COORDINATION: Final = "coordination"
HETEROGENEITY: Final = "heterogeneity"

_METHODS: Final = ("saf", "mappo", "ippo")
_BY_COORDINATION: Final = tuple(Level(c, 1) for c in (1, 2, 3))
_BY_HETEROGENEITY: Final = tuple(Level(1, h) for h in (1, 2, 3, 4, 5))
_BOTH: Final = tuple(Level(level, level) for level in (2, 3, 4))
#: Not all tasks that there are: one more must not enlarge the paper's experiments.
_PAPER_TASKS: Final[tuple[TaskName, ...]] = ("TeamTogether", "TeamSupport", "KeyForTreasure")
_TWO_TASKS: Final[tuple[TaskName, ...]] = ("TeamTogether", "TeamSupport")
_COORDINATION: Final = View(COORDINATION, _BY_COORDINATION)
_HETEROGENEITY: Final = View(HETEROGENEITY, _BY_HETEROGENEITY)
_OOD_COORDINATION: Final = View(COORDINATION, _BY_COORDINATION, train=Level(2, 1))
_OOD_HETEROGENEITY: Final = View(HETEROGENEITY, _BY_HETEROGENEITY, train=Level(1, 2))

_ALL: Final = (
    Experiment("coordination", "how hard is coordination?", _PAPER_TASKS, _METHODS, (_COORDINATION,)),
    Experiment("heterogeneity", "how hard are zones?", _PAPER_TASKS, _METHODS, (_HETEROGENEITY,)),
    Experiment(
        "joint",
        "how hard are both at once?",
        ("TeamSupport",),
        _METHODS,
        (View(f"{COORDINATION} = {HETEROGENEITY}", _BOTH),),
    ),
    Experiment(
        "ablation",
        "what does each part of SAF give?",
        _PAPER_TASKS,
        ("saf-no-pool", *_METHODS),
        (_COORDINATION, _HETEROGENEITY),
    ),
    Experiment("ood-coordination", "robustness to unseen coordination", _TWO_TASKS, _METHODS, (_OOD_COORDINATION,)),
    Experiment("ood-heterogeneity", "robustness to unseen heterogeneity", _TWO_TASKS, _METHODS, (_OOD_HETEROGENEITY,)),
    Experiment(
        "ood-ablation",
        "what does the pool give out of distribution?",
        _TWO_TASKS,
        ("saf-no-pool", "saf"),
        (_OOD_COORDINATION, _OOD_HETEROGENEITY),
    ),
    Experiment(
        "qplex",
        "does a pool help value factorisation?",
        _PAPER_TASKS,
        ("qplex", "qplex-pool"),
        (View(COORDINATION, (Level(1, 1),)),),
        n_agents=5,
    ),
    Experiment("parameters", "the parameter table"),
)
EXPERIMENTS: Final[dict[str, Experiment]] = {experiment.name: experiment for experiment in _ALL}


def find_experiment(name: str) -> Experiment:
    """
    An experiment by name.

    :raises ValueError: with the nearest name that exists
    """
    if name not in EXPERIMENTS:
        raise unknown_name("experiment", name, EXPERIMENTS)
    return EXPERIMENTS[name]
