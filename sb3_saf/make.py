"""``make_team_env``: vector environments for the policies of this package from a task, environment or factory."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import gymnasium as gym
from pettingzoo import AECEnv, ParallelEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv

from sb3_saf.envs.curriculum import Curriculum, Stage
from sb3_saf.envs.game_reader import AnyParallelEnv, AskMasks
from sb3_saf.envs.joint_observation import CentralizedValueWrapper, TimeLimit
from sb3_saf.envs.monitor import SharedReward, TeamMonitor, TeamReward
from sb3_saf.envs.supersuit_vec_env import SuperSuitVecEnv
from sb3_saf.suites.registry import TeamEnvironment, find_environment
from sb3_saf.teams.checks import check_choice, check_count
from sb3_saf.teams.rows import TeamSpaces
from sb3_saf.teams.vec_env import require_n_agents

Backend = Literal["native", "supersuit"]
EnvFactory: TypeAlias = "Callable[..., AnyParallelEnv]"


class Request(NamedTuple):
    """Requested properties of the games; the fields are arguments of :func:`make_team_env`."""

    n_envs: int
    backend: Backend | None = None
    n_cpus: int = 1
    active: bool | None = None
    action_masks: AskMasks = "auto"
    state: bool = False
    stagger: bool = False


def make_team_env(
    env: str | AnyParallelEnv | EnvFactory,
    n_envs: int = 1,
    seed: int | None = None,
    backend: Backend | None = None,
    time_limit: TimeLimit = "terminal",
    monitor_dir: str | os.PathLike[str] | None = None,
    n_cpus: int = 1,
    *,
    active: bool | None = None,
    action_masks: AskMasks = "auto",
    state: bool = False,
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

    Environments may have agents that die or join, action masks, and a state:

    - An agent that has ended, or not joined yet, keeps its row, filled with zeros; ``"active"`` marks it for the
      critics, and ``TeamRolloutBuffer`` excludes such rows from the loss.
    - Masks come from Dict observations with an entry such as ``"action_mask"``, which is taken out, or from
      ``infos[agent]["action_mask"]``. Policies of this package take legal actions only.
    - The environment's ``state()`` can be the input of MAPPO's critic, ``policy_kwargs={"critic_input": "state"}``.

    :param env: a name: a HECOGrid task ("TeamTogether"), a task of a suite ("lbf/Foraging-8x8-2p-3f-v3", see
        :mod:`sb3_saf.suites`), a module with ``parallel_env`` ("mpe2.simple_spread_v3"), a function
        ("my_package.my_module:make_env") or an id registered with PettingZoo. Or a PettingZoo ParallelEnv, a Gymnasium
        environment of several agents (:class:`GymnasiumTeam`), or a factory that returns one
        (``simple_spread_v3.parallel_env``). An environment is copied. Agents with different spaces get equal ones:
        observations are padded with zeros, and actions that an agent lacks are masked
    :param n_envs: E, parallel games
    :param seed: the run's seed, which determines the games' seeds; None for random ones. An algorithm's ``seed``
        overrides it
    :param backend: ``"native"`` steps all games at once in the suite's own engine, the default where there is one;
        ``"supersuit"`` goes through SuperSuit, the default for other games. Both give identical results for HECOGrid
    :param time_limit: ``"terminal"`` treats a time limit as a true end, ``"bootstrap"`` adds the last observation's
        value
    :param monitor_dir: folder for a ``monitor.csv`` with one line per team episode; None for none
    :param n_cpus: number of processes for the games of ``"supersuit"``
    :param active: whether observations have the signal ``"active"``; None for True unless the suite
        knows that all agents always take part, as in HECOGrid
    :param action_masks: ``"auto"`` for masks if the environment gives any (in observations, or in the infos of its
        first reset), True to require them, False for none
    :param state: whether observations have the environment's ``state()``
    :param team_reward: reward for learning: ``"given"`` is each agent's own reward, ``"sum"`` and ``"mean"`` are over
        the agents of its team; None for the suite's default, ``"given"`` without a suite. Logs and evaluation always
        report the games' rewards, in the suite's unit
    :param curriculum: stages before the games with ``params``, see :class:`~sb3_saf.Curriculum`
    :param stagger: whether the first episodes are cut to different lengths, evenly spread, so that games do not all end
        together and a rollout shorter than an episode has all its phases; for engines with time limits only
    :param params: parameters of the task or the factory, such as ``n_agents=5``
    :raises ValueError: if the arguments do not fit together, with a fix
    """
    if monitor_dir is not None and os.path.exists(monitor_dir) and not os.path.isdir(monitor_dir):
        raise ValueError(f"monitor_dir must be a folder, which is created if missing; {monitor_dir} is a file")
    check_choice("active", active, (None, True, False))
    check_choice("action_masks", action_masks, ("auto", True, False))
    if team_reward is not None:
        check_choice("team_reward", team_reward, get_args(TeamReward))
    source = find_environment(env) if isinstance(env, str) else env
    suite = None
    if isinstance(source, TeamEnvironment):
        source.warn_if_competitive()
        suite = source.suite
        if suite is not None:
            params = {**suite.defaults, **params}
    request = Request(n_envs, backend, n_cpus, active, action_masks, state, stagger)
    make = partial(_make_rows, source, request)
    venv = make(seed, params) if not curriculum else _in_stages(make, seed, params, curriculum)
    if monitor_dir is not None:
        os.makedirs(monitor_dir, exist_ok=True)
        monitor_dir = os.path.join(monitor_dir, Monitor.EXT)
    venv = TeamMonitor(venv, filename=monitor_dir, team_return="sum" if suite is None else suite.team_return)
    if team_reward is None:
        team_reward = "given" if suite is None else suite.team_reward
    if team_reward != "given":
        venv = SharedReward(venv, team_reward)
    return CentralizedValueWrapper(venv, time_limit=time_limit)


def make_vec_env(
    env: str,
    n_envs: int = 1,
    seed: int | None = None,
    backend: Backend | None = None,
    n_cpus: int = 1,
    stagger: bool = False,
    **params: Any,
) -> VecEnv:
    """
    Make E parallel games as a parameter-shared vector environment: one row per agent, game-major, then agent.

    These are the games of :func:`make_team_env` without its wrappers and its defaults for HECOGrid: a row has its
    agent's own observation (pixels for HECOGrid), not the team's. Both backends give the same numbers for HECOGrid, row
    for row.

    :param env: a name as for :func:`make_team_env`, such as ``"TeamSupport"``
    :param n_envs: see :func:`make_team_env`
    :param seed: game ``e`` starts from ``game_seeds(seed, E)[e]``
    :param backend: see :func:`make_team_env`
    :param n_cpus: number of processes for the games of ``"supersuit"``
    :param stagger: see :func:`make_team_env`
    :param params: parameters of the game; for HECOGrid the fields of :class:`~hecogrid_envs.HECOGridParams`, and
        ``render_mode`` as in :func:`hecogrid_envs.parallel_env`
    :return: a VecEnv of B = E N rows with attributes ``n_games`` and ``n_agents``
    :raises ValueError: for an unknown name, backend or parameter, or a value out of range
    """
    request = Request(n_envs, backend, n_cpus, stagger=stagger)
    return _make_rows(find_environment(env), request, seed, params)


def _in_stages(
    make: Callable[[int | None, dict[str, Any]], VecEnv],
    seed: int | None,
    params: dict[str, Any],
    curriculum: Sequence[Stage],
) -> Curriculum:
    """Make the games of all stages and join them to a curriculum."""
    for stage in curriculum:
        if not isinstance(stage, Stage):
            raise ValueError(f"curriculum must list sb3_saf.Stage(game_steps, params), got {stage!r}")
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


def _make_rows(
    source: TeamEnvironment | AnyParallelEnv | EnvFactory, request: Request, seed: int | None, params: dict[str, Any]
) -> VecEnv:
    """Make the rows of the games in the suite's own engine or through SuperSuit."""
    check_count("n_envs", request.n_envs)
    check_count("n_cpus", request.n_cpus)
    if request.backend is not None:
        check_choice("backend", request.backend, get_args(Backend))
    env = source if isinstance(source, TeamEnvironment) else None
    name = env.id if env is not None else getattr(source, "__qualname__", None) or type(source).__name__
    suite = None if env is None else env.suite
    if env is not None and suite is not None and suite.vec_env is not None:
        if request.backend != "supersuit":
            return _make_in_engine(env, request, seed, params)
    elif request.backend == "native":
        raise ValueError(
            f"backend='native' needs a suite with an engine of its own, got it with {name}; leave backend out or use "
            "backend='supersuit'"
        )
    if env is not None and env.make is None:
        raise ValueError(f"backend='supersuit' needs single games, {name} has an engine only; leave backend out")
    if request.stagger:
        raise ValueError(f"stagger=True needs a suite with an engine of its own, got {name} through SuperSuit")
    active = request.active
    if active is None:
        active = suite is None or not suite.always_active
    game: Any = source
    if env is not None:
        game = partial(env.make_game, params)
    elif isinstance(source, VecEnv):
        raise ValueError(
            f"expected a task name, a PettingZoo ParallelEnv or a factory, got the VecEnv {name}; wrap it yourself: "
            "sb3_saf.CentralizedValueWrapper(sb3_saf.TeamMonitor(venv))"
        )
    elif params:
        if not callable(source) or isinstance(source, (ParallelEnv, AECEnv, gym.Env)):
            raise ValueError(
                f"parameters {sorted(params)} go to a factory, got them with {name}; give them to the environment "
                "when you make it, or pass its factory (such as simple_spread_v3.parallel_env) instead"
            )
        game = partial(source, **params)
    return SuperSuitVecEnv(game, request.n_envs, seed, request.n_cpus, active, request.action_masks, request.state)


def _make_in_engine(env: TeamEnvironment, request: Request, seed: int | None, params: dict[str, Any]) -> VecEnv:
    assert env.suite is not None
    others = "" if env.suite.game is None else ", or use backend='supersuit'"
    if request.n_cpus != 1:
        raise ValueError(
            f"n_cpus={request.n_cpus} divides games among processes, but {env.id} has an engine of its own, which "
            f"steps all games at once; leave n_cpus out{others}"
        )
    params = {**params, "stagger": True} if request.stagger else params
    venv = env.make_engine(request.n_envs, seed, params, state=request.state)
    rows = TeamSpaces.of_rows(venv.observation_space, venv.action_space, require_n_agents(venv))
    given = {"active": rows.has_active, "action_masks": rows.n_masked_actions is not None}
    asked = {"active": request.active, "action_masks": request.action_masks}
    for argument, value in asked.items():
        if value not in (None, "auto", given[argument]):
            venv.close()
            have = "have" if given[argument] else "have no"
            raise ValueError(f"rows of {env.id} {have} {argument}, got {argument}={value}; leave it out{others}")
    return venv
