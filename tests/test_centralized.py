from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, VecTransposeImage, is_vecenv_wrapped
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_saf.envs.joint_observation import CentralizedValueWrapper
from sb3_saf.envs.monitor import TeamMonitor
from sb3_saf.teams.rows import AgentSpace, TeamSpaces
from sb3_saf.teams.vec_env import find_n_agents
from tests.team_venv import VECTOR, Array, TeamVenv, see_where, still
from tests.toy_teams import CodeSpace


def bytes_of(shape: tuple[int, ...]) -> Callable[[int, int, int, int], Array]:
    """Return bytes that differ for all games, agents, episodes, steps and places."""
    size = int(np.prod(shape))

    def see(game: int, agent: int, episode: int, step: int) -> Array:
        return (
            ((np.arange(size) * 7 + 31 * game + 17 * agent + 5 * episode + 3 * step) % 256)
            .astype(np.uint8)
            .reshape(shape)
        )

    return see


def test_rows_of_two_games_with_three_agents() -> None:
    env = CentralizedValueWrapper(TeamVenv(lengths=(3, 2), n_agents=3))
    env.reset()
    obs, rewards, dones, _ = env.step(still(env))
    assert isinstance(obs, dict)
    own = [[0, 0, 0, 1], [0, 1, 0, 1], [0, 2, 0, 1], [1, 0, 0, 1], [1, 1, 0, 1], [1, 2, 0, 1]]
    assert obs["obs"].tolist() == own
    assert obs["team"].tolist() == [own[:3], own[:3], own[:3], own[3:], own[3:], own[3:]]
    assert obs["agent"].tolist() == [0, 1, 2, 0, 1, 2]
    assert rewards.tolist() == [1, 11, 21, 101, 111, 121]
    assert dones.tolist() == [False] * 6
    assert env.step(still(env))[2].tolist() == [False] * 3 + [True] * 3


@pytest.mark.parametrize(
    ("own_space", "see"),
    [
        (VECTOR, see_where),
        (spaces.Box(-1, 1, (2, 2), np.float64), lambda e, i, k, t: np.full((2, 2), (e + i) / 10)),
        (spaces.Discrete(9), lambda e, i, k, t: e + i),
        (spaces.Discrete(9, start=3), lambda e, i, k, t: 3 + e + i),
        (spaces.MultiDiscrete([9, 4]), lambda e, i, k, t: [e + i, t]),
        (spaces.MultiBinary(3), lambda e, i, k, t: [e, i % 2, t % 2]),
        (spaces.Box(0, 255, (9, 8, 3), np.uint8), bytes_of((9, 8, 3))),
        (spaces.Box(0, 255, (3, 9, 8), np.uint8), bytes_of((3, 9, 8))),
        # SB3 takes the views of three agents, (3, 2, 7) bytes, for a channel-last image; the same for (3, 7, 2).
        (spaces.Box(0, 255, (2, 7), np.uint8), bytes_of((2, 7))),
        (spaces.Box(0, 255, (7, 2), np.uint8), bytes_of((7, 2))),
        (CodeSpace((7, 7), 200), lambda e, i, k, t: bytes_of((7, 7))(e, i, k, t) % 200),
    ],
    ids=lambda value: None if callable(value) else str(value),
)
def test_rows_lie_in_the_space_and_do_not_change_later(own_space: spaces.Space[Any], see: Any) -> None:
    env = CentralizedValueWrapper(TeamVenv(own_space=own_space, see=see))
    assert PPO._wrap_env(env) is env, "SB3 takes the rows as they are"
    parts = TeamSpaces.from_observation_space(env.observation_space)
    assert parts == env.team_spaces and parts.n_agents == 3
    assert isinstance(env.observation_space, spaces.Dict)
    returned: list[Any] = [(env.reset(), None, None, [])]
    copies = copy.deepcopy(returned)
    for _ in range(4):
        returned.append(env.step(still(env)))
        copies.append(copy.deepcopy(returned[-1]))
    np.testing.assert_equal(returned, copies)
    for obs, _, dones, infos in returned[1:]:
        rows = [{key: part[row] for key, part in obs.items()} for row in range(6)]
        rows += [infos[row]["terminal_observation"] for row in np.flatnonzero(dones)]
        for row in rows:
            assert row.keys() == env.observation_space.spaces.keys()
            for key, space in env.observation_space.spaces.items():
                assert space.contains(row[key]), key
                assert np.asarray(row[key]).dtype == space.dtype
            np.testing.assert_array_equal(row["team"][row["agent"]], row["obs"])


def test_images_are_transposed_once() -> None:
    venv = TeamVenv(own_space=spaces.Box(0, 255, (9, 8, 3), np.uint8), see=bytes_of((9, 8, 3)))
    env = CentralizedValueWrapper(venv)
    obs = env.reset()
    picture = bytes_of((9, 8, 3))(1, 2, 0, 0)
    assert obs["obs"].shape == (6, 3, 9, 8)
    assert obs["obs"][5, 2, 4, 7] == picture[4, 7, 2]
    np.testing.assert_array_equal(obs["obs"][5], picture.transpose(2, 0, 1))
    np.testing.assert_array_equal(obs["team"][3, 2], picture.transpose(2, 0, 1))
    env.step(still(env))
    *_, infos = env.step(still(env))
    last = bytes_of((9, 8, 3))(1, 2, 0, 2).transpose(2, 0, 1)
    np.testing.assert_array_equal(infos[5]["terminal_observation"]["obs"], last)
    np.testing.assert_array_equal(infos[4]["terminal_observation"]["team"][2], last)
    assert not is_vecenv_wrapped(PPO._wrap_env(env), VecTransposeImage)


def test_images_that_sb3_would_transpose_twice() -> None:
    # Fewer columns than channels: applying SB3's rule again after the transposition would transpose again.
    venv = TeamVenv(own_space=spaces.Box(0, 255, (9, 3, 5), np.uint8), see=bytes_of((9, 3, 5)))
    with pytest.warns(UserWarning, match="Treating image space as channels-last"):
        env = CentralizedValueWrapper(venv)
    np.testing.assert_array_equal(env.reset()["obs"][5], bytes_of((9, 3, 5))(1, 2, 0, 0).transpose(2, 0, 1))
    assert PPO._wrap_env(env) is env


def test_codes_are_no_image_even_if_they_look_like_one() -> None:
    see = bytes_of((9, 8, 3))
    env = CentralizedValueWrapper(TeamVenv(own_space=CodeSpace((9, 8, 3), 256), see=see))
    np.testing.assert_array_equal(env.reset()["obs"][5], see(1, 2, 0, 0))
    assert PPO._wrap_env(env) is env


def test_terminal_observation_is_the_rows_own_dict() -> None:
    venv = TeamVenv(lengths=(3, 2, 2))
    env = CentralizedValueWrapper(venv)
    env.reset()
    env.step(still(env))
    obs, _, dones, infos = env.step(still(env))
    assert dones.dtype == bool
    last = [[1, 0, 0, 2], [1, 1, 0, 2], [1, 2, 0, 2]]
    for agent in range(3):
        row = infos[3 + agent]["terminal_observation"]
        assert row["obs"].tolist() == last[agent]
        assert row["team"].tolist() == last
        assert row["agent"] == agent
        assert "terminal_observation" not in infos[agent]
        assert infos[6 + agent]["terminal_observation"]["obs"].tolist() == [2, agent, 0, 2], "game 2 ends, too"
    assert isinstance(obs, dict)
    assert obs["obs"][3].tolist() == [1, 0, 1, 0], "the next episode has begun"
    # The environment's infos are not changed.
    assert venv.infos[3]["terminal_observation"].tolist() == last[0]
    assert venv.infos[3]["TimeLimit.truncated"] is True


def test_a_time_limit_is_a_true_end_unless_told_otherwise() -> None:
    for time_limit, truncated in (("terminal", False), ("bootstrap", True)):
        env = CentralizedValueWrapper(TeamVenv(), time_limit=time_limit)  # type: ignore[arg-type]
        env.reset()
        env.step(still(env))
        *_, infos = env.step(still(env))
        assert [info.get("TimeLimit.truncated") for info in infos] == [None] * 3 + [truncated] * 3
    env = CentralizedValueWrapper(TeamVenv(truncate=False), time_limit="bootstrap")
    env.reset()
    env.step(still(env))
    assert env.step(still(env))[3][3]["TimeLimit.truncated"] is False


def test_ends_that_do_not_tell_whether_they_are_time_limits_are_named_once() -> None:
    class Silent(TeamVenv):
        def step_wait(self) -> VecEnvStepReturn:
            *rest, infos = super().step_wait()
            for info in infos:
                info.pop("TimeLimit.truncated", None)
            return (*rest, infos)  # type: ignore[return-value]

    for time_limit in ("terminal", "bootstrap"):
        env = CentralizedValueWrapper(Silent(lengths=(2, 2)), time_limit=time_limit)
        env.reset()
        env.step(still(env))
        if time_limit == "bootstrap":
            with pytest.warns(UserWarning, match="without 'TimeLimit.truncated'.* no value is added"):
                env.step(still(env))
        for _ in range(4):
            env.step(still(env))


def test_rows_say_where_episodes_begin_and_last_rows_which_row_they_are_of() -> None:
    env = CentralizedValueWrapper(TeamVenv(lengths=(3, 5, 7)))
    obs: Any = env.reset()
    for step in range(20):
        starts = [step % length == 0 for length in (3, 5, 7) for _ in range(3)]
        assert obs["episode_start"].tolist() == starts
        obs, _, dones, infos = env.step(still(env))
        for row in np.flatnonzero(dones):
            last = infos[row]["terminal_observation"]
            assert last["episode_start"] == 0 and last.row == row
    assert env.reset()["episode_start"].all()


def test_team_size_is_seen_through_further_wrappers() -> None:
    env: VecEnv = CentralizedValueWrapper(TeamMonitor(TeamVenv(lengths=(3, 2, 4))))
    for layer in (env, VecNormalize(env, norm_obs=False)):
        assert find_n_agents(layer) == 3
        assert (layer.n_agents, layer.n_games) == (3, 3)  # type: ignore[attr-defined]
        assert layer.has_attr("n_agents")
        assert layer.get_attr("n_agents", [0, 1]) == [3, 3]
    told = VecNormalize(CentralizedValueWrapper(TeamVenv(tell_size=False), n_agents=2), norm_obs=False)
    assert told.get_attr("n_agents") == [2] * 6 and told.get_attr("n_games") == [3] * 6


def team_space(team: tuple[int, ...] = (3, 4), agent: Any = None) -> spaces.Dict:
    agent = spaces.Discrete(3) if agent is None else agent
    return spaces.Dict({"obs": VECTOR, "team": spaces.Box(0, 1, team), "agent": agent})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CentralizedValueWrapper(TeamVenv(tell_size=False)), "attribute n_agents, .*n_agents=N"),
        (lambda: CentralizedValueWrapper(TeamVenv(tell_size=False), n_agents=4), "n_agents=4, got 6 rows"),
        (lambda: CentralizedValueWrapper(TeamVenv(), n_agents=2), "n_agents=2, .* teams of 3"),
        (lambda: CentralizedValueWrapper(TeamVenv(), n_agents=0), "n_agents .*got 0"),
        (lambda: CentralizedValueWrapper(TeamVenv(), time_limit=cast(Any, "truncate")), "time_limit .*got 'truncate'"),
        (lambda: CentralizedValueWrapper(CentralizedValueWrapper(TeamVenv())), "wrap it once"),
        (lambda: TeamSpaces(spaces.Dict({"a": VECTOR}), 2), "got Dict.* gymnasium.spaces.flatten"),
        (lambda: TeamSpaces.from_observation_space(VECTOR), r"got Box.*make_team_env\(...\).*n_agents=N"),
        (lambda: TeamSpaces.from_observation_space(team_space((2, 4))), r"'team' .*shape \(3, 4\) .*got Box"),
        (lambda: TeamSpaces.from_observation_space(team_space(agent=spaces.Discrete(3, start=1))), "'agent' .*start=1"),
    ],
)
def test_what_cannot_be_wrapped(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


class Broken(TeamVenv):
    """Teams with a fault that a test adds after a correct step."""

    def __init__(self, fault: Callable[[Broken], None], **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.fault = fault

    def step_wait(self) -> Any:
        _, rewards, dones, infos = super().step_wait()
        self.fault(self)
        return self.obs, rewards, dones, infos


def set_entry(name: str, index: Any, value: Any) -> Callable[[Broken], None]:
    def fault(venv: Broken) -> None:
        getattr(venv, name)[index] = value

    return fault


def last_view(value: Any) -> Callable[[Broken], None]:
    """Replace the last view of row 4, or remove it."""

    def fault(venv: Broken) -> None:
        if venv.dones[4]:
            venv.infos[4]["terminal_observation"] = None if value is None else np.array(value, dtype=np.float32)

    return fault


def step_twice(env: VecEnv) -> None:
    for _ in range(2):
        env.step(still(env))


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (set_entry("rewards", 4, np.nan), "rewards .* nan at step 1 for agent 1 of game 1"),
        (set_entry("rewards", slice(2, 5), -np.inf), r"-inf at step 1 for agent 2 of game 0 \(and 2 more rows\)"),
        (set_entry("obs", (5, 3), np.inf), "observations .* inf at step 1 for agent 2 of game 1"),
        (set_entry("dones", 1, 1), r"\[False, True, False\] for the agents of game 0.*n_agents and the order of rows"),
        (last_view(None), r"'terminal_observation'.* game 1, whose episode ended at step 2, got none for agents \[1\]"),
        (last_view([1, 1, np.nan, 2]), "terminal observations .* nan at step 2 for agent 1 of game 1"),
        (last_view([0, 0, 0]), "inhomogeneous shape"),
        (lambda venv: setattr(venv, "obs", venv.obs[:5]), r"shape \(6, 4\) and dtype float32 .*, got shape \(5, 4\)"),
        (lambda venv: setattr(venv, "obs", venv.obs.astype(np.complex64)), "float32 .* and dtype complex64"),
    ],
)
def test_silent_garbage_is_not_passed_on(fault: Callable[[Broken], None], message: str) -> None:
    env = CentralizedValueWrapper(Broken(fault))
    env.reset()
    with pytest.raises(ValueError, match=message):
        step_twice(env)


def test_numbers_of_a_larger_kind_are_cast_to_the_space() -> None:
    def wider(venv: Broken) -> None:
        venv.obs = venv.obs.astype(np.float64)

    env = CentralizedValueWrapper(Broken(wider))
    env.reset()
    obs = env.step(still(env))[0]
    assert isinstance(obs, dict)
    assert obs["obs"].dtype == obs["team"].dtype == np.float32


def test_agents_in_other_places_are_another_team() -> None:
    here = AgentSpace(3, ("a", "b", "c"))
    for names, is_equal in ((("a", "b", "c"), True), (("x", "y", "z"), True), (("a", "x", "c"), True), (None, True)):
        assert (here == AgentSpace(3, names)) == is_equal
    for names in (("b", "c", "a"), ("b", "c", "x")):
        assert here != AgentSpace(3, names)
