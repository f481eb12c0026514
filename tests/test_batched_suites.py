"""Suites whose engines step all games at once, compared with the engines stepped game by game."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch as th
from gymnasium import spaces

from sb3_saf import CentralizedValueWrapper, MLPEncoder, evaluate_team, game_seeds, make_team_env, ppo_settings
from sb3_saf.checkpoints.states import environment_state, load_environment_state
from sb3_saf.inspection.recording import picture
from sb3_saf.suites.engines.batch import Batch, BatchStep, BatchVecEnv
from sb3_saf.suites.registry import find_environment
from sb3_saf.teams.files import decode, encode
from sb3_saf.teams.rows import TeamSpaces
from sb3_saf.training.settings import load_settings
from sb3_saf.training.yaml_files import Size
from tests.test_suites import needs

Array = npt.NDArray[Any]


needs_jaxmarl, needs_vmas = needs("jaxmarl"), needs("vmas")


def rows_of(env_id: str, n_envs: int, seed: int = 0, **params: Any) -> Any:
    """Create the VecEnv of a task, without the wrappers of ``make_team_env``."""
    one = find_environment(env_id)
    assert one.suite is not None and one.suite.vec_env is not None
    return one.suite.vec_env(one.task, n_envs, seed, **params)


def legal_actions(observations: dict[str, Array], rng: np.random.Generator, n_actions: int) -> Array:
    masks = observations.get("action_mask", np.ones((len(observations["active"]), n_actions)))
    return np.asarray((rng.random(masks.shape) * masks).argmax(axis=1))


# --- every engine -----------------------------------------------------------------------------------------------------


class Still(Batch):
    """Three games of two agents in which nothing happens; the picture of a game has its number in each pixel."""

    def __init__(self) -> None:
        super().__init__(3, ("a", "b"), TeamSpaces(spaces.Box(0, 1, (1,), np.float32), 2), spaces.Discrete(2))

    def reset(self, seeds: Any) -> dict[str, Array]:
        return {"obs": np.zeros((6, 1), dtype=np.float32)}

    def step(self, actions: Array) -> BatchStep:
        rows, ended = self.reset(None), np.zeros(3, dtype=bool)
        return BatchStep(rows, np.zeros((3, 2), dtype=np.float32), ended, ended, rows)

    def picture(self, game: int) -> npt.NDArray[np.uint8]:
        return np.full((4, 4, 3), game, dtype=np.uint8)


def test_games_without_objects_are_drawn_by_row() -> None:
    """As ``enjoy`` and ``replay`` do."""
    env = CentralizedValueWrapper(BatchVecEnv(Still(), render_mode="rgb_array"))
    assert [frame.max() for frame in env.env_method("render")] == [0, 0, 1, 1, 2, 2]
    assert picture(env.env_method("render", indices=[0])[0]).shape == (4, 4, 3)
    with pytest.raises(AttributeError, match="share one engine"):
        env.env_method("close")


# --- JaxMARL ----------------------------------------------------------------------------------------------------------


@needs_jaxmarl
def test_games_of_an_engine_cannot_be_wrapped_one_by_one() -> None:
    settings = load_settings("mappo", "smax/3m", "smoke", overrides={"env_wrapper": "supersuit.dtype_v0"})
    with pytest.raises(ValueError, match=r"has an engine only, .*: use vec_env_wrapper"):
        settings.make_env(0)


@needs_jaxmarl
def test_rows_are_the_games_of_jaxmarl_one_by_one() -> None:
    """Padded observations, last observations, masks, random streams per game; a listener and a speaker."""
    import jax

    venv = rows_of("jaxmarl/MPE_simple_speaker_listener_v4", 2, seed=7, max_steps=3)  # 4 steps: it counts from 0
    env = venv.batch.env
    reset, step = jax.jit(env.reset), jax.jit(env.step_env)
    keys = [np.array(divmod(seed, 2**32), dtype=np.uint32) for seed in game_seeds(7, 2)]
    rng = np.random.default_rng(0)
    rows: dict[str, Array] = venv.reset()
    states: list[Any] = [None, None]

    def check(seen: Array, game: int, own: Any) -> None:
        for i, agent in enumerate(env.agents):
            size = len(own[agent])
            np.testing.assert_allclose(seen[2 * game + i, :size], own[agent], rtol=1e-6, atol=1e-6)
            assert not seen[2 * game + i, size:].any()

    for t in range(9):
        for game in range(2):
            if t % 4 == 0:
                keys[game], now = np.asarray(jax.random.split(keys[game]))
                own, states[game] = reset(now)
                check(rows["obs"], game, own)
        n_actions = [int(env.action_space(agent).n) for agent in env.agents]
        assert rows["action_mask"].sum(axis=1).tolist() == n_actions * 2
        actions = legal_actions(rows, rng, 5)
        rows, rewards, dones, infos = venv.step(actions)
        for game in range(2):
            keys[game], now = np.asarray(jax.random.split(keys[game]))
            chosen = dict(zip(env.agents, actions[2 * game : 2 * game + 2].tolist(), strict=True))
            own, states[game], own_rewards, _, _ = step(now, states[game], chosen)
            np.testing.assert_allclose(
                rewards[2 * game : 2 * game + 2], [own_rewards[agent] for agent in env.agents], rtol=1e-5
            )
            if (t + 1) % 4:
                check(rows["obs"], game, own)
            else:
                last = [info["terminal_observation"] for info in infos]
                check(np.stack([one["obs"] for one in last]), game, own)
                assert all(one["active"] == 1 for one in last), "something would have followed"
        assert dones.all() == (t % 4 == 3) and all(info.get("TimeLimit.truncated", True) for info in infos)


@needs_jaxmarl
def test_games_do_not_depend_on_their_number_and_actions_are_checked() -> None:
    few, many = (rows_of("jaxmarl/switch_riddle", n, seed=3) for n in (2, 5))
    first, all_of_them = few.reset(), many.reset()
    rng = np.random.default_rng(1)
    for _ in range(12):
        np.testing.assert_array_equal(first["obs"], all_of_them["obs"][:6])
        actions = rng.integers(0, 3, 15)
        first, *_ = few.step(actions[:6])
        all_of_them, *_ = many.step(actions)
    assert few.seeded_with == many.seeded_with[:2]
    with pytest.raises(ValueError, match=r"expected actions from Discrete\(3\), got 3 in row 4 \(game 1, agent_1\)"):
        few.step(np.array([0, 0, 0, 0, 3, 0]))
    few.set_options({"layout": 1})
    with pytest.raises(ValueError, match="no options"):
        few.reset()


@needs_jaxmarl
def test_an_end_is_no_time_limit() -> None:
    """Telling in the riddle terminates it; its observations are then not bootstrapped."""
    venv = rows_of("jaxmarl/switch_riddle", 2, seed=3)
    venv.reset()
    tell = np.tile([2, 2, 2], 2)
    for _ in range(6):
        _, _, dones, infos = venv.step(tell)
        if dones[0]:
            break
    assert dones[0] and infos[0]["TimeLimit.truncated"] is False and infos[0]["terminal_observation"]["active"] == 0
    venv.reset()
    for day in range(1, 7):  # told on the last of six days
        _, rewards, dones, infos = venv.step(tell if day == 6 else np.zeros(6, dtype=np.int64))
    assert dones.all() and rewards.all() and infos[0]["TimeLimit.truncated"] is False


@needs_jaxmarl
def test_moves_of_hanabi_are_masked() -> None:
    """Its method is called otherwise than those of other games."""
    venv = rows_of("jaxmarl/hanabi", 4, seed=0)
    rows, rng = venv.reset(), np.random.default_rng(0)
    for _ in range(30):
        masks = rows["action_mask"]
        assert 0 < masks.sum() < masks.size and (masks.sum(axis=1).reshape(-1, 2).min(axis=1) == 1).all()  # one waits
        rows, *_ = venv.step(np.array([rng.choice(np.flatnonzero(mask)) for mask in masks]))


@needs_jaxmarl
def test_shaped_rewards_have_their_first_weight_after_new_seeds() -> None:
    venv = rows_of("overcooked/cramped_room", 4, seed=0, max_steps=10, reward_shaping=1.0, reward_shaping_steps=40)
    venv.reset()
    for _ in range(10):
        venv.step(np.zeros(8, dtype=np.int64))
    assert venv.checkpoint_state()["games"]["n_steps"] == 40
    venv.seed(1)
    venv.reset()
    assert venv.checkpoint_state()["games"]["n_steps"] == 0


@needs_jaxmarl
def test_battles_of_smax() -> None:
    """Dead agents are rewarded but cannot act; masks are JaxMARL's; the critic reads the state; wins are reported."""
    import jax

    env = make_team_env("smax/3m", n_envs=2, seed=0, state=True)
    venv: Any = env.unwrapped
    observations: Any = env.reset()
    assert observations["state"].shape == (6, 72)
    assert "active" not in observations
    n_dead, won = 0, []
    for _ in range(120):  # allies approach the enemy, and all shoot at the same one
        legal = observations["action_mask"]
        ahead = np.where(legal[:, 1], 1, 4)  # the dead stand still
        observations, rewards, dones, infos = env.step(
            np.where(legal[:, 5:].any(axis=1), 5 + legal[:, 5:].argmax(axis=1), ahead)
        )
        game = jax.tree.map(lambda leaf: leaf[1], venv.batch.games)
        alive = np.asarray(game.state.state.unit_alive[:3])
        assert rewards[3] == rewards[4] == rewards[5]
        n_dead += int((~alive).sum())
        legal = venv.batch.env.get_avail_actions(game.state)
        for i in range(3):
            np.testing.assert_array_equal(observations["action_mask"][3 + i], legal[f"ally_{i}"])
            assert alive[i] or observations["action_mask"][3 + i].tolist() == [0, 0, 0, 0, 1, 0, 0, 0]
        for first in np.flatnonzero(dones)[::3].tolist():
            won.append(infos[first]["is_success"])
            assert won[-1] == (rewards[first] >= 1), "the bonus of a victory is 1"
            assert infos[first]["TimeLimit.truncated"] is False and "is_success" not in infos[first + 1]
    assert n_dead and set(won) == {False, True}
    env.close()


@needs_jaxmarl
def test_the_kitchen() -> None:
    """Observations are flags and counts; shaped rewards (3 for an onion in the pot) have a decreasing weight."""
    shaped: dict[str, Any] = {"reward_shaping": 2.0, "reward_shaping_steps": 30}
    venv = rows_of("overcooked/cramped_room", 3, max_steps=11, **shaped)
    rows = venv.reset()
    assert rows["obs"].dtype == np.float32 and rows["obs"].shape == (6, 520)
    assert isinstance(venv.observation_space, spaces.Dict)
    encoder = MLPEncoder(venv.observation_space["obs"])
    assert not encoder.is_scaled, "flags and counts in bytes are no pictures: divided by 255, nothing is learned"
    gained = []
    left, right, up, interact = 3, 2, 0, 5
    for action in (left, interact, right, up, interact, left, left, interact, right, up, interact):
        _, rewards, dones, infos = venv.step(np.array([action, 4] * 3))
        gained.append(rewards.reshape(3, 2)[2].tolist())
    np.testing.assert_allclose(gained[4], [3 * 2 * (1 - 12 / 30), 0], rtol=1e-6)
    assert np.count_nonzero(gained) == 1, "the second onion comes when the weight is gone"
    assert dones.all() and infos[0]["TimeLimit.truncated"] is True
    with pytest.raises(ValueError, match="MPE_simple_spread_v3 has no rewards for steps on the way"):
        rows_of("jaxmarl/MPE_simple_spread_v3", 1, reward_shaping=1.0)
    plain = rows_of("overcooked/cramped_room", 1)
    assert plain.settings() != rows_of("overcooked/cramped_room", 1, **shaped).settings()


@needs_jaxmarl
def test_parameters_that_particles_do_not_know_are_named() -> None:
    with pytest.raises(ValueError, match=r"has no parameters \['max_cycles', 'n_agents'\]; its number of agents is"):
        rows_of("jaxmarl/MPE_simple_spread_v3", 1, n_agents=5, max_cycles=50)
    known: dict[str, Any] = {
        "num_agents": 4,
        "num_landmarks": 4,
        "max_steps": 2,
        "action_type": "Discrete",
        "damping": 0.5,
    }
    assert rows_of("jaxmarl/MPE_simple_spread_v3", 1, **known).num_envs == 4


@needs_jaxmarl
@pytest.mark.parametrize("env_id", ["overcooked/cramped_room", "jaxmarl/overcooked"])
def test_soups_alone_are_evaluated(env_id: str) -> None:
    """A cook puts onions into the pot, which is rewarded only in training: 3 for each, with this weight."""
    shaped = {"reward_shaping": 1.0, "reward_shaping_steps": 1_000_000, "max_steps": 11}
    settings = load_settings("ippo", env_id, "smoke", env_kwargs=shaped)
    left, right, up, interact = 3, 2, 0, 5
    gained = []
    for evaluation in (False, True):
        env = settings.make_env(0, evaluation=evaluation, n_envs=2)
        env.reset()
        steps = [env.step(np.array([action, 4] * 2))[1] for action in (left, interact, right, up, interact)]
        gained.append(np.sum(steps, axis=0))
        assert env.step(np.array([4, 4] * 2))[2].tolist() == [False] * 4, "max_steps holds for both"
    np.testing.assert_allclose(gained, [[3, 0, 3, 0], [0, 0, 0, 0]], rtol=1e-4)


@needs_jaxmarl
def test_arguments_are_those_of_the_moment() -> None:
    """A list that is changed after a game was made with it makes another game."""
    payoffs, actions = [[1, 1, -2], [1, 1, -2]], np.random.default_rng(0).integers(0, 5, (40, 4))
    paid = []
    for penalty in (-2, -50):
        payoffs[0][2] = payoffs[1][2] = penalty
        venv = rows_of("jaxmarl/coin_game", 2, payoff_matrix=payoffs)
        venv.reset()
        paid.append(np.min([venv.step(row)[1].min() for row in actions]))
    assert paid[0] >= -2 and paid[1] <= -49
    with pytest.raises(ValueError, match="reward_shaping_steps must be at least 1, got 0"):
        make_team_env("overcooked/cramped_room", 2, reward_shaping=1.0, reward_shaping_steps=0)
    with pytest.raises(ValueError, match="expected no layout, which the task's name sets; choose another task"):
        make_team_env("overcooked/cramped_room", layout="coord_ring")


@needs_jaxmarl
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("env_id", "size", "least"),
    [
        ("overcooked/cramped_room", "medium", 50),
        ("smax/3m", "small", 0.8),
        ("jaxmarl/MPE_simple_speaker_listener_v4", "small", -60),
    ],
)
def test_teams_learn(env_id: str, size: Size, least: float) -> None:
    """MAPPO in 100,000 game steps, far from a random team's 0.8, 0.2 and -96 and from what three seeds reach."""
    settings = load_settings("mappo", env_id, size)
    model = settings.make_model(settings.make_env(0), 0).learn(100_000 * settings.n_agents)
    games = settings.make_env(1, evaluation=True)
    returns = evaluate_team(model, games, n_eval_episodes=64, deterministic=False).returns
    assert np.mean(returns) > least


@needs_jaxmarl
def test_states_of_games_are_plain_data_and_checked() -> None:
    env, other = (make_team_env("overcooked/cramped_room", n_envs=3, seed=seed, max_steps=40) for seed in (0, 1))
    env.reset()
    rng = np.random.default_rng(0)
    for _ in range(50):
        env.step(rng.integers(0, 6, 6))
    states = decode(encode(environment_state(env)))
    load_environment_state(other, states)
    for _ in range(45):
        actions = rng.integers(0, 6, 6)
        for ours, theirs in zip(env.step(actions)[:3], other.step(actions)[:3], strict=True):
            np.testing.assert_equal(ours, theirs)
    states[-1]["games"]["n_steps"] = np.zeros(2)
    with pytest.raises(ValueError, match=r"\['n_steps'\] of shape"):
        load_environment_state(other, states)


@needs_jaxmarl
@pytest.mark.parametrize("env_id", ["smax/3m", "overcooked/cramped_room", "jaxmarl/MPE_simple_spread_v3"])
def test_pictures_are_those_of_the_suite(env_id: str) -> None:
    venv = rows_of(env_id, 2, render_mode="rgb_array")
    venv.reset()
    first, *_, last = venv.get_images()
    assert first.dtype == np.uint8 and first.ndim == 3 and first.shape[2] == 3
    assert (first != last).any(), "games differ"


# --- VMAS -------------------------------------------------------------------------------------------------------------


@needs_vmas
@pytest.mark.parametrize("continuous", [True, False])
def test_rows_are_those_of_vmas_and_draw_from_a_stream_of_their_own(continuous: bool) -> None:
    import vmas

    venv = rows_of("vmas/balance", 3, seed=2, max_steps=4, continuous_actions=continuous)
    seed = game_seeds(2, 3)[0] % 2**32
    make: Any = vmas.make_env
    engine = make("balance", 3, max_steps=4, continuous_actions=continuous, seed=seed, terminated_truncated=True)
    before = th.get_rng_state()
    rows = venv.reset()
    own = engine.reset(seed=seed)
    rng = np.random.default_rng(0)
    for _ in range(9):
        np.testing.assert_array_equal(rows["obs"].reshape(3, 3, -1), np.stack([one.numpy() for one in own], axis=1))
        shape = (9, 2) if continuous else (9,)
        actions = rng.uniform(-1, 1, shape).astype(np.float32) if continuous else rng.integers(0, 9, shape)
        by_agent = [th.from_numpy(actions.reshape(3, 3, *shape[1:])[:, i].copy()) for i in range(3)]
        own, own_rewards, terminated, truncated, _ = engine.step(by_agent)
        ended = (terminated | truncated).numpy()
        last = np.stack([one.numpy() for one in own], axis=1)
        rows, rewards, dones, infos = venv.step(actions)
        np.testing.assert_array_equal(rewards.reshape(3, 3), np.stack([one.numpy() for one in own_rewards], axis=1))
        np.testing.assert_array_equal(dones[::3], ended)
        for game in np.flatnonzero(ended):
            info = infos[3 * game + 1]
            np.testing.assert_array_equal(info["terminal_observation"]["obs"], last[game, 1])
            assert info["TimeLimit.truncated"] == bool(truncated[game] & ~terminated[game])
        if ended.any():
            venv.seed(2)  # VMAS's own resets continue one common random state, so seed again
            rows, own = venv.reset(), engine.reset(seed=seed)
    assert th.equal(before, th.get_rng_state()), "nothing is drawn from the caller's stream"


@needs_vmas
def test_what_others_draw_changes_nothing_in_vmas() -> None:
    alone, disturbed = (rows_of("vmas/balance", 3, seed=2, max_steps=4) for _ in range(2))
    still = np.zeros((9, 2), dtype=np.float32)
    found: list[list[Array]] = []
    for venv, others in ((alone, None), (disturbed, rows_of("vmas/balance", 2, seed=9, max_steps=3))):
        venv.reset()
        if others is not None:
            others.reset()
        found.append([])
        for _ in range(12):
            if others is not None:
                others.step(still[:6])
            found[-1].append(venv.step(still)[0]["obs"])
    np.testing.assert_array_equal(found[0], found[1])


@needs_vmas
def test_games_of_vmas_begin_again_one_by_one() -> None:
    venv = rows_of("vmas/balance", 6, seed=1)
    rows = venv.reset()
    ends: list[tuple[int, bool]] = []
    for t in range(100):
        last = rows
        rows, _, dones, infos = venv.step(np.full((18, 2), -1, dtype=np.float32))
        for game in np.flatnonzero(dones[::3]).tolist():
            ends.append((t, infos[3 * game]["TimeLimit.truncated"]))
            assert (rows["obs"][3 * game] != infos[3 * game]["terminal_observation"]["obs"]).any()
        going = ~dones
        if dones.any() and going.any():
            change = np.abs(rows["obs"][going] - last["obs"][going])[:, :-1]  # the last is an angle, which may wrap
            assert change.max() < 0.5, "others go on"
    assert any(t < 99 and not truncated for t, truncated in ends)
    venv = rows_of("vmas/multi_give_way", 1, seed=1)  # BenchMARL's time limit is not 100 everywhere
    venv.reset()
    still = np.zeros((venv.num_envs, 2), dtype=np.float32)
    assert [venv.step(still)[2].all() for _ in range(200)].index(True) == 199


@needs_vmas
def test_agents_of_vmas_with_other_spaces() -> None:
    env = make_team_env("vmas/simple_speaker_listener", n_envs=2, seed=0, continuous_actions=False)
    observations = env.reset()
    assert observations["action_mask"].sum(axis=1).tolist() != [observations["action_mask"].shape[1]] * 4
    env.step(legal_actions(observations, np.random.default_rng(0), 1))
    for params, words in (
        ({"max_steps": -1}, "max_steps must be at least 1, got -1"),
        ({"dict_spaces": True, "wrapper": "gym"}, "has dict_spaces, wrapper as rows need it; leave it out"),
        ({"n_agents": 0}, r"cannot be made with \{'n_agents': 0\}: AssertionError"),
    ):
        with pytest.raises(ValueError, match=words):
            make_team_env("vmas/balance", 2, seed=0, **params)
    with pytest.raises(ValueError, match=r"vmas/balance cannot be made with \{'colour': 1\}"):
        make_team_env("vmas/balance", colour=1)
    with pytest.raises(ValueError, match="vmas/balance tells no state"):
        make_team_env("vmas/balance", state=True)


@pytest.mark.parametrize(
    ("env_id", "params", "is_shared"),
    [
        pytest.param("smax/3m", {}, True, marks=needs_jaxmarl),
        pytest.param("overcooked/cramped_room", {}, True, marks=needs_jaxmarl),
        pytest.param("overcooked/cramped_room", {"reward_shaping": 1.0}, False, marks=needs_jaxmarl),
        pytest.param("vmas/flocking", {}, False, marks=needs_vmas),
        ("hecogrid/TeamSupport-v0", {}, True),
    ],
)
def test_advantages_are_each_agents_where_rewards_are(env_id: str, params: dict[str, Any], is_shared: bool) -> None:
    settings = ppo_settings(make_team_env(env_id, n_envs=2, seed=0, **params))
    assert ("rollout_buffer_kwargs" not in settings) == is_shared


STAGGERED = [
    pytest.param("jaxmarl/MPE_simple_spread_v3", 10, marks=needs_jaxmarl),
    pytest.param("vmas/balance", 8, marks=needs_vmas),
    ("hecogrid/TeamSupport-v0", 8),
]


@pytest.mark.parametrize(("env_id", "n_steps"), STAGGERED)
def test_first_episodes_of_staggered_games_end_one_after_the_other(env_id: str, n_steps: int) -> None:
    limit: dict[str, Any] = {"max_cycles": n_steps} if env_id.startswith("hecogrid") else {"max_steps": n_steps}
    venv: Any = make_team_env(env_id, 4, seed=0, stagger=True, **limit).unwrapped
    venv.reset()
    idle = np.zeros((venv.num_envs, *(venv.action_space.shape or ())), dtype=venv.action_space.dtype)
    ends: dict[int, list[tuple[int, bool]]] = {game: [] for game in range(4)}
    for step in range(n_steps):
        _, _, dones, infos = venv.step(idle)
        for row in np.flatnonzero(dones[:: len(dones) // 4]):
            ends[int(row)].append((step, "staggered" in infos[row * (len(dones) // 4)]))
    lengths = [ends[game][0][0] for game in (3, 2, 1)]
    assert lengths == sorted(set(lengths)) and all(ends[game][0][1] for game in (1, 2, 3))
    assert not any(short for _, short in ends[0])


def test_a_restored_state_knows_which_episodes_are_short() -> None:
    one, other = (make_team_env("TeamSupport", 3, seed=0, stagger=True, max_cycles=6).unwrapped for _ in range(2))
    states: Any = (one, other)
    one.reset()
    idle = np.zeros(one.num_envs, dtype=int)
    one.step(idle)
    states[1].load_checkpoint_state(states[0].checkpoint_state())
    for _ in range(5):
        infos = [venv.step(idle)[3] for venv in (one, other)]
        np.testing.assert_equal(infos[0], infos[1])


@needs_jaxmarl
def test_games_without_a_limit_to_move_are_not_staggered() -> None:
    with pytest.raises(ValueError, match="stagger=True"):
        make_team_env("smax/3m", 2, stagger=True).reset()
