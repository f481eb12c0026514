"""What the paper's experiments are: methods, tasks and levels by name. No code here trains anything."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from typing import Final, Literal, NamedTuple, get_args

from hecogrid_envs.params import TASK_NAMES, TaskName

Size = Literal["paper", "small", "smoke"]
SIZES: Final[tuple[Size, ...]] = get_args(Size)

#: Seeds of a run that names none. The spec asks for at least three; smoke is for tests.
DEFAULT_SEEDS: Final[dict[Size, tuple[int, ...]]] = {"paper": (0, 1, 2), "small": (0, 1, 2), "smoke": (0, 1)}

#: The untrained team that every experiment has beside its methods.
RANDOM: Final = "random"

#: Names of algorithms as figures and pages write them.
LABELS: Final[dict[str, str]] = {
    "saf": "SAF",
    "saf-no-pool": "SAF without pool",
    "saf-no-ks": "SAF without knowledge source",
    "mappo": "MAPPO",
    "ippo": "IPPO",
    "qplex": "QPLEX",
    "qplex-pool": "QPLEX with pool",
    RANDOM: "random team",
}


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


class Experiment(NamedTuple):
    """
    One row of the paper's list.

    :param name: as the commands know it
    :param question: what it asks
    :param tasks: the games
    :param methods: algorithms as in ``--algo``
    :param settings: levels
    :param n_agents: N where it is not the size's own
    """

    name: str
    question: str
    tasks: tuple[TaskName, ...] = ()
    methods: tuple[str, ...] = ()
    settings: tuple[Setting, ...] = ()
    n_agents: int | None = None

    @property
    def is_grid(self) -> bool:
        """Whether there is anything to train."""
        return bool(self.settings)

    @property
    def is_out_of_distribution(self) -> bool:
        """Whether it tests where it has not trained."""
        return any(setting.tests != (setting.train,) for setting in self.settings)

    @property
    def test_levels(self) -> list[Level]:
        """All levels that are tested, in order."""
        return list(dict.fromkeys(level for setting in self.settings for level in setting.tests))

    @property
    def varies(self) -> list[str]:
        """Which of the dials its test levels turn."""
        levels = self.test_levels
        return [dial for dial in Level._fields if len({getattr(level, dial) for level in levels}) > 1]


def _same(*levels: Level) -> tuple[Setting, ...]:
    """Settings that are tested where they are trained."""
    return tuple(Setting(level, (level,)) for level in levels)


_METHODS: Final = ("saf", "mappo", "ippo")
_BY_COORDINATION: Final = tuple(Level(c, 1) for c in (1, 2, 3))
_BY_HETEROGENEITY: Final = tuple(Level(1, h) for h in (1, 2, 3, 4, 5))
_TWO_TASKS: Final[tuple[TaskName, ...]] = ("TeamTogether", "TeamSupport")
_OOD_COORDINATION: Final = Setting(Level(2, 1), _BY_COORDINATION)
_OOD_HETEROGENEITY: Final = Setting(Level(1, 2), _BY_HETEROGENEITY)

_ALL: Final = (
    Experiment("coordination", "how hard is coordination?", TASK_NAMES, _METHODS, _same(*_BY_COORDINATION)),
    Experiment("heterogeneity", "how hard are zones?", TASK_NAMES, _METHODS, _same(*_BY_HETEROGENEITY)),
    Experiment(
        "joint", "both at once", ("TeamSupport",), _METHODS, _same(*(Level(level, level) for level in (2, 3, 4)))
    ),
    Experiment(
        "ablation",
        "what does each part of SAF give?",
        TASK_NAMES,
        ("saf-no-pool", *_METHODS),
        _same(*_BY_COORDINATION, *_BY_HETEROGENEITY[1:]),
    ),
    Experiment(
        "ood-coordination", "robustness to unseen coordination", _TWO_TASKS, _METHODS, (_OOD_COORDINATION,)
    ),
    Experiment(
        "ood-heterogeneity", "robustness to unseen heterogeneity", _TWO_TASKS, _METHODS, (_OOD_HETEROGENEITY,)
    ),
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
        TASK_NAMES,
        ("qplex", "qplex-pool"),
        _same(Level(1, 1)),
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
    return EXPERIMENTS[check_choice("experiment", name, list(EXPERIMENTS))]


def check_choice(what: str, name: str, known: Sequence[str]) -> str:
    """
    A name that exists.

    :param what: what it names, for the error
    :raises ValueError: with the nearest name that exists
    """
    if name in known:
        return name
    close = get_close_matches(name, known, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    raise ValueError(f"unknown {what} {name!r}{hint}; there are {', '.join(known)}")


def label(method: str) -> str:
    """A method as figures and pages write it."""
    return LABELS.get(method, method)
