"""Turn-based games in parallel form: the same game, in which agents act only in their turn."""

from __future__ import annotations

import re
from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo import AECEnv
from pettingzoo.test import parallel_api_test

from sb3_saf import TurnsInParallel, make_team_env
from tests.toy_envs import CounterEnv

PILE = 7


class Nim(AECEnv[str, Any, Any]):
    """
    Two players take 1 to 3 stones from a pile in turn (action = stones - 1); whoever takes the last stone wins.

    :param masks: whether observations have masks (all zeros for the waiting player, as in PettingZoo's classic games)
    :param dtype: of the masks
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "nim_v0", "is_parallelizable": False, "render_modes": []}
    render_mode = None

    def __init__(self, masks: bool = True, dtype: Any = np.int8):
        super().__init__()
        self.masks, self.dtype = masks, dtype
        self.possible_agents = ["first", "second"]
        self.moves: list[int] = []
        own = spaces.Box(0, PILE, (2,), np.float32)
        self._space = spaces.Dict({"observation": own, "action_mask": spaces.Box(0, 1, (3,), dtype)}) if masks else own
        self._action_space = spaces.Discrete(3)

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return self._space

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return self._action_space

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        assert seed is None or seed < 2**31
        self.agents = self.possible_agents[:]
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self.terminations = dict.fromkeys(self.agents, False)
        self.truncations = dict.fromkeys(self.agents, False)
        self.infos: dict[str, dict[str, Any]] = {agent: {} for agent in self.agents}
        self.agent_selection = "first"
        self.pile = PILE
        self.moves = []

    def observe(self, agent: str) -> Any:
        mine = agent == self.agent_selection
        own = np.array([self.pile, mine], np.float32)
        mask = (np.arange(1, 4) <= self.pile if mine else np.zeros(3)).astype(self.dtype)
        return {"observation": own, "action_mask": mask} if self.masks else own

    def step(self, action: int | None) -> None:
        if self.terminations[self.agent_selection]:
            self._was_dead_step(None)
            return
        assert action is not None
        self.moves.append(int(action))
        self.pile -= min(int(action) + 1, self.pile)
        mover = self.agent_selection
        self.agent_selection = self.agents[1 - self.agents.index(mover)]
        if self.pile == 0:
            self.rewards = {agent: 1.0 if agent == mover else -1.0 for agent in self.agents}
            self.terminations = dict.fromkeys(self.agents, True)


def parallel(**kwargs: Any) -> TurnsInParallel:
    return TurnsInParallel(Nim(**kwargs))


@pytest.mark.parametrize("kwargs", [{}, {"dtype": np.int64}, {"masks": False}])
def test_who_waits_has_one_action_that_nobody_reads(kwargs: dict[str, Any]) -> None:
    env = parallel(**kwargs)
    observations, infos = env.reset(seed=2**40)
    moves: list[int] = []
    while env.agents:
        mover, waiter = ("first", "second") if len(moves) % 2 == 0 else ("second", "first")
        masks = {
            agent: infos[agent]["action_mask"] if "masks" in kwargs else observations[agent]["action_mask"]
            for agent in env.agents
        }
        assert masks[waiter].tolist() == [1, 0, 0]
        assert masks[mover].tolist() == [1, 1, 1] or env.unwrapped.pile < 3
        assert all(env.observation_space(agent).contains(observations[agent]) for agent in env.agents)
        moves.append(len(moves) % 2)
        observations, rewards, terminations, _, infos = env.step({mover: moves[-1], waiter: 2})
    assert env.unwrapped.moves == moves == [0, 1, 0, 1, 0], "the pile went 6, 4, 3, 1, 0"
    assert rewards == {"first": 1.0, "second": -1.0}
    assert terminations == {"first": True, "second": True}


def test_it_is_a_proper_parallel_env() -> None:
    parallel_api_test(parallel(masks=False), 200)


@pytest.mark.parametrize("kwargs", [{}, {"masks": False}])
def test_masks_reach_the_team(kwargs: dict[str, Any]) -> None:
    env = make_team_env(parallel, n_envs=16, seed=0, **kwargs)
    rows = env.reset()
    assert isinstance(rows, dict)
    assert rows["action_mask"].tolist() == [[1, 1, 1], [1, 0, 0]] * 16


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (CounterEnv(), "expected a PettingZoo AECEnv, whose agents take turns, got CounterEnv; pass what the module's"),
        (Nim, "got Nim; pass what the module's env() returns, for instance TurnsInParallel(connect_four_v3.env())"),
    ],
)
def test_other_environments_are_refused(env: Any, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        TurnsInParallel(env)


def test_other_actions_are_refused() -> None:
    game = Nim()
    game._action_space = spaces.Box(0, 1, (1,))  # type: ignore[assignment]
    with pytest.raises(ValueError, match=r"needs Discrete actions, of which 0 is to wait, got Box.* of first"):
        TurnsInParallel(game)
