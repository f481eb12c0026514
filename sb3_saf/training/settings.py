"""
Settings of a run, by name: ``load_settings("saf", "TeamTogether-v0", "small")`` contains everything that determines a
result except the seed, and makes the games and the model.

They come from ``zoo_configs``: ``levels.yml`` has the games of each size, the algorithm's file its hyperparameters. The
files have only differences from the constructors' defaults. E games, N agents.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, get_args

from sb3_contrib import MaskablePPO, RecurrentPPO
from sb3_contrib.common.maskable.utils import is_masking_supported
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_saf.envs.joint_observation import CentralizedValueWrapper, TimeLimit
from sb3_saf.make import make_team_env
from sb3_saf.suites.registry import suites
from sb3_saf.teams.checks import check_seed, evaluation_seed, unknown_name
from sb3_saf.training.algorithms import ALGOS, AlgorithmSpec, find_algorithm
from sb3_saf.training.environments import ENV_IDS, HECOGRID, TeamEnvironment, find_environment
from sb3_saf.training.values import algorithm_arguments, policy_arguments, resolve
from sb3_saf.training.wrappers import WRAPPER_KEYS, stages_of, wrap_game, wrap_rows, wraps_games
from sb3_saf.training.yaml_files import DEFAULT, MERGED, SIZES, Size, entry_of, merge, read_config, read_file

#: Types of this package's keys, in addition to the arguments of the algorithm's constructor.
_OWN_KEYS: Final[dict[str, Any]] = {
    "n_envs": int,
    "game_steps": int,
    "n_minibatches": int,
    "time_limit": TimeLimit,
    "env_kwargs": dict[str, Any],
    "policy_kwargs": dict[str, Any],
    **WRAPPER_KEYS,
}
#: Key of the method; ``algorithm`` is a class that trains the method's policy instead of its own.
_ALGO: Final = "algo"
#: RL-Zoo3's name for game steps.
_N_TIMESTEPS: Final = "n_timesteps"
_SAVED_KEYS: Final = ("algo", "env", "size", "n_envs", "game_steps", "time_limit", "env_kwargs", "hyperparams")


@dataclass(frozen=True)
class Settings:
    """
    Everything that determines a run except its seed.

    :param algo: name in ``ALGOS``
    :param env_id: such as ``"TeamTogether-v0"``; see ``environments.HOW_TO_NAME``
    :param size: one of ``SIZES``
    :param n_agents: N
    :param env_kwargs: parameters of the game; all of them for HECOGrid
    :param time_limit: whether a time limit counts as an end (see ``CentralizedValueWrapper``)
    :param n_envs: E, parallel training games
    :param game_steps: game steps to train for, summed over all games
    :param hyperparams: arguments of the algorithm's constructor, as objects
    :param plain: the same as plain data, for files
    :param wrapping: values of the given keys of ``WRAPPER_KEYS``
    """

    algo: str
    env_id: str
    size: Size
    n_agents: int
    env_kwargs: Mapping[str, Any]
    time_limit: TimeLimit
    n_envs: int
    game_steps: int
    hyperparams: Mapping[str, Any]
    plain: Mapping[str, Any]
    wrapping: Mapping[str, Any]

    @property
    def spec(self) -> AlgorithmSpec:
        """Algorithm and policy."""
        return find_algorithm(self.algo, self.wrapping.get("algorithm"))

    @property
    def task(self) -> str:
        """The HECOGrid task's name, or the environment's."""
        return self.environment.task or self.env_id

    @property
    def environment(self) -> TeamEnvironment:
        """Environment that makes the games."""
        return find_environment(self.env_id)

    @property
    def total_timesteps(self) -> int:
        """Argument of ``learn``: agent steps, as SB3 counts."""
        return self.game_steps * self.n_agents

    def make_env(
        self,
        seed: int,
        *,
        evaluation: bool = False,
        monitor_dir: str | Path | None = None,
        n_envs: int | None = None,
        n_cpus: int = 1,
        render_mode: str | None = None,
    ) -> CentralizedValueWrapper:
        """
        Make the games.

        :param seed: the run's seed
        :param evaluation: whether the games are for evaluation, with seeds that no training game of any run has
        :param monitor_dir: folder for a ``monitor.csv``; None for none
        :param n_envs: E; None for the settings'
        :param n_cpus: number of processes for the games; HECOGrid's compiled games need one
        :param render_mode: render mode of the games; None for no rendering
        """
        task, params = self.environment.task, dict(self.env_kwargs)
        if evaluation:
            params = {key: value for key, value in params.items() if key not in self.environment.training_params}
        source: Any = task
        if self.environment.suite_task is not None and not wraps_games(self.wrapping):
            source = self.env_id
        elif task is None or wraps_games(self.wrapping):
            source, params = partial(self.make_game, render_mode), {}
        if not callable(source) and render_mode is not None:
            params["render_mode"] = render_mode
        env = make_team_env(
            source,
            n_envs=self.n_envs if n_envs is None else n_envs,
            seed=evaluation_seed(seed) if evaluation else check_seed(seed),
            time_limit=self.time_limit,
            monitor_dir=None if monitor_dir is None else str(monitor_dir),
            n_cpus=n_cpus,
            curriculum=() if evaluation else stages_of(self.wrapping, self.game_steps),
            team_reward=self.wrapping.get("team_reward"),
            state=self.wrapping.get("state", False),
            stagger=not evaluation and isinstance(source, str) and self.wrapping.get("stagger", False),
            **params,
        )
        return wrap_rows(env, self.wrapping, float(self.plain.get("gamma", 0.99)), is_training=not evaluation)

    def make_game(self, render_mode: str | None = None, **changes: Any) -> Any:
        """
        Make one game, a PettingZoo ParallelEnv with the wrappers of the settings.

        :param render_mode: render mode of the game; None for no rendering
        :param changes: parameters that differ from ``env_kwargs``
        """
        return wrap_game(self.environment.make_game({**self.env_kwargs, **changes}, render_mode), self.wrapping)

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
        Make the algorithm, ready for ``learn(settings.total_timesteps)``; further arguments as in SB3.

        :param env: from :meth:`make_env`
        :param seed: the run's seed
        :raises ValueError: if the algorithm rejects its arguments
        """
        self._check_masks(env)
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
        except (AssertionError, TypeError) as error:  # SB3's checks of its arguments
            raise ValueError(str(error)) from error

    def _check_masks(self, env: CentralizedValueWrapper) -> None:
        if issubclass(self.spec.algorithm, MaskablePPO) and not is_masking_supported(env):
            raise ValueError(
                f"MaskablePPO is for games that tell which actions are legal; {self.env_id} has no action masks: leave "
                "algo:MaskablePPO out"
            )

    def as_dict(self) -> dict[str, Any]:
        """Return all settings as plain data, for a file with the results."""
        return {
            "algo": self.algo,
            "env": self.env_id,
            "size": self.size,
            "algorithm": self.spec.algorithm.__name__,
            "policy": self.spec.policy,
            "n_envs": self.n_envs,
            "game_steps": self.game_steps,
            "time_limit": self.time_limit,
            "n_agents": self.n_agents,
            "env_kwargs": dict(self.env_kwargs),
            **self.wrapping,
            "hyperparams": dict(self.plain),
        }


def load_settings(
    algo: str,
    env_id: str,
    size: Size = "small",
    env_kwargs: Mapping[str, Any] | None = None,
    overrides: Mapping[str, Any] | None = None,
    config: Path | None = None,
) -> Settings:
    """
    Load settings by name; the arguments take precedence over the files.

    :param algo: name in ``ALGOS``
    :param env_id: such as ``"TeamTogether-v0"``; see ``environments.HOW_TO_NAME``
    :param size: ``"paper"``, ``"medium"``, ``"small"`` or ``"smoke"``
    :param env_kwargs: parameters of the game
    :param overrides: keys as in the algorithm's file, such as ``{"n_envs": 8, "policy_kwargs": {"n_slots": 8}}``
    :param config: a file to read instead of the algorithm's
    :raises ValueError: for an unknown name, a value of the wrong type, games that cannot be made
    """
    spec = find_algorithm(algo)
    environment = find_environment(env_id)
    if size not in SIZES:
        raise unknown_name("size", size, SIZES)
    source = f"zoo_configs/{spec.config}.yml" if config is None else str(config)
    content = read_config(spec.config) if config is None else read_file(config)
    _check_environments(content, environment, source)
    own = _checked_keys(entry_of(content, environment.yaml_keys, size), spec, source)
    overrides = overrides or {}
    trained_by = find_algorithm(algo, overrides.get(_ALGO, overrides.get("algorithm")))
    given = _exclusive(_checked(overrides, trained_by, "the given settings"))
    level = entry_of(read_config("levels"), environment.yaml_keys, size)
    own = _known_to(given.get("algorithm"), algo, own)
    layers = (level, own, given, {"env_kwargs": env_kwargs or {}}, {"policy_kwargs": dict(spec.policy_kwargs)})
    return _build(algo, environment, size, _for_algorithm(algo, merge(*layers)))


def saved_settings(saved: Mapping[str, Any], env_kwargs: Mapping[str, Any] | None = None) -> Settings:
    """
    Read settings written by :meth:`Settings.as_dict`, independent of later changes of ``zoo_configs``.

    :param saved: plain data
    :param env_kwargs: parameters of the game to change
    :raises ValueError: if ``saved`` is invalid, or the games cannot be made
    """
    missing = [key for key in _SAVED_KEYS if key not in saved]
    if missing:
        raise ValueError(f"expected settings that sb3_saf.train has saved; {', '.join(missing)} is missing")
    if not isinstance(saved["hyperparams"], Mapping):
        raise ValueError(f"expected saved hyperparams to map names to values, got {saved['hyperparams']!r}")
    spec = find_algorithm(saved["algo"])
    own = {key: saved[key] for key in _OWN_KEYS if key in saved and saved[key] != spec.algorithm.__name__}
    trained_by = find_algorithm(saved["algo"], own.get("algorithm"))
    entry = merge(_checked({**own, **saved["hyperparams"]}, trained_by, "the saved settings"))
    # Reading N from the file avoids importing the games' package for plots.
    n_agents = None if env_kwargs else saved.get("n_agents")
    return _build(
        saved["algo"],
        find_environment(saved["env"]),
        saved["size"],
        merge(entry, {"env_kwargs": env_kwargs or {}}),
        None if n_agents is None else resolve("n_agents", n_agents, int),
    )


def _known_to(algorithm: str | None, algo: str, entry: dict[str, Any]) -> dict[str, Any]:
    """Leave out settings of the method's file that an algorithm given in place of its own does not have."""
    if algorithm is None:
        return entry
    known = algorithm_arguments(find_algorithm(algo, algorithm).algorithm)
    left_out = {"n_minibatches"} if "batch_size" not in known else set()
    return {key: value for key, value in entry.items() if key in {*known, *_OWN_KEYS} - left_out}


def _for_algorithm(algo: str, entry: dict[str, Any]) -> dict[str, Any]:
    """Remove entries that an algorithm other than the method's own does not support."""
    own, spec = ALGOS[algo], find_algorithm(algo, entry.get("algorithm"))
    if spec.algorithm is own.algorithm:
        return {key: value for key, value in entry.items() if key != "algorithm"}
    if issubclass(spec.algorithm, (MaskablePPO, RecurrentPPO)):  # need their own buffers for masks and sequences
        entry = {key: value for key, value in entry.items() if key != "rollout_buffer_class"}
    return _checked_keys(entry, spec, f"the settings for {spec.algorithm.__name__}")


def _check_environments(content: Mapping[str, Any], environment: TeamEnvironment, source: str) -> None:
    """Raise ValueError for entries that no environment reads."""
    known = (DEFAULT, HECOGRID, *ENV_IDS, *suites(), environment.id)
    for key in content:
        if key not in known and not {".", ":", "/"} & set(str(key)):
            raise ValueError(f"{source}: {unknown_name('environment', key, known)}")


def _checked_keys(entry: Mapping[str, Any], spec: AlgorithmSpec, source: str) -> dict[str, Any]:
    """Rename RL-Zoo3's keys; raise ValueError for unknown keys."""
    entry = dict(entry)
    known = [*_OWN_KEYS, *algorithm_arguments(spec.algorithm)]
    if _N_TIMESTEPS in entry:
        if "game_steps" in entry:
            raise ValueError(f"{source}: game_steps and {_N_TIMESTEPS} say the same thing; give one of them")
        entry["game_steps"] = entry.pop(_N_TIMESTEPS)
    if _ALGO in entry:
        entry["algorithm"] = entry.pop(_ALGO)
    if entry.get("policy") == spec.policy:
        del entry["policy"]
    for key in entry:
        if key == "policy":
            raise ValueError(
                f"{source}: {key!r} is not a setting here; use --algo, which names the policy ({spec.policy})"
            )
        if key not in known:
            raise ValueError(f"{source}: {unknown_name('setting', key, known)}")
    for key in MERGED:
        resolve(key, entry.get(key, {}), _OWN_KEYS[key])
    return entry


def _checked(entry: Mapping[str, Any], spec: AlgorithmSpec, source: str) -> dict[str, Any]:
    """Check the keys, and raise ValueError for values that contradict the algorithm; a file is for all its names."""
    entry = _checked_keys(entry, spec, source)
    for key, value in entry.get("policy_kwargs", {}).items():
        if spec.policy_kwargs.get(key, value) != value:
            raise ValueError(
                f"{source}: {key}={value!r} takes back what this algorithm is, {spec.policy} with "
                f"{key}={spec.policy_kwargs[key]!r}; choose another algorithm, or leave {key!r} out"
            )
    return entry


def _exclusive(given: dict[str, Any]) -> dict[str, Any]:
    """Remove the number of minibatches if a batch size is given."""
    if given.get("batch_size") is not None and given.get("n_minibatches") is not None:
        raise ValueError("batch_size and n_minibatches say the same thing; give one of them")
    if given.get("batch_size") is not None:
        return {**given, "n_minibatches": None}
    return given


def _build(
    algo: str, environment: TeamEnvironment, size: Size, entry: dict[str, Any], n_agents: int | None = None
) -> Settings:
    spec = find_algorithm(algo, entry.get("algorithm"))
    own = {key: entry.pop(key, None) for key in _OWN_KEYS}
    n_envs = resolve("n_envs", 1 if own["n_envs"] is None else own["n_envs"], int)
    game_steps = resolve("game_steps", own["game_steps"], int)
    env_kwargs = environment.complete(own["env_kwargs"] or {})
    time_limit = resolve("time_limit", own["time_limit"] or get_args(TimeLimit)[0], TimeLimit)
    wrapping = {
        key: resolve(key, own[key], _OWN_KEYS[key])
        for key in WRAPPER_KEYS
        if own[key] is not None and own[key] is not False
    }
    _check_wrapping(wrapping, environment, env_kwargs, spec)
    for stage in stages_of(wrapping, game_steps):
        environment.complete({**env_kwargs, **stage.params})
    if n_agents is None:
        n_agents = environment.count_agents(env_kwargs)
    plain = dict(entry)
    if own["n_minibatches"] is not None:
        n_minibatches = resolve("n_minibatches", own["n_minibatches"], int)
        plain["batch_size"] = _teams(spec, plain, n_minibatches, n_envs) * n_agents
    hints = algorithm_arguments(spec.algorithm)
    hyperparams = {key: resolve(key, value, hints[key]) for key, value in plain.items()}
    if own["policy_kwargs"]:
        plain["policy_kwargs"] = own["policy_kwargs"]
        hyperparams["policy_kwargs"] = _resolved_policy_kwargs(spec, own["policy_kwargs"])
    return Settings(
        algo,
        environment.id,
        size,
        n_agents,
        env_kwargs,
        time_limit,
        n_envs,
        game_steps,
        hyperparams,
        plain,
        wrapping,
    )


def _check_wrapping(
    wrapping: Mapping[str, Any], environment: TeamEnvironment, env_kwargs: Mapping[str, Any], spec: AlgorithmSpec
) -> None:
    if wrapping.get("normalize") and issubclass(spec.algorithm, OffPolicyAlgorithm):
        raise ValueError(f"normalize is for algorithms that learn from fresh rollouts, got it with {environment.id}")
    if "frame_stack" in wrapping and env_kwargs.get("observation") == "tiles":
        raise ValueError("frame_stack stacks pictures, not tile codes; give the game observation: rgb in env_kwargs")


def _teams(spec: AlgorithmSpec, plain: Mapping[str, Any], n_minibatches: int, n_envs: int) -> int:
    """Return the number of teams in a minibatch: one team is the rows of one game at one step."""
    n_steps = plain.get("n_steps")
    if n_steps is None:
        raise ValueError(f"n_minibatches divides a rollout, which needs n_steps; {spec.algorithm.__name__} has none")
    return -(-int(resolve("n_steps", n_steps, int)) * n_envs // n_minibatches)


def _resolved_policy_kwargs(spec: AlgorithmSpec, given: Mapping[str, Any]) -> dict[str, Any]:
    hints = policy_arguments(spec.policy_class)
    for key in given:
        if key not in hints:
            raise unknown_name(f"argument of {spec.policy}", key, hints)
    return {key: resolve(key, value, hints[key]) for key, value in given.items()}


__all__ = ["ALGOS", "ENV_IDS", "SIZES", "Settings", "Size", "load_settings", "saved_settings"]
