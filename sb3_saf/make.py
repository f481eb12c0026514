"""``make_team_env``: vector environments for the policies of this package from a task, environment or factory."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final, Literal, NamedTuple, TypeAlias, get_args

import gymnasium as gym
from pettingzoo import AECEnv, ParallelEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.envs.curriculum import Curriculum, Stage
from sb3_saf.envs.equal_spaces import make_team_game, team_game
from sb3_saf.envs.game_reader import AnyParallelEnv, AskMasks
from sb3_saf.envs.joint_observation import CentralizedValueWrapper, TimeLimit
from sb3_saf.envs.monitor import TeamMonitor
from sb3_saf.envs.team_reward import SharedReward, TeamReward
from sb3_saf.suites.registry import SuiteTask, find_task
from sb3_saf.teams.checks import check_choice, check_count
from sb3_saf.teams.rows import TeamSpaces

Backend = Literal["native", "supersuit"]
#: Characters that occur in names of modules and functions, but not of tasks.
_NAMES_OF_CODE: Final = frozenset(".:")

EnvFactory: TypeAlias = "Callable[..., AnyParallelEnv]"


class Request(NamedTuple):
    """
    Requested properties of the games.

    :param n_envs: E
    :param backend: None for the default
    :param n_cpus: number of processes
    :param active: whether rows tell which agents take part
    :param action_masks: as in :func:`make_team_env`
    :param state: whether rows have the game's state
    :param float64: whether observations of float64 stay so
    """

    n_envs: int
    backend: Backend | None
    n_cpus: int
    active: bool
    action_masks: AskMasks
    state: bool
    float64: bool


def make_team_env(
    env: str | AnyParallelEnv | EnvFactory,
    n_envs: int = 1,
    seed: int | None = None,
    backend: Backend | None = None,
    time_limit: TimeLimit = "terminal",
    monitor_dir: str | None = None,
    n_cpus: int = 1,
    *,
    active: bool | None = None,
    action_masks: AskMasks = "auto",
    state: bool = False,
    float64: bool = False,
    team_reward: TeamReward | None = None,
    curriculum: Sequence[Stage] = (),
    stagger: bool = False,
    **params: Any,
) -> CentralizedValueWrapper:
    """
    Make E parallel games for ``PPO("SAFPolicy", ...)``.

    The chain is: games flattened to rows, :class:`TeamMonitor`, :class:`CentralizedValueWrapper`.

    HECOGrid tasks use ``observation="tiles"`` by default: the same views as one code per cell, which the encoder
    expands to the same pixels, in 48 times less memory than ``observation="rgb"``.

    Other environments may have agents that die or join, action masks, and a state:

    - An agent that has ended, or not joined yet, keeps its row, filled with zeros; ``"active"`` marks it for the
      critics, and ``TeamRolloutBuffer`` excludes such rows from the loss.
    - Masks come from Dict observations with an entry such as ``"action_mask"``, which is taken out, or from
      ``infos[agent]["action_mask"]``. Policies of this package take legal actions only.
    - The environment's ``state()`` can be the input of MAPPO's critic, ``policy_kwargs={"critic_input": "state"}``.

    :param env: a HECOGrid task ("TeamTogether", or its id "hecogrid/TeamTogether-v0"); a task of a suite
        ("lbf/Foraging-8x8-2p-3f-v3", see :mod:`sb3_saf.suites`); a module with ``parallel_env``
        ("mpe2.simple_spread_v3") or a function ("my_package.my_module:make_env"); a PettingZoo ParallelEnv, a Gymnasium
        environment of several agents (:class:`GymnasiumTeam`), or a factory that returns one
        (``simple_spread_v3.parallel_env``). An environment is copied. Agents with different spaces get equal ones
        (:class:`EqualSpaces`)
    :param n_envs: E, parallel games
    :param seed: the run's seed, which determines the games' seeds; None for random ones. An algorithm's ``seed``
        overrides it
    :param backend: ``"native"`` steps all games at once in compiled code, for HECOGrid only and its default;
        ``"supersuit"`` goes through SuperSuit, the default for other games. Both give identical results for HECOGrid
    :param time_limit: ``"terminal"`` treats a time limit as a true end, ``"bootstrap"`` adds the last observation's
        value
    :param monitor_dir: folder for a ``monitor.csv`` with one line per team episode; None for none
    :param n_cpus: number of processes for the games of ``"supersuit"``
    :param active: whether observations have the signal ``"active"``; None for True, but False for HECOGrid
    :param action_masks: ``"auto"`` for masks if the environment gives any (in observations, or in the infos of its
        first reset), True to require them, False for none
    :param state: whether observations have the environment's ``state()``
    :param float64: whether observations of float64 stay so; they become float32 otherwise, which networks read
    :param team_reward: reward for learning: ``"given"`` is each agent's own reward, ``"sum"`` and ``"mean"`` are over
        the agents of its team; None for the suite's default, ``"given"`` without a suite. Logs and evaluation always
        report the games' rewards, in the suite's unit
    :param curriculum: stages before the games with ``params``, see :class:`~sb3_saf.Curriculum`
    :param stagger: whether the first episodes are cut to different lengths, evenly spread, so that games do not all end
        together and a rollout shorter than an episode has all its phases; HECOGrid with ``backend="native"`` only
    :param params: parameters of the task or the factory, such as ``n_agents=5``
    :raises ValueError: if the arguments do not fit together, with a fix
    """
    check_count("n_envs", n_envs)
    check_count("n_cpus", n_cpus)
    if backend is not None:
        check_choice("backend", backend, get_args(Backend))
    if team_reward is not None:
        check_choice("team_reward", team_reward, get_args(TeamReward))
    request = Request(n_envs, backend, n_cpus, active is not False, action_masks, state, float64)
    task = find_task(env) if isinstance(env, str) and "/" in env else None
    if isinstance(env, str) and _NAMES_OF_CODE.intersection(env):
        env = _imported(env)
    make: Callable[[int | None, dict[str, Any]], VecEnv]
    if stagger and (task is not None or not isinstance(env, str)):
        raise ValueError("stagger=True needs HECOGrid's compiled games, a task named by a string; leave it out")
    if task is not None:
        task.warn_if_competitive()
        make = partial(_suite, task, request)
    elif isinstance(env, str):
        _refuse_signals(active, action_masks, state)
        make = partial(_hecogrid, env, request, stagger)
    else:
        make = partial(_foreign, env, request)
    venv = make(seed, params) if not curriculum else _in_stages(make, seed, params, curriculum)
    if monitor_dir is not None:
        os.makedirs(monitor_dir, exist_ok=True)
    venv = TeamMonitor(venv, filename=monitor_dir, team_return="sum" if task is None else task.suite.team_return)
    if team_reward is None:
        team_reward = "given" if task is None else task.suite.team_reward
    if team_reward != "given":
        venv = SharedReward(venv, team_reward)
    return CentralizedValueWrapper(venv, time_limit=time_limit)


def _imported(name: str) -> EnvFactory:
    """Import a function that makes games by its name."""
    from sb3_saf.training.environments import find_environment  # imports the settings, too

    make = find_environment(name).make
    assert make is not None, "only HECOGrid's environments have none, whose names have no dots"
    return make


def _refuse_signals(active: bool | None, action_masks: AskMasks, state: bool) -> None:
    asked = {"active=True": active, "action_masks=True": action_masks is True, "state=True": state}
    for argument, is_asked in asked.items():
        if is_asked:
            raise ValueError(
                f"{argument} goes through SuperSuit, and a HECOGrid task named by a string does not ask for it: its "
                "agents always take part and may do anything. Leave it out, or pass a factory for env, for instance "
                "hecogrid_envs.tasks.team_support.parallel_env"
            )


def _in_stages(
    make: Callable[[int | None, dict[str, Any]], VecEnv],
    seed: int | None,
    params: dict[str, Any],
    curriculum: Sequence[Stage],
) -> Curriculum:
    """Make the games of all stages and join them to a curriculum."""
    games: list[VecEnv] = []
    try:
        for of_stage in [*(stage.params for stage in curriculum), {}]:
            games.append(make(None, {**params, **of_stage}))
        staged = Curriculum(games, [stage.game_steps for stage in curriculum])
    except BaseException:
        for made in games:
            made.close()
        raise
    staged.seed(seed)
    return staged


def _hecogrid(task: str, request: Request, stagger: bool, seed: int | None, params: dict[str, Any]) -> VecEnv:
    """Make the games of a HECOGrid task."""
    from hecogrid_envs.task import check_task

    try:
        name = check_task(task.removeprefix("hecogrid/").removesuffix("-v0"))
    except ValueError as error:
        raise ValueError(
            f"{error}. For any other environment pass a task of a suite (python -m sb3_saf.suites lists them), a "
            "PettingZoo ParallelEnv, or a factory that returns one, for instance simple_spread_v3.parallel_env"
        ) from None
    backend = request.backend or "native"
    if request.n_cpus != 1:
        if backend == "native":
            raise ValueError(
                f"n_cpus={request.n_cpus} divides games among SuperSuit's processes, but backend='native' steps all "
                "games at once; leave n_cpus out (native has n_threads) or use backend='supersuit'"
            )
        params = {**params, "n_cpus": request.n_cpus}
    params = {"observation": "tiles", **params}
    return make_vec_env(name, request.n_envs, seed=seed, backend=backend, stagger=stagger, **params)


def _suite(one: SuiteTask, request: Request, seed: int | None, params: dict[str, Any]) -> VecEnv:
    """Make the games of a suite's task, with its own engine or through SuperSuit."""
    suite = one.suite
    if suite.vec_env is None:
        assert suite.game is not None
        return _foreign(_Named(one.id, partial(suite.game, one.task)), request, seed, params)
    if request.backend == "native" or request.n_cpus != 1:
        raise ValueError(
            f"{one.id} has an engine of its own, which steps all games at once; leave backend and n_cpus out"
        )
    try:
        venv = suite.vec_env(one.task, request.n_envs, seed, state=request.state, **params)
    except TypeError as error:  # most often an argument that it does not have
        raise ValueError(f"{one.id} cannot be made with {params}: {error}") from error
    rows = TeamSpaces.of_rows(venv.observation_space, venv.action_space, venv.n_agents)
    _check_signals(one.id, rows, request)
    return venv


def _check_signals(name: str, rows: TeamSpaces, request: Request) -> None:
    has_masks = rows.n_masked_actions is not None
    if request.action_masks not in ("auto", has_masks):
        raise ValueError(
            f"{name} {'gives' if has_masks else 'has no'} action masks, got action_masks={request.action_masks}; "
            "leave it out"
        )
    if request.state and rows.state is None:
        raise ValueError(f"{name} has no state, got state=True; leave it out")


class _Named:
    """Factory with a name for messages."""

    def __init__(self, name: str, make: Callable[..., Any]) -> None:
        self.__qualname__ = name
        self._make = make

    def __call__(self, **params: Any) -> Any:
        try:
            return self._make(**params)
        except TypeError as error:  # most often an argument that it does not have
            raise ValueError(f"{self.__qualname__} cannot be made with {params}: {error}") from error


def _foreign(env: AnyParallelEnv | EnvFactory, request: Request, seed: int | None, params: dict[str, Any]) -> VecEnv:
    """Make the games of any ParallelEnv through SuperSuit."""
    from sb3_saf.envs.supersuit_vec_env import SuperSuitVecEnv

    if request.backend == "native":
        raise ValueError(
            f"backend='native' is the compiled core of HECOGrid, got it with {_name(env)}; leave backend out or use "
            "backend='supersuit'"
        )
    n_envs, _, n_cpus, active, action_masks, state, float64 = request
    return SuperSuitVecEnv(_bound(env, params), n_envs, seed, n_cpus, active, action_masks, state, float64)


def _bound(env: AnyParallelEnv | EnvFactory, params: dict[str, Any]) -> AnyParallelEnv | Callable[[], AnyParallelEnv]:
    """Return a factory with its parameters bound, or the environment itself."""
    if isinstance(env, VecEnv):
        raise ValueError(
            f"expected a task name, a PettingZoo ParallelEnv or a factory, got the VecEnv {_name(env)}; wrap it "
            "yourself: sb3_saf.CentralizedValueWrapper(sb3_saf.TeamMonitor(venv))"
        )
    is_factory = callable(env) and not isinstance(env, (ParallelEnv, AECEnv, gym.Env))
    if not params:
        return partial(make_team_game, env) if is_factory else team_game(env)
    if not is_factory:
        raise ValueError(
            f"parameters {sorted(params)} go to a factory, got them with {_name(env)}; give them to the environment "
            "when you make it, or pass its factory (such as simple_spread_v3.parallel_env) instead"
        )
    return partial(make_team_game, partial(env, **params))


def _name(env: object) -> str:
    return getattr(env, "__qualname__", None) or type(env).__name__


def make_vec_env(
    task: str,
    n_envs: int = 1,
    seed: int | None = None,
    backend: Backend = "native",
    render_mode: Literal["rgb_array", "human"] | None = None,
    n_threads: int = 1,
    n_cpus: int = 1,
    stagger: bool = False,
    **params: Any,
) -> VecEnv:
    """
    Make a parameter-shared vector environment: one row per agent, game-major, then agent.

    Both backends give the same numbers, row for row, for the same seed.

    :param task: a name of ``TASK_NAMES``, such as ``"TeamSupport"``
    :param n_envs: E, games
    :param seed: game ``e`` starts from ``game_seeds(seed, E)[e]``
    :param backend: ``"native"`` drives the batched core; ``"supersuit"`` goes through SuperSuit's
        ``pettingzoo_env_to_vec_env_v1`` and ``concat_vec_envs_v1``
    :param render_mode: as in :func:`hecogrid_envs.parallel_env`
    :param n_threads: threads of the native backend
    :param n_cpus: worker processes of the SuperSuit backend
    :param stagger: whether the first episodes of the native backend end at different times (:class:`NativeVecEnv`)
    :param params: fields of :class:`~hecogrid_envs.params.HECOGridParams`
    :return: a VecEnv of B = E N rows with attributes ``n_games`` and ``n_agents``
    :raises ValueError: for an unknown task, backend or parameter, or a value out of range
    """
    from hecogrid_envs import TASKS, GameBatch, HECOGridParams
    from sb3_saf.suites.hecogrid import NativeVecEnv

    if backend not in get_args(Backend):
        raise ValueError(f"backend must be 'native' or 'supersuit', got {backend!r}")
    if stagger and backend != "native":
        raise ValueError(f"stagger=True needs backend='native', got {backend!r}; leave it out")
    batch = GameBatch(task, HECOGridParams.from_kwargs(params), n_envs, n_threads)
    if backend == "native":
        return NativeVecEnv(batch, seed, render_mode, stagger)
    from sb3_saf.envs.supersuit_vec_env import SuperSuitVecEnv

    return SuperSuitVecEnv(partial(TASKS[batch.task], render_mode=render_mode, **params), n_envs, seed, n_cpus)
