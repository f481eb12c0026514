"""Definitions of experiments: methods, environments and levels by name."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final, NamedTuple

from sb3_saf.teams.checks import unknown_name

#: The command, as users type it.
MODULE: Final = "sb3_saf.experiments"
PROGRAM: Final = f"python -m {MODULE}"
#: Default seeds of a run: the paper's experiments have at least three.
DEFAULT_SEEDS: Final = (0, 1, 2)

#: The untrained team that every experiment includes.
RANDOM: Final = "random"


class Method(NamedTuple):
    """
    A method of experiments.

    :param algo: algorithm, as in ``sb3_saf.train --algo``
    :param policy_kwargs: arguments of the policy that differ from those of ``zoo_configs``
    """

    algo: str
    words: str
    policy_kwargs: Mapping[str, Any] = {}


#: SAF as in the paper: its pool and slots, and a critic for each agent on all agents' s^SAF.
_PAPER_SAF: Final[dict[str, Any]] = {
    **{"heads": "per_agent", "critic_input": "team"},
    **{"n_policies": 4, "n_slots": 4, "latent_dim": 64, "projection_arch": [128, 128]},
}
_ACTORS: Final[dict[str, dict[str, Any]]] = {
    "own": {"n_policies": 1, "heads": "per_agent", "critic_heads": "shared"},
    "shared": {"n_policies": 1},
    "pool": {"n_policies": 4},
}
_CRITICS: Final[dict[str, dict[str, Any]]] = {
    "own": {"knowledge_source": False, "critic_input": "own"},
    "team": {"knowledge_source": False, "critic_input": "team"},
    "mean": {"knowledge_source": False, "critic_input": "mean"},
    "source": {"n_slots": 4, "latent_dim": 64, "projection_arch": [128, 128]},
}
_ACTOR_WORDS: Final = {"own": "an actor each", "shared": "one actor", "pool": "pool of four"}
_CRITIC_WORDS: Final = {"own": "own view", "team": "concatenation", "mean": "mean pool", "source": "knowledge source"}
#: Methods that are more than an algorithm's name, or have another name in words.
METHODS: Final[dict[str, Method]] = {
    RANDOM: Method("", "random"),
    "saf": Method("saf", "SAF"),
    "saf-paper": Method("saf", "SAF, paper's form", _PAPER_SAF),
    "saf-no-pool": Method("saf-no-pool", "SAF without pool"),
    "saf-paper-no-pool": Method("saf", "SAF without pool, paper's form", {**_PAPER_SAF, "n_policies": 1}),
    "saf-no-ks": Method("saf-no-ks", "SAF without knowledge source"),
    "mappo": Method("mappo", "MAPPO, paper's text"),
    "mappo-separate": Method("mappo-separate", "MAPPO, paper's table"),
    "ippo": Method("ippo", "IPPO, shared"),
    "ippo-separate": Method("ippo-separate", "IPPO, paper's"),
    "qplex": Method("qplex", "QPLEX"),
    "qplex-pool": Method("qplex-pool", "QPLEX with pool"),
    **{
        f"actor-{actor}-critic-{critic}": Method(
            "saf", f"{_ACTOR_WORDS[actor]}, {_CRITIC_WORDS[critic]}", {**_ACTORS[actor], **_CRITICS[critic]}
        )
        for actor in _ACTORS
        for critic in _CRITICS
    },
}


def find_method(name: str) -> Method:
    """Return a method by its name; any other name is an algorithm's."""
    return METHODS.get(name, Method(name, name))


#: Abbreviations of parameters in names of levels.
_SHORT: Final = {"coordination": "c", "heterogeneity": "h", "n_agents": "n"}
#: Values allowed in a folder's name.
_PLAIN: Final = re.compile(r"[\w.+-]+")


class Level(NamedTuple):
    """
    Parameters of the environment that an experiment varies.

    :param parameters: names and values; empty for the defaults
    """

    parameters: tuple[tuple[str, Any], ...] = ()

    @classmethod
    def of(cls, **parameters: Any) -> Level:
        """Return the level with these parameters: ``Level.of(coordination=2, heterogeneity=1)``."""
        return cls(tuple(parameters.items()))

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Parameters as arguments of the environment."""
        return dict(self.parameters)

    @property
    def slug(self) -> str:
        """Name for files and folders, such as ``"c2-h1"``."""
        return "-".join(f"{_SHORT.get(name, name)}{value}" for name, value in self.parameters) or "default"

    def __str__(self) -> str:
        return ", ".join(f"{_SHORT.get(name, name)}={value}" for name, value in self.parameters) or "default"


class View(NamedTuple):
    """
    Levels along one parameter: the content of a bar chart.

    :param parameter: varied parameter; empty if there is one level only
    :param train: level of the training; None to train at each test level
    :param label: label of the axis; empty for the parameter's name
    """

    parameter: str
    levels: tuple[Level, ...]
    train: Level | None = None
    label: str = ""

    @property
    def axis(self) -> str:
        """Name of the axis in figures."""
        return self.label or self.parameter or "level"

    @property
    def suffix(self) -> str:
        """Level of the training, for titles; empty if training is at each test level."""
        return "" if self.train is None else f", trained at {self.train}"

    def position(self, level: Level) -> Any:
        """Return the position of a level on the axis."""
        return level.env_kwargs.get(self.parameter, "default")

    def at(self, positions: Collection[str]) -> View:
        """Return the view with only the test levels at the given positions."""
        return self._replace(levels=tuple(level for level in self.levels if str(self.position(level)) in positions))

    def __str__(self) -> str:
        levels = "; ".join(map(str, self.levels))
        return f"levels {levels}" if self.train is None else f"trained at {self.train}, tested at {levels}"


class Experiment(NamedTuple):
    """
    A grid of methods, environments and levels.

    :param envs: environments, as in ``sb3_saf.train --env``
    :param methods: algorithms, as in ``sb3_saf.train --algo``
    """

    name: str
    question: str
    envs: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    views: tuple[View, ...] = ()

    @property
    def is_grid(self) -> bool:
        """Whether the experiment has cells to train."""
        return bool(self.views)

    def tests(self) -> dict[Level, tuple[Level, ...]]:
        """Return the training levels, each with its test levels."""
        tests: dict[Level, dict[Level, None]] = {}
        for view in self.views:
            for level in view.levels:
                tests.setdefault(view.train or level, {})[level] = None
        return {train: tuple(levels) for train, levels in tests.items()}

    def at(self, positions: Collection[str]) -> Experiment:
        """
        Return the part of the experiment at some positions of its axes.

        :param positions: such as 1, 3, 5, as text; empty for all
        :raises ValueError: for a position that no axis has
        """
        if not positions:
            return self
        known = dict.fromkeys(str(view.position(level)) for view in self.views for level in view.levels)
        for position in positions:
            if position not in known:
                raise ValueError(f"{self.name} has no level {position} on its axes; there are {', '.join(known)}")
        views = (view.at(positions) for view in self.views)
        return self._replace(views=tuple(view for view in views if view.levels))


def own_experiment(name: str, envs: Sequence[str], vary: Mapping[str, Sequence[Any]]) -> Experiment:
    """
    Return an experiment on any environment, with the paper's methods.

    :param name: name of the folder of its report
    :param envs: environments, as in ``sb3_saf.train --env``
    :param vary: at most one parameter of the environment, with its values
    :raises ValueError: for names or values not allowed in folder names
    """
    if not _PLAIN.fullmatch(name) or name in EXPERIMENTS:
        raise ValueError(
            f"an experiment of your own needs a name of letters, digits, '.', '_' and '-' that the paper's do not "
            f"have, got {name!r}; write one before --env"
        )
    if len(vary) > 1:
        raise ValueError(f"--vary takes one parameter, got {', '.join(vary)}; give the others with --env-kwargs")
    view = View("", (Level(),))
    for parameter, given in vary.items():
        values = given if isinstance(given, list) else [given]
        for value in values:
            if not isinstance(value, (bool, int, float, str)) or not _PLAIN.fullmatch(str(value)):
                raise ValueError(
                    f"--vary {parameter} expects numbers or words, such as {parameter}:[1,2], got {value!r}"
                )
        view = View(parameter, tuple(Level(((parameter, value),)) for value in dict.fromkeys(values)))
    return Experiment(name, f"methods on {', '.join(envs)}", tuple(envs), _METHODS, (view,))


COORDINATION: Final = "coordination"
HETEROGENEITY: Final = "heterogeneity"


def _level(coordination: int, heterogeneity: int) -> Level:
    return Level.of(coordination=coordination, heterogeneity=heterogeneity)


_METHODS: Final = ("saf", "mappo", "ippo")
#: The paper's tasks, written out, so that new tasks do not enlarge the paper's experiments.
_THREE_TASKS: Final = ("TeamTogether-v0", "TeamSupport-v0", "KeyForTreasure-v0")
_TWO_TASKS: Final = _THREE_TASKS[:2]
_BY_COORDINATION: Final = View(COORDINATION, tuple(_level(c, 1) for c in (1, 2, 3)))
_BY_HETEROGENEITY: Final = View(HETEROGENEITY, tuple(_level(1, h) for h in (1, 2, 3, 4, 5)))
_BOTH: Final = View(COORDINATION, tuple(_level(n, n) for n in (2, 3, 4)), label=f"{COORDINATION} = {HETEROGENEITY}")
_OOD_COORDINATION: Final = _BY_COORDINATION._replace(train=_level(2, 1))
_OOD_HETEROGENEITY: Final = _BY_HETEROGENEITY._replace(train=_level(1, 2))
_FIVE_AGENTS: Final = View(
    COORDINATION, tuple(Level.of(coordination=c, heterogeneity=1, n_agents=5) for c in (1, 2, 3))
)
#: SAF without pool: an actor for each agent, as in the paper's ablation, and one actor that all agents share.
_WITHOUT_POOL: Final = ("saf-paper-no-pool", "saf-no-pool")

_ALL: Final = (
    Experiment("coordination", "how hard is coordination?", _THREE_TASKS, _METHODS, (_BY_COORDINATION,)),
    Experiment("heterogeneity", "how hard are zones?", _THREE_TASKS, _METHODS, (_BY_HETEROGENEITY,)),
    Experiment("joint", "how hard are both at once?", ("TeamSupport-v0",), _METHODS, (_BOTH,)),
    Experiment(
        "ablation",
        "what does each part of SAF give?",
        _THREE_TASKS,
        (*_WITHOUT_POOL, *_METHODS),
        (_BY_COORDINATION, _BY_HETEROGENEITY),
    ),
    Experiment("ood-coordination", "robustness to unseen coordination", _TWO_TASKS, _METHODS, (_OOD_COORDINATION,)),
    Experiment("ood-heterogeneity", "robustness to unseen heterogeneity", _TWO_TASKS, _METHODS, (_OOD_HETEROGENEITY,)),
    Experiment(
        "ood-ablation",
        "what does the pool give out of distribution?",
        _TWO_TASKS,
        (*_WITHOUT_POOL, "saf"),
        (_OOD_COORDINATION, _OOD_HETEROGENEITY),
    ),
    Experiment(
        "qplex", "does a pool help value factorisation?", _THREE_TASKS, ("qplex", "qplex-pool"), (_FIVE_AGENTS,)
    ),
    Experiment("parameters", "the parameter table"),
)
EXPERIMENTS: Final[dict[str, Experiment]] = {experiment.name: experiment for experiment in _ALL}


def find_experiment(name: str, others: Collection[str] = ()) -> Experiment:
    """Return an experiment of the paper; the ValueError suggests the nearest known name."""
    if name not in EXPERIMENTS:
        raise unknown_name("experiment", name, [*others, *EXPERIMENTS])
    return EXPERIMENTS[name]
