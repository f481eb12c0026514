"""
Measure the batched suites at 64 games: as rows of teams, compared with the engine alone and with single games.

``python -m benchmarks.suites`` prints one table; names of tasks select rows. Random legal actions. *Engine alone* is
the suite's own step of all games at once, including new episodes, without reading results; *rows* is our VecEnv, with
last observations, masks and infos; *training chain* adds joint observations and monitors, copies included; *game by
game* is the suite's own step of one game, as called by wrappers of single games. Agent-steps per second of processor
time, best of rounds in which all take turns, so that other load on the machine matters little.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from benchmarks.turns import Work, rates
from sb3_saf import make_team_env
from sb3_saf.suites.registry import find_environment

N_GAMES = 64
TASKS = ("smax/3m", "overcooked/cramped_room", "jaxmarl/MPE_simple_spread_v3", "vmas/balance", "vmas/navigation")
#: For which each works in a round.
SECONDS = 0.2


def rows_of(env: Any) -> Work:
    """Step a VecEnv, with or without the wrappers of training."""
    observations: dict[str, Any] = env.reset()
    rng = np.random.default_rng(0)

    def step() -> int:
        nonlocal observations
        masks = observations.get("action_mask")
        if masks is None:
            observations = env.step(actions[rng.integers(len(actions))])[0]
        else:
            observations = env.step((random[rng.integers(len(random))] * masks).argmax(axis=1))[0]
        return int(env.num_envs)

    random = rng.random((16, env.num_envs, getattr(env.action_space, "n", 1)), dtype=np.float32)
    actions = np.stack([[env.action_space.sample() for _ in range(env.num_envs)] for _ in range(16)])
    return step


def jax_engine(env: Any, n_games: int, actions: Any) -> Work:
    """Step with JaxMARL's own ``step``, which begins new episodes itself."""
    import jax

    def one(key: Any, state: Any, chosen: Any) -> Any:
        key, now = jax.random.split(key)
        return key, *env.step(now, state, {agent: chosen[i] for i, agent in enumerate(env.agents)})

    play = jax.jit(jax.vmap(one) if n_games > 1 else one)
    keys = jax.random.split(jax.random.PRNGKey(0), n_games)
    keys = keys if n_games > 1 else keys[0]
    _, state = jax.jit(jax.vmap(env.reset) if n_games > 1 else env.reset)(keys)
    rng = np.random.default_rng(0)

    def step() -> int:
        nonlocal keys, state
        keys, _, state, *rest = play(keys, state, actions[rng.integers(len(actions))])
        jax.block_until_ready(rest)
        return n_games * len(env.agents)

    return step


def vmas_engine(scenario: str, n_games: int, actions: Any) -> Work:
    """Step with VMAS's own ``step``, and its ``reset_at`` for games that have ended."""
    import torch as th
    import vmas

    env = vmas.make_env(scenario, n_games, max_steps=100, seed=0, terminated_truncated=True)
    env.reset()
    rng = np.random.default_rng(0)

    def step() -> int:
        chosen = th.from_numpy(actions[rng.integers(len(actions))])
        *_, terminated, truncated, _ = env.step([chosen[:, i] for i in range(env.n_agents)])
        for game in np.flatnonzero((terminated | truncated).numpy()).tolist():
            env.reset_at(game, return_observations=False)
        return n_games * int(env.n_agents)

    return step


def contestants(env_id: str) -> dict[str, Work]:
    """Create engine alone, rows, training chain, game by game."""
    one = find_environment(env_id)
    assert one.suite is not None and one.suite.vec_env is not None
    venv = one.suite.vec_env(one.task, N_GAMES, 0)
    sample = [[venv.action_space.sample() for _ in range(venv.num_envs)] for _ in range(16)]
    actions = np.stack(sample).reshape(16, N_GAMES, venv.n_agents, *venv.action_space.shape)
    if one.suite.name == "vmas":
        engine, single = (vmas_engine(one.task, n, actions[:, :n]) for n in (N_GAMES, 1))
    else:
        actions = actions.astype(np.int32)
        engine = jax_engine(venv.batch.env, N_GAMES, actions)
        single = jax_engine(venv.batch.env, 1, actions[:, 0])
    return {
        "engine alone": engine,
        "rows": rows_of(venv),
        "training chain": rows_of(make_team_env(env_id, N_GAMES, seed=0)),
        "game by game": single,
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", default=TASKS)
    parser.add_argument("--rounds", type=int, default=7)
    args = parser.parse_args()
    print("| task | engine alone | rows | of the engine | training chain | game by game |")
    print("| --- | --- | --- | --- | --- | --- |")
    for env_id in args.tasks:
        best = {name: max(values) for name, values in rates(contestants(env_id), args.rounds, SECONDS).items()}
        share = best["rows"] / best["engine alone"]
        cells = [f"{best[name]:,.0f}" for name in ("engine alone", "rows", "training chain", "game by game")]
        print(f"| {env_id} | {cells[0]} | {cells[1]} | {share:.0%} | {cells[2]} | {cells[3]} |", flush=True)


if __name__ == "__main__":
    main()
