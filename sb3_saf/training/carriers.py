"""
Gymnasium ids of the tasks, which RL-Zoo3 asks for: ``gymnasium.make("TeamTogether-v0")``.

Gymnasium environments have one agent. So these only carry a game, with one agent's spaces; the zoo makes its vector
environments with ``make_team_env`` and never steps a carrier.
"""

from __future__ import annotations

from typing import Any, Final, NoReturn

import gymnasium as gym

from hecogrid_envs import parallel_env
from sb3_saf.training.settings import TASK_OF_ENV

_ENTRY_POINT: Final = "sb3_saf.training.carriers:TeamCarrier"


class TeamCarrier(gym.Env[Any, Any]):
    """
    Holds a game of several agents under an id of Gymnasium.

    :param task: a HECOGrid task
    :param params: its parameters
    """

    def __init__(self, task: str, **params: Any):
        self.parallel_env = parallel_env(task, **params)
        agent = self.parallel_env.possible_agents[0]
        self.observation_space = self.parallel_env.observation_space(agent)
        self.action_space = self.parallel_env.action_space(agent)
        self.render_mode = self.parallel_env.render_mode

    def _refuse(self) -> NoReturn:
        raise ValueError(
            "this id stands for a game of several agents and cannot be stepped as a Gymnasium environment; use "
            "sb3_saf.make_team_env(...) to train, or its attribute parallel_env, a PettingZoo environment, to play"
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> NoReturn:
        """Refuse."""
        self._refuse()

    def step(self, action: Any) -> NoReturn:
        """Refuse."""
        self._refuse()

    def close(self) -> None:
        """Close the game."""
        self.parallel_env.close()


def register_carriers() -> None:
    """Make every task known to Gymnasium."""
    for env_id, task in TASK_OF_ENV.items():
        if env_id not in gym.registry:
            gym.register(env_id, _ENTRY_POINT, kwargs={"task": task}, disable_env_checker=True, order_enforce=False)
