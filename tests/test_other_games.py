"""Games as the authors of other libraries write them: masks, rewards, ends, spaces and turns in forms of their own."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Callable
from copy import deepcopy
from functools import cache, partial
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from pettingzoo import AECEnv
from pettingzoo.test import parallel_api_test
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.utils import explained_variance
from stable_baselines3.common.vec_env import VecNormalize

from sb3_saf import (
    CentralizedValueWrapper,
    GymnasiumTeam,
    ObservationEncoder,
    RandomPolicy,
    TeamRolloutBuffer,
    TurnsInParallel,
    check_team_env,
    evaluate_team,
    inspect_team,
    make_team_env,
    resumable_learn,
)
from sb3_saf.training.wrappers import wrap_game, wrap_rows
from tests.contrib_teams import MaskedGame
from tests.toy_envs import BOX, ZEROS, CounterEnv, Game
from tests.toy_teams import CodeSpace


def ppo(env: Any, **kwargs: Any) -> PPO:
    settings: dict[str, Any] = {"n_steps": 8, "n_epochs": 1, "seed": 0, "gamma": 0.5, "gae_lambda": 1.0}
    buffer = {"rollout_buffer_class": TeamRolloutBuffer, "batch_size": 8 * env.num_envs}
    return PPO("IPPOPolicy", env, **{**settings, **buffer, **kwargs})


def test_drawn_floats_are_learned_from_where_actions_are_integers() -> None:
    class Whole(Game):
        def action_space(self, agent: Any) -> spaces.Space[Any]:
            return spaces.Box(-3, 3, (2,), np.int32)

    model = ppo(make_team_env(Whole, 2, seed=0), learning_rate=0.0).learn(32)
    assert model.logger.name_to_value["train/approx_kl"] == pytest.approx(0, abs=1e-6), "the policy has not changed"


# --- action masks -----------------------------------------------------------------------------------------------------


MULTI = {"actions": spaces.MultiDiscrete([2, 3]), "mask": (0, 1, 1, 0, 0)}


@pytest.mark.parametrize(
    "game",
    [
        {"where": "action_mask"},
        {"where": "action_mask", "others": {"observations": BOX}},
        {"where": "action_mask", "others": {"real_obs": BOX, "step": spaces.Discrete(5)}},
        {"where": "avail_actions", "others": {"obs": BOX}},
        {"where": "action_mask", **MULTI},
        {"where": "info:action_mask"},
        {"where": "info:avail_actions"},
        {"where": "info:action_mask", **MULTI},
    ],
    ids=str,
)
def test_masks_are_used_wherever_they_are(game: dict[str, Any]) -> None:
    env = make_team_env(MaskedGame, 2, seed=0, **game)
    assert env.team_spaces.n_masked_actions == len(game.get("mask", "abc"))
    assert not any("mask" in key or "avail" in key for key in getattr(env.team_spaces.own, "spaces", ()))
    ppo(env).learn(32)
    assert evaluate_team(RandomPolicy(env, seed=0), env, 4).mean == 8


@pytest.mark.parametrize(
    ("game", "message"),
    [
        ({"where": "info:action_mask", "given": lambda step: step != 1}, "'action_mask' is in some infos"),
        ({"where": "info:legal_moves"}, "'legal_moves'"),
        ({"where": "legal_actions", "mask": (1, 1)}, "'legal_actions'.* one entry per choice"),
        ({"where": "visible_mask"}, "'visible_mask'.* an ordinary part .* masks are 'action_mask'"),
        ({"where": "invalid_actions"}, "'invalid_actions'.* an ordinary part"),
    ],
)
def test_masks_that_are_not_always_used_are_named(game: dict[str, Any], message: str) -> None:
    with pytest.warns(UserWarning, match=message):
        make_team_env(MaskedGame, seed=0, **game)


@pytest.mark.parametrize(
    ("observed", "message"),
    [
        ([spaces.Dict(view=spaces.Dict(x=BOX, action_mask=spaces.MultiBinary(3)))], "'action_mask' inside of 'view'"),
        ([spaces.Dict(view=CodeSpace(), energy=BOX)], "tile codes beside other entries"),
        ([spaces.Box(0, 1000, (2,), np.int32), spaces.Box(0, 1, (2,), np.int32)], r"reach up to \[1.0, 1000.0\]"),
        ([spaces.Box(-200, 0, (2,), np.int32), spaces.Box(-1, 1, (2,))], r"reach up to \[1.0, 200.0\]"),
        ([spaces.Dict(x=spaces.Box(0, high, (2,))) for high in (255, 1)], r"reach up to \[1.0, 255.0\]"),
    ],
)
def test_observations_that_are_not_read_as_meant_are_named(observed: list[Any], message: str) -> None:
    with pytest.warns(UserWarning, match=message):
        make_team_env(Showing(*observed), seed=0)


def test_masks_that_come_after_the_trial_are_named() -> None:
    game = MaskedGame("info:action_mask", given=lambda step: step > 32)
    game.length = 40
    env = make_team_env(game, seed=0, active=False)
    env.reset()
    for _ in range(32):
        env.step(np.ones(2, int))
    with pytest.warns(UserWarning, match="not used; give them from the first reset on"):
        env.step(np.ones(2, int))


class TwoKinds(Game):
    """Agents with spaces of their own, and masks by the method that MaskablePPO calls."""

    actions_of: ClassVar[dict[str, Any]] = {"a": spaces.Discrete(3), "b": spaces.Discrete(4)}

    def action_space(self, agent: Any) -> spaces.Space[Any]:
        return self.actions_of[agent]

    def step(self, actions: dict[str, Any]) -> Any:
        assert all(action in self.actions_of[agent] for agent, action in actions.items()), actions
        return super().step(actions)


def test_maskable_ppo_on_agents_with_different_actions() -> None:
    class Masked(TwoKinds):
        def action_masks(self) -> dict[str, Any]:
            return {a: np.arange(self.actions_of[a].n) != 1 for a in self.agents}

        def step(self, actions: dict[str, Any]) -> Any:
            assert all(action != 1 for action in actions.values()), actions
            return super().step(actions)

    MaskablePPO("MAPPOMaskablePolicy", make_team_env(Masked, seed=0), n_steps=8, batch_size=16, n_epochs=1).learn(16)


@pytest.mark.parametrize(
    ("one", "other", "common"),
    [
        (spaces.MultiDiscrete([2, 3]), spaces.MultiDiscrete([4, 1]), spaces.MultiDiscrete([4, 3])),
        (spaces.MultiDiscrete([2, 3, 2]), spaces.MultiDiscrete([3, 2]), spaces.MultiDiscrete([3, 3, 2])),
        (spaces.Discrete(5), spaces.MultiDiscrete([2, 3]), spaces.MultiDiscrete([5, 3])),
        (spaces.Discrete(2, start=3), spaces.MultiDiscrete([2, 3], start=[1, -1]), spaces.MultiDiscrete([2, 3])),
    ],
    ids=str,
)
def test_discrete_actions_of_every_form_are_padded_and_masked(one: Any, other: Any, common: Any) -> None:
    class Kinds(TwoKinds):
        actions_of: ClassVar[dict[str, Any]] = {"a": one, "b": other}

    env = make_team_env(Kinds, 2, seed=0)
    assert env.action_space == common
    ppo(env).learn(64)
    evaluate_team(RandomPolicy(env, seed=0), env, 4)


def test_discrete_beside_box_says_what_to_do() -> None:
    class Kinds(TwoKinds):
        actions_of: ClassVar[dict[str, Any]] = {"a": spaces.Discrete(3), "b": BOX}

    with pytest.raises(ValueError, match=r"a: Discrete.*b: Box.*in a wrapper"):
        make_team_env(Kinds)


# --- rewards of agents that do not act --------------------------------------------------------------------------------


class Leaving(Game):
    """
    Agent ``a`` is out in some steps, and the game pays by a table.

    :param out: steps after which ``a`` does not act
    :param paid: rewards of ``a`` in the four steps
    :param dies: whether ``a`` ends when it leaves; otherwise it waits
    """

    def __init__(self, out: tuple[int, ...], paid: tuple[float, ...], dies: bool) -> None:
        self.out, self.paid, self.dies = out, paid, dies

    def change(self, out: list[Any]) -> None:
        out[1] = {"a": self.paid[self.t - 1], "b": 0.0}
        if self.dies and self.t == self.out[0]:
            out[2]["a"] = True
        self.agents = [a for a in self.possible_agents if a == "b" or self.t not in self.out]
        out[0] = {a: self.see(a) for a in self.agents}


def returns_of_a(game: Game, gae_lambda: float) -> list[float]:
    """Return the returns of agent ``a`` in one episode with gamma 0.5, for a critic that says 0."""
    model = ppo(make_team_env(game), gae_lambda=gae_lambda)
    with th.no_grad():
        for parameter in model.policy.value_net.parameters():
            parameter.zero_()
    model.learn(16)
    buffer = model.rollout_buffer
    assert isinstance(buffer, TeamRolloutBuffer) and buffer.active is not None
    active = buffer.active.reshape(8, 2)[:4, 0] != 0
    return [round(float(r), 6) for r in buffer.returns[:4, 0][active]]


@pytest.mark.parametrize(
    ("out", "paid", "dies", "gae_lambda", "expected"),
    [
        ((1, 2, 3), (0, 0, 0, 8), True, 1.0, [1.0]),  # after death: 8 / 2^3
        ((1, 2, 3), (0, 0, 0, 8), False, 1.0, [1.0]),  # never returns
        ((1, 2), (0, 0, 4, 0), False, 1.0, [1.0, 0.0]),  # when it returns: in step 3, it did not act
        ((1,), (0, 2, 0, 8), False, 1.0, [2.0, 4.0, 8.0]),  # a skipped turn, and the return goes on
        ((1, 2, 3), (3, 0, 0, 0), True, 1.0, [3.0]),
        ((1, 2, 3), (0, 0, 0, 8), False, 0.0, [1.0]),  # a return is the reward, and the value that follows, here 0
        ((1,), (0, 2, 0, 8), False, 0.0, [1.0, 0.0, 8.0]),
    ],
)
def test_an_agent_learns_from_all_that_the_game_pays_it(
    out: tuple[int, ...], paid: tuple[float, ...], dies: bool, gae_lambda: float, expected: list[float]
) -> None:
    game = Leaving(out, paid, dies)
    assert returns_of_a(game, gae_lambda) == expected
    env = make_team_env(game)
    assert evaluate_team(RandomPolicy(env, seed=0), env, 2).returns == [sum(paid)] * 2


@pytest.mark.parametrize("algorithm", [partial(PPO, batch_size=32), A2C])
def test_explained_variance_is_that_of_the_rows_of_agents_that_act(algorithm: Any) -> None:
    game = Leaving((1, 2, 3), (5, 0, 0, 8), dies=True)  # a critic without gradients explains nothing of its one return
    settings = {"rollout_buffer_class": TeamRolloutBuffer, "gamma": 0.5, "learning_rate": 0.0, "device": "cpu"}
    model = algorithm("MAPPOPolicy", make_team_env(game, 2, seed=0), n_steps=8, seed=0, **settings).learn(32)
    buffer = model.rollout_buffer
    assert isinstance(buffer, TeamRolloutBuffer) and buffer.active is not None
    active = buffer.active.reshape(8, 4) != 0
    assert active.sum() == 20
    expected = explained_variance(buffer.values[active], buffer.returns[active])
    assert model.logger.name_to_value["train/explained_variance"] == pytest.approx(expected, abs=1e-4)


class Alone(Game):
    """Agent ``a`` is stopped by a time limit in step 2."""

    def change(self, out: list[Any]) -> None:
        out[1] = dict.fromkeys(out[1], 0.0)
        if self.t == 2:
            out[0]["a"] = np.full(2, 0.5, np.float32)
            out[3]["a"] = True
            self.agents.remove("a")


@pytest.mark.parametrize("normalised", [False, True])
def test_an_agent_stopped_alone_is_bootstrapped_with_its_own_last_observation(normalised: bool) -> None:
    env = make_team_env(Alone, time_limit="bootstrap")
    if normalised:
        normal = VecNormalize(env.venv, norm_obs_keys=["obs"], norm_reward=False, training=False)
        normal.obs_rms["obs"].mean[:] = 1.5
        env = CentralizedValueWrapper(normal, time_limit="bootstrap")
    model = ppo(env).learn(16)
    env.reset()
    env.step(np.zeros(2, int))
    _, _, dones, infos = env.step(np.zeros(2, int))
    assert dones.tolist() == [True, False]
    last = infos[0]["terminal_observation"]
    expected = [-1, -1] if normalised else [0.5, 0.5]
    np.testing.assert_allclose(last["obs"], expected, atol=1e-3)
    np.testing.assert_allclose(last["team"][0], expected, atol=1e-3)
    assert last["active"].tolist() == [1, 1] and last["agent"] == 0
    buffer = model.rollout_buffer
    np.testing.assert_array_equal(buffer.episode_starts[:5, 0], [1, 0, 1, 0, 1])
    assert evaluate_team(RandomPolicy(env, seed=0), env, 3).lengths == [4] * 3


def test_bootstrapped_value_of_an_agent_stopped_alone() -> None:
    env = make_team_env(Alone, time_limit="bootstrap")
    model = ppo(env, learning_rate=0.0).learn(16)
    env.reset()
    for _ in range(2):
        infos = env.step(np.zeros(2, int))[3]
    last, _ = model.policy.obs_to_tensor(infos[0]["terminal_observation"])
    value = model.policy.predict_values(last).item()
    assert abs(value) > 1e-3
    np.testing.assert_allclose(model.rollout_buffer.returns[:2, 0], [value / 4, value / 2], rtol=1e-4)
    ended = ppo(make_team_env(Alone), learning_rate=0.0).learn(16)
    np.testing.assert_array_equal(ended.rollout_buffer.returns[:2, 0], [0, 0])


# --- classes of scripts, generators, ends -----------------------------------------------------------------------------


def test_a_class_of_a_script_stays_as_it_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Script(Game):
        level = 0.0

        def see(self, agent: Any) -> Any:
            return np.full(2, self.level, np.float32)

    Script.__module__, Script.__qualname__ = "__main__", "Script"
    monkeypatch.setattr(sys.modules["__main__"], "Script", Script, raising=False)
    env = make_team_env(Script, 2, seed=0)
    Script.level = 0.5
    obs: Any = env.reset()
    assert (obs["obs"] == 0.5).all()
    resumable_learn(ppo(env), 8 * 4, tmp_path)
    obs = make_team_env(Script(), 2).reset()
    assert Script.level == 0.5 and (obs["obs"] == 0.5).all()


class Drawing(Game):
    """
    Agents see a number that is drawn in each episode.

    :param how: where from
    """

    def __init__(self, how: str) -> None:
        self.how, self.seed = how, 0
        self.of_game = np.random.random()  # noqa: NPY002

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        if seed is not None and self.how == "the last seed":
            self.seed = seed
        if seed is not None or not self.how.startswith("a generator kept"):
            self.rng = np.random.default_rng(self.seed if seed is None else seed)
        drawn = {"torch": lambda: th.rand(()).item(), "the game": lambda: self.of_game}
        self.level = drawn.get(self.how, lambda: self.rng.random())()
        return super().reset(seed, options)

    def see(self, agent: Any) -> Any:
        return np.full(2, self.level, np.float32)


@pytest.mark.parametrize("how", ["torch", "the game"])
def test_games_of_worker_processes_draw_differently(how: str) -> None:
    env = make_team_env(partial(Drawing, how), 4, seed=0, n_cpus=2)
    obs: Any = env.reset()
    env.close()
    assert len(np.unique(obs["obs"][::2, 0])) == 4


@pytest.mark.parametrize("how", ["the last seed", "a seed of its own", "a generator kept"])
def test_games_that_repeat_their_episodes_are_named(how: str) -> None:
    env = make_team_env(partial(Drawing, how), 3, seed=0)
    env.reset()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for _ in range(4 * 12):
            env.step(np.zeros(6, int))
    assert ["to make its generator anew at resets without a seed" in str(one.message) for one in told] == (
        [] if how == "a generator kept" else [True]
    )


class Listing(Game):
    """
    An agent that has not acted is in ``agents`` after the step in which it ends.

    :param how: whether ``agents`` is whoever moves next, or the second agent joins, in the last step
    """

    def __init__(self, how: str) -> None:
        self.how = how

    def change(self, out: list[Any]) -> None:
        self.agents = ["ab"[self.t % 2]] if self.how == "turns" else ["a", "b"] if self.t >= 4 else ["a"]
        out[0], out[3] = dict.fromkeys("ab", ZEROS), dict.fromkeys("ab", self.t >= 4)

    def step(self, actions: dict[str, Any]) -> Any:
        result = super().step(actions)
        if self.t == 4:
            self.agents = ["a", "b"]
        return result

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        result = super().reset(seed, options)
        self.agents = ["a"]
        return result


@pytest.mark.parametrize("how", ["turns", "join"])
def test_ends_of_listed_agents_that_have_not_acted_count(how: str) -> None:
    env = make_team_env(partial(Listing, how), seed=0)
    env.reset()
    assert [env.step(np.zeros(2, int))[2].tolist() for _ in range(4)] == [[False] * 2] * 3 + [[True] * 2]


def test_possible_agents_that_lose_an_agent_after_the_trial_are_named() -> None:
    class Alias(Game):
        length = 40

        def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
            result = super().reset(seed, options)
            self.agents = self.possible_agents
            return result

        def change(self, out: list[Any]) -> None:
            if self.t == 35:
                self.agents.remove("a")
                out[2]["a"] = True

    Alias.possible_agents = ["a", "b"]
    env = make_team_env(Alias, seed=0)
    env.reset()
    for _ in range(39):
        env.step(np.zeros(2, int))
    with pytest.raises(ValueError, match=r"possible_agents at all times, got \['a', 'b'\], and \['b'\] at a reset of"):
        env.step(np.zeros(2, int))


class GymTeam(gym.Env[Any, Any]):
    """
    Two agents.

    :param ends: what step ``t`` returns as terminated and truncated
    :param old: whether resets return observations only
    """

    observation_space, action_space = spaces.Tuple([BOX] * 2), spaces.Tuple([spaces.Discrete(2)] * 2)

    def __init__(self, ends: Callable[[int], tuple[Any, ...]], old: bool = False) -> None:
        self.ends, self.old = ends, old

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.t = 0
        return (ZEROS, ZEROS) if self.old else ((ZEROS, ZEROS), {})

    def step(self, actions: Any) -> Any:
        self.t += 1
        return (ZEROS, ZEROS), [1.0, 1.0], *self.ends(self.t), {}


@pytest.mark.parametrize(
    ("ends", "over_in"),
    [
        (lambda t: (t >= 3, False), 3),
        (lambda t: (np.bool_(t >= 3), np.False_), 3),
        (lambda t: ([t >= 3, False], [False, t >= 5]), 5),
        (lambda t: ([t == 3, False], [False, t == 5]), 5),
        (lambda t: (np.array([t >= 2, t >= 4]), np.zeros(2, bool)), 4),
        (lambda t: ({0: t >= 2, 1: t >= 4}, {0: False, 1: False}), 4),
        (lambda t: ({"agent_0": t >= 2, "agent_1": t >= 4}, False), 4),
        (lambda t: ({"agent_0": False, "agent_1": False, "__all__": t >= 3}, {"__all__": False}), 3),
    ],
)
def test_gymnasium_teams_end_as_they_say(ends: Any, over_in: int) -> None:
    env = make_team_env(GymTeam(ends))
    env.reset()
    dones = [bool(env.step(np.zeros(2, int))[2][0]) for _ in range(over_in)]
    assert dones == [False] * (over_in - 1) + [True]


@pytest.mark.parametrize("names", [(0, 1), ("agent_0", "agent_1")])
def test_infos_of_gymnasium_teams_may_be_by_agent(names: tuple[Any, ...]) -> None:
    class Told(GymTeam):
        def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
            return super().reset()[0], {name: {"action_mask": np.eye(2)[i]} for i, name in enumerate(names)}

        def step(self, actions: Any) -> Any:
            return *super().step(actions)[:4], self.reset()[1]

    env = make_team_env(Told(lambda t: (False, False)))
    assert env.reset()["action_mask"].tolist() == [[1, 0], [0, 1]]


@cache
def shared_team() -> GymTeam:
    return GymTeam(lambda t: (False, False))


def test_games_that_are_one_gymnasium_team_are_refused() -> None:
    with pytest.raises(ValueError, match="returned the same object for 3 games"):
        make_team_env(shared_team, 3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GymTeam(lambda t: ([True], [False])), "terminated of 2 agents"),
        (lambda: GymTeam(lambda t: ("no", "no")), "True or False in terminated"),
        (lambda: GymTeam(lambda t: (False,)), "terminated, truncated, info.*older gym"),
        (lambda: GymTeam(lambda t: (False, False), old=True), r"\(observations, info\).*older gym"),
    ],
)
def test_other_forms_of_ends_are_refused(make: Callable[[], Any], message: str) -> None:
    def play() -> None:
        env = GymnasiumTeam(make())
        env.reset()
        env.step({"agent_0": 0, "agent_1": 0})

    with pytest.raises(ValueError, match=message):
        play()


def test_all_ends_a_parallel_game() -> None:
    class RayGame(Game):
        def change(self, out: list[Any]) -> None:
            out[2] = {"__all__": self.t == 3}
            out[3] = {"__all__": False}

    env = make_team_env(RayGame)
    env.reset()
    assert [bool(env.step(np.zeros(2, int))[2][0]) for _ in range(3)] == [False, False, True]


def test_respawned_agents_are_named() -> None:
    class Respawning(Game):
        def change(self, out: list[Any]) -> None:
            out[2]["a"] = self.t == 1

    env: Any = None
    for make in (check_team_env, make_team_env):
        with pytest.warns(UserWarning, match="a has ended and is in agents again in step 2 of a trial episode"):
            env = make(Respawning)
    env.reset()
    env.step(np.zeros(2, int))
    with pytest.warns(UserWarning, match="a has ended and is in agents again in game 0 at step 2"):
        env.step(np.zeros(2, int))
    env.step(np.zeros(2, int))  # once: warnings are errors


def test_masks_that_allow_nothing_are_named() -> None:
    class Stuck(Game):
        def info(self, agent: Any) -> dict[str, Any]:
            return {"action_mask": np.ones(3, np.int8) * (agent == "a" or self.t != 2)}

    with pytest.warns(UserWarning, match="'action_mask' in the info of b in step 2 of a trial episode allows nothing"):
        check_team_env(Stuck())


def test_parts_of_one_name_have_one_place_for_all_agents() -> None:
    """Whatever their sizes, their order, and what else an agent sees; integers alone are divided by their bounds."""

    class Depot(Game):
        parts: Any = {
            "a": spaces.Dict({"load": spaces.Discrete(2), "parcels": spaces.Box(0, 50, (2,), np.int64), "place": BOX}),
            "b": spaces.Dict({"load": spaces.Discrete(4), "place": BOX, "parcels": spaces.Box(0, 50, (2,), np.int64)}),
            "c": spaces.Dict({"lamp": spaces.MultiBinary(1), "place": BOX}),
        }
        possible_agents = ("a", "b", "c")

        def observation_space(self, agent: Any) -> spaces.Space[Any]:
            return self.parts[agent]

        def see(self, agent: Any) -> Any:
            seen: dict[str, Any] = {
                "load": 1,
                "parcels": np.array([20, 3]),
                "place": np.array([0.5, 0.25]),
                "lamp": np.ones(1, np.int8),
            }
            return {key: seen[key] for key in self.parts[agent].spaces}

    env = make_team_env(Depot, n_envs=1, seed=0)
    own = env.reset()["obs"]
    assert own.tolist() == [
        [0, 1, 0, 0, 20, 3, 0.5, 0.25, 0],
        [0, 1, 0, 0, 20, 3, 0.5, 0.25, 0],
        [0, 0, 0, 0, 0, 0, 0.5, 0.25, 1],
    ]
    policy: Any = PPO("MAPPOPolicy", env, n_steps=8, batch_size=24, rollout_buffer_class=TeamRolloutBuffer).policy
    assert policy.features_extractor.encoder.divisor.tolist() == [1, 1, 1, 1, 50, 50, 1, 1, 1]
    seen, _ = Depot().reset()
    actions, _ = policy.predict(seen, deterministic=True)
    assert list(actions.values()) == policy.predict(env.reset(), deterministic=True)[0].tolist()


# --- seeds, statistics, names, types ----------------------------------------------------------------------------------


class GlobalGame(Game):
    def see(self, agent: Any) -> Any:
        return np.random.uniform(-1, 1, 2).astype(np.float32)  # noqa: NPY002


def test_games_on_the_global_generator_differ_between_processes_and_repeat() -> None:
    def first() -> Any:
        env = make_team_env(GlobalGame, 4, seed=3, n_cpus=2)
        obs = env.reset()["obs"]
        env.close()
        return obs

    obs = first()
    assert len({row.tobytes() for row in obs}) == 8
    np.testing.assert_array_equal(obs, first())


class Alternating(Game):
    """One agent plays, the other one in the next episode."""

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        observations, infos = super().reset(seed, options)
        self.n_resets = getattr(self, "n_resets", 0) + 1
        self.agents = ["ab"[self.n_resets % 2]]
        return {agent: observations[agent] for agent in self.agents}, infos


@pytest.mark.parametrize("draws", [True, False])
def test_a_game_that_ignores_its_seed_is_named(draws: bool) -> None:
    class Stubborn(Game):
        def __init__(self) -> None:
            self.rng = np.random.default_rng(0)

        def see(self, agent: Any) -> Any:
            return self.rng.uniform(-1, 1, 2).astype(np.float32) if draws else ZEROS

    env = make_team_env(Stubborn(), 2, seed=0)
    env.reset()
    for _ in range(35):
        env.step(np.zeros(4, int))
    if draws:
        with pytest.warns(UserWarning, match=r"ignore reset\(seed"):
            env.step(np.zeros(4, int))
        for game, agent in ((Stubborn(), "a"), (Alternating(), "[ab]"), (Toggling(), "a")):
            with pytest.warns(UserWarning, match=f"first observations of {agent} differ in two resets with the seed 0"):
                check_team_env(game)
    else:
        env.step(np.zeros(4, int))  # a game without chance: warnings are errors
        check_team_env(Stubborn())


class Toggling(Game):
    """Changes sides at each reset, whatever the seed."""

    n_resets = 0

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.n_resets += 1
        return super().reset(seed, options)

    def see(self, agent: Any) -> Any:
        return np.full(2, self.n_resets % 2, np.float32)


class Lineup(Game):
    """Draws who plays from its seed."""

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        observations, infos = super().reset(seed, options)
        self.agents = [self.possible_agents[int(self.rng.integers(2))]]
        return {agent: observations[agent] for agent in self.agents}, {agent: infos[agent] for agent in self.agents}


def test_games_that_draw_who_plays_are_fine() -> None:
    check_team_env(Lineup())


def test_a_game_that_begins_at_random_after_its_seed_is_named() -> None:
    class Forgetful(Game):
        def reset(self, seed: int | None = None, options: Any = None) -> Any:
            self.rng = np.random.default_rng(seed)
            return super().reset(seed, options)

        def see(self, agent: Any) -> Any:
            return self.rng.uniform(-1, 1, 2).astype(np.float32)

    with pytest.warns(UserWarning, match="of a differ in two resets with the seed 0, each followed by one without: "):
        check_team_env(Forgetful())


def test_statistics_of_observations_leave_out_the_dead() -> None:
    class Dying(Game):
        length = 20

        def observation_space(self, agent: Any) -> spaces.Space[Any]:
            return spaces.Box(-99, 99, (1,), np.float32)

        def see(self, agent: Any) -> Any:
            return np.random.normal(10, 1, 1).astype(np.float32)  # noqa: NPY002

        def change(self, out: list[Any]) -> None:
            if self.t == 1:
                out[2]["a"] = True
                self.agents.remove("a")

    normal = VecNormalize(make_team_env(Dying, 2).venv, norm_obs_keys=["obs"], norm_reward=False)
    env = CentralizedValueWrapper(normal)
    env.reset()
    for _ in range(300):
        obs: Any = env.step(np.zeros(4, int))[0]
        assert (obs["obs"][obs["active"][:, 0] == 0][::2] == 0).all(), "policies see zeros"
    assert normal.obs_rms["obs"].mean == pytest.approx(10, abs=0.2)
    assert normal.obs_rms["obs"].var == pytest.approx(1, abs=0.2)


def test_a_model_without_its_games_tells_that_they_were_normalised(tmp_path: Path) -> None:
    plain = make_team_env(Alone, 2)
    statistics = VecNormalize(plain.venv, norm_obs_keys=["obs"], norm_reward=False)
    normal = CentralizedValueWrapper(statistics)
    model = ppo(normal)
    assert inspect_team(model, normal, 2), "games of a model that is not trained yet have no statistics"
    model.learn(16).save(tmp_path / "model")
    loaded = PPO.load(tmp_path / "model")
    statistics.training = False
    fresh = CentralizedValueWrapper(VecNormalize(make_team_env(Alone, 2).venv, norm_obs_keys=["obs"], training=False))
    for given in (loaded, PPO.load(tmp_path / "model", env=fresh)):
        with pytest.raises(ValueError, match="without statistics"):
            evaluate_team(given, fresh, 2)
    assert len(evaluate_team(loaded, normal, 2).returns) == 2
    for play in (lambda: evaluate_team(loaded, plain, 2), lambda: inspect_team(model, plain, 2)):
        with pytest.raises(ValueError, match="expected observations normalised by VecNormalize, as in the training of"):
            play()
    with pytest.raises(ValueError, match="expected observations not normalised by VecNormalize"):
        evaluate_team(ppo(plain).policy, normal, 2)


class Showing(Game):
    """Agents see samples of spaces of their own."""

    def __init__(self, *shown: spaces.Space[Any]) -> None:
        self.shown = {agent: deepcopy(shown[index % len(shown)]) for index, agent in enumerate("ab")}

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        for space in self.shown.values() if seed is not None else ():
            space.seed(seed)
        return super().reset(seed, options)

    def observation_space(self, agent: Any) -> spaces.Space[Any]:
        return self.shown[agent]

    def see(self, agent: Any) -> Any:
        return self.shown[agent].sample()


def read_by(env: Any, n_steps: int = 50) -> tuple[bool, float]:
    """Return whether the default encoder has convolutions, and the largest number that its first layers read."""
    encoder = ObservationEncoder(env.team_spaces.own)
    largest = [0.0]
    for net in encoder.modules():
        if isinstance(net, th.nn.Sequential) and not isinstance(net[-1], th.nn.ReLU):  # which joins features
            net[0].register_forward_pre_hook(lambda _, inputs: largest.append(float(inputs[0].abs().max())))
    env.reset()
    for _ in range(n_steps):
        obs: Any = env.step(np.zeros(env.num_envs, int))[0]
        encoder(preprocess_obs(th.as_tensor(obs["obs"]), env.team_spaces.own))
    return any(isinstance(layer, th.nn.Conv2d) for layer in encoder.modules()), max(largest)


COUNTS: Any = spaces.Box(0, 1000, (3,), np.int64)
SHARES: Any = spaces.Box(-1, 1, (2,), np.float32)
PICTURE = spaces.Box(0, 255, (20, 20, 3), np.uint8)


@pytest.mark.parametrize(
    ("shown", "convolves"),
    [
        ([spaces.Dict(a=COUNTS, b=SHARES)], False),
        ([spaces.Tuple([COUNTS, SHARES])], False),
        ([COUNTS, SHARES], False),
        ([spaces.Dict(a=PICTURE, b=COUNTS)], True),
        ([spaces.Dict(a=PICTURE, b=SHARES), spaces.Dict(a=PICTURE, b=COUNTS)], True),
        ([spaces.Dict(a=spaces.Box(0, 1, (20, 20, 3), np.float32), b=SHARES)], True),
        ([spaces.Dict(a=spaces.Box(0, 255, (20, 20), np.uint8), b=SHARES)], True),
    ],
)
@pytest.mark.filterwarnings("ignore:the agents' observations reach up to")
def test_parts_of_observations_are_scaled_and_pictures_convolved(shown: Any, convolves: bool) -> None:
    has_convolutions, largest = read_by(make_team_env(Showing(*shown), 2, seed=0))
    assert has_convolutions == convolves and 0.8 < largest <= 1


def test_pictures_that_cannot_be_told_apart_are_warned_of() -> None:
    with pytest.warns(UserWarning, match="read as plain numbers, without convolutions"):
        env = make_team_env(Showing(spaces.Dict(a=PICTURE, b=SHARES), SHARES), 2, seed=0)
    assert not read_by(env)[0]


@pytest.mark.parametrize("space", [spaces.Box(0, 255, (3,), np.float32), COUNTS, spaces.Dict(a=COUNTS, b=SHARES)])
def test_normalised_observations_are_not_scaled_again(space: Any) -> None:
    normal = VecNormalize(make_team_env(Showing(space), 2, seed=0).venv, norm_obs_keys=["obs"], norm_reward=False)
    assert 1.5 < read_by(CentralizedValueWrapper(normal))[1] < 3


def test_pictures_are_not_normalised() -> None:
    for space in (spaces.Dict(a=PICTURE, b=SHARES), spaces.Box(0, 1, (20, 20, 3), np.float32)):
        env = make_team_env(Showing(space), 2, seed=0)
        normal = VecNormalize(env.venv, norm_obs_keys=["obs"], norm_reward=False)
        with pytest.raises(ValueError, match="expected VecNormalize over vectors, got it over the pictures"):
            CentralizedValueWrapper(normal)
        assert read_by(wrap_rows(env, {"normalize": True}, 0.9, is_training=True))[1] <= 1


def test_success_of_a_step_is_that_of_all_agents_in_any_order() -> None:
    class Leaving(Game):
        possible_agents = ("a", "b", "c")
        lost = ""

        def change(self, out: list[Any]) -> None:
            if self.t == 2:
                for agent in "ab":
                    out[2][agent], out[4][agent] = True, {"is_success": agent != self.lost}
                    self.agents.remove(agent)

    for lost, rate in (("a", 0), ("b", 0), ("", 1)):
        env = make_team_env(type("Lost", (Leaving,), {"lost": lost}), 2, seed=0)
        assert evaluate_team(RandomPolicy(env, seed=0), env, 2).success_rate == rate


@pytest.mark.parametrize(("told", "rate"), [([False, False], 0), (np.array([True, False]), 0), ([True, True], 1)])
def test_success_of_a_gymnasium_team_may_be_a_list(told: Any, rate: float) -> None:
    class Telling(GymTeam):
        def step(self, actions: Any) -> Any:
            return *super().step(actions)[:4], {"is_success": told}

    env = make_team_env(Telling(lambda t: (t >= 3, False)), seed=0)
    assert evaluate_team(RandomPolicy(env, seed=0), env, 2).success_rate == rate


def test_agents_in_another_order_are_refused() -> None:
    class Turned(CounterEnv):
        def __init__(self) -> None:
            super().__init__()
            self.possible_agents = self.possible_agents[::-1]

    model = ppo(make_team_env(CounterEnv))
    model.set_env(make_team_env(CounterEnv, seed=1))
    with pytest.raises(ValueError, match=r"Observation spaces do not match: .*names="):
        model.set_env(make_team_env(Turned))


AGENTS: list[Any] = [np.array(["a", "b"]), {"a": 1, "b": 2}.keys(), ("a", "b"), ["agent", "b"], [0, 1]]


@pytest.mark.parametrize("agents", AGENTS)
def test_names_of_agents(agents: Any) -> None:
    class Named(Game):
        possible_agents = agents

    env = make_team_env(Named, 2, seed=0)
    assert env.team_spaces.names == tuple(agents)
    model = ppo(env).learn(32)
    names = list(agents)
    assert set(model.predict(dict.fromkeys(names, ZEROS))[0]) == set(names)


def test_float64_becomes_float32() -> None:
    class Double(Game):
        def observation_space(self, agent: Any) -> spaces.Space[Any]:
            return spaces.Box(-np.inf, np.inf, (2,), np.float64)

        def see(self, agent: Any) -> Any:
            return np.full(2, 1 / 3)

    assert make_team_env(Double).reset()["team"].dtype == np.float32


def test_the_audit_accepts_a_good_game_and_raises_the_errors_of_the_game() -> None:
    check_team_env(Game())
    check_team_env(Game)
    check_team_env(GymTeam(lambda t: (t >= 3, False)))

    class Broken(Game):
        def change(self, out: list[Any]) -> None:
            raise ArithmeticError("the game broke")

    with pytest.raises(ArithmeticError):
        check_team_env(Broken())


@pytest.mark.parametrize(
    ("low", "high", "is_reached"), [(500, 1000, False), (-3, -2, False), (0, 2, True), (-1, 1, True)]
)
def test_actions_that_a_policy_does_not_reach_are_named(low: float, high: float, is_reached: bool) -> None:
    class Far(Game):
        def action_space(self, agent: Any) -> spaces.Space[Any]:
            return spaces.Box(low, high, (2,), np.float32)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_team_env(Far())
    assert bool([one for one in caught if "scale the actions" in str(one.message)]) != is_reached


def test_frames_are_stacked_beside_masks_in_infos_and_not_in_observations() -> None:
    env = make_team_env(wrap_game(MaskedGame("info:action_mask"), {"frame_stack": 3}), seed=0)
    assert env.team_spaces.own_shape == (6,) and env.team_spaces.n_masked_actions == 3
    assert evaluate_team(RandomPolicy(env, seed=0), env, 3).mean == 8
    message = r"frame_stack expects observations that are Boxes, a has Dict\(.*\); use policy_kwargs {memory: gru}"
    with pytest.raises(ValueError, match=message):
        wrap_game(MaskedGame("action_mask"), {"frame_stack": 3})


# --- turns ------------------------------------------------------------------------------------------------------------


PILE = 7


class Nim(AECEnv[str, Any, Any]):
    """
    Two players take 1 to 3 stones from a pile in turn (action = stones - 1); whoever takes the last stone wins.

    :param masks: whether observations have masks (all zeros for the waiting player, as in PettingZoo's classic games)
    :param dtype: of the masks
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "nim_v0", "is_parallelizable": False, "render_modes": []}
    render_mode = None

    def __init__(self, masks: bool = True, dtype: Any = np.int8, mask_name: str = "action_mask"):
        super().__init__()
        self.masks, self.dtype, self.mask_name = masks, dtype, mask_name
        self.possible_agents = ["first", "second"]
        self.moves: list[int] = []
        own = spaces.Box(0, PILE, (2,), np.float32)
        self._space = spaces.Dict({"observation": own, mask_name: spaces.Box(0, 1, (3,), dtype)}) if masks else own
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
        return {"observation": own, self.mask_name: mask} if self.masks else own

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


class Leaver(Nim):
    """Three players, of whom the second is out after the first move, so that its turn is skipped."""

    def __init__(self) -> None:
        super().__init__(masks=False)
        self.possible_agents = ["first", "second", "third"]

    def step(self, action: int | None) -> None:
        if self.terminations[self.agent_selection]:
            self._was_dead_step(None)
            return
        self.moves.append(int(action or 0))
        self.terminations["second"] = True
        self.agent_selection = "third" if self.agent_selection == "first" else "first"
        self.agent_selection = self._deads_step_first()


class OwnSums(Nim):
    """Pays a stone for each move, and sums up by itself what ``last`` gives, without clearing what was paid."""

    def step(self, action: int | None) -> None:
        mover = self.agent_selection
        self._cumulative_rewards[mover] = 0.0
        super().step(action)
        if mover in self.rewards and not any(self.terminations.values()):
            self.rewards[mover] = 1.0
            self._cumulative_rewards[mover] += 1.0


def test_rewards_other_than_those_of_last_are_told() -> None:
    env = TurnsInParallel(OwnSums())
    env.reset(seed=0)
    assert env.step(dict.fromkeys(env.agents, 0))[1] == {"first": 1.0, "second": 0.0}
    with pytest.warns(
        UserWarning, match=r"first is paid 2.0, .* but last\(\) of the game says 1.0: let its step clear"
    ):
        assert env.step(dict.fromkeys(env.agents, 0))[1] == {"first": 1.0, "second": 1.0}


def test_the_next_player_sees_its_turn_after_one_that_is_skipped() -> None:
    env = TurnsInParallel(Leaver())
    env.reset(seed=0)
    observations, _, terminations, _, infos = env.step(dict.fromkeys(env.agents, 0))
    assert terminations == {"first": False, "second": True, "third": False}
    assert [observations[agent][1] for agent in ("first", "third")] == [0, 1], "whose turn it is"
    assert [infos[agent]["action_mask"].sum() for agent in ("first", "third")] == [1, 3]


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


class Dealt(Nim):
    """Draws the pile at random after a game with a seed, as OpenSpiel does, and tells masks in infos, too."""

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        super().reset(seed, options)
        self.pile = int(np.random.default_rng(seed).integers(1, 8))
        self.infos = {agent: {"action_mask": np.zeros(3, np.int8)} for agent in self.agents}


def test_games_after_one_with_a_seed_repeat() -> None:
    envs = [TurnsInParallel(Dealt()) for _ in range(2)]
    piles = [[(env.reset(seed=seed), env.unwrapped.pile)[1] for seed in (5, *[None] * 9)] for env in envs]
    assert piles[0] == piles[1] and len(set(piles[0])) > 1
    check_team_env(envs[0])  # infos are not read where observations have masks: warnings are errors


def test_it_is_a_proper_parallel_env() -> None:
    parallel_api_test(parallel(masks=False), 200)


class Teller(Nim):
    """Tells masks in infos by another of the names that games use."""

    def __init__(self) -> None:
        super().__init__(masks=False)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        super().reset(seed, options)
        self.infos = {agent: {"avail_actions": np.array([0, 1, 0], np.int8)} for agent in self.agents}


def test_masks_have_any_of_their_names() -> None:
    env = make_team_env(lambda: TurnsInParallel(Teller()), seed=0)
    assert env.reset()["action_mask"].tolist() == [[0, 1, 0], [1, 0, 0]]
    for given in ({"mask_name": "avail_actions"}, {"mask_name": "action_mask"}, {"masks": False}):
        env = make_team_env(parallel, 2, seed=0, **given)
        assert env.reset()["action_mask"].tolist() == [[1, 1, 1], [1, 0, 0]] * 2


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
