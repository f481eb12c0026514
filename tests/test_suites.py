"""Third-party suites: their declarations, their lookup, and the real games as rows of teams."""

from __future__ import annotations

import configparser
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.spaces import Discrete
from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO

from benchmarks.paper import fill
from benchmarks.suite_results import PAGE, RAW, TASKS, table
from sb3_saf import (
    RandomPolicy,
    SAFMaskablePolicy,
    TeamRolloutBuffer,
    evaluate_team,
    game_seeds,
    inspect_team,
    make_team_env,
    ppo_settings,
    resumable_learn,
)
from sb3_saf.envs.gymnasium_team import GymnasiumTeam
from sb3_saf.envs.monitor import SharedReward
from sb3_saf.networks.encoders import PaperCNN, PartsEncoder, PartsSpace
from sb3_saf.suites.__main__ import main
from sb3_saf.suites.meltingpot import MeltingPotTeam
from sb3_saf.suites.registry import Suite, TeamEnvironment, find_environment, references, standing, suites
from sb3_saf.training.settings import load_settings, saved_settings
from tests.test_resume import Lightning
from tests.toy_envs import CounterEnv

ROOT = Path(__file__).resolve().parents[1]


#: Suites whose games have hundreds of agents; a separate test makes them smaller.
_MANY_AGENTS = ("magent",)


def _examples() -> list[Any]:
    return [
        pytest.param(f"{suite.name}/{task}", marks=[needs(suite.name)])
        for suite in suites().values()
        for task in suite.examples
        if suite.name not in _MANY_AGENTS
    ]


def needs(name: str) -> pytest.MarkDecorator:
    problem = suites()[name].problem()
    return pytest.mark.skipif(problem is not None, reason=str(problem))


def _random_episodes(env_id: str, seed: int, n_steps: int = 12) -> list[Any]:
    """Return observations, rewards and dones of random actions in two games."""
    env = make_team_env(env_id, n_envs=2, seed=seed)
    policy = RandomPolicy(env, seed=1)
    obs: Any = env.reset()
    found: list[Any] = []
    for _ in range(n_steps):
        actions, _ = policy.predict(obs)
        obs, rewards, dones, _ = env.step(actions)
        found.append({**obs, "reward": rewards, "done": dones})
    env.close()
    return found


# --- declarations -----------------------------------------------------------------------------------------------------


PACKAGED = [suite for suite in suites().values() if suite.extra]


@pytest.mark.parametrize("suite", PACKAGED, ids=[suite.name for suite in PACKAGED])
def test_the_extra_of_a_suite_installs_what_it_requires(suite: Suite) -> None:
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg", encoding="utf-8")
    lines = config["options.extras_require"][suite.extra].strip().splitlines()
    assert [line for line in lines if not line.startswith("#")] == list(suite.requires)


@pytest.mark.parametrize("name", suites())
def test_the_page_of_suites_has_a_row_for_each(name: str) -> None:
    assert f"\n| `{name}/" in (ROOT / "docs" / "suites.md").read_text(encoding="utf-8")


def test_what_is_said_of_packages_that_are_missing_or_of_another_version() -> None:
    one: dict[str, Any] = {"title": "", "extra": "x", "page": "", "list_tasks": list, "examples": (), "game": print}
    assert Suite("x", requires=("no-such-package>=2",), **one).problem() == (
        "needs no-such-package, which is not installed: pip install 'sb3-saf[x]'"
    )
    old = Suite("x", requires=("gymnasium<0.1",), **one)
    assert f"works with gymnasium<0.1, got version {gym.__version__}: pip install 'gymnasium<0.1'" == old.problem()
    with pytest.raises(ValueError, match=r"x/\.\.\.: works with gymnasium<0.1"):
        old.find_task("y")
    assert "another version of Python" in str(Suite("x", requires=('a; python_version < "3"',), **one).problem())


def test_an_engine_that_does_not_take_a_parameter_says_so() -> None:
    def engine(task: str, n_envs: int, seed: int | None, *, size: int) -> None:
        raise AssertionError

    suite = Suite("x", title="", requires=(), extra="x", page="", list_tasks=list, examples=(), vec_env=engine)
    with pytest.raises(ValueError, match=r"x/y cannot be made with \{'colour': 1\}: .* 'colour'"):
        TeamEnvironment("x/y", None, suite, "y").count_agents({"colour": 1})


@needs("mpe")
def test_competitive_games_are_said_to_be_trained_as_one_team() -> None:
    with pytest.warns(UserWarning, match="simple_tag_v3 play against each other; .* one team"):
        make_team_env("mpe/simple_tag_v3")


def test_the_listing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    listed = capsys.readouterr().out
    for suite in suites().values():
        assert suite.title in listed
        problem = suite.problem()
        assert problem in listed if problem else f"{suite.name}/{suite.examples[0]}: " in listed
    for wrong, right in (("lbff", "lbf"), ("TeamSuport", "TeamSupport")):
        with pytest.raises(SystemExit, match="2"):
            main([wrong])
        assert f"did you mean '{right}'" in capsys.readouterr().err


def test_the_table_of_results_is_that_of_the_raw_data(tmp_path: Path) -> None:
    page, lines = PAGE.read_text(encoding="utf-8"), list(table(TASKS, RAW))
    assert fill(page, {"table": "\n".join(lines)}) == page
    assert len({line.count("|") for line in lines if line.startswith("|")}) == 1
    *_, missing = table(TASKS, tmp_path)
    assert all(f"`{task.game}` (" in missing for task in TASKS)
    assert {task.env_id.partition("/")[0] for task in TASKS} <= set(suites())
    assert "`mpe/simple_spread_v3` (-59.5 (1); -47.4 (2))" in missing
    assert "** | -59.5 (1); -47.4 (2) |" in page and "1. XuanCe's MAPPO (continuous actions) after 1,000,000" in page


# --- every task -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", _examples())
def test_a_task_is_trained_on_and_played(env_id: str) -> None:
    env = make_team_env(env_id, n_envs=2, seed=0)
    PPO("SAFPolicy", env, **ppo_settings(env, n_steps=8, n_epochs=1), seed=0).learn(8 * env.num_envs)
    assert env.observation_space.contains({key: value[0] for key, value in env.reset().items()})
    env.close()


@pytest.mark.parametrize("env_id", _examples())
def test_seeds_decide_what_happens(env_id: str) -> None:
    if env_id.startswith("meltingpot/"):
        pytest.skip("its engine takes no seed")
    first, again, other = (_random_episodes(env_id, seed) for seed in (3, 3, 4))
    for step, same in zip(first, again, strict=True):
        for key, value in step.items():
            np.testing.assert_array_equal(value, same[key], err_msg=key)
    assert any((step["obs"] != different["obs"]).any() for step, different in zip(first, other, strict=True))


@pytest.mark.parametrize(
    "env_id",
    [
        pytest.param("lbf/Foraging-5x5-2p-1f-v3", marks=needs("lbf")),
        pytest.param("jaxmarl/switch_riddle", marks=needs("jaxmarl")),
    ],
)
def test_a_struck_run_goes_on_bit_for_bit_and_its_team_is_inspected(env_id: str, tmp_path: Path) -> None:
    def learn(folder: str, at: int = -1) -> Any:
        env = make_team_env(env_id, n_envs=2, seed=5, monitor_dir=str(tmp_path / folder))
        kwargs: dict[str, Any] = {"n_steps": 8, "n_epochs": 2, "rollout_buffer_class": TeamRolloutBuffer}
        model = PPO("SAFPolicy", env, batch_size=8 * env.n_agents, seed=5, **kwargs)
        total = 48 * env.n_agents
        arguments: dict[str, Any] = {"every_game_steps": 1, "trust_games": True}
        return resumable_learn(model, total, tmp_path / folder, [Lightning(at)], **arguments)

    whole = learn("a")
    with pytest.raises(RuntimeError):
        learn("b", at=21)
    again = learn("b")
    for name, weights in whole.policy.state_dict().items():
        assert th.equal(weights, again.policy.state_dict()[name]), name
    assert (tmp_path / "a" / "monitor.csv").read_text().splitlines()[1:]

    look = inspect_team(whole, make_team_env(env_id, n_envs=2, seed=7), 2, pictures=False)
    assert look.scalars and np.isfinite([value for value in look.scalars.values() if value is not None]).all()


@needs("magent")
def test_groups_with_other_spaces_are_one_team() -> None:
    with pytest.warns(UserWarning, match="one team"):
        env = make_team_env("magent/tiger_deer_v4", n_envs=1, seed=0, state=True, map_size=14, max_cycles=30)
    assert env.team_spaces.own.shape == (9, 9, 5) and env.action_space == spaces.Discrete(9)
    policy = RandomPolicy(env, seed=0)
    rows: Any = env.reset()
    n_legal = rows["action_mask"].sum(axis=1).tolist()
    assert set(n_legal) == {5, 9} and rows["state"].shape[1:] == (14, 14, 5)
    for _ in range(30):
        rows, *_ = env.step(policy.predict(rows)[0])
    assert rows["action_mask"].sum(axis=1).tolist() == n_legal


def test_an_engine_makes_no_single_games_to_wrap() -> None:
    with pytest.raises(ValueError, match=r"engine/task .* vec_env_wrapper"):
        TeamEnvironment("engine/task", None).make_game({})


# --- custom suites ----------------------------------------------------------------------------------------------------


class PickUp(gym.Env[Any, Any]):
    """Two agents, lists of observations, masks; episodes are truncated unless both choose 1."""

    observation_space = spaces.Tuple([spaces.Box(0, 9, (2,))] * 2)
    action_space = spaces.Tuple([spaces.Discrete(3)] * 2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.count = 0
        return self._seen()

    def step(self, actions: Any) -> Any:
        self.count += 1
        self.done = list(actions) == [1, 1]
        observations, info = self._seen()
        return observations, [1.0, 2.0], self.done or self.count == 3, False, info

    def _seen(self) -> Any:
        seen = np.array([self.count, 0], dtype=np.float32)
        return (seen, seen + 1), {"action_mask": [[1, 1, 0], [0, 1, 1]]}


def test_a_gymnasium_environment_of_several_agents_is_taken_as_it_is() -> None:
    env = make_team_env(PickUp(), n_envs=2, seed=0)
    obs = env.reset()
    assert obs["action_mask"].tolist() == [[1, 1, 0], [0, 1, 1]] * 2
    _, rewards, dones, _ = env.step(np.array([1, 1, 0, 1]))
    assert rewards.tolist() == [1, 2, 1, 2] and dones.tolist() == [True, True, False, False]
    with pytest.raises(ValueError, match=r"Tuples with one entry per agent.*for one agent use Stable-Baselines3"):
        GymnasiumTeam(gym.make("CartPole-v1"))


@needs("lbf")
def test_wrapped_games_keep_the_settings_of_their_suite() -> None:
    wrapped = {"env_wrapper": [{"supersuit.dtype_v0": {"dtype": "float64"}}]}
    for overrides in ({}, wrapped):
        env = load_settings("mappo", "lbf/Foraging-8x8-2p-3f-v3", "smoke", overrides=overrides).make_env(0)
        assert isinstance(env.venv, SharedReward), "agents share the reward of LBF"
        env.close()


@needs("lbf")
def test_wrapped_games_are_not_compared_with_published_results() -> None:
    """Wrappers may change rewards, which are then those of the returns."""
    for overrides, is_known in (({}, True), ({"env_wrapper": "supersuit.clip_reward_v0"}, False)):
        settings = load_settings("mappo", "lbf/Foraging-8x8-2p-3f-v3", "smoke", overrides=overrides)
        assert (settings.standing({"return": 0.5}, 1000) is not None) == is_known


@needs("lbf")
def test_foraging_ends_by_its_time_limit_unless_all_food_is_collected() -> None:
    env: Any = find_environment("lbf/Foraging-8x8-2p-3f-v3").make_game({"max_episode_steps": 60})
    env.reset(seed=0)
    for _ in range(60):
        assert env.agents, "the game's 50 steps are no limit if others are given"
        *_, terminations, truncations, infos = env.step(dict.fromkeys(env.possible_agents, 0))
    assert set(terminations.values()) == {False} and set(truncations.values()) == {True} and not env.agents
    assert infos["agent_0"]["is_success"] is False
    env.reset(seed=0)
    env.unwrapped.env.unwrapped.field[:] = 0
    *_, terminations, truncations, infos = env.step(dict.fromkeys(env.possible_agents, 0))
    assert set(terminations.values()) == {True} and set(truncations.values()) == {False}
    assert infos["agent_0"]["is_success"] is True


@needs("mpe")
def test_agents_with_other_spaces_are_padded_and_masked() -> None:
    task = "mpe/simple_speaker_listener_v4"
    env = make_team_env(task, n_envs=2, seed=0)
    rows: Any = env.reset()
    own, _ = find_environment(task).make_game({}).reset(seed=game_seeds(0, 1)[0])
    for row, (agent, n_actions) in enumerate({"speaker_0": 3, "listener_0": 5}.items()):
        np.testing.assert_array_equal(rows["obs"][row], np.pad(own[agent], (0, 11 - len(own[agent]))))
        assert rows["action_mask"][row].tolist() == [1] * n_actions + [0] * (5 - n_actions)
    with pytest.raises(ValueError, match=r"Discrete\(3\), got \[4\], which is masked"):
        env.step(np.array([4, 0, 0, 0]))
    evaluate_team(RandomPolicy(env, seed=0), env, 4)  # would raise at a masked action


def test_rewards_are_shared_and_returns_stay_in_the_unit_of_the_games() -> None:
    """PickUp gives 1 and 2 at every step, for 3 steps unless both agents choose 1."""
    found = {}
    for team_reward in ("given", "sum", "mean"):
        env = make_team_env(PickUp, n_envs=1, seed=0, team_reward=team_reward)
        env.reset()
        steps = [env.step(np.array([0, 1])) for _ in range(3)]
        found[team_reward] = (steps[0][1].tolist(), steps[2][3][0]["episode"]["r"])
    assert found == {"given": ([1, 2], 9), "sum": ([3, 3], 9), "mean": ([1.5, 1.5], 9)}
    with pytest.raises(ValueError, match="team_reward must be one of 'given', 'sum', 'mean', got 'max'"):
        make_team_env(PickUp, team_reward="max")  # type: ignore[arg-type]


class PictureEnv(CounterEnv):
    """Agents see an image of their index, and the step as two numbers."""

    def _make_observation_space(self) -> spaces.Space[Any]:
        return spaces.Dict(
            RGB=spaces.Box(0, 255, (12, 14, 3), np.uint8), ready=spaces.Box(0, 99, (), np.float64), left=Discrete(4)
        )

    def _observation(self, index: int, draw: np.float32) -> Any:
        return {"RGB": np.full((12, 14, 3), 10 * index, np.uint8), "ready": np.float64(self.steps), "left": 3}


class SpritesEnv(CounterEnv):
    """Agents see a picture of 3 x 2 sprites with 8 x 8 random pixels each, and what all are paid."""

    def _make_observation_space(self) -> spaces.Space[Any]:
        return spaces.Dict(RGB=spaces.Box(0, 255, (24, 16, 3), np.uint8), COLLECTIVE_REWARD=spaces.Box(0, 1))

    def _observation(self, index: int, draw: np.float32) -> Any:
        pixels = np.random.default_rng(index).integers(0, 256, (24, 16, 3), np.uint8)
        return {"RGB": pixels, "COLLECTIVE_REWARD": np.zeros(1, np.float32)}

    def observation_spec(self) -> Any:
        """Return a substrate's description of what each player and the world show."""
        return [{"WORLD.RGB": np.zeros((24, 16, 3))}]


@pytest.mark.parametrize("pixels", [1, 2, 4, 8])
def test_sprites_of_melting_pot_are_averaged(pixels: int) -> None:
    env = SpritesEnv()
    team = MeltingPotTeam(env, env, pixels_per_sprite=pixels)
    observations, _ = team.reset(seed=0)
    block = 8 // pixels
    for index, agent in enumerate(env.possible_agents):
        assert observations[agent] in team.observation_space(agent) and list(observations[agent]) == ["RGB"]
        picture = np.asarray(env._observation(index, np.float32(0))["RGB"])
        blocks = picture.reshape(3 * pixels, block, 2 * pixels, block, 3)
        np.testing.assert_array_equal(observations[agent]["RGB"], np.floor(blocks.mean(axis=(1, 3))))


def test_pictures_beside_numbers_are_encoded_each_in_their_way(tmp_path: Path) -> None:
    env = make_team_env(PictureEnv, n_envs=2, seed=0)
    rows = env.reset()["obs"]
    assert rows.shape == (4, 12 * 14 * 3 + 1 + 4) and rows.dtype == np.float32
    own = env.team_spaces.own
    assert isinstance(own, PartsSpace) and [part[:2] for part in own.pictures] == [(0, 504)]
    assert own.pictures[0].space.shape == (12, 14, 3)
    assert rows[1, 504:].tolist() == [0, 0, 0, 0, 1]
    assert (rows[:, :504] == np.array([0, 10, 0, 10])[:, np.newaxis]).all()
    model = PPO("SAFPolicy", env, n_steps=8, batch_size=32, n_epochs=1, seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.learn(32)
    encoder: Any = model.policy.features_extractor.encoder
    assert isinstance(encoder, PartsEncoder) and isinstance(encoder.pictures[0], PaperCNN)
    assert encoder.rest is not None
    with th.no_grad():
        picture = encoder.pictures[0](th.as_tensor(rows[:, :504]).reshape(-1, 12, 14, 3) / 255)
        expected = encoder.join(th.cat([picture, encoder.rest(th.as_tensor(rows[:, 504:]))], dim=1))
        th.testing.assert_close(encoder(th.as_tensor(rows)), expected)
    model.save(tmp_path / "model.zip")
    loaded = PPO.load(tmp_path / "model.zip", env=env)
    np.testing.assert_array_equal(
        loaded.predict(env.reset(), deterministic=True)[0], model.predict(env.reset(), deterministic=True)[0]
    )
    with pytest.raises(ValueError, match="expected pictures beside vectors in one PartsSpace"):
        PartsEncoder(spaces.Box(0, 1, (3,)))


def test_settings_name_reward_state_and_algorithm() -> None:
    given = {"algorithm": "MaskablePPO", "team_reward": "sum", "state": True}
    settings = load_settings("saf", "tests.toy_envs:TellingEnv", "smoke", overrides=given)
    assert saved_settings(settings.as_dict()) == settings
    env = settings.make_env(0)
    assert env.team_spaces.state is not None and isinstance(env.venv, SharedReward)
    model = settings.make_model(env, 0)
    assert isinstance(model, MaskablePPO) and isinstance(model.policy, SAFMaskablePolicy)
    with pytest.raises(ValueError, match="unknown algorithm that trains QPLEXPolicy 'MaskablePPO'; there is QPLEX"):
        load_settings("qplex", "tests.toy_envs:TellingEnv", "smoke", overrides={"algorithm": "MaskablePPO"})


def test_masks_that_nobody_asks_for_are_told_of_once() -> None:
    def step_twice(env: Any) -> None:
        env.reset()
        for _ in range(2):
            env.step(np.ones(env.num_envs, dtype=int))

    with pytest.warns(UserWarning, match=r'MaskablePPO\("SAFPolicy", env\)') as told:
        step_twice(make_team_env(CounterEnv))
    assert len(told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make_team_env(CounterEnv)
        env.reset()
        env.env_method("action_masks")
        step_twice(env)
        step_twice(make_team_env(PickUp))


def test_the_tasks_of_hecogrid_are_a_suite_and_have_short_names() -> None:
    for name in ("TeamSupport", "TeamSupport-v0", "hecogrid/TeamSupport", "hecogrid/TeamSupport-v0"):
        environment = find_environment(name)
        assert (environment.id, environment.folder_name) == ("TeamSupport-v0", "TeamSupport-v0")
        assert environment.suite is suites()["hecogrid"] and environment.task == "TeamSupport-v0"


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("TeemSupport", "'TeamSupport'"),
        ("lfb/Foraging-8x8-2p-3f-v3", "'lbf/Foraging-8x8-2p-3f-v3'"),
        ("lbf/Foraging-8x8-2p-3f", "lbf/Foraging-8x8-2p-3f-v3"),
        ("simple_spread", "'mpe/simple_spread_v3'"),
        ("hecogrid/TeamSuport", "hecogrid/TeamSupport-v0"),
    ],
)
def test_an_unknown_name_lists_the_nearest(name: str, nearest: str) -> None:
    with pytest.raises(ValueError, match=f"unknown .*{name}.*did you mean.* {nearest}"):
        make_team_env(name)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nowhere.game", "cannot import 'nowhere.game' .* set PYTHONPATH"),
        (
            "tests.toy_envs:CounterEnw",
            "expected a function or class, got tests.toy_envs.CounterEnw = None .did you mean 'CounterEnv'",
        ),
        ("tests.test_other_games:Nim", "got a function that returned the AECEnv .*; convert it with"),
        ("tests.toy_envs", "parallel_env = None; where agents take turns, name a function .*TurnsInParallel"),
    ],
)
def test_a_game_that_cannot_be_made_says_why(name: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make_team_env(name)


def test_a_result_stands_beside_what_is_known_of_its_task() -> None:
    spread = find_environment("mpe/simple_spread_v3")
    assert {one.task for one in references(spread)} == {"mpe/simple_spread_v3"}
    place = standing(spread, {}, {"return": -64.1}, 1_000_000)
    assert place is not None and place.share == pytest.approx((78.9 - 64.1) / (78.9 - 47.4))
    for words in ("sum over agents: -64.1", "random -78.9", "XuanCe's VDAC -47.4 after 1,000,000", "47%"):
        assert words in place.text
    early = standing(spread, {}, {"return": -80.0}, 90_000)
    assert early is not None and "-73 after 100,000" in early.text and early.text.endswith("below random")
    # Games of another length, or scores in another unit, are never compared.
    assert standing(spread, {"max_cycles": 50}, {"return": -64.1}, 1_000_000) is None
    assert standing(spread, {}, {"won": 0.5}, 1_000_000) is None
    battle = standing(TeamEnvironment("smax/3s_vs_5z", None), {}, {"won": 0.9}, 10_000_000)
    assert battle is not None and "JaxMARL's IPPO with memory 60 % won" in battle.text, "not our own, as long"
    level = load_settings("saf", "TeamSupport-v0", "small", env_kwargs={"coordination": 2}).env_kwargs
    assert len(references(find_environment("TeamSupport"), level)) == 2
    assert not references(find_environment("TeamSupport"), {**level, "heterogeneity": 2})


def test_known_results_of_a_task_are_printed_also_without_its_package(capsys: pytest.CaptureFixture[str]) -> None:
    for name, words in (
        ("smax/2s3z", "JaxMARL's MAPPO with memory 100 % won after 10,000,000 game steps: its report"),
        ("TeamSupport", "random 1.38, coordination 2, n_agents 5"),
    ):
        assert main([name]) == 0 and words in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["smax2/2s3z"])
    assert "smax2/2s3z" in capsys.readouterr().err
