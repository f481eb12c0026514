"""The runs that the kill harness kills: small, with all kinds of state that a resumed run could lose."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from sb3_contrib import TRPO, MaskablePPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.vec_env import VecNormalize

import sb3_saf
from tests.toy_envs import LazyEnv
from tests.weights import DyingGame

N_AGENTS, N_GAMES, N_STEPS = 3, 4, 16
#: Agent-steps of a rollout of PPO; the unit of a run's length for all algorithms.
ROLLOUT: Final = N_AGENTS * N_GAMES * N_STEPS

_TASK: Final[dict[str, Any]] = {
    "n_agents": N_AGENTS,
    "grid_size": 9,
    "n_treasures": 4,
    "coordination": 1,
    "max_cycles": 20,
}
_LIGHT: Final[dict[str, Any]] = {"features_extractor_class": sb3_saf.LightEncoder, "net_arch": [16]}


class Run(NamedTuple):
    """
    A run.

    :param model: made as at every start
    :param evaluation: its callback
    :param every: game steps between checkpoints
    """

    model: Any
    evaluation: sb3_saf.TeamEvalCallback
    every: int

    def warm_up(self) -> None:
        """Compile everything that is compiled on first use."""
        self.model.learn(2 * ROLLOUT)
        self.close()

    def close(self) -> None:
        """Close the environments."""
        self.model.env.close()
        self.evaluation.eval_env.close()

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All that was learned, and the content of a replay buffer."""
        found = {name: tensor.numpy() for name, tensor in self.model.policy.state_dict().items()}
        buffer = getattr(self.model, "replay_buffer", None)
        if buffer is not None:
            found |= {f"replay {name}": array for name, array in buffer.checkpoint_state()["slots"].items()}
            found["exploration_rate"] = np.array(self.model.exploration_rate)
        return found


class Games(NamedTuple):
    """
    The games of a run.

    :param name: one of GAMES
    :param n_cpus: worker processes of third-party games
    """

    name: str = "hecogrid"
    n_cpus: int = 1

    @property
    def start_method(self) -> Literal["fork", "spawn"]:
        """How a process of a run is started: JAX's threads do not survive a fork."""
        return "spawn" if self.name == "jax" else "fork"

    def make(self, n_games: int, seed: int, monitor_dir: str | None = None) -> sb3_saf.CentralizedValueWrapper:
        """Create parallel games."""
        if self.name in ("hecogrid", "curriculum"):
            stages = [sb3_saf.Stage(150, {"coordination": 2})] if self.name == "curriculum" else []
            return sb3_saf.make_team_env(
                "TeamTogether", n_games, seed=seed, monitor_dir=monitor_dir, curriculum=stages, **_TASK
            )
        make, n_cpus = GAMES[self.name], self.n_cpus
        if self.name == "jax":
            return sb3_saf.make_team_env(make, n_games, seed=seed, monitor_dir=monitor_dir, max_steps=19)
        return sb3_saf.make_team_env(make, n_games, seed=seed, monitor_dir=monitor_dir, n_cpus=n_cpus)


def _spread() -> Any:
    return import_module("mpe2.simple_spread_v3").parallel_env(max_cycles=20)


def _pursuit() -> Any:
    return import_module("pettingzoo.sisl.pursuit_v5").parallel_env(
        n_pursuers=N_AGENTS, x_size=8, y_size=8, n_evaders=4, max_cycles=20
    )


def _lazy() -> Any:
    return LazyEnv(n_agents=N_AGENTS, max_cycles=20)


#: Games of N_AGENTS agents: this package's, of one level and of two; MPE's and SISL's; one that creates its generator
#: late; one whose agents die and join, with masks; JaxMARL's, in a batch.
GAMES: Final[dict[str, Any]] = {
    "hecogrid": None,
    "curriculum": None,
    "spread": _spread,
    "pursuit": _pursuit,
    "lazy": _lazy,
    "dying": DyingGame,
    "jax": "jaxmarl/MPE_simple_spread_v3",
}


def make_run(algo: str, folder: Path | None, games: Games = Games()) -> Run:  # noqa: B008 - it is a tuple
    """
    Create a run as a user's script does at every start.

    :param algo: one of ALGOS
    :param folder: for monitor.csv, TensorBoard and evaluations; None for none
    :param games: of the run
    """
    where = None if folder is None else str(folder)
    env = games.make(N_GAMES, 0, where)
    eval_env = games.make(2, 99)
    if algo == "normalized":
        env, eval_env = (
            sb3_saf.CentralizedValueWrapper(VecNormalize(one.venv, norm_obs_keys=["obs"])) for one in (env, eval_env)
        )
    evaluation = sb3_saf.TeamEvalCallback(
        eval_env,
        n_eval_episodes=2,
        eval_freq=200,
        log_path=where,
        best_model_save_path=where,
        deterministic=False,
        verbose=0,
    )
    networks = _LIGHT if games.name in ("hecogrid", "curriculum") else {"net_arch": [16]}
    model = ALGOS[algo](env, networks, tensorboard_log=None if folder is None else str(folder / "tb"))
    return Run(model, evaluation, 100 if algo.startswith("qplex") else 1)


def _ppo(policy: str, algorithm: Any = PPO, **parts: Any) -> Callable[..., Any]:
    def make(env: Any, networks: dict[str, Any], **arguments: Any) -> Any:
        return algorithm(
            policy,
            env,
            learning_rate=lambda progress: 1e-3 * progress,
            n_steps=N_STEPS,
            seed=0,
            policy_kwargs=networks | parts,
            **({"batch_size": ROLLOUT // 4, "n_epochs": 2} if algorithm in (PPO, MaskablePPO) else {}),
            **({} if algorithm is MaskablePPO else {"rollout_buffer_class": sb3_saf.TeamRolloutBuffer}),
            **arguments,
        )

    return make


def _qplex(**parts: Any) -> Callable[..., Any]:
    """QPLEX with a replay buffer that is full after a third of the run, and changing targets and schedules."""

    def make(env: Any, networks: dict[str, Any], **arguments: Any) -> Any:
        return sb3_saf.QPLEX(
            "QPLEXPoolPolicy",
            env,
            learning_rate=lambda progress: 1e-3 * progress,
            buffer_size=800,
            learning_starts=100,
            batch_size=16,
            train_freq=16,
            target_update_interval=150,
            exploration_fraction=0.8,
            seed=0,
            policy_kwargs=networks | parts,
            **arguments,
        )

    return make


#: What is trained, by name.
ALGOS: Final[dict[str, Callable[..., Any]]] = {
    "saf": _ppo("SAFPolicy", normalize_values=True),
    "qplex": _qplex(),
    "saf-gru": _ppo("SAFPolicy", memory="gru", memory_size=8, normalize_values=True),
    "mappo-lstm": _ppo("MAPPOPolicy", memory="lstm", memory_size=8),
    "qplex-gru": _qplex(memory="gru", memory_size=8),
    "ippo-a2c": _ppo("IPPOPolicy", A2C),
    "mappo-trpo": _ppo("MAPPOPolicy", TRPO),
    "maskable": _ppo("SAFMaskablePolicy", MaskablePPO),
    "normalized": _ppo("SAFPolicy"),
}
