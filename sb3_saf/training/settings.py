"""
Settings of a run, by name: ``load_settings("saf", "TeamTogether-v0", "small")`` says everything that decides a result
but the seed, and makes the environments and the model.

They come from ``zoo_configs``: ``levels.yml`` has the games of each size, the algorithm's file its hyperparameters.
Only what differs from the constructors is written there. E games, N agents.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, get_args

from stable_baselines3.common.base_class import BaseAlgorithm

from hecogrid_envs import TASK_NAMES
from hecogrid_envs.constants import RenderMode
from hecogrid_envs.params import HECOGridParams
from hecogrid_envs.task import TaskName
from sb3_saf.buffers.rollout import TeamRolloutBuffer
from sb3_saf.envs.joint_observation import CentralizedValueWrapper, TimeLimit
from sb3_saf.envs.make import make_team_env
from sb3_saf.training.algorithms import ALGOS, AlgorithmSpec, find_algorithm
from sb3_saf.training.names import unknown_name
from sb3_saf.training.seeds import check_seed, evaluation_seed
from sb3_saf.training.values import algorithm_arguments, policy_arguments, resolve
from sb3_saf.training.yaml_files import DEFAULT, MERGED, SIZES, Size, entry_of, merge, read_config, read_file

#: Environment ids, as RL-Zoo3 and Gymnasium write them.
TASK_OF_ENV: Final[dict[str, TaskName]] = {f"{task}-v0": task for task in TASK_NAMES}
ENV_IDS: Final = tuple(TASK_OF_ENV)

#: Types of the keys that are ours, beside the arguments of the algorithm's constructor.
_OWN_KEYS: Final[dict[str, Any]] = {
    "n_envs": int,
    "game_steps": int,
    "n_minibatches": int,
    "time_limit": TimeLimit,
    "env_kwargs": dict[str, Any],
    "policy_kwargs": dict[str, Any],
}
#: What RL-Zoo3's files have that counts in other units here.
_RENAMED: Final = {
    "n_timesteps": "game_steps (steps of the game; timesteps are those of every agent)",
    "policy": "--algo, which names the policy",
}
_SAVED_KEYS: Final = ("algo", "env", "size", "n_envs", "game_steps", "time_limit", "env_kwargs", "hyperparams")
#: The games' default here: the same views as the paper's pictures in 49 bytes.
_ENV_DEFAULTS: Final = {"observation": "tiles"}


@dataclass(frozen=True)
class Settings:
    """
    Everything that decides a run but its seed.

    :param algo: name in ``ALGOS``
    :param env_id: such as ``"TeamTogether-v0"``
    :param size: one of ``SIZES``
    :param env_kwargs: every parameter of the game
    :param time_limit: whether a time limit counts as an end (see ``CentralizedValueWrapper``)
    :param n_envs: E, games that are trained on in parallel
    :param game_steps: steps of the game to train for, summed over all games
    :param hyperparams: arguments of the algorithm's constructor, as objects
    :param plain: the same as plain data, for files
    """

    algo: str
    env_id: str
    size: Size
    env_kwargs: Mapping[str, Any]
    time_limit: TimeLimit
    n_envs: int
    game_steps: int
    hyperparams: Mapping[str, Any]
    plain: Mapping[str, Any]

    @property
    def spec(self) -> AlgorithmSpec:
        """Algorithm and policy."""
        return ALGOS[self.algo]

    @property
    def task(self) -> TaskName:
        """The task's name in HECOGrid."""
        return TASK_OF_ENV[self.env_id]

    @property
    def n_agents(self) -> int:
        """N."""
        return int(self.env_kwargs["n_agents"])

    @property
    def total_timesteps(self) -> int:
        """What ``learn`` takes: SB3 counts the steps of every agent."""
        return self.game_steps * self.n_agents

    def make_env(
        self,
        seed: int,
        *,
        evaluation: bool = False,
        monitor_dir: str | Path | None = None,
        n_envs: int | None = None,
        render_mode: RenderMode | None = None,
    ) -> CentralizedValueWrapper:
        """
        Make the games.

        :param seed: the run's seed
        :param evaluation: games for evaluation, whose seeds no training game of any run has
        :param monitor_dir: folder for a ``monitor.csv``; None for none
        :param n_envs: E; None for the settings'
        :param render_mode: how games can be drawn; None for not at all
        """
        return make_team_env(
            self.task,
            n_envs=self.n_envs if n_envs is None else n_envs,
            seed=evaluation_seed(seed) if evaluation else check_seed(seed),
            time_limit=self.time_limit,
            monitor_dir=None if monitor_dir is None else str(monitor_dir),
            render_mode=render_mode,
            **self.env_kwargs,
        )

    def make_model(
        self,
        env: CentralizedValueWrapper,
        seed: int,
        *,
        device: str = "auto",
        tensorboard_log: str | None = None,
        verbose: int = 0,
    ) -> BaseAlgorithm:
        """
        Make the algorithm, ready for ``learn(settings.total_timesteps)``.

        :param env: from :meth:`make_env`
        :param seed: the run's seed
        :param device: as SB3 takes it
        :param tensorboard_log: folder, None for none
        :param verbose: as SB3 takes it
        :raises ValueError: if the algorithm refuses its arguments
        """
        try:
            return self.spec.algorithm(
                self.spec.policy,
                env,
                seed=check_seed(seed),
                device=device,
                tensorboard_log=tensorboard_log,
                verbose=verbose,
                **self.hyperparams,
            )
        except (AssertionError, TypeError) as error:  # SB3's checks of what it is given
            raise ValueError(str(error)) from error

    def as_dict(self) -> dict[str, Any]:
        """Everything as plain data, for a file beside the results."""
        return {
            "algo": self.algo,
            "env": self.env_id,
            "size": self.size,
            "algorithm": self.spec.algorithm.__name__,
            "policy": self.spec.policy,
            "n_envs": self.n_envs,
            "game_steps": self.game_steps,
            "time_limit": self.time_limit,
            "env_kwargs": dict(self.env_kwargs),
            "hyperparams": dict(self.plain),
        }


def load_settings(
    algo: str,
    env_id: str,
    size: Size = "paper",
    env_kwargs: Mapping[str, Any] | None = None,
    overrides: Mapping[str, Any] | None = None,
    config: Path | None = None,
) -> Settings:
    """
    Settings by name; whatever is given here wins over the files.

    :param algo: name in ``ALGOS``
    :param env_id: such as ``"TeamTogether-v0"``
    :param size: ``"paper"``, ``"small"`` or ``"smoke"``
    :param env_kwargs: parameters of the game
    :param overrides: keys as in the algorithm's file, such as ``{"n_envs": 8, "policy_kwargs": {"n_slots": 8}}``
    :param config: a file to read in place of the algorithm's
    :raises ValueError: for a name that does not exist, a value of the wrong type, a level that cannot be built
    """
    spec = find_algorithm(algo)
    if env_id not in TASK_OF_ENV:
        raise unknown_name("environment", env_id, ENV_IDS)
    if size not in SIZES:
        raise unknown_name("size", size, SIZES)
    name = f"zoo_configs/{spec.config}.yml" if config is None else str(config)
    content = read_config(spec.config) if config is None else read_file(config)
    for key in content:
        if key not in (DEFAULT, *ENV_IDS):
            raise ValueError(f"{name}: {unknown_name('environment', key, (DEFAULT, *ENV_IDS))}")
    own = entry_of(content, env_id, size)
    _check_keys(own, spec, name)
    given = dict(overrides or {})
    _check_keys(given, spec, "the given settings")
    layers = (entry_of(read_config("levels"), env_id, size), own, _exclusive(given), {"env_kwargs": env_kwargs or {}})
    return _build(algo, env_id, size, merge(*layers, {"policy_kwargs": dict(spec.policy_kwargs)}))


def saved_settings(saved: Mapping[str, Any], env_kwargs: Mapping[str, Any] | None = None) -> Settings:
    """
    Settings that :meth:`Settings.as_dict` has written; files that have changed since do not matter.

    :param saved: plain data
    :param env_kwargs: parameters of the game that shall be others now
    :raises ValueError: if it is something else, or the level cannot be built
    """
    missing = [key for key in _SAVED_KEYS if key not in saved]
    if missing:
        raise ValueError(f"expected settings that the zoo has saved; {', '.join(missing)} is missing")
    find_algorithm(saved["algo"])
    if saved["env"] not in TASK_OF_ENV:
        raise unknown_name("environment", saved["env"], ENV_IDS)
    own = {key: saved[key] for key in ("n_envs", "game_steps", "time_limit", "env_kwargs")}
    entry = merge(own, saved["hyperparams"], {"env_kwargs": env_kwargs or {}})
    return _build(saved["algo"], saved["env"], saved["size"], entry)


def _check_keys(entry: Mapping[str, Any], spec: AlgorithmSpec, source: str) -> None:
    """Refuse names that nothing would read, and what would take an ablation back."""
    known = [*_OWN_KEYS, *algorithm_arguments(spec.algorithm)]
    for key in entry:
        if key in _RENAMED and key not in known:
            raise ValueError(f"{source}: {key!r} is not a setting here; use {_RENAMED[key]}")
        if key not in known:
            raise ValueError(f"{source}: {unknown_name('setting', key, known)}")
    for key in MERGED:
        resolve(key, entry.get(key, {}), _OWN_KEYS[key])
    for key, value in entry.get("policy_kwargs", {}).items():
        if spec.policy_kwargs.get(key, value) != value:
            raise ValueError(
                f"{source}: {key}={value!r} takes back what this algorithm is, {spec.policy} with "
                f"{key}={spec.policy_kwargs[key]!r}; choose another algorithm, or leave {key!r} out"
            )


def _exclusive(given: dict[str, Any]) -> dict[str, Any]:
    """Whoever gives a batch size takes the number of minibatches back, and the other way round."""
    if given.get("batch_size") is not None and given.get("n_minibatches") is not None:
        raise ValueError("batch_size and n_minibatches say the same thing; give one of them")
    if given.get("batch_size") is not None:
        return {**given, "n_minibatches": None}
    return given


def _build(algo: str, env_id: str, size: Size, entry: dict[str, Any]) -> Settings:
    spec = ALGOS[algo]
    own = {key: entry.pop(key, None) for key in _OWN_KEYS}
    n_envs = _count("n_envs", 1 if own["n_envs"] is None else own["n_envs"])
    game_steps = _count("game_steps", own["game_steps"])
    env_kwargs = _checked_level(TASK_OF_ENV[env_id], own["env_kwargs"])
    time_limit = own["time_limit"] or get_args(TimeLimit)[0]
    resolve("time_limit", time_limit, TimeLimit)
    plain = dict(entry)
    if own["n_minibatches"] is not None:
        n_minibatches = _count("n_minibatches", own["n_minibatches"])
        plain["batch_size"] = _teams(spec, plain, n_minibatches, n_envs) * int(env_kwargs["n_agents"])
    _check_batch_size(plain.get("batch_size"), int(env_kwargs["n_agents"]), plain.get("rollout_buffer_class"))
    hints = algorithm_arguments(spec.algorithm)
    hyperparams = {key: resolve(key, value, hints[key]) for key, value in plain.items()}
    if own["policy_kwargs"]:
        plain["policy_kwargs"] = own["policy_kwargs"]
        hyperparams["policy_kwargs"] = _resolved_policy_kwargs(spec, own["policy_kwargs"])
    return Settings(algo, env_id, size, env_kwargs, time_limit, n_envs, game_steps, hyperparams, plain)


def _count(name: str, value: object) -> int:
    number = resolve(name, value, int)
    if number < 1:
        raise ValueError(f"{name} must be at least 1, got {value!r}")
    return int(number)


def _checked_level(task: TaskName, env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Every parameter of a level that can be built."""
    params = HECOGridParams.from_kwargs({**_ENV_DEFAULTS, **env_kwargs})
    params.check_fits(task)
    return asdict(params)


def _teams(spec: AlgorithmSpec, plain: Mapping[str, Any], n_minibatches: int, n_envs: int) -> int:
    """Whole teams of a minibatch: one team is the rows of one game at one step."""
    n_steps = plain.get("n_steps")
    if n_steps is None:
        raise ValueError(f"n_minibatches divides a rollout, which needs n_steps; {spec.algorithm.__name__} has none")
    return -(-_count("n_steps", n_steps) * n_envs // n_minibatches)


def _check_batch_size(batch_size: object, n_agents: int, buffer: object) -> None:
    """Minibatches of the team buffer are whole teams, which it would say only after the first rollout."""
    if buffer == TeamRolloutBuffer.__name__ and batch_size is not None and _count("batch_size", batch_size) % n_agents:
        raise ValueError(
            f"batch_size counts rows and must be a multiple of n_agents={n_agents}, got {batch_size}; n_minibatches "
            "says how many parts a rollout is divided into instead"
        )


def _resolved_policy_kwargs(spec: AlgorithmSpec, given: Mapping[str, Any]) -> dict[str, Any]:
    hints = policy_arguments(spec.policy_class)
    for key in given:
        if key not in hints:
            raise unknown_name(f"argument of {spec.policy}", key, hints)
    return {key: resolve(key, value, hints[key]) for key, value in given.items()}


__all__ = ["ALGOS", "ENV_IDS", "SIZES", "TASK_OF_ENV", "Settings", "Size", "load_settings", "saved_settings"]
