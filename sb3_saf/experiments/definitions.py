"""Experiments: methods, environments and levels by name, and the cells of a grid, its trainings and their tests."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple

from sb3_saf.teams.checks import unknown_name
from sb3_saf.teams.files import plain
from sb3_saf.training.commands import option_words
from sb3_saf.training.settings import ALGOS, Settings, load_settings
from sb3_saf.training.yaml_files import Size

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
#: Actors and critics in words, with their arguments of the policy.
_ACTORS: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "own": ("an actor each", {"n_policies": 1, "heads": "per_agent", "critic_heads": "shared"}),
    "shared": ("one actor", {"n_policies": 1}),
    "pool": ("pool of four", {"n_policies": 4}),
}
_CRITICS: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "own": ("own view", {"knowledge_source": False, "critic_input": "own"}),
    "team": ("concatenation", {"knowledge_source": False, "critic_input": "team"}),
    "mean": ("mean pool", {"knowledge_source": False, "critic_input": "mean"}),
    "source": ("knowledge source", {"n_slots": 4, "latent_dim": 64, "projection_arch": [128, 128]}),
}
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
    "pqn": Method("pqn", "PQN-VDN"),
    **{
        f"actor-{actor}-critic-{critic}": Method("saf", f"{words}, {critic_words}", {**of_actor, **of_critic})
        for actor, (words, of_actor) in _ACTORS.items()
        for critic, (critic_words, of_critic) in _CRITICS.items()
    },
}


def find_method(name: str) -> Method:
    """Return a method by its name; any other name is an algorithm's."""
    return METHODS.get(name, Method(name, name))


#: Abbreviations of parameters in names of levels.
_SHORT: Final = {"coordination": "c", "heterogeneity": "h", "n_agents": "n"}
#: Values allowed in a folder's name.
_PLAIN: Final = re.compile(r"[\w.+-]+")
#: Names in a folder of results.
_TAKEN: Final = ("cells", "damaged", "settings.json", "unfinished")


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
    envs: tuple[str, ...]
    methods: tuple[str, ...]
    views: tuple[View, ...]

    @property
    def vary(self) -> dict[str, list[Any]]:
        """Varied parameters with their values, as :func:`own_experiment` takes them."""
        return {
            view.parameter: [view.position(level) for level in view.levels] for view in self.views if view.parameter
        }

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


#: Columns of the tables, which no varied parameter can be.
_COLUMNS: Final = {
    *("method", "task", "train_level", "level", "max_return", "game", "training", "seed", "game_steps"),
    *("best_game_steps", "episodes", "actions", "return_mean", "return_low", "return_high", "return_sd", "return_last"),
    *("return_most_likely", "return_last_most_likely", "success_rate", "length", "score", "agent_returns", "commit"),
    *("processor_seconds", "wall_seconds_training", "wall_seconds_test", "processor", "cell", "low", "span"),
}


def own_experiment(name: str, envs: Sequence[str], vary: Mapping[str, Sequence[Any]]) -> Experiment:
    """
    Return an experiment on any environment, with the paper's methods.

    :param name: name of the folder of its report
    :param envs: environments, as in ``sb3_saf.train --env``
    :param vary: at most one parameter of the environment, with its values
    :raises ValueError: for names or values not allowed in folder names
    """
    if not _PLAIN.fullmatch(name) or name[0] == "." or name in {*EXPERIMENTS, *_TAKEN}:
        raise ValueError(
            f"an experiment of your own needs a name of letters, digits, '.', '_' and '-' that the paper's and the "
            f"files beside it do not have, got {name!r}; write one before --env"
        )
    if len(vary) > 1:
        raise ValueError(f"--vary takes one parameter, got {', '.join(vary)}; give the others with --env-kwargs")
    if taken := _COLUMNS.intersection(vary):
        raise ValueError(f"--vary cannot take {', '.join(taken)}, a column of the tables; rename it in the environment")
    view = View("", (Level(),))
    for parameter, given in vary.items():
        values = given if isinstance(given, list) else [given]
        for value in values:
            if not isinstance(value, (bool, int, float, str)) or not _PLAIN.fullmatch(str(value)):
                raise ValueError(
                    f"--vary {parameter} expects numbers or words, such as {parameter}:[1,2], got {value!r}"
                )
        view = View(parameter, tuple(Level(((parameter, value),)) for value in values))
        if len(set(values)) < len(values) or len({level.slug for level in view.levels}) < len(values):
            raise ValueError(f"--vary {parameter} expects different values, got {', '.join(map(repr, values))}")
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
)
EXPERIMENTS: Final[dict[str, Experiment]] = {experiment.name: experiment for experiment in _ALL}

#: Algorithm whose settings define the environment of the random team; it is the same for all algorithms.
_ANY_ALGORITHM = "ippo"
#: Settings of the games, which a random team plays, too.
_OF_GAMES: Final = "env_kwargs", "env_wrapper", "frame_stack", "state", "team_reward", "time_limit", "vec_env_wrapper"


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
        overrides = {key: value for key, value in self.overrides.items() if cell.is_trained or key in _OF_GAMES}
        overrides["env_kwargs"] = {**overrides.get("env_kwargs", {}), **level.env_kwargs}
        if of_method := find_method(cell.method).policy_kwargs:
            given = overrides.get("policy_kwargs", {})
            if fixed := {key: value for key, value in of_method.items() if given.get(key, value) != value}:
                raise ValueError(f"the method {cell.method} sets policy_kwargs {fixed}; leave them out, or the method")
            overrides["policy_kwargs"] = {**given, **of_method}
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
        if settings.as_dict().get("normalize") not in (None, False):
            raise ValueError(
                "experiments do not keep the statistics of normalize, which tests would need; leave it out, or train "
                "with sb3_saf.train"
            )
        return settings

    def describe(self, cell: Cell) -> dict[str, Any]:
        """Return everything that determines a cell's result, as plain data: settings, seed and options of its run."""
        settings = self.settings(cell).as_dict()
        if not cell.is_trained:
            of_games = {key: self.overrides[key] for key in _OF_GAMES if key in self.overrides}
            settings = {"algo": cell.method, "env": settings["env"], **of_games, "env_kwargs": settings["env_kwargs"]}
        evaluation = {"eval_freq": self.eval_freq, "eval_episodes": self.eval_episodes} if cell.is_trained else {}
        options = {"method": cell.method, "level": cell.level.env_kwargs, "episodes": self.episodes, **evaluation}
        return plain({"settings": settings, "seed": cell.seed, "options": options})


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


def expand(experiment: Experiment, selection: Selection, config: RunConfig) -> list[Cell]:
    """
    Return the cells of an experiment, its methods and a random team, ordered so that every section has all methods.

    :raises ValueError: for levels that the experiment lacks, or that cannot be made in the size
    """
    levels = experiment.at(selection.levels).tests()
    envs, methods = selection.envs or experiment.envs, selection.methods or experiment.methods
    for env in envs:
        for level in dict.fromkeys(one for train, tests in levels.items() for one in (train, *tests)):
            try:
                config.settings(Cell(RANDOM, env, level, 0))
            except ValueError as error:
                raise ValueError(
                    f"{env.removesuffix('-v0')} at {level} cannot be made in the size {config.size!r}: {error}; or "
                    "leave the level out with --levels"
                ) from error
    trained = [
        Cell(method, env, level, seed, tests)
        for seed in selection.seeds
        for env in envs
        for level, tests in levels.items()
        for method in methods
        if method != RANDOM
    ]
    tested = dict.fromkeys(level for tests in levels.values() for level in tests)
    random = [Cell(RANDOM, env, level, seed, (level,)) for seed in selection.seeds for env in envs for level in tested]
    return merge([*trained, *random])


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
