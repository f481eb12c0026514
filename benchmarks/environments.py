"""
Measure the speed of HECOGrid on one core, beside a memory copy and the third-party gridworlds that are installed.

``python -m benchmarks.environments`` (``make bench``) prints a table and writes it to ``benchmarks/results.md``.
Medians and spread over rounds in which all rows take turns, so that changes of the machine's speed affect all of them.
128 games of 10 agents on a 30 x 30 grid, 100 treasures, random actions, resets included, unless a row says otherwise.
The others have settings as close to these as they allow: views of 7 x 7 cells, episodes of 50 steps.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

import sb3_saf
from benchmarks.turns import Work, rates
from hecogrid_envs import TASK_NAMES, GameBatch, HECOGridParams, parallel_env
from sb3_saf.training.folders import software_versions

N_GAMES: Final = 128
N_AGENTS: Final = 10
GRID_SIZE: Final = 30
MAX_CYCLES: Final = 50
#: Cells that an agent sees in every direction: views of 7 x 7.
SIGHT: Final = 3
COPY: Final = "copy of the bytes of rgb views"
RESULTS: Final = Path(__file__).parent / "results.md"


def random_actions(shape: tuple[int, ...], n_actions: int = 7) -> Iterator[Any]:
    """
    Yield actions drawn beforehand, endlessly.

    :param shape: number of actions, then the shape of one
    :param n_actions: exclusive upper bound of the actions
    """
    actions = np.random.default_rng(0).integers(0, n_actions, size=shape)
    while True:
        yield from actions


def batch_work(task: str, observation: str, n_games: int = N_GAMES, **params: Any) -> Work:
    """Step and observe a batch, whose games reset at their time limit."""
    all_params = HECOGridParams.from_kwargs({"observation": observation, **params})
    batch = GameBatch(task, all_params, n_games)
    batch.reset(seeds=sb3_saf.game_seeds(0, n_games))
    out = batch.observe()
    actions = random_actions((64, n_games, all_params.n_agents))

    def work() -> int:
        batch.advance(next(actions), out)
        return n_games * all_params.n_agents

    return work


def vec_env_work(make: Callable[[], Any]) -> Work:
    """Step an SB3 VecEnv."""
    env = make()
    env.reset()
    actions = random_actions((64, env.num_envs))

    def work() -> int:
        env.step(next(actions))
        return int(env.num_envs)

    return work


def parallel_env_work() -> Work:
    """Step one PettingZoo game with its dicts."""
    env = parallel_env("TeamSupport")
    env.reset(seed=0)
    return _parallel_work(env, n_actions=7)


def copy_work() -> Work:
    """Copy as many bytes as 1,280 rgb views take, a lower bound."""
    source = np.ones((N_GAMES * N_AGENTS, 2352), dtype=np.uint8)
    target = np.empty_like(source)

    def work() -> int:
        np.copyto(target, source)
        return len(source)

    return work


def pursuit() -> Work:
    """Step Pursuit of PettingZoo's SISL with 10 pursuers on its own map of 16 x 16."""
    import pettingzoo

    env: Any = pettingzoo.make("parallel", "sisl/pursuit_v5", n_pursuers=N_AGENTS, max_cycles=MAX_CYCLES)
    env.reset(seed=0)
    return _parallel_work(env, n_actions=5)


def _parallel_work(env: Any, n_actions: int) -> Work:
    actions = random_actions((64, N_AGENTS), n_actions)

    def work() -> int:
        if not env.agents:
            env.reset()
        agents = list(env.agents)
        env.step(dict(zip(agents, next(actions).tolist()[: len(agents)], strict=True)))
        return len(agents)

    return work


def minigrid() -> Work:
    """Step MiniGrid: one agent, rgb partial view with tiles of 4 pixels, the size of HECOGrid's."""
    import gymnasium
    from minigrid.wrappers import RGBImgPartialObsWrapper

    env = RGBImgPartialObsWrapper(gymnasium.make("MiniGrid-FourRooms-v0", max_steps=MAX_CYCLES), tile_size=4)
    return _gymnasium_work(env, random_actions((4096,)), n_agents=1)


def foraging() -> Work:
    """
    Step level-based foraging on 30 x 30, with 10 foods.

    Vectors (a position and a level for each food and player) instead of grids, which fail with Gymnasium 1; fewer foods
    and vectors are both faster.
    """
    from lbforaging.foraging import ForagingEnv

    env = ForagingEnv(
        players=N_AGENTS,
        min_player_level=1,
        max_player_level=2,
        min_food_level=1,
        max_food_level=None,
        field_size=(GRID_SIZE, GRID_SIZE),
        max_num_food=10,
        sight=SIGHT,
        max_episode_steps=MAX_CYCLES,
        force_coop=False,
    )
    return _gymnasium_work(env, random_actions((64, N_AGENTS), n_actions=6), N_AGENTS)


def _gymnasium_work(env: Any, actions: Iterator[Any], n_agents: int) -> Work:
    env.reset(seed=0)

    def work() -> int:
        _, _, terminated, truncated, _ = env.step(next(actions).tolist())
        if terminated or truncated:
            env.reset()
        return n_agents

    return work


def jaxmarl_work(task: str, **params: Any) -> Work:
    """Step 128 games of JaxMARL (``vmap`` in ``jit``), with automatic resets."""
    import jax
    import jaxmarl

    env = jaxmarl.make(task, max_steps=MAX_CYCLES, **params)
    split = jax.random.split
    _, state = jax.jit(jax.vmap(env.reset))(split(jax.random.key(0), N_GAMES))

    @jax.jit
    def step(key: Any, state: Any, actions: Any) -> Any:
        key, now = split(key)
        by_agent = {agent: actions[i] for i, agent in enumerate(env.agents)}
        return key, *jax.vmap(env.step)(split(now, N_GAMES), state, by_agent)

    actions = random_actions((64, env.num_agents, N_GAMES), int(env.action_space(env.agents[0]).n))
    key = jax.random.key(1)

    def work() -> int:
        nonlocal key, state
        key, _, state, *_ = jax.block_until_ready(step(key, state, next(actions)))
        return N_GAMES * int(env.num_agents)

    return work


#: Third-party gridworlds by the title of their row.
BASELINES: Final[dict[str, Callable[[], Work]]] = {
    "PettingZoo SISL pursuit, 10 pursuers, 16 x 16": pursuit,
    "MiniGrid, 1 agent, rgb partial, 4 px": minigrid,
    "LBF, 10 players, 30 x 30": foraging,
    "JaxMARL overcooked, 128 games of 2 agents, 4 x 5": partial(jaxmarl_work, "overcooked"),
    "JaxMARL overcooked_v2, 128 games of 2 agents, 7 x 7 views": partial(
        jaxmarl_work, "overcooked_v2", agent_view_size=SIGHT
    ),
}


def programs() -> dict[str, Callable[[], Work]]:
    """Return what is measured, by title."""
    large: dict[str, Any] = {"n_agents": 1000, "grid_size": 300, "n_treasures": 10_000}
    make_vec_env = partial(sb3_saf.make_vec_env, "TeamSupport", seed=0)
    return {
        **{
            f"batch, {observation}, {task}": partial(batch_work, task, observation)
            for observation in ("tiles", "rgb")
            for task in TASK_NAMES
        },
        "batch, tiles, TeamSupport, 1 game, N = 1000, 300 x 300": partial(
            batch_work, "TeamSupport", "tiles", n_games=1, **large
        ),
        "VecEnv.step, tiles": lambda: vec_env_work(partial(make_vec_env, n_envs=N_GAMES, observation="tiles")),
        "VecEnv.step, tiles, joint view and monitor": lambda: vec_env_work(
            lambda: sb3_saf.make_team_env("TeamSupport", n_envs=N_GAMES, seed=0)
        ),
        "parallel_env, rgb": parallel_env_work,
        "SuperSuit, 8 games, rgb": lambda: vec_env_work(partial(make_vec_env, n_envs=8, backend="supersuit")),
        COPY: copy_work,
        **BASELINES,
    }


def made() -> dict[str, Work]:
    """Make all programs; a message names those that cannot run."""
    works = {}
    for title, make in programs().items():
        try:
            works[title] = make()
        except Exception as error:  # raised by third-party libraries
            print(f"left out: {title} ({type(error).__name__}: {str(error).splitlines()[0][:200]})", flush=True)
    return works


def table(measured: dict[str, list[float]]) -> str:
    """Format rates as Markdown: median, spread, and the ratio to the copy."""
    copy = float(np.median(measured[COPY]))
    lines = ["| what | agent-steps/s | lowest - highest | ratio to the copy |", "| --- | --- | --- | --- |"]
    for title, values in measured.items():
        median = float(np.median(values))
        lines.append(f"| {title} | {median:,.0f} | {min(values):,.0f} - {max(values):,.0f} | {median / copy:.3g} |")
    return "\n".join(lines)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=0.3, help="per row and round")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):  # one core, before JAX starts its threads
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    text = table(rates(made(), options.rounds, options.seconds))
    print(text)
    versions = software_versions()
    machine = ", ".join(f"{name} {versions[name]}" for name in ("processor", "python", "numba", "numpy", "torch"))
    head = f"`python -m benchmarks.environments`: medians of {options.rounds} rounds on one core; {machine}."
    options.output.write_text(f"# Speed of the games\n\n{head}\n\n{text}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
