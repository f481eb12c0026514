"""
Settings of a run, by name: ``load_settings("saf", "TeamTogether-v0", "small")`` contains everything that determines a
result except the seed, and makes the games and the model.

They come from ``zoo_configs``: ``levels.yml`` has the games of each size, the algorithm's file its hyperparameters. The
files have only differences from the constructors' defaults. E games, N agents.

:func:`ppo_settings` returns PPO's for teams, for use in scripts.
"""

from __future__ import annotations

import inspect
import math
import reprlib
import types
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final, Union, get_args, get_origin, get_type_hints

import msgspec
import torch as th
from msgspec import Meta
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.utils import is_masking_supported
from stable_baselines3 import PPO
from stable_baselines3.common import vec_env
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_saf.buffers.rollout import TeamRolloutBuffer
from sb3_saf.envs.joint_observation import CentralizedValueWrapper, TimeLimit
from sb3_saf.make import make_team_env
from sb3_saf.networks.encoders import LightEncoder, MLPEncoder, NatureEncoder, ObservationEncoder, PaperCNN
from sb3_saf.networks.layers import NormalizedReLU
from sb3_saf.networks.memory import MemoryName
from sb3_saf.policies.parts import AlgorithmSpec
from sb3_saf.registration import COMMANDS, DECLARATIONS
from sb3_saf.suites.registry import HOME, Standing, TeamEnvironment, find_environment, standing, suites
from sb3_saf.teams.checks import check_seed, evaluation_seed, unknown_name
from sb3_saf.teams.rows import TeamSpaces
from sb3_saf.teams.vec_env import require_n_agents, shares_reward
from sb3_saf.training.wrappers import WRAPPER_KEYS, stages_of, wrap_game, wrap_rows
from sb3_saf.training.yaml_files import DEFAULT, SIZES, Size, check_either, entry_of, merge, read_settings

#: Methods by their names on the command line, in log folders and YAML files.
ALGOS: Final[dict[str, AlgorithmSpec]] = COMMANDS
#: Types of this package's keys, beside the arguments of the algorithm's constructor.
_OWN_KEYS: Final[dict[str, Any]] = {
    "n_envs": int,
    "game_steps": int,
    "n_minibatches": int,
    "time_limit": TimeLimit,
    "env_kwargs": dict[str, Any],
    "policy_kwargs": dict[str, Any],
    **WRAPPER_KEYS,
}
_SAVED_KEYS: Final = ("algo", "env", "size", "n_envs", "game_steps", "time_limit", "env_kwargs", "hyperparams")


def find_algorithm(algo: str, algorithm: str | None = None) -> AlgorithmSpec:
    """
    Return a method's algorithm and policy.

    :param algo: the method, a name in ``ALGOS``
    :param algorithm: class that trains the policy instead of the method's own, such as ``"MaskablePPO"``
    :raises ValueError: for an unknown name, with the nearest one
    """
    if algo not in ALGOS:
        raise unknown_name("algorithm", algo, ALGOS)
    spec = ALGOS[algo]
    if algorithm is None:
        return spec
    classes = {
        kind.__name__: kind for one in DECLARATIONS for kind in one.policies if spec.policy in kind.policy_aliases
    }
    if algorithm not in classes:
        raise unknown_name(f"algorithm that trains {spec.policy}", algorithm, classes)
    return replace(spec, algorithm=classes[algorithm])


@dataclass(frozen=True)
class Settings:
    """
    Everything that determines a run except its seed.

    :param algo: name in ``ALGOS``
    :param env_id: such as ``"TeamTogether-v0"``; see ``suites.registry.HOW_TO_NAME``
    :param size: one of ``SIZES``
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
    def environment(self) -> TeamEnvironment:
        """Environment that makes the games."""
        return find_environment(self.env_id)

    @property
    def n_treasures(self) -> int | None:
        """Treasures of a HECOGrid game, the largest team return; None for other games, whatever their parameters."""
        suite = self.environment.suite
        return None if suite is None or suite.name != HOME else int(self.env_kwargs["n_treasures"])

    def standing(self, scores: Mapping[str, float], game_steps: int) -> Standing | None:
        """
        Compare a result with what is known of the games, see :func:`sb3_saf.suites.registry.standing`.

        :return: None also with an ``env_wrapper``, which may change rewards and lengths
        """
        if "env_wrapper" in self.wrapping:
            return None
        return standing(self.environment, self.env_kwargs, scores, game_steps)

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

        :param evaluation: whether the games are for evaluation, with seeds that no training game of any run has
        :param monitor_dir: folder for a ``monitor.csv``; None for none
        :param n_envs: E; None for the settings'
        :param n_cpus: number of processes for the games; HECOGrid's compiled games need one
        :param render_mode: render mode of the games; None for no rendering
        """
        source: Any = self.env_id
        backend: Any = None
        params = dict(self.env_kwargs) if render_mode is None else {**self.env_kwargs, "render_mode": render_mode}
        if evaluation:
            params = self.environment.of_evaluation(params)
        if {"env_wrapper", "frame_stack"} & self.wrapping.keys():  # of single games, not of compiled ones
            source, backend = replace(self.environment, make=self._make_game), "supersuit"
        env = make_team_env(
            source,
            n_envs=self.n_envs if n_envs is None else n_envs,
            seed=evaluation_seed(seed) if evaluation else check_seed(seed),
            backend=backend,
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

    def _make_game(self, render_mode: str | None = None, **params: Any) -> Any:
        """Make one game, a PettingZoo ParallelEnv with the wrappers of the settings."""
        return wrap_game(self.environment.make_game(params, render_mode), self.wrapping)

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

        :raises ValueError: if the algorithm rejects its arguments
        """
        if issubclass(self.spec.algorithm, MaskablePPO) and not is_masking_supported(env):
            raise ValueError(
                f"MaskablePPO is for games that tell which actions are legal; {self.env_id} has no action masks: leave "
                "algorithm:MaskablePPO out"
            )
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
    :param env_id: such as ``"TeamTogether-v0"``; see ``suites.registry.HOW_TO_NAME``
    :param size: ``"paper"``, ``"medium"``, ``"small"`` or ``"smoke"``
    :param overrides: keys as in the algorithm's file, such as ``{"n_envs": 8, "policy_kwargs": {"n_slots": 8}}``
    :param config: a file to read instead of the algorithm's
    :raises ValueError: for an unknown name, a value of the wrong type, games that cannot be made
    """
    method, environment = find_algorithm(algo), find_environment(env_id)
    if size not in SIZES:
        raise unknown_name("size", size, SIZES)
    content, source = read_settings(config or method.config), str(config or f"zoo_configs/{method.config}.yml")
    known = (DEFAULT, *suites(), *suites()[HOME].tasks, environment.id)
    for key in content:
        if key not in known and (str(key).startswith(f"{HOME}/") or not {".", ":", "/"} & set(str(key))):
            raise ValueError(f"{source}: {unknown_name('environment', key, known)}")
    own, given = entry_of(content, environment.yaml_keys, size), overrides or {}
    spec = find_algorithm(algo, given.get("algorithm", own.get("algorithm")))
    own, given = _checked(own, method, spec, source), _checked(given, spec, spec, "the given settings")
    for key, value in given["policy_kwargs"].items():
        if spec.policy_kwargs.get(key, value) != value:
            raise ValueError(
                f"{key} is fixed to {spec.policy_kwargs[key]!r} by --algo {algo}, got {value!r}; choose another "
                f"method, or leave {key} out"
            )
    if spec.algorithm is not method.algorithm:
        # It takes the settings that it has; masks need a buffer of their own.
        arguments = {*_OWN_KEYS, *algorithm_arguments(spec.algorithm)}
        if "batch_size" not in arguments:
            arguments.discard("n_minibatches")
        if issubclass(spec.algorithm, MaskablePPO):
            arguments -= {"rollout_buffer_class", "rollout_buffer_kwargs"}
            own["policy_kwargs"].pop("normalize_values", None)
        own = {key: value for key, value in own.items() if key in arguments}
    if given.get("normalize_advantage", own.get("normalize_advantage")) is False:
        buffer = dict(own.pop("rollout_buffer_kwargs", None) or {})
        buffer.pop("normalize_advantage", None)  # the buffer normalises those of each agent
        own |= {"rollout_buffer_kwargs": buffer} if buffer else {}
    levels = entry_of(read_settings("levels"), environment.yaml_keys, size)
    last = {"env_kwargs": env_kwargs or {}, "policy_kwargs": dict(spec.policy_kwargs)}
    return _build(spec, algo, environment, size, merge(levels, own, given, last))


def saved_settings(saved: Mapping[str, Any], env_kwargs: Mapping[str, Any] | None = None) -> Settings:
    """
    Read settings written by :meth:`Settings.as_dict`, independent of later changes of ``zoo_configs``.

    :raises ValueError: if ``saved`` is invalid, or the games cannot be made
    """
    missing = [key for key in _SAVED_KEYS if key not in saved]
    if missing:
        raise ValueError(f"expected settings that sb3_saf.train has saved; {', '.join(missing)} is missing")
    if not isinstance(saved["hyperparams"], Mapping):
        raise ValueError(f"expected saved hyperparams to map names to values, got {saved['hyperparams']!r}")
    if wrong := (_OWN_KEYS.keys() - {"policy_kwargs"}) & saved["hyperparams"].keys():
        raise ValueError(f"expected {', '.join(sorted(wrong))} beside the saved hyperparams, got them among these")
    spec = find_algorithm(saved["algo"], saved.get("algorithm"))
    own = {key: saved[key] for key in _OWN_KEYS if key in saved} | dict(saved["hyperparams"])
    entry = merge(_checked(own, spec, spec, "the saved settings"), {"env_kwargs": env_kwargs or {}})
    # Reading N from the file avoids making a game for plots.
    n_agents = None if env_kwargs or "n_agents" not in saved else convert("n_agents", saved["n_agents"], int)
    return _build(spec, saved["algo"], find_environment(saved["env"]), saved["size"], entry, n_agents)


def _checked(entry: Mapping[str, Any], method: AlgorithmSpec, spec: AlgorithmSpec, source: str) -> dict[str, Any]:
    """
    Return settings with RL-Zoo3's names replaced by ours.

    :param method: algorithm whose arguments are also allowed: a file is for all algorithms that train its method
    :raises ValueError: for unknown keys
    """
    entry = dict(entry)
    if "n_timesteps" in entry:
        if "game_steps" in entry:
            raise ValueError(f"{source}: game_steps and n_timesteps say the same thing; give one of them")
        entry["game_steps"] = entry.pop("n_timesteps")
    check_either(entry, source)
    if (policy := entry.pop("policy", spec.policy)) != spec.policy:
        raise ValueError(f"{source}: policy={policy!r} is not a setting here; --algo names the policy ({spec.policy})")
    known = {**_OWN_KEYS, **algorithm_arguments(method.algorithm), **algorithm_arguments(spec.algorithm)}
    for key in entry:
        if key not in known:
            raise ValueError(f"{source}: {unknown_name(f'setting of {spec.algorithm.__name__}', key, known)}")
    for key in ("env_kwargs", "policy_kwargs"):
        entry[key] = convert(key, entry.get(key) or {}, dict[str, Any])
    return entry


def _build(
    spec: AlgorithmSpec,
    algo: str,
    environment: TeamEnvironment,
    size: Size,
    entry: Mapping[str, Any],
    n_agents: int | None = None,
) -> Settings:
    """Convert checked settings to arguments of the games and of the constructors, which check ranges."""
    own = {
        key: convert(key, entry[key], hint)
        for key, hint in _OWN_KEYS.items()
        if entry.get(key) is not None and entry[key] is not False
    }
    if own.get("algorithm") == find_algorithm(algo).algorithm.__name__:
        del own["algorithm"]
    env_kwargs = environment.complete(own.get("env_kwargs", {}))
    if taken := sorted(env_kwargs.keys() & (inspect.signature(make_team_env).parameters.keys() - {"params"})):
        raise ValueError(
            f"{taken} of env_kwargs are arguments of make_team_env, so {environment.id} cannot get them; give the game "
            "other names for them, or a function that makes it with them: --env my_module:make"
        )
    wrapping = {key: own[key] for key in WRAPPER_KEYS if key in own}
    if wrapping.get("normalize", False) is not False and issubclass(spec.algorithm, OffPolicyAlgorithm):
        raise ValueError(f"normalize is for PPO, A2C and TRPO, got it with {algo}")
    n_envs, game_steps = own.get("n_envs", 1), convert("game_steps", own.get("game_steps"), int)
    for stage in stages_of(wrapping, game_steps):
        environment.complete({**env_kwargs, **stage.params})
    if n_agents is None:
        n_agents = environment.count_agents(env_kwargs)
    hints = algorithm_arguments(spec.algorithm)
    plain = {key: value for key, value in entry.items() if key in hints}
    if "n_minibatches" in own:
        if plain.get("n_steps") is None or "batch_size" not in hints:
            raise ValueError(
                f"n_minibatches divides rollouts of n_steps; {spec.algorithm.__name__} has no parts of them"
            )
        # Whole teams: one team is the rows of one game at one step.
        plain["batch_size"] = -(-convert("n_steps", plain["n_steps"], int) * n_envs // own["n_minibatches"]) * n_agents
    hyperparams = {key: convert(key, value, hints[key]) for key, value in plain.items()}
    if policy_kwargs := own.get("policy_kwargs"):
        hints = policy_arguments(spec.policy_class)
        for key in policy_kwargs:
            if key not in hints:
                raise unknown_name(f"argument of {spec.policy}", key, hints)
        plain["policy_kwargs"] = policy_kwargs
        hyperparams["policy_kwargs"] = {key: convert(key, value, hints[key]) for key, value in policy_kwargs.items()}
    time_limit = own.get("time_limit", get_args(TimeLimit)[0])
    return Settings(
        algo, environment.id, size, n_agents, env_kwargs, time_limit, n_envs, game_steps, hyperparams, plain, wrapping
    )


# --- plain values as arguments of constructors ------------------------------------------------------------------------


#: Classes by name for each key that takes a class. Names are looked up here only; nothing is imported or evaluated.
CLASSES: Final[dict[str, dict[str, type]]] = {
    "rollout_buffer_class": {"TeamRolloutBuffer": TeamRolloutBuffer},
    "features_extractor_class": {
        encoder.__name__: encoder for encoder in (LightEncoder, MLPEncoder, NatureEncoder, ObservationEncoder, PaperCNN)
    },
    "activation_fn": {
        "tanh": nn.Tanh,
        "relu": nn.ReLU,
        "elu": nn.ELU,
        "gelu": nn.GELU,
        "silu": nn.SiLU,
        "leaky_relu": nn.LeakyReLU,
        "normalized_relu": NormalizedReLU,
    },
    "optimizer_class": {"Adam": th.optim.Adam, "AdamW": th.optim.AdamW, "RMSprop": th.optim.RMSprop},
}

#: Ranges that the algorithms' constructors do not check.
RANGES: Final[dict[str, Meta]] = {
    **dict.fromkeys(("gamma", "gae_lambda", "td_lambda", "tau"), Meta(ge=0, le=1)),
    **dict.fromkeys(("exploration_fraction", "exploration_initial_eps", "exploration_final_eps"), Meta(ge=0, le=1)),
    **dict.fromkeys(("learning_rate", "ent_coef", "vf_coef", "learning_starts"), Meta(ge=0)),
    **dict.fromkeys(("clip_range", "max_grad_norm", "target_kl"), Meta(gt=0)),
    **dict.fromkeys(("n_steps", "rollout_steps", "n_epochs", "batch_size", "n_minibatches", "game_steps"), Meta(ge=1)),
    **dict.fromkeys(("buffer_size", "train_freq", "target_update_interval", "stats_window_size"), Meta(ge=1)),
    "n_envs": Meta(ge=1, le=100_000),
    "frame_stack": Meta(ge=1, le=1_000),
}

#: Constructor arguments that are set by the run, not by its settings.
_RUN_ARGUMENTS: Final = {
    *("self", "policy", "env", "policy_kwargs", "tensorboard_log", "verbose", "seed", "device", "_init_setup_model")
}
_POLICY_RUN_ARGUMENTS: Final = {"self", "observation_space", "action_space", "lr_schedule", "args", "kwargs"}


def convert(name: str, value: object, hint: Any) -> Any:
    """
    Convert a plain value to a constructor argument.

    ``lin_0.001`` is RL-Zoo3's schedule, linear from 0.001 to 0.

    :param name: the argument's name, which selects its classes and its range
    :param value: value from YAML or a command line; classes and functions are returned unchanged
    :raises ValueError: for a wrong type or range
    """
    members = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    is_schedule = any(get_origin(member) is Callable for member in members)
    if isinstance(value, str):
        if name in CLASSES:
            if value not in CLASSES[name]:
                raise unknown_name(name, value, CLASSES[name])
            return CLASSES[name][value]
        if is_schedule and value.startswith("lin_"):
            return LinearSchedule(convert(name, value.removeprefix("lin_"), float), 0.0, 1.0)
    if Any in members or callable(value):
        return value
    kinds = [member for member in members if get_origin(member) not in (Callable, type)]
    if name in RANGES:
        kinds = [Annotated[kind, RANGES[name]] if kind in (int, float) else kind for kind in kinds]
    try:
        if not kinds:
            raise ValueError(f"expected one of {', '.join(CLASSES.get(name, ()))}")
        result = msgspec.convert(value, Union[tuple(kinds)], strict=False)  # noqa: UP007 (made of a list)
        if isinstance(result, float) and not math.isfinite(result):
            raise ValueError("expected a finite number")
        return result
    except ValueError as error:
        schedules = " (or a schedule such as 'lin_7e-4')" if is_schedule else ""
        raise ValueError(f"invalid setting {name}={reprlib.repr(value)}: {error}{schedules}") from None


def algorithm_arguments(algorithm: type[BaseAlgorithm]) -> dict[str, Any]:
    """Return the valid settings of an algorithm with types: its constructor's arguments but for the run's."""
    return _init_hints(algorithm, _RUN_ARGUMENTS)


def policy_arguments(policy: type[BasePolicy]) -> dict[str, Any]:
    """
    Return the valid ``policy_kwargs`` with types: the arguments of the constructors of the policy and of its base
    classes, and the fields of its parts.
    """
    arguments: dict[str, Any] = {}
    for base in reversed(policy.__mro__):
        if issubclass(base, BasePolicy) and "__init__" in vars(base):
            arguments |= _init_hints(base, _POLICY_RUN_ARGUMENTS)
    parts = getattr(policy, "parts_class", None)
    if parts is not None and is_dataclass(parts):
        hints = get_type_hints(parts)
        arguments |= {field.name: hints[field.name] for field in fields(parts)}
    return arguments


def _init_hints(owner: type, without: set[str]) -> dict[str, Any]:
    init = owner.__init__  # type: ignore[misc]
    hints = get_type_hints(init, localns=vars(vec_env) | {"vec_env": vec_env})  # of SB3's type of environments
    return {name: hints.get(name, Any) for name in inspect.signature(init).parameters if name not in without}


# --- settings for scripts ---------------------------------------------------------------------------------------------


#: Settings of ``sb3_saf.train --size small`` that also apply to scripts.
_OF_BUFFER: Final = ("rollout_buffer_class", "rollout_buffer_kwargs")
_TAKEN: Final = ("learning_rate", "n_epochs", "gae_lambda", "ent_coef", "vf_coef", "max_grad_norm", *_OF_BUFFER)


def ppo_settings(
    env: VecEnv,
    algo: str = "mappo",
    algorithm: type[OnPolicyAlgorithm] = PPO,
    memory: MemoryName | None = None,
    **overrides: Any,
) -> dict[str, Any]:
    """
    Return PPO hyperparameters for an environment of teams::

        model = PPO("MAPPOPolicy", env, **sb3_saf.ppo_settings(env))
        model = PPO("SAFPolicy", env, **sb3_saf.ppo_settings(env, "saf"))
        model = MaskablePPO("SAFPolicy", env, **sb3_saf.ppo_settings(env, "saf", MaskablePPO))
        model = PPO("SAFPolicy", env, **sb3_saf.ppo_settings(env, "saf", memory="gru"))

    They are those of ``sb3_saf.train --size small``: ``TeamRolloutBuffer``, and a few minibatches per rollout with the
    same number of game steps for any number of games. HECOGrid with tile codes has its own settings: the light encoder,
    narrow heads, normalised values, its discount, and a learning rate that decreases to 0.

    Where agents have rewards of their own (``team_reward="given"``, unless the suite gives all the team's), advantages
    are normalised for each agent, and so are values if ``policy_kwargs`` has ``normalize_values``: agents that are paid
    less learn as fast as those that are paid more.

    :param env: from ``make_team_env``, with any number of games
    :param algo: the method, a name of ``sb3_saf.train --algo`` that PPO trains. The settings of ``"saf"`` include its
        widths, which other policies do not take
    :param algorithm: the class for which the settings are, those that it takes: PPO, MaskablePPO, TRPO, or A2C, which
        keeps its own short rollouts
    :param memory: ``"gru"`` or ``"lstm"`` for agents that remember their episode
    :param overrides: arguments of the algorithm that take precedence; ``policy_kwargs`` are merged
    :raises ValueError: if ``env`` has no teams, or the algorithm does not train ``algo``
    """
    trained = [name for name, spec in ALGOS.items() if spec.algorithm is PPO]
    if algo not in trained:
        raise unknown_name("method of PPO", algo, trained)
    n_agents, spec = require_n_agents(env), find_algorithm(algo, algorithm.__name__)
    n_games, own = env.num_envs // n_agents, TeamSpaces.from_observation_space(env.observation_space).own
    encoder = LightEncoder if hasattr(own, "atlas") else None
    source = entry_of(read_settings(spec.config), ("default",) if encoder is None else ("default", HOME), "small")
    hints = algorithm_arguments(algorithm)
    taken = _TAKEN if encoder is None else (*_TAKEN, "gamma")  # HECOGrid's discount
    policy: Any = algorithm.policy_aliases[spec.policy]
    found = {key: convert(key, source[key], hints[key]) for key in taken if key in source and key in hints}
    if not policy.takes_team_buffer:  # masks and sequences need buffers of their own
        found = {key: value for key, value in found.items() if key not in _OF_BUFFER}
    if "batch_size" in hints:
        rollout = source["n_steps"] * source["n_envs"]  # game steps, in all games
        n_minibatches = source["n_minibatches"]
        n_steps = max(source["n_steps"], -(-rollout // (n_games * n_minibatches)) * n_minibatches)
        teams = int(overrides.get("n_steps", n_steps)) * n_games
        rows = teams // (1 if teams % n_minibatches else n_minibatches) * n_agents
        found |= {"n_steps": n_steps, "batch_size": max(2, rows)}
    policy_kwargs = source.get("policy_kwargs", {}) | spec.policy_kwargs
    if memory is not None:
        policy_kwargs["memory"] = memory
    if encoder is not None:
        policy_kwargs["features_extractor_class"] = encoder
    if not policy.takes_team_buffer:
        policy_kwargs.pop("normalize_values", None)
    policy_kwargs |= overrides.get("policy_kwargs") or {}
    if shares_reward(env) or overrides.get("normalize_advantage") is False:
        found.pop("rollout_buffer_kwargs", None)
    if not shares_reward(env) and policy_kwargs.get("normalize_values") is True:
        policy_kwargs["normalize_values"] = "agent"
    return {**found, **overrides, "policy_kwargs": policy_kwargs}
