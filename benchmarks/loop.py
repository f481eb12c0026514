"""
Measure the training loop with few games and small networks: SB3's own PPO compared with IPPO, MAPPO and SAF.
``python -m benchmarks.loop``

``free``: games that take no time (arrays drawn once), 3 agents, 18 numbers, 5 actions, episodes of 25 steps; MLP of 2 x
64 without an encoder, for all, and SAF's pool, slots and widths of the zoo's size ``small``; 4 epochs, 4 minibatches.
SB3 plays the same rows with its ``MlpPolicy``. ``small``: HECOGrid in the zoo's size ``small``, with the zoo's
settings. ``memory``: the same for MAPPO and SAF, without and with memory, in as many games as ``--memory-games`` says.
``recurrent``: there, sb3-contrib's RecurrentPPO, and IPPO and MAPPO with LSTMs of ``--units`` for actor and critic (one
for the team in MAPPO's). ``growth``: cost by the number of agents, ``small`` with N agents and as many rows.

Processor time of one core; programs take turns, the best of their rounds counts. Columns: one step of the rollout in
milliseconds, the update in microseconds per agent-step (all epochs), agent-steps per second of the whole loop, and the
time of the whole loop as a multiple of the first program's.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import VecEnv, VecExtractDictObs
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from benchmarks.stages import Stopwatch, small_model
from sb3_saf import CentralizedValueWrapper, LightEncoder, TeamMonitor, TeamRolloutBuffer, ppo_settings
from sb3_saf.suites.registry import find_environment
from sb3_saf.training.settings import load_settings

SB3: Final = "SB3 PPO"
N_AGENTS: Final = 3
N_NUMBERS: Final = 18
N_ACTIONS: Final = 5
EPISODE: Final = 25
N_EPOCHS: Final = 4
N_MINIBATCHES: Final = 4
#: Game steps of a rollout in each game.
N_STEPS: Final = {4: 128, 16: 128, 128: 25}
#: The same in games of a suite, as in JaxMARL's settings.
SUITE_STEPS: Final = 128
NARROW: Final[dict[str, Any]] = {"net_arch": [64, 64], "features_extractor_class": FlattenExtractor}
POLICIES: Final = ("IPPO", "MAPPO", "SAF")
GROWTH: Final = (2, 5, 10, 20, 50, 100)
GROWTH_ROWS: Final = 100
TABLES: Final = ("free", "small", "memory", "recurrent", "growth")


class FreeGames(VecEnv):
    """
    Games whose steps were drawn beforehand.

    :param n_games: E
    :param n_agents: N; 0 for rows without teams
    """

    def __init__(self, n_games: int, n_agents: int) -> None:
        box = spaces.Box(-1.0, 1.0, (N_NUMBERS,), np.float32)
        self.n_agents, self.n_games, self.render_mode, self.num_envs = n_agents, n_games, None, n_games * n_agents
        super().__init__(self.num_envs, box, spaces.Discrete(N_ACTIONS))
        generator = np.random.default_rng(0)
        self._observations = generator.uniform(-1, 1, (EPISODE, self.num_envs, N_NUMBERS)).astype(np.float32)
        self._rewards = generator.uniform(-1, 1, (EPISODE, self.num_envs)).astype(np.float32)
        self._going, self._ended = np.zeros(self.num_envs, bool), np.ones(self.num_envs, bool)
        self._infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        self._last = [{"terminal_observation": row} for row in self._observations[0]]
        self._step = 0

    def reset(self) -> VecEnvObs:
        """Return the first observations."""
        self._step = 0
        return self._observations[0]

    def step_async(self, actions: np.ndarray) -> None:
        """Ignore the actions."""

    def step_wait(self) -> VecEnvStepReturn:
        """Return the next observations."""
        self._step = (self._step + 1) % EPISODE
        ended = self._step == 0
        infos: Any = self._last if ended else self._infos
        return (
            self._observations[self._step],
            self._rewards[self._step].copy(),  # SB3 may add to them
            (self._ended if ended else self._going).copy(),
            infos.copy(),
        )

    def close(self) -> None:
        """Do nothing."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return the same attribute for all games."""
        return [getattr(self, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Not used."""
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Not used."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for all rows."""
        return [False] * self.num_envs


class Cost(NamedTuple):
    """
    Best processor seconds.

    :param rollout: of a rollout
    :param update: of an update
    :param n_steps: game steps of the rollout in each game
    :param n_rows: agent-steps of the rollout
    """

    rollout: float
    update: float
    n_steps: int
    n_rows: int

    @property
    def whole(self) -> float:
        """Total seconds per agent-step."""
        return (self.rollout + self.update) / self.n_rows


def free_models(n_games: int) -> dict[str, PPO]:
    """Create SB3's PPO and ours on games that take no time."""
    return _models(lambda: FreeGames(n_games, N_AGENTS), N_STEPS[n_games])


def suite_models(env_id: str, n_games: int) -> dict[str, PPO]:
    """Create SB3's PPO and ours on games of a batched suite."""
    one = find_environment(env_id)
    assert one.suite is not None and one.suite.vec_env is not None
    return _models(partial(one.suite.vec_env, one.task, n_games, 0), SUITE_STEPS)


def _models(make_games: Callable[[], VecEnv], n_steps: int) -> dict[str, PPO]:
    """Create SB3's PPO on the agents' rows, and ours on teams."""
    games = make_games()
    settings: dict[str, Any] = {
        "n_steps": n_steps,
        "batch_size": n_steps * games.num_envs // N_MINIBATCHES,
        "n_epochs": N_EPOCHS,
        "device": "cpu",
        "seed": 0,
    }
    rows = VecExtractDictObs(games, "obs") if isinstance(games.observation_space, spaces.Dict) else games
    models = {SB3: PPO("MlpPolicy", rows, policy_kwargs=NARROW, **settings)}
    for name in POLICIES:
        env = CentralizedValueWrapper(TeamMonitor(make_games()))
        policy_kwargs = {**ppo_settings(env, name.lower())["policy_kwargs"], **NARROW}  # SAF's pool, slots and widths
        buffer: dict[str, Any] = {"rollout_buffer_class": TeamRolloutBuffer, "policy_kwargs": policy_kwargs}
        models[name] = PPO(f"{name}Policy", env, **buffer, **settings)
    return models


def recurrent_models(units: int) -> dict[str, OnPolicyAlgorithm]:
    """Create sb3-contrib's RecurrentPPO, and IPPO and MAPPO with memory, with equal widths, encoders and settings."""
    overrides = {"policy_kwargs": {"memory_size": units, "normalize_values": False}}
    ours: dict[str, OnPolicyAlgorithm] = {}
    for algo in ("ippo-lstm", "mappo-lstm"):
        settings = load_settings(algo, "TeamSupport-v0", "small", overrides=overrides)
        ours[algo] = settings.make_model(settings.make_env(0), 0, device="cpu")  # type: ignore[assignment]
    names = ("n_steps", "batch_size", "n_epochs", "gamma", "gae_lambda", "ent_coef", "vf_coef", "max_grad_norm")
    same = {name: getattr(ours["ippo-lstm"], name) for name in names}
    policy_kwargs = {"net_arch": [64], "lstm_hidden_size": units, "features_extractor_class": LightEncoder}
    rows = VecExtractDictObs(settings.make_env(0), "obs")
    theirs = RecurrentPPO("MlpLstmPolicy", rows, policy_kwargs=policy_kwargs, device="cpu", seed=0, **same)
    return {"RecurrentPPO": theirs, **ours}


def costs(models: Mapping[str, OnPolicyAlgorithm], rounds: int) -> dict[str, Cost]:
    """Measure programs in turns; the first round is a warm-up."""
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in models}
    for _ in range(rounds + 1):
        for name, model in models.items():
            with Stopwatch(clock=time.process_time) as stopwatch:
                stopwatch.watch(model, "collect_rollouts", "rollout")
                stopwatch.watch(model, "train", "update")
                model.learn(model.n_steps * model.n_envs, reset_num_timesteps=False)
                seconds = stopwatch.stop()
            spent[name].append((seconds["rollout"], seconds["update"]))
    found = {}
    for name, model in models.items():
        rollouts, updates = zip(*spent[name][1:], strict=True)
        found[name] = Cost(min(rollouts), min(updates), model.n_steps, model.n_steps * model.n_envs)
    return found


def print_table(title: str, costs_by_name: Mapping[str, Cost]) -> None:
    """Print Markdown."""
    first = next(iter(costs_by_name))
    print(f"\n{title}\n\n| program | step, ms | update, us a row | agent-steps/s | whole loop, x {first} |")
    print("| --- | --- | --- | --- | --- |")
    for name, cost in costs_by_name.items():
        step, update = 1e3 * cost.rollout / cost.n_steps, 1e6 * cost.update / cost.n_rows
        ratio = cost.whole / costs_by_name[first].whole
        print(f"| {name} | {step:.2f} | {update:.1f} | {1 / cost.whole:,.0f} | {ratio:.2f} |", flush=True)


def print_growth(rounds: int) -> None:
    """Print the cost by the number of agents, with equal rows and density."""
    print("\n| agents | " + " | ".join(f"{algo}, us per agent-step" for algo in ("SAF", "MAPPO")) + " |")
    print("| --- | --- | --- |")
    for n_agents in GROWTH:
        side = max(8, round(15 * (n_agents / 5) ** 0.5))
        overrides = {"n_envs": max(1, GROWTH_ROWS // n_agents), "n_steps": 50, "n_minibatches": 2}
        level = {"n_agents": n_agents, "grid_size": side, "n_treasures": side * side // 9}
        models = {algo: small_model(algo, overrides, env_kwargs=level) for algo in ("saf", "mappo")}
        by_algo = costs(models, rounds)
        print(
            f"| {n_agents} | " + " | ".join(f"{1e6 * cost.whole:.0f}" for cost in by_algo.values()) + " |", flush=True
        )


def main() -> None:
    """Print the selected tables, by default all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=TABLES)
    parser.add_argument("--games", nargs="+", type=int, default=list(N_STEPS), choices=list(N_STEPS), help="of free")
    parser.add_argument("--memory-games", type=int, help="of memory, by default the size's")
    parser.add_argument("--units", type=int, nargs="+", default=[64, 256], help="of the LSTMs of recurrent")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    tables = options.only or TABLES
    th.set_num_threads(1)
    if "free" in tables:
        for n_games in options.games:
            print_table(f"{n_games} free games x {N_AGENTS} agents", costs(free_models(n_games), options.rounds))
    if "small" in tables:
        models = {algo.upper(): small_model(algo, {}) for algo in ("ippo", "mappo", "saf")}
        print_table("HECOGrid TeamSupport, size small", costs(models, options.rounds))
    memory_games = {} if options.memory_games is None else {"n_envs": options.memory_games}
    if "memory" in tables:
        for algo in ("mappo", "saf"):
            names = (algo, f"{algo}-gru", f"{algo}-lstm")
            models = {name: small_model(name, memory_games) for name in names}
            print_table(f"HECOGrid TeamSupport, size small, {algo} with memory", costs(models, options.rounds))
    if "recurrent" in tables:
        for units in options.units:
            print_table(
                f"HECOGrid TeamSupport, size small, LSTMs of {units}", costs(recurrent_models(units), options.rounds)
            )
    if "growth" in tables:
        print_growth(options.rounds)


if __name__ == "__main__":
    main()
