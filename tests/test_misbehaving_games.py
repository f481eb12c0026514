"""Games that break PettingZoo's rules: each error names the agent, the step, and what was expected."""

from __future__ import annotations

import re
import threading
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO

from sb3_saf import TeamRolloutBuffer, check_team_env, make_team_env
from tests.toy_envs import CounterEnv, Game, TellingEnv

#: Changes what a step returns: observations, rewards, terminations, truncations and infos by agent.
Fault = Callable[[CounterEnv, list[Any]], Any]


class MisbehavingEnv(CounterEnv):
    """
    A game with a fault at its second step, or in its reset.

    A third agent has other spaces if ``unequal``. A ``late`` fault comes after the trial episode, which has the seed 0.

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
        unequal: bool = False,
        late: bool = False,
    ):
        self.space, self.seen, self.actions, self.unequal, self.late = space, seen, action_space, unequal, late
        super().__init__(n_agents=3 if unequal else 2)
        self.at_step, self.at_reset = at_step, at_reset
        if setup is not None:
            setup(self)

    def _make_observation_space(self) -> spaces.Space[Any]:
        return super()._make_observation_space() if self.space is None else self.space

    def _make_action_space(self) -> spaces.Space[Any]:
        return super()._make_action_space() if self.actions is None else self.actions

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Box(0, 1, (5,)) if agent == "agent_2" else super().observation_space(agent)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return spaces.Discrete(7) if agent == "agent_2" else super().action_space(agent)

    def _observation(self, index: int, draw: np.float32) -> Any:
        if index == 2:
            return np.zeros(5, np.float32)
        return super()._observation(index, draw) if self.seen is None else self.seen(self.steps)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        result = list(super().reset(seed, options))
        return tuple(result) if self.at_reset is None else self.at_reset(self, result) or tuple(result)

    def step(self, actions: dict[str, Any]) -> Any:
        result = list(super().step(actions))
        if self.steps != 2 or self.at_step is None or (self.late and self.last_seed == 0):
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


STEP = "step of counter_v0 to return (observations, rewards, terminations, truncations, infos)"
RESET = "reset of counter_v0 to return (observations, infos)"

#: Faults, and words that the errors have in common with their names.
FAULTS: list[tuple[dict[str, Any], str]] = [
    (lacks(REWARD), "a reward for agent_1, which acted, in step 2"),
    (gives(REWARD, "1.0"), "the reward of agent_1 in step 2 of a trial episode, got '1.0'"),
    (gives(REWARD, np.ones(2)), "the reward of agent_1 in step 2"),
    (gives(REWARD, np.nan), "the reward of agent_1 in step 2 of a trial episode, got nan"),
    (replaces(REWARD, np.ones(2)), f"{STEP}, as PettingZoo 1.24 and later do, got 5 values: dict, ndarray"),
    (lacks(OBSERVATION), "an observation for agent_1, which takes part or has just been truncated, in step 2"),
    (gives(OBSERVATION, None), "an observation for agent_1, which takes part or has just been truncated, in step 2"),
    (gives(OBSERVATION, np.zeros(4)), "agent_1 in step 2 of a trial episode: expected float32 of shape (3,), got"),
    (gives(OBSERVATION, [1, [2], [3, 4]]), "agent_1 in step 2 of a trial episode: expected float32 of shape (3,)"),
    (gives(OBSERVATION, [0, np.nan, 0]), "agent_1 in step 2 of a trial episode: expected finite values, got nan"),
    (sees(spaces.Discrete(4, start=5), 9, 5), "agent_0 in step 2 of a trial episode: expected values from 5 to 8"),
    (sees(spaces.Discrete(4), -1, 1), "agent_0 in step 2 of a trial episode: expected values from 0 to 3"),
    (sees(spaces.Discrete(4), 1.5, 1), "agent_0 in step 2 of a trial episode: expected int64 of shape ()"),
    (sees(spaces.MultiDiscrete([2, 3]), [1, 3], [0, 0]), "expected values from 0 to 2 as in MultiDiscrete([2 3])"),
    (sees(spaces.Box(0, 19, (2,), np.uint8), np.array([3, 255], np.uint8), np.zeros(2, np.uint8)),
     "agent_0 in step 2 of a trial episode: expected values from 0 to 19 as in Box(0, 19, (2,), uint8), got 255"),
    (sees(spaces.Dict(a=spaces.Discrete(2)), {"b": 0}, {"a": 0}), "expected the parts ['a'], got ['b']"),
    (sees(spaces.Dict(a=spaces.Discrete(2)), {"a": 2}, {"a": 0}), "['a']: expected values from 0 to 1"),
    (gives(TERMINATION, "False"), "True or False for agent_1 in terminations in step 2"),
    (gives(TERMINATION, 2), "True or False for agent_1 in terminations in step 2"),
    (gives(TERMINATION, np.array([True, False])), "True or False for agent_1 in terminations in step 2"),
    (gives(TRUNCATION, "yes"), "True or False for agent_1 in truncations in step 2"),
    ({"at_step": lambda env, result: setattr(env, "agents", None)}, "agents of counter_v0 to be a list"),
    ({"at_step": lists("agent_0", "agent_7")}, "in agents of counter_v0 in step 2 of a trial episode, got 'agent_7'"),
    (gives(INFO, "fine"), "a dict as the info of agent_1 in step 2 of a trial episode, got 'fine'"),
    ({"at_step": lambda env, result: tuple(result[:4])}, "got 4 values: dict, dict, dict, dict (one dict of dones"),
    ({"at_step": lambda env, result: 0.5}, f"{STEP}, as PettingZoo 1.24 and later do, got an object of type float"),
    ({"at_reset": lambda env, result: result[0]}, "(observations alone, as in older versions)"),
    ({"at_reset": lambda env, result: (result[0], [])}, f"{RESET}, as PettingZoo 1.24 and later do, got 2 values"),
    ({"at_reset": lists()}, "expected at least one name in agents of counter_v0 after reset, got none"),
    ({"at_reset": lists("left")}, "in agents of counter_v0 at the reset of a trial episode, got 'left'"),
    ({"at_reset": lambda env, result: result[0].clear()}, "an observation for agent_0, which takes part"),
    ({"at_reset": lambda env, result: result[1].update(agent_0="new")}, "a dict as the info of agent_0 at the reset"),
    ({"setup": set_to("reset", lambda: None)}, "expected counter_v0 to have reset(seed=None, options=None)"),
    ({"setup": set_to("possible_agents", ["a", "b", "a"])}, "got 'a' more than once in ['a', 'b', 'a']"),
    ({"setup": set_to("possible_agents", [])}, "expected counter_v0 to list its agents in possible_agents"),
    ({"setup": set_to("observation_space", {})}, "expected observation_space(agent) to be a method"),
    ({"at_step": lambda env, result: env.possible_agents.pop() and None}, "removes agents from both: write"),
    ({"space": spaces.Box(0, 1, (0,))}, "expected an observation space with at least one entry"),
    ({"space": spaces.Box(0, 1, ())}, "expected an observation space with an axis, got Box(0.0, 1.0, (), float32)"),
    ({"at_step": lambda env, result: result[3].update(agent_0=True) or result[0].clear()},
     "an observation for agent_0, which takes part or has just been truncated, in step 2"),
    ({"space": spaces.Text(3)}, "expected an observation space that is one of Discrete, MultiDiscrete, MultiBinary"),
    ({"action_space": spaces.Tuple([spaces.Discrete(2)])}, "expected an action space that is one of Discrete"),
]  # fmt: skip


@pytest.mark.parametrize("unequal", [False, True])
@pytest.mark.parametrize(("fault", "message"), FAULTS, ids=lambda value: value[:50] if isinstance(value, str) else "")
def test_each_fault_is_named_when_the_environment_is_made(fault: dict[str, Any], message: str, unequal: bool) -> None:
    """Agents with different spaces are checked against their own, before they are padded."""
    with pytest.raises(ValueError, match=re.escape(message)):
        make_team_env(MisbehavingEnv, 2, seed=0, unequal=unequal, **fault)
    with pytest.raises(ValueError, match=re.escape(message)):
        check_team_env(MisbehavingEnv(unequal=unequal, **fault))


class HelperEnv(Game):
    """Has attributes of its own with the names of others: neither a wrapped game nor masks for sb3-contrib."""

    def __init__(self) -> None:
        self.env = "grid"

    def action_masks(self, agent: str) -> Any:
        raise AssertionError("called without its agent")


def test_attributes_with_the_names_of_others_are_the_games_own() -> None:
    check_team_env(HelperEnv())
    env = make_team_env(HelperEnv, 2, seed=0)
    env.reset()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.step(np.zeros(env.num_envs, dtype=int))
    assert not env.has_attr("action_masks") and env.get_attr("env")[0] == "grid"


#: Faults that come after the trial, and words of their errors.
LATE_FAULTS: list[tuple[dict[str, Any], str]] = [
    (lacks(REWARD), "agent_1, which acted, in game 0 at step 2"),
    (gives(REWARD, "1.0"), "agent_1 in game 0 at step 2"),
    (gives(REWARD, np.nan), "rewards must be finite, got nan at step 2 for agent 1 of game 0"),
    (gives(OBSERVATION, None), "agent_1"),
    (gives(OBSERVATION, [0, np.nan, 0]), "observations must be finite, got nan at step 2 for agent 1 of game 0"),
    (gives(TERMINATION, "False"), "agent_1 in terminations in game 0 at step 2"),
    ({"at_step": lambda env, result: tuple(result[:4])}, "got 4 values"),
    ({"at_step": lists("agent_0", "agent_7")}, "in game 0 at step 2, got 'agent_7'"),
    ({"at_step": lambda env, result: result[0].update(agent_1=7), "space": spaces.Discrete(4), "seen": lambda step: 0},
     "agent_1"),
]  # fmt: skip


@pytest.mark.parametrize("unequal", [False, True])
@pytest.mark.parametrize(
    ("fault", "message", "n_cpus"),
    [*((*fault, 1) for fault in LATE_FAULTS), *((*fault, 2) for fault in LATE_FAULTS[::5])],
)
def test_faults_after_the_trial_are_named(fault: dict[str, Any], message: str, n_cpus: int, unequal: bool) -> None:
    env = make_team_env(MisbehavingEnv, 2, seed=1, n_cpus=n_cpus, unequal=unequal, late=True, **fault)
    try:
        env.reset()
        env.step(np.zeros(env.num_envs, dtype=int))
        with pytest.raises(ValueError, match=re.escape(message)):
            env.step(np.zeros(env.num_envs, dtype=int))
    finally:
        env.close()


def test_the_trial_disturbs_no_game_and_no_generator() -> None:
    game = CounterEnv()
    before = np.random.get_state(legacy=False)["state"]["key"].tolist()  # noqa: NPY002
    env = make_team_env(game, 1, seed=3)
    assert np.random.get_state(legacy=False)["state"]["key"].tolist() == before  # noqa: NPY002
    assert game.episode == 0
    env.reset()
    assert env.get_attr("episode") == [1, 1]


@pytest.mark.parametrize("n_cpus", [1, 2])
def test_an_info_that_cannot_be_copied(n_cpus: int) -> None:
    def fault(env: CounterEnv, result: list[Any]) -> None:
        result[INFO]["agent_1"]["lock"] = threading.Lock()

    env = make_team_env(MisbehavingEnv, n_cpus=n_cpus, at_step=fault)
    env.reset()
    env.step(np.zeros(2, dtype=int))
    with pytest.raises(TypeError, match=r"the info of agent_1 cannot be copied .* leave out what cannot be copied"):
        env.step(np.zeros(2, dtype=int))


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("mask", [np.zeros(3), np.array([0, 1, 2, 0]), "all", None])
def test_wrong_masks(mask: Any, late: bool) -> None:
    class Game(TellingEnv):
        def step(self, actions: dict[str, Any]) -> Any:
            *rest, infos = super().step(actions)
            if late and self.last_seed == 0:
                return (*rest, infos)
            return (*rest, {agent: {**infos[agent], "action_mask": mask} for agent in infos})

    def play() -> None:
        env = make_team_env(Game, seed=1, masks="info", action_masks=True if mask is None else "auto")
        env.reset()
        env.step(np.array([0, 1]))

    with pytest.raises(ValueError, match=r"'action_mask' in the info of agent_0 in .* 1.*4 zeros and ones"):
        play()


def test_a_state_of_another_shape() -> None:
    env = make_team_env(TellingEnv, state=True)
    env.set_attr("state", lambda: np.zeros(3))
    with pytest.raises(ValueError, match=r"the state in game 0 at step 0: expected float32 of shape \(2,\)"):
        env.reset()


def test_observations_outside_the_bounds_of_floats_are_warned_of_once() -> None:
    """Rounding alone may cause it, and policies accept any float."""
    game = sees(spaces.Box(0, 1, (2,)), [0.5, 1.5], [0, 0])
    with pytest.warns(UserWarning, match=r"agent_0 in step 2 .*: expected values from 0.0 to 1.0 .* got 1.5") as w:
        env = make_team_env(MisbehavingEnv, 2, **game)
    assert len(w) == 1
    env.reset()
    for _ in range(3):
        env.step(np.zeros(4, dtype=int))  # warnings are errors


@pytest.mark.parametrize("n_cpus", [1, 2])
@pytest.mark.parametrize(
    ("fault", "reward", "done"),
    [
        (gives(REWARD, np.array([1.5])), 1.5, False),
        (gives(REWARD, [2]), 2.0, False),
        (gives(REWARD, np.True_), 1.0, False),
        (gives(TERMINATION, np.False_), 21.0, False),
        (gives(TRUNCATION, np.array([False])), 21.0, False),
        (lacks(TRUNCATION), 21.0, False),
        (lacks(INFO), 21.0, False),
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
