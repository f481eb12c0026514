"""Games that break PettingZoo's rules: each error names the agent, the step, and what was expected."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO

from sb3_saf import TeamRolloutBuffer, make_team_env
from tests.toy_envs import CounterEnv, TellingEnv

#: Changes what a step returns: observations, rewards, terminations, truncations and infos by agent.
Fault = Callable[[CounterEnv, list[Any]], Any]


class MisbehavingEnv(CounterEnv):
    """
    A game with a fault at its second step, or in its reset.

    :param at_step: changes or replaces what the second step returns
    :param at_reset: the same for observations and infos of resets
    :param setup: changes the game itself
    :param space: of observations, whose values are ``seen``
    """

    def __init__(
        self,
        at_step: Fault | None = None,
        at_reset: Fault | None = None,
        setup: Callable[[CounterEnv], Any] | None = None,
        space: spaces.Space[Any] | None = None,
        seen: Callable[[int], Any] | None = None,
        action_space: spaces.Space[Any] | None = None,
    ):
        self.space, self.seen, self.actions = space, seen, action_space
        super().__init__()
        self.at_step, self.at_reset = at_step, at_reset
        if setup is not None:
            setup(self)

    def _make_observation_space(self) -> spaces.Space[Any]:
        return super()._make_observation_space() if self.space is None else self.space

    def _make_action_space(self) -> spaces.Space[Any]:
        return super()._make_action_space() if self.actions is None else self.actions

    def _observation(self, index: int, draw: np.float32) -> Any:
        return super()._observation(index, draw) if self.seen is None else self.seen(self.steps)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        result = list(super().reset(seed, options))
        return tuple(result) if self.at_reset is None else self.at_reset(self, result) or tuple(result)

    def step(self, actions: dict[str, Any]) -> Any:
        result = list(super().step(actions))
        if self.steps != 2 or self.at_step is None:
            return tuple(result)
        return self.at_step(self, result) or tuple(result)


OBSERVATION, REWARD, TERMINATION, TRUNCATION, INFO = range(5)


def gives(part: int, value: Any) -> dict[str, Fault]:
    """Agent 1 gets a value at step 2."""
    return {"at_step": lambda env, result: result[part].update(agent_1=value)}


def lacks(part: int) -> dict[str, Fault]:
    """Agent 1 is missing at step 2."""

    def fault(env: CounterEnv, result: list[Any]) -> None:
        del result[part]["agent_1"]

    return {"at_step": fault}


def replaces(part: int, value: Any) -> dict[str, Fault]:
    """Replace a whole part of the results of step 2."""
    return {"at_step": lambda env, result: (*result[:part], value, *result[part + 1 :])}


def lists(*names: Any) -> Fault:
    """Change the list of agents."""
    return lambda env, result: setattr(env, "agents", list(names))


def sees(space: spaces.Space[Any], value: Any, first: Any = None) -> dict[str, Any]:
    """Set the observations at step 2, and those before."""
    return {"space": space, "seen": lambda step: value if step == 2 else first}


def set_to(name: str, value: Any) -> Callable[[Any], None]:
    return lambda env: setattr(env, name, value)


PLACE = "in game 0 at step 2"
A_STEP = "expected step of counter_v0 to return (observations, rewards, terminations, truncations, infos)"
A_RESET = "expected reset of counter_v0 to return (observations, infos)"
WIDER = "; make the space as wide as what the game gives"

FAULTS: list[tuple[dict[str, Any], str]] = [
    # rewards
    (lacks(REWARD), f"expected a reward for agent_1, which acted, {PLACE}, got rewards for ['agent_0']; give every "
     "agent that acts a reward, 0.0 for none"),
    (gives(REWARD, "1.0"), f"expected a number as the reward of agent_1 {PLACE}, got '1.0'"),
    (gives(REWARD, None), f"expected a number as the reward of agent_1 {PLACE}, got None"),
    (gives(REWARD, [1.0, 2.0]), f"expected a number as the reward of agent_1 {PLACE}, got [1.0, 2.0]"),
    (gives(REWARD, np.ones(2)), f"expected a number as the reward of agent_1 {PLACE}, got array([1., 1.])"),
    (gives(REWARD, 1j), f"expected a number as the reward of agent_1 {PLACE}, got 1j"),
    (gives(REWARD, {"team": 1.0}), f"expected a number as the reward of agent_1 {PLACE}, got {{'team': 1.0}}"),
    (gives(REWARD, [[1], [1, 2]]), f"expected a number as the reward of agent_1 {PLACE}, got [[1], [1, 2]]"),
    (gives(REWARD, np.nan), "rewards must be finite, got nan at step 2 for agent 1 of game 0"),
    (gives(REWARD, -np.inf), "rewards must be finite, got -inf at step 2 for agent 1 of game 0"),
    (replaces(REWARD, np.ones(2)), f"{A_STEP}, as PettingZoo 1.24 and later do, got 5 values: dict, ndarray, dict, "
     "dict, dict"),
    # observations
    (lacks(OBSERVATION), f"expected an observation for agent_1, which takes part, {PLACE}, got observations for "
     "['agent_0']"),
    (gives(OBSERVATION, None), f"expected an observation for agent_1, which takes part, {PLACE}, got"),
    (gives(OBSERVATION, np.zeros(4)), f"observation of agent_1 {PLACE}: expected float32 of shape (3,), got float64 of "
     "shape (4,)"),
    (gives(OBSERVATION, "abc"), f"observation of agent_1 {PLACE}: expected float32 of shape (3,), got <U3 of shape ()"),
    (gives(OBSERVATION, [1, [2], [3, 4]]), f"observation of agent_1 {PLACE}: expected float32 of shape (3,), got "
     "object"),
    (gives(OBSERVATION, np.zeros(3, complex)), f"observation of agent_1 {PLACE}: expected float32 of shape (3,), got "
     "complex128"),
    (gives(OBSERVATION, [0, np.nan, 0]), "observations must be finite, got nan at step 2 for agent 1 of game 0"),
    (sees(spaces.Discrete(4, start=5), 9, 5), f"observation of agent_0 {PLACE}: expected values from 5 to 8 as in "
     f"Discrete(4, start=5), got 9{WIDER}"),
    (sees(spaces.Discrete(4), 1.5, 1), f"observation of agent_0 {PLACE}: expected int64 of shape (), got float64"),
    (sees(spaces.MultiDiscrete([2, 3]), [1, 3], [0, 0]), f"observation of agent_0 {PLACE}: expected values from 0 to 2 "
     f"as in MultiDiscrete([2 3]), got 3{WIDER}"),
    (sees(spaces.MultiBinary(2), [0, 2], [0, 1]), f"observation of agent_0 {PLACE}: expected values from 0 to 1 as in "
     f"MultiBinary(2), got 2{WIDER}"),
    (sees(spaces.Box(0, 19, (2,), np.uint8), np.array([3, 255], np.uint8), np.zeros(2, np.uint8)),
     f"observation of agent_0 {PLACE}: expected values from 0 to 19 as in Box(0, 19, (2,), uint8), got 255{WIDER}"),
    (sees(spaces.Dict(a=spaces.Discrete(2)), {"b": 0}, {"a": 0}), f"observation of agent_0 {PLACE}: expected a dict "
     "with ['a'], got ['b']"),
    (sees(spaces.Tuple([spaces.Discrete(2)] * 2), (0,), (0, 0)), f"observation of agent_0 {PLACE}: expected 2 parts, "
     "got (0,)"),
    (sees(spaces.Dict(a=spaces.Discrete(2)), {"a": 2}, {"a": 0}), f"observation of agent_0 {PLACE}, 'a': expected "
     f"values from 0 to 1 as in Discrete(2), got 2{WIDER}"),
    # terminations, truncations and agents
    (gives(TERMINATION, "False"), f"expected True or False for agent_1 in terminations {PLACE}, got 'False'"),
    (gives(TERMINATION, np.nan), f"expected True or False for agent_1 in terminations {PLACE}, got nan"),
    (gives(TERMINATION, None), f"expected True or False for agent_1 in terminations {PLACE}, got None"),
    (gives(TERMINATION, 2), f"expected True or False for agent_1 in terminations {PLACE}, got 2"),
    (gives(TERMINATION, np.array([True, False])), f"expected True or False for agent_1 in terminations {PLACE}, got "
     "array([ True, False])"),
    (gives(TRUNCATION, "yes"), f"expected True or False for agent_1 in truncations {PLACE}, got 'yes'"),
    (replaces(TERMINATION, np.zeros(2, bool)), f"{A_STEP}, as PettingZoo 1.24 and later do, got 5 values: dict, dict, "
     "ndarray, dict, dict"),
    ({"at_step": lambda env, result: setattr(env, "agents", None)}, "expected agents of counter_v0 to be a list of "
     f"names {PLACE}, got None"),
    ({"at_step": lambda env, result: setattr(env, "agents", "agent_0")}, "expected agents of counter_v0 to be a list "
     f"of names {PLACE}, got 'agent_0'"),
    ({"at_step": lists("agent_0", "agent_7")}, "expected names from possible_agents (['agent_0', 'agent_1']) in agents "
     f"of counter_v0 {PLACE}, got 'agent_7'"),
    # infos, and results as a whole
    (gives(INFO, "fine"), f"expected a dict as the info of agent_1 {PLACE}, got 'fine'"),
    (gives(INFO, [1]), f"expected a dict as the info of agent_1 {PLACE}, got [1]"),
    (replaces(INFO, []), f"{A_STEP}, as PettingZoo 1.24 and later do, got 5 values: dict, dict, dict, dict, list"),
    (replaces(INFO, "fine"), "got 5 values: dict, dict, dict, dict, str"),
    ({"at_step": lambda env, result: tuple(result[:4])}, "got 4 values: dict, dict, dict, dict (one dict of dones, as "
     "in older versions): return terminations for agents whose game is over"),
    ({"at_step": lambda env, result: 0.5}, f"{A_STEP}, as PettingZoo 1.24 and later do, got an object of type float"),
    # resets
    ({"at_reset": lambda env, result: result[0]}, f"{A_RESET}, as PettingZoo 1.24 and later do, got a dict with the "
     "keys ['agent_0', 'agent_1'] (observations alone"),
    ({"at_reset": lambda env, result: (result[0], [])}, f"{A_RESET}, as PettingZoo 1.24 and later do, got 2 values: "
     "dict, list"),
    ({"at_reset": lists()}, "expected at least one name in agents after reset of game 0, got none"),
    ({"at_reset": lists("left")}, "in agents of counter_v0 in game 0 at step 0, got 'left'"),
    ({"at_reset": lambda env, result: result[0].clear()}, "expected an observation for agent_0, which takes part, in "
     "game 0 at step 0, got observations for []"),
    ({"at_reset": lambda env, result: result[1].update(agent_0="new")}, "expected a dict as the info of agent_0 in "
     "game 0 at step 0, got 'new'"),
    ({"setup": set_to("reset", lambda: None)}, "expected counter_v0 to have reset(seed=None, options=None)"),
    # what is known before the first episode
    ({"setup": set_to("possible_agents", ["a", "b", "a"])}, "expected different names in possible_agents of "
     "counter_v0, got 'a' more than once in ['a', 'b', 'a']"),
    ({"setup": set_to("possible_agents", [])}, "expected counter_v0 to list its agents in possible_agents"),
    ({"setup": set_to("observation_space", {})}, "expected observation_space(agent) to be a method that gives an "
     "agent's space, got dict"),
    ({"space": spaces.Box(0, 1, (0,))}, "expected an observation space with at least one entry, got Box([], [], (0,), "
     "float32); give agents without anything to see one constant entry"),
    ({"action_space": spaces.Box(0, 1, (2, 0))}, "expected an action space with at least one entry, got Box("),
    ({"space": spaces.Dict()}, "expected an observation space with at least one entry, got Dict()"),
    ({"space": spaces.Text(3)}, "expected an observation space that is one of Discrete, MultiDiscrete, MultiBinary"),
    ({"action_space": spaces.Tuple([spaces.Discrete(2)])}, "expected an action space that is one of Discrete"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("fault", "message", "n_cpus"),
    # Whether a worker's errors arrive does not depend on their words.
    [*((*fault, 1) for fault in FAULTS), *((*fault, 2) for fault in FAULTS[::10])],
    ids=lambda value: value[:70] if isinstance(value, str) else "",
)
def test_each_fault_is_named(fault: dict[str, Any], message: str, n_cpus: int) -> None:
    with contextlib.ExitStack() as stack, pytest.raises(ValueError, match=re.escape(message)):
        play_two_steps(stack, n_cpus, fault)


def play_two_steps(stack: contextlib.ExitStack, n_cpus: int, fault: dict[str, Any]) -> None:
    env = make_team_env(MisbehavingEnv, 2, seed=0, n_cpus=n_cpus, **fault)
    stack.callback(env.close)
    env.reset()
    for _ in range(2):
        env.step(np.zeros(env.num_envs, dtype=int))


def test_the_table_is_as_long_as_promised() -> None:
    assert len(FAULTS) >= 40


@pytest.mark.parametrize("n_cpus", [1, 2])
def test_an_info_that_cannot_be_copied(n_cpus: int) -> None:
    def fault(env: CounterEnv, result: list[Any]) -> None:
        result[INFO]["agent_1"]["lock"] = threading.Lock()

    env = make_team_env(MisbehavingEnv, n_cpus=n_cpus, at_step=fault)
    env.reset()
    env.step(np.zeros(2, dtype=int))
    with pytest.raises(TypeError, match=r"the info of agent_1 cannot be copied .* leave out what cannot be copied"):
        env.step(np.zeros(2, dtype=int))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"agent_0": np.zeros(3)}, "4 zeros and ones (one per action), got array([0., 0., 0.])"),
        ({"agent_0": np.array([0, 1, 2, 0])}, "4 zeros and ones (one per action), got array([0, 1, 2, 0])"),
        ({"agent_0": "all"}, "4 zeros and ones (one per action), got 'all'"),
    ],
)
def test_wrong_masks(change: dict[str, Any], message: str) -> None:
    class Game(TellingEnv):
        def step(self, actions: dict[str, Any]) -> Any:
            *rest, infos = super().step(actions)
            return (*rest, {agent: {**infos[agent], "action_mask": change.get(agent)} for agent in infos})

    env = make_team_env(Game, masks="info")
    env.reset()
    where = "expected 'action_mask' in the info of agent_0 in game 0 at step 1, "
    with pytest.raises(ValueError, match=re.escape(where + message)):
        env.step(np.array([0, 1]))


def test_a_state_of_another_shape() -> None:
    env = make_team_env(TellingEnv, state=True)
    env.set_attr("state", lambda: np.zeros(3))
    with pytest.raises(
        ValueError, match=r"the state of game 0 at step 0: expected float32 of shape \(2,\), got float6"
    ):
        env.reset()


def test_observations_outside_the_bounds_of_floats_are_warned_of_once() -> None:
    """Rounding alone may cause it, and policies accept any float."""
    game = sees(spaces.Box(0, 1, (2,)), [0.5, 1.5], [0, 0])
    env = make_team_env(MisbehavingEnv, 2, **game)
    env.reset()
    env.step(np.zeros(4, dtype=int))
    with pytest.warns(
        UserWarning, match=r"agent_0 in game 0 at step 2: expected values from 0.0 to 1.0 .* got 1.5;"
    ) as w:
        env.step(np.zeros(4, dtype=int))
    assert len(w) == 1
    for _ in range(3):
        env.step(np.zeros(4, dtype=int))  # warnings are errors


@pytest.mark.parametrize("n_cpus", [1, 2])
@pytest.mark.parametrize(
    ("fault", "reward", "done"),
    [
        (gives(REWARD, np.array([1.5])), 1.5, False),
        (gives(REWARD, np.float32(1.5)), 1.5, False),
        (gives(REWARD, [2]), 2.0, False),
        (gives(REWARD, np.True_), 1.0, False),
        (gives(TERMINATION, np.False_), 21.0, False),
        (gives(TRUNCATION, np.array([False])), 21.0, False),
        (gives(TERMINATION, 0), 21.0, False),
        (lacks(TRUNCATION), 21.0, False),
        (lacks(INFO), 21.0, False),
        (gives(INFO, None), 21.0, False),
        ({"at_step": lambda env, result: [part.update(judge=None) for part in result] and None}, 21.0, False),
        (replaces(TRUNCATION, {"agent_0": np.True_, "agent_1": np.array([1])}), 21.0, True),
    ],
)
def test_what_is_unusual_but_clear_is_taken(fault: dict[str, Any], reward: float, done: bool, n_cpus: int) -> None:
    env = make_team_env(MisbehavingEnv, n_cpus=n_cpus, **fault)
    env.reset()
    env.step(np.zeros(2, dtype=int))
    _, rewards, dones, _ = env.step(np.zeros(2, dtype=int))
    assert rewards.tolist() == [20.0, reward]
    assert dones.tolist() == [done] * 2
    env.close()


def test_a_games_own_words_in_infos_do_not_collide_with_those_of_sb3() -> None:
    """SB3 treats an entry "episode" as a monitor's, and fails if "r", "l", "t" are missing."""
    own = {"episode": {"r": 1}, "l": 1, "r": 2, "t": 3, "active": "yes", "terminal_observation": 4}

    class Game(CounterEnv):
        def step(self, actions: dict[str, Any]) -> Any:
            return (*super().step(actions)[:4], {agent: dict(own) for agent in self.possible_agents})

    env = make_team_env(Game, 2, seed=0)
    model = PPO("MAPPOPolicy", env, n_steps=6, batch_size=12, n_epochs=1, rollout_buffer_class=TeamRolloutBuffer)
    model.learn(48)
    assert model.ep_info_buffer is not None
    assert {episode["l"] for episode in model.ep_info_buffer} == {3}
    env.reset()
    info = env.step(np.zeros(4, dtype=int))[3][1]
    assert info == {
        "game_episode": {"r": 1},
        "l": 1,
        "r": 2,
        "t": 3,
        "game_active": "yes",
        "game_terminal_observation": 4,
    }


@pytest.mark.parametrize(
    ("space", "seen", "own", "row"),
    [
        (spaces.Discrete(4, start=5), lambda step: 5 + step, spaces.Discrete(4), 1),
        (
            spaces.MultiDiscrete([4, 2], start=[1, -1]),
            lambda step: [1 + step, -1],
            spaces.MultiDiscrete([4, 2]),
            [1, 0],
        ),
        (
            spaces.Dict(place=spaces.Box(-1, 9, (2,)), kind=spaces.Discrete(3, start=1)),
            lambda step: {"place": [step, 0.5], "kind": 2},
            spaces.Box(np.array([-1, -1, 0, 0, 0], np.float32), np.array([9, 9, 1, 1, 1], np.float32)),
            [1, 0.5, 0, 1, 0],
        ),
        (
            spaces.Tuple([spaces.MultiBinary(2), spaces.Box(-1, 9, ())]),
            lambda step: ([1, 0], step),
            spaces.Box(np.array([0, 0, -1], np.float32), np.array([1, 1, 9], np.float32)),
            [1, 0, 1],
        ),
    ],
)
@pytest.mark.parametrize("policy", ["SAFPolicy", "MAPPOPolicy"])
def test_observations_are_counted_from_0_and_flattened(
    space: spaces.Space[Any], seen: Callable[[int], Any], own: spaces.Space[Any], row: Any, policy: str
) -> None:
    env = make_team_env(MisbehavingEnv, 2, seed=0, space=space, seen=seen)
    assert env.team_spaces.own == own
    env.reset()
    obs: Any = env.step(np.zeros(4, dtype=int))[0]
    assert obs["obs"][0].tolist() == row
    PPO(policy, env, n_steps=4, batch_size=8, n_epochs=1, rollout_buffer_class=TeamRolloutBuffer).learn(16)


@pytest.mark.parametrize(
    "space", [spaces.MultiBinary(3), spaces.Box(-2, 5, (2,), np.int64), spaces.Discrete(3, start=2)], ids=str
)
@pytest.mark.parametrize("policy", ["SAFPolicy", "MAPPOPolicy"])
def test_actions_of_every_space_reach_the_game(space: spaces.Space[Any], policy: str) -> None:
    env = make_team_env(MisbehavingEnv, 2, seed=0, action_space=space)
    PPO(policy, env, n_steps=8, batch_size=16, n_epochs=1, rollout_buffer_class=TeamRolloutBuffer).learn(64)
    for actions in env.get_attr("last_actions"):
        assert all(np.asarray(action).dtype == space.dtype and action in space for action in actions.values())
