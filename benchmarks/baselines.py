"""
Third-party gridworlds for speed comparisons: settings, and how they are stepped.

Settings are as close to HECOGrid's defaults (10 agents, a 30 x 30 grid, views of 7 x 7 cells, episodes of 50 steps,
random actions, resets included) as each allows; otherwise the faster choice is used. This module needs only NumPy and
the library in question, because some run in separate environments (:mod:`benchmarks.install_baselines`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks.rates import Work, random_actions

N_GAMES = 128
N_AGENTS = 10
GRID_SIZE = 30
MAX_CYCLES = 50
#: Cells that an agent sees in every direction: views of 7 x 7.
SIGHT = 3


class Stepper(NamedTuple):
    """
    A running environment.

    :param work: steps it and returns the number of agent-steps
    :param observe: observations of the last step, agents first
    """

    work: Work
    observe: Callable[[], Any]


class Baseline(NamedTuple):
    """
    One row of the table.

    :param title: title of the row
    :param distribution: the package to install
    :param make: creates and resets it
    :param isolated: whether it needs a separate environment
    :param module: module to import, if it is not named like the package
    """

    title: str
    distribution: str
    make: Callable[[], Stepper]
    isolated: bool = False
    module: str | None = None


class LastSeen:
    """Results of the last step, for use outside the measured time."""

    def __init__(self, observation: Any) -> None:
        self.observation = observation

    def stacked(self) -> Any:
        """Stack observations, agents first."""
        found = self.observation
        return np.stack(list(found.values()) if isinstance(found, dict) else list(found))


def pursuit() -> Stepper:
    """Pursuit of PettingZoo's SISL with 10 pursuers on its own map of 16 x 16."""
    import pettingzoo

    env: Any = pettingzoo.make("parallel", "sisl/pursuit_v5", n_pursuers=N_AGENTS, max_cycles=MAX_CYCLES)
    seen = LastSeen(env.reset(seed=0)[0])
    actions = random_actions((64, N_AGENTS), n_actions=5)

    def work() -> int:
        if not env.agents:
            env.reset()
        n_agents = len(env.agents)
        seen.observation = env.step(dict(zip(env.agents, next(actions).tolist()[:n_agents], strict=True)))[0]
        return n_agents

    return Stepper(work, seen.stacked)


def minigrid() -> Stepper:
    """MiniGrid: one agent, rgb partial view with tiles of 4 pixels, the size of HECOGrid's."""
    import gymnasium
    from minigrid.wrappers import RGBImgPartialObsWrapper

    env = RGBImgPartialObsWrapper(gymnasium.make("MiniGrid-FourRooms-v0", max_steps=MAX_CYCLES), tile_size=4)
    env.reset(seed=0)
    seen = LastSeen(None)
    actions = random_actions((4096,))

    def work() -> int:
        observation, _, terminated, truncated, _ = env.step(int(next(actions)))
        seen.observation = [observation["image"]]
        if terminated or truncated:
            env.reset()
        return 1

    return Stepper(work, seen.stacked)


def foraging() -> Stepper:
    """
    Level-based foraging on 30 x 30.

    Uses 10 foods instead of 100, and vectors (a position and a level for each food and player) instead of grids, which
    fail with Gymnasium 1; both are faster.
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
    seen = LastSeen(env.reset(seed=0)[0])
    actions = random_actions((64, N_AGENTS), n_actions=6)

    def work() -> int:
        seen.observation, _, terminated, truncated, _ = env.step(next(actions).tolist())
        if terminated or truncated:
            env.reset()
        return N_AGENTS

    return Stepper(work, seen.stacked)


def pogema() -> Stepper:
    """POGEMA on 30 x 30 with its obstacles (density 0.3); an agent that arrives gets a new target."""
    from pogema import GridConfig, pogema_v0

    config = GridConfig(
        num_agents=N_AGENTS,
        size=GRID_SIZE,
        density=0.3,
        obs_radius=SIGHT,
        on_target="restart",
        max_episode_steps=MAX_CYCLES,
        seed=0,
    )
    env = pogema_v0(config)
    seen = LastSeen(env.reset(seed=0)[0])
    actions = random_actions((64, N_AGENTS), n_actions=5)

    def work() -> int:
        seen.observation, _, terminated, truncated, _ = env.step(next(actions).tolist())
        if all(terminated) or all(truncated):
            env.reset()
        return N_AGENTS

    return Stepper(work, seen.stacked)


def overcooked() -> Stepper:
    """JaxMARL's Overcooked: its first layout, 2 cooks on 4 x 5, fully observed."""
    return _jaxmarl("overcooked")


def overcooked_v2() -> Stepper:
    """JaxMARL's second Overcooked with views of 7 x 7: its first layout, 2 cooks."""
    return _jaxmarl("overcooked_v2", agent_view_size=SIGHT)


def _jaxmarl(task: str, **params: Any) -> Stepper:
    """Create 128 parallel games (vmap), compiled (jit), on the CPU, with automatic resets."""
    import jax
    import jaxmarl

    env = jaxmarl.make(task, max_steps=MAX_CYCLES, **params)
    split = jax.random.split
    observation, state = jax.jit(jax.vmap(env.reset))(split(jax.random.key(0), N_GAMES))
    seen = LastSeen(observation)

    @jax.jit
    def step(key: Any, state: Any, chosen: Any) -> Any:
        key, now = split(key)
        by_agent = {agent: chosen[i] for i, agent in enumerate(env.agents)}
        observation, state, rewards, dones, _ = jax.vmap(env.step)(split(now, N_GAMES), state, by_agent)
        return key, state, observation, rewards, dones

    n_actions = int(env.action_space(env.agents[0]).n)
    actions = random_actions((64, env.num_agents, N_GAMES), n_actions)
    carried = (jax.random.key(1), state)

    def work() -> int:
        nonlocal carried
        key, state, *results = jax.block_until_ready(step(*carried, next(actions)))
        carried, seen.observation = (key, state), results[0]
        return N_GAMES * int(env.num_agents)

    def observe() -> Any:
        return np.concatenate([np.asarray(views) for views in seen.observation.values()])

    return Stepper(work, observe)


def trash_pickup() -> Stepper:
    """PufferLib's C environment of 10 agents on 30 x 30 with 100 pieces of trash and views of 7 x 7, one-hot."""
    from pufferlib.ocean.trash_pickup.trash_pickup import TrashPickupEnv

    env = TrashPickupEnv(
        num_envs=N_GAMES,
        grid_size=GRID_SIZE,
        num_agents=N_AGENTS,
        num_trash=100,
        num_bins=2,
        max_steps=MAX_CYCLES,
        agent_sight_range=SIGHT,
        report_interval=100,
    )
    env.reset(seed=0)
    actions = random_actions((64, N_GAMES * N_AGENTS), n_actions=4)

    def work() -> int:
        env.step(next(actions))
        return N_GAMES * N_AGENTS

    return Stepper(work, lambda: env.observations)


BASELINES: dict[str, Baseline] = {
    "pursuit": Baseline("PettingZoo SISL pursuit, 10 pursuers, 16 x 16", "pettingzoo", pursuit, module="pygame"),
    "minigrid": Baseline("MiniGrid, 1 agent, rgb partial, 4 px", "minigrid", minigrid),
    "foraging": Baseline("LBF, 10 players, 30 x 30", "lbforaging", foraging),
    "pogema": Baseline("POGEMA, 10 agents, 30 x 30, 7 x 7 views", "pogema", pogema, isolated=True),
    "overcooked": Baseline("JaxMARL overcooked, 128 games of 2 agents, 4 x 5", "jaxmarl", overcooked),
    "overcooked_v2": Baseline("JaxMARL overcooked_v2, 128 games of 2 agents, 7 x 7 views", "jaxmarl", overcooked_v2),
    "trash_pickup": Baseline(
        "PufferLib trash_pickup (C), 128 games of 10 agents, 30 x 30, 7 x 7 views",
        "pufferlib",
        trash_pickup,
        isolated=True,
    ),
}
