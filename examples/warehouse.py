"""
A team of two kinds of agents: train it, evaluate it, let it play by itself, export its actors and replay a game.

    python examples/warehouse.py --game-steps 100000

Carriers fetch crates of three colours from shelves and bring them to packers; packers call the colour of their next
order and pack it once it is delivered. The two kinds have observations and actions of different sizes, illegal actions
are masked in the infos, and a packer leaves when its orders are done. ``make_team_env`` needs no wrapper for any of it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO

import sb3_saf

Array = npt.NDArray[Any]
Infos = dict[str, dict[str, Array]]

N_COLOURS = 3
#: Actions of carriers: wait, four moves, take or give. Packers: call nothing, or a colour.
MOVES = np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1), (0, 0)])
GRIP = 5
FLOOR, SHELVES, STATION, CARRIER = (
    (235, 235, 235),
    ((213, 94, 0), (0, 158, 115), (0, 114, 178)),
    (90, 90, 90),
    (0, 0, 0),
)


class Warehouse(ParallelEnv[str, Array, int]):
    """
    The game: shelves on the left wall, packers' stations on the right one.

    :param n_carriers: carriers
    :param n_packers: packers
    :param size: width and height of the floor
    :param n_orders: crates that each packer has to pack
    :param max_cycles: steps of an episode
    :param render_mode: ``"rgb_array"`` for pictures
    """

    metadata = {"name": "warehouse", "render_modes": ["rgb_array"]}

    def __init__(
        self,
        n_carriers: int = 3,
        n_packers: int = 2,
        size: int = 5,
        n_orders: int = 3,
        max_cycles: int = 60,
        render_mode: str | None = None,
    ) -> None:
        self.carriers = [f"carrier_{number}" for number in range(n_carriers)]
        self.packers = [f"packer_{number}" for number in range(n_packers)]
        self.possible_agents = [*self.carriers, *self.packers]
        self.size, self.n_orders, self.max_cycles, self.render_mode = size, n_orders, max_cycles, render_mode
        self.shelves = [(colour * (size - 1) // (N_COLOURS - 1), 0) for colour in range(N_COLOURS)]
        self.stations = [((number + 1) * size // (n_packers + 1), size - 1) for number in range(n_packers)]
        # A carrier: position, load, the colours that packers call. A packer: its next order, its stock.
        n_numbers = 2 + (N_COLOURS + 1) + n_packers * N_COLOURS
        self._spaces = {agent: spaces.Box(0, 1, (n_numbers,), np.float64) for agent in self.carriers}
        self._spaces |= {agent: spaces.Box(0, 1, (2 * N_COLOURS,), np.float64) for agent in self.packers}
        self._actions = {agent: spaces.Discrete(len(MOVES)) for agent in self.carriers}
        self._actions |= {agent: spaces.Discrete(1 + N_COLOURS) for agent in self.packers}

    def observation_space(self, agent: str) -> spaces.Box:
        """Return an agent's observation space."""
        return self._spaces[agent]

    def action_space(self, agent: str) -> spaces.Discrete:
        """Return an agent's action space."""
        return self._actions[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Array], Infos]:
        """Begin a game."""
        if seed is not None or not hasattr(self, "rng"):
            self.rng = np.random.default_rng(seed)
        self.agents, self.steps = self.possible_agents[:], 0
        self.places = self.rng.integers(self.size, size=(len(self.carriers), 2))
        self.loads: list[int | None] = [None] * len(self.carriers)
        self.orders = [self.rng.integers(N_COLOURS, size=self.n_orders).tolist() for _ in self.packers]
        self.calls: list[int | None] = [None] * len(self.packers)
        self.stock = np.zeros((len(self.packers), N_COLOURS), dtype=np.int64)
        return self._observations(), self._infos()

    def step(
        self, actions: dict[str, int]
    ) -> tuple[dict[str, Array], dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Move carriers, then let packers call and pack; the team's reward is shared."""
        reward = 0.0
        for number, agent in enumerate(self.carriers):
            if agent in self.agents:
                self.places[number] = np.clip(self.places[number] + MOVES[actions[agent]], 0, self.size - 1)
                reward += self._grip(number) if actions[agent] == GRIP else 0.0
        for number, agent in enumerate(self.packers):
            if agent in self.agents:
                self.calls[number] = actions[agent] - 1 if actions[agent] else None
                order = self.orders[number][0]
                if self.calls[number] == order and self.stock[number, order]:
                    self.stock[number, order] -= 1
                    self.orders[number].pop(0)
                    reward += 1.0
        self.steps += 1
        team, over = self.agents, self.steps == self.max_cycles
        is_packed = not any(self.orders)
        orders = dict(zip(self.packers, self.orders, strict=True))
        terminations = {agent: is_packed or not orders.get(agent, [0]) for agent in team}
        results = self._observations(), dict.fromkeys(team, reward / len(self.possible_agents)), terminations
        infos = self._infos()
        self.agents = [] if over else [agent for agent in team if not terminations[agent]]
        return *results, dict.fromkeys(team, over), infos

    def _grip(self, number: int) -> float:
        """Take a crate at a shelf, or give it at a station; return the reward for an ordered one."""
        place, load = tuple(self.places[number].tolist()), self.loads[number]
        if load is None and place in self.shelves:
            self.loads[number] = self.shelves.index(place)
        elif load is not None and place in self.stations:
            packer = self.stations.index(place)
            self.stock[packer, load] += 1
            self.loads[number] = None
            return 0.3 if load in self.orders[packer][:1] else 0.0
        return 0.0

    def _observations(self) -> dict[str, Array]:
        one_hot = np.eye(N_COLOURS + 1)  # the last for none
        calls = [one_hot[-1 if call is None else call][:N_COLOURS] for call in self.calls]
        views = {}
        for number, agent in enumerate(self.carriers):
            load = self.loads[number]
            parts = [self.places[number] / (self.size - 1), one_hot[-1 if load is None else load], *calls]
            views[agent] = np.concatenate(parts)
        for number, agent in enumerate(self.packers):
            order = (self.orders[number] or [N_COLOURS])[0]
            views[agent] = np.concatenate([one_hot[order][:N_COLOURS], np.minimum(self.stock[number], 3) / 3])
        return {agent: views[agent] for agent in self.agents}

    def _infos(self) -> Infos:
        """Mask what does nothing: gripping away from shelves and stations."""
        masks = {agent: np.ones(self._actions[agent].n, np.int8) for agent in self.agents}
        for number, agent in enumerate(self.carriers):
            places = self.shelves if self.loads[number] is None else self.stations
            if agent in masks and tuple(self.places[number].tolist()) not in places:
                masks[agent][GRIP] = 0
        return {agent: {"action_mask": mask} for agent, mask in masks.items()}

    def render(self) -> Array:
        """Draw the floor, (16 size, 16 size, 3) uint8: a carrier shows the colour that it carries."""
        floor = np.full((self.size, self.size, 3), FLOOR, dtype=np.uint8)
        for place, colour in [*zip(self.shelves, SHELVES, strict=True), *((place, STATION) for place in self.stations)]:
            floor[place] = colour
        picture = floor.repeat(16, axis=0).repeat(16, axis=1)
        for (row, column), load in zip(self.places.tolist(), self.loads, strict=True):
            picture[16 * row + 4 : 16 * row + 12, 16 * column + 4 : 16 * column + 12] = CARRIER
            if load is not None:
                picture[16 * row + 6 : 16 * row + 10, 16 * column + 6 : 16 * column + 10] = SHELVES[load]
        return picture


def main(arguments: list[str] | None = None) -> None:
    """Train, evaluate, play, export, replay."""
    parser = argparse.ArgumentParser(prog="python examples/warehouse.py", description="train a team of two kinds")
    parser.add_argument("--game-steps", type=int, default=100_000)
    parser.add_argument("--episodes", type=int, default=100, help="team episodes of the evaluation")
    parser.add_argument("--output", type=Path, default=Path("runs", "warehouse"))
    options = parser.parse_args(arguments)

    env = sb3_saf.make_team_env(Warehouse, n_envs=16, seed=0)
    settings = sb3_saf.ppo_settings(env, "mappo", gamma=0.95, policy_kwargs={"normalize_values": True})
    model = PPO("MAPPOPolicy", env, seed=0, device="cpu", **settings).learn(options.game_steps * env.n_agents)

    test_env = sb3_saf.make_team_env(Warehouse, n_envs=16, seed=1)
    for name, team in (("trained", model), ("random", sb3_saf.RandomPolicy(test_env, seed=0))):
        print(f"{name:<8} {sb3_saf.evaluate_team(team, test_env, options.episodes, deterministic=False)}")

    # Every agent acts on what the game gives it, with actions drawn as in training.
    game = Warehouse()
    given: Any = game.reset(seed=2)  # observations and infos, with the masks
    while game.agents:
        actions: Any = model.predict(given)[0]
        observations, _, _, _, infos = game.step(actions)
        given = observations, infos
    print(f"by itself: {sum(map(len, game.orders))} orders left after {game.steps} steps")

    # The same without Stable-Baselines3: on a robot, say.
    sb3_saf.export_actors(model, options.output / "actor")
    actor = sb3_saf.Actor.load(options.output / "actor", agent="packer_0")
    observations, infos = game.reset(seed=2)
    action = actor.act(observations["packer_0"], action_mask=infos["packer_0"]["action_mask"])
    print(f"exported actor of packer_0: calls {int(action)}")

    replayed = sb3_saf.make_team_env(Warehouse, n_envs=1, seed=3, render_mode="rgb_array")
    print(f"replay: {sb3_saf.replay(model, replayed, options.output / 'replay.html')}")


if __name__ == "__main__":
    main()
