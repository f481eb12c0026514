"""The inspection callback in real training: what it writes, what it leaves out, and that training does not change."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from PIL import Image
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn

from sb3_saf import (
    CentralizedValueWrapper,
    GameStepsCallback,
    InspectionCallback,
    TeamMonitor,
    TeamRolloutBuffer,
    evaluate_team,
    inspect_team,
    make_team_env,
)
from sb3_saf.inspection.recording import EpisodeRecording, QReader, record_episodes, zones_by_attribute
from sb3_saf.inspection.scalars import critic_scalars, message_scalars
from sb3_saf.inspection.tensorboard import Line, line_of
from sb3_saf.policies.base import TeamPolicy
from sb3_saf.policies.ippo import IPPOPolicy
from sb3_saf.policies.saf import SAFPolicy
from tests.contrib_teams import MaskedTeams
from tests.probe_envs import ConstantReward, DelayedReward, Message
from tests.team_venv import TeamVenv
from tests.test_active import ACTIVE, LIVES
from tests.test_monitor import RETURN_OF_GAME_0, RETURN_OF_GAME_1
from tests.test_probes import error_of
from tests.test_probes import train as train_on_probe
from tests.test_qplex import make_model as make_qplex
from tests.test_qplex import telling_env
from tests.toy_envs import CounterEnv, TellingEnv
from tests.toy_teams import ToyTeams

LEVEL: dict[str, Any] = {"n_agents": 3, "grid_size": 9, "n_treasures": 30, "heterogeneity": 2, "max_cycles": 6}
SMALL: dict[str, Any] = {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 8}}
SMALL_SAF: dict[str, Any] = SMALL | {"latent_dim": 8, "projection_arch": (16,), "n_policies": 3, "n_slots": 2}


def learn(
    folder: Path | None,
    callback: InspectionCallback | None,
    policy: str = "SAFPolicy",
    algorithm: Any = PPO,
    env: Any = None,
    n_updates: int = 2,
    **policy_kwargs: Any,
) -> Any:
    """Train with rollouts of four games of five steps."""
    env = env or ToyTeams()
    settings: dict[str, Any] = {} if algorithm is A2C else {"batch_size": 5 * env.num_envs, "n_epochs": 2}
    if algorithm is PPO:
        settings["rollout_buffer_class"] = TeamRolloutBuffer
    settings["policy_kwargs"] = (SMALL_SAF if policy.startswith("SAF") else SMALL) | policy_kwargs
    logs = None if folder is None else str(folder)
    model = algorithm(policy, env, n_steps=5, gamma=0.9, seed=1, device="cpu", tensorboard_log=logs, **settings)
    callbacks = [GameStepsCallback()] if callback is None else [GameStepsCallback(), callback]
    return model.learn(5 * env.num_envs * n_updates, callback=callbacks)


def level_games() -> CentralizedValueWrapper:
    return make_team_env("TeamSupport", n_envs=2, seed=0, **LEVEL)


def events(folder: Path) -> EventAccumulator:
    """Return the run's own event file, not those of its sub-runs."""
    (file,) = folder.glob("*/events.*")
    return EventAccumulator(
        str(file), size_guidance=dict.fromkeys(("scalars", "images", "histograms", "tensors"), 0)
    ).Reload()


def scalars_of(folder: Path) -> dict[str | Line, list[float]]:
    found = events(folder)
    scalars = {tag: [event.value for event in found.Scalars(tag)] for tag in found.Tags()["scalars"]}
    for file in folder.glob("*/*/events.*"):
        lines = EventAccumulator(str(file)).Reload()
        for chart in lines.Tags()["scalars"]:
            scalars[Line(chart, file.parent.name)] = [event.value for event in lines.Scalars(chart)]
    return scalars


def groups(tags: Any) -> set[str]:
    return {tag.split("/")[0] for tag in tags} - {"rollout", "time", "train"}


class Inspected(NamedTuple):
    """A model, the callback that inspected it in training, and the folder of its logs."""

    model: Any
    callback: InspectionCallback
    folder: Path


@pytest.fixture(scope="module")
def inspected(tmp_path_factory: pytest.TempPathFactory) -> Inspected:
    """Train SAF on a small HECOGrid, with everything turned on."""
    folder = tmp_path_factory.mktemp("page")
    env = make_team_env("TeamSupport", n_envs=4, seed=0, **LEVEL)
    eval_env = make_team_env("TeamSupport", n_envs=2, render_mode="rgb_array", **LEVEL)
    callback = InspectionCallback(eval_env, every_game_steps=24, n_eval_episodes=3, hparams={"task": "TeamSupport"})
    return Inspected(learn(folder, callback, env=env, n_updates=2), callback, folder)


@pytest.fixture(scope="module")
def page(inspected: Inspected) -> EventAccumulator:
    return events(inspected.folder)


class TestInHand:
    def test_is_what_the_callback_writes(self, inspected: Inspected, page: EventAccumulator) -> None:
        model, eval_env, found = inspected.model, inspected.callback.eval_env, page
        before = th.get_rng_state()
        look = inspect_team(model, eval_env, n_eval_episodes=3)
        assert th.equal(th.get_rng_state(), before)
        again = inspect_team(model, eval_env, n_eval_episodes=3, pictures=False)
        assert again.scalars == look.scalars  # the same episodes every time
        written = scalars_of(inspected.folder)
        shown_as = {tag: line_of(tag) or tag for tag in look.scalars}
        assert {tag: pytest.approx(written[shown_as[tag]][-1], rel=1e-5) for tag in look.scalars} == look.scalars
        assert shown_as["pool/chosen/policy_2"] == Line("pool/chosen", "policy_2")
        assert shown_as["message/value_error"] == Line("message/value_error", "message_as_read")
        assert {*look.figures, "episode/film"} == set(found.Tags()["images"])
        assert look.film is not None
        shown = found.Images("episode/film")[-1].encoded_image_string
        np.testing.assert_array_equal(
            np.asarray(Image.open(io.BytesIO(look.film))), np.asarray(Image.open(io.BytesIO(shown)))
        )

    def test_refuses_policies_of_others(self) -> None:
        env = level_games()
        model = PPO("MultiInputPolicy", env, n_steps=5, batch_size=30, device="cpu")
        looks = lambda: inspect_team(model, env), lambda: model.learn(30, callback=InspectionCallback(level_games()))
        for look in looks:
            with pytest.raises(ValueError, match=r"expected a policy of sb3_saf .* got MultiInputActorCriticPolicy"):
                look()


class TestPage:
    def test_scalars(self, page: EventAccumulator) -> None:
        expected = {
            *("team/return", "team/return_low", "team/return_high", "team/episode_length", "team/share_of_treasures"),
            *("pool/entropy", "pool/entropy_of_mean", "pool/difference", "pool/zone_dependence"),
            *(f"knowledge_source/{way}_entropy{of}" for way in ("write", "read") for of in ("", "_of_mean")),
            "message/strength",
            *("critic/mean_value", "critic/mean_return", "critic/bias", "critic/error", "critic/td_error"),
            *("critic/slope", "critic/explained_variance", "critic/explained_variance_of_target"),
            *("time/game_steps", "time/game_steps_per_second", "time/inspection_seconds", "time/inspection_share"),
        }
        assert expected <= set(page.Tags()["scalars"])
        assert [event.histogram_value.num for event in page.Histograms("team/return_of_each_episode")] == [3] * 3
        # Before, during and after training, on an axis of game steps as for what SB3 logs: a rollout has 20 game steps.
        assert [event.step for event in page.Scalars("team/return")] == [0, 24, 40]
        assert [event.step for event in page.Scalars("time/fps")] == [20, 40]

    def test_pictures(self, page: EventAccumulator) -> None:
        assert set(page.Tags()["images"]) == {
            *("pool/by_zone", "pool/by_agent", "pool/differences"),
            *("knowledge_source/attention", "knowledge_source/one_episode"),
            *("critic/calibration", "episode/film"),
        }
        for tag in page.Tags()["images"]:
            image = Image.open(io.BytesIO(page.Images(tag)[-1].encoded_image_string))
            assert image.width > 100 and image.height > 100
        movie = Image.open(io.BytesIO(page.Images("episode/film")[-1].encoded_image_string))
        assert (movie.format, movie.n_frames) == ("GIF", LEVEL["max_cycles"])  # type: ignore[attr-defined]

    def test_layout_and_hyperparameters(self, page: EventAccumulator) -> None:
        layout = page.Tensors("custom_scalars__config__")[0].tensor_proto.string_val[0].decode(errors="replace")
        for name in ("Team", "Policy pool", "Policy pool by zone", "Knowledge source", "Critic", "zone 1", "share of"):
            assert name in layout
        assert "Mixer" not in layout
        told = page.PluginTagToContent("hparams")
        for word in (b"1 task", b"2 seed", b"3 method", b"n_policies", b"learning_rate"):
            assert word in told["_hparams_/session_start_info"]
        assert b"team/return" in told["_hparams_/experiment"]
        text = page.Tensors("about/text_summary")[0].tensor_proto.string_val[0].decode()
        explained = set(re.findall(r"`([a-z_]+)/", text))
        assert groups(page.Tags()["scalars"]) <= explained


@pytest.mark.parametrize(
    ("policy", "settings"), [("SAFPolicy", {"selection": "gumbel"}), ("MAPPOPolicy", {"normalize_values": True})]
)
def test_training_ends_with_the_same_weights_to_the_last_bit(policy: str, settings: dict[str, Any]) -> None:
    alone = learn(None, None, policy, n_updates=3, **settings).policy.state_dict()
    callback = InspectionCallback(ToyTeams(), every_game_steps=24, n_eval_episodes=2, pictures=False)
    with pytest.warns(UserWarning, match="writes no TensorBoard file"):
        watched = learn(None, callback, policy, n_updates=3, **settings).policy.state_dict()
    assert callback.seconds > 0 and alone.keys() == watched.keys()
    assert [name for name, weights in alone.items() if not th.equal(weights, watched[name])] == []


@pytest.mark.parametrize(
    ("algorithm", "policy", "settings", "expected"),
    [
        (A2C, "SAFPolicy", {"critic_input": "team", "n_policies": 1}, {"knowledge_source", "message"}),
        (PPO, "IPPOPolicy", {}, set()),
        (MaskablePPO, "SAFMaskablePolicy", {"knowledge_source": False}, {"pool"}),
    ],
)
def test_what_a_policy_lacks_is_left_out(
    algorithm: type[BaseAlgorithm], policy: str, settings: dict[str, Any], expected: set[str], tmp_path: Path
) -> None:
    env = MaskedTeams(spaces.Discrete(3)) if algorithm is MaskablePPO else ToyTeams()
    eval_env = type(env)(spaces.Discrete(3)) if isinstance(env, MaskedTeams) else ToyTeams()
    learn(tmp_path, InspectionCallback(eval_env, n_eval_episodes=4), policy, algorithm, env, n_updates=1, **settings)
    if isinstance(eval_env, MaskedTeams):
        assert eval_env.n_forbidden == 0 < eval_env.n_actions
    found = events(tmp_path)
    assert groups(found.Tags()["scalars"]) == {"team", "critic"} | expected
    assert groups(found.Tags()["images"]) == {"critic"} | (expected - {"message"})
    for tag in found.Tags()["scalars"]:
        assert all(math.isfinite(event.value) for event in found.Scalars(tag)), tag


def test_reward_normalisation_is_that_of_training(tmp_path: Path) -> None:
    callback = InspectionCallback(ToyTeams(), n_eval_episodes=4, pictures=False)
    env = VecNormalize(ToyTeams(), norm_obs=False, clip_reward=1e9)
    learn(tmp_path, callback, env=env, n_updates=4)
    model, scale = callback.model, math.sqrt(env.ret_rms.var + env.epsilon)
    plain = record_episodes(model.policy, ToyTeams(), 4, gamma=0.9)
    found = scalars_of(tmp_path)
    assert found["team/return"][-1] == pytest.approx(np.mean(plain.episode_returns), rel=1e-5)
    mean_return = plain._replace(rewards=plain.rewards / scale).returns[plain.counted].mean()
    assert found["critic/mean_return"][-1] == pytest.approx(mean_return, rel=1e-4)
    assert abs(scale - 1) > 0.01


# --- hand-made policies -----------------------------------------------------------------------------------------------


def hand_made(policy_class: type[TeamPolicy], env: Any, **kwargs: Any) -> Any:
    """Create a policy whose features are the observation."""
    return policy_class(
        env.observation_space, env.action_space, lambda _: 0.0, features_extractor_class=FlattenExtractor, **kwargs
    )


def play(env: Any, policy: TeamPolicy, n_episodes: int = 64, gamma: float = 0.5) -> EpisodeRecording:
    return record_episodes(policy, env, n_episodes, seed=3, gamma=gamma)


class Critic(nn.Module):
    """A critic that is a function of an agent's own features."""

    reads_agent = False

    def __init__(self, values: Callable[[th.Tensor], th.Tensor]):
        super().__init__()
        self.values = values

    def forward(self, features: th.Tensor, agent: th.Tensor | None = None) -> th.Tensor:
        return self.values(features)


class TestCritic:
    @pytest.mark.parametrize(("time_limit", "bias"), [("bootstrap", 0.0), ("terminal", 2 - (1.5 + 1) / 2)])
    def test_time_limits_are_those_of_training(self, time_limit: Any, bias: float) -> None:
        """Reward 1 at every step: the value is 2 if the time limit does not terminate, otherwise 1.5 and then 1."""
        env = make_team_env(ConstantReward(length=2), n_envs=4, time_limit=time_limit)
        policy = hand_made(IPPOPolicy, env)
        policy.value_net = Critic(lambda seen: th.full((len(seen),), 2.0))
        assert critic_scalars(play(env, policy), 1.0)["critic/bias"] == pytest.approx(bias)


class TestWhatCounts:
    def test_each_game_plays_its_share_of_episodes(self) -> None:
        """Three episodes in two games, of three and of two steps: one and two."""
        env = CentralizedValueWrapper(TeamMonitor(TeamVenv(lengths=(3, 2))))
        game = play(env, hand_made(IPPOPolicy, env), n_episodes=3)
        assert game.counted[:, ::3].T.tolist() == [[True, True, True, False], [True] * 4]
        assert game.episode_returns == [RETURN_OF_GAME_1, RETURN_OF_GAME_0, RETURN_OF_GAME_1]
        assert game.episode_lengths == [2, 3, 2]

    def test_episodes_that_were_cut_short_do_not_count(self) -> None:
        env = make_team_env(
            "TeamSupport", 4, seed=0, stagger=True, n_agents=3, grid_size=8, n_treasures=6, max_cycles=8
        )
        policy = IPPOPolicy(env.observation_space, env.action_space, lambda _: 0.0)
        game = record_episodes(policy, env, 8, seed=3, deterministic=True)
        env.seed(3)
        assert game.episode_lengths == [8] * 8
        assert game.episode_returns == evaluate_team(policy, env, 8).returns

    def test_agents_that_take_no_part_do_not_count(self) -> None:
        """Illegal actions fail in this environment; agents die and join."""
        env = make_team_env(TellingEnv(**LIVES), n_envs=2)
        policy = hand_made(SAFPolicy, env)
        game = play(env, policy, n_episodes=2)
        active = np.array(ACTIVE, dtype=bool)
        np.testing.assert_array_equal(game.counted, np.tile(active, 2))
        # Agent 0 ends with step 3, but is paid until its team ends.
        assert game.ends[:, 0].tolist() == game.ends[:, 2].tolist() == [False, False, False, False, True]
        assert game.write_attention is not None and game.pool_actions is not None
        assert ((game.write_attention > 0) == active[:, np.newaxis, np.newaxis]).all()
        legal = np.array(
            [[(action + agent + step) % 2 == 0 for action in range(4)] for agent in (0,) for step in (0, 1)]
        )
        assert ((game.pool_actions[:2, 0, 0] > -1e7) == legal).all()


def test_hecogrids_zones_are_those_of_the_agents_columns() -> None:
    env = make_team_env("TeamTogether", n_envs=5, seed=0, n_agents=4, grid_size=12, heterogeneity=3, n_treasures=4)
    env.reset()
    columns = np.concatenate(
        [state["agent_pos"][:, 0] for state in env.env_method("get_state", indices=range(0, 20, 4))]
    )
    np.testing.assert_array_equal(zones_by_attribute(env), columns // 4)
    assert len(env.get_attr("zone_colours", indices=[0])[0]) == 3


class TestMessages:
    def test_a_critic_that_needs_messages_is_wrong_without(self) -> None:
        """The value is what the next agent sees, -1 or 1: every guess without the message has an error of 1 or more."""
        probe = Message(n_agents=3)
        policy = train_on_probe("SAFPolicy", probe, n_updates=25)
        assert error_of(policy, probe) < 0.1
        scalars = message_scalars(play(make_team_env(Message(n_agents=3), n_envs=64), policy, 128, gamma=0.9))
        assert scalars["message/value_error"] < 0.3
        assert scalars["message/value_error_zeroed"] > 0.9
        assert scalars["message/value_error_shuffled"] > 0.9

    def test_a_single_game_has_nobody_to_shuffle_with(self) -> None:
        env = make_team_env(Message(n_agents=3), n_envs=1)
        assert set(message_scalars(play(env, hand_made(SAFPolicy, env), 4))) == {
            "message/strength",
            "message/value_error",
            "message/value_error_zeroed",
        }


# --- QPLEX: values of teams, best actions -----------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["QPLEXPoolPolicy", "QPLEXPolicy-gru"])
def test_the_page_of_qplex(policy: str, tmp_path: Path) -> None:
    callback = InspectionCallback(telling_env(), every_game_steps=20, n_eval_episodes=4)
    make_qplex(telling_env(), policy, gamma=0.5, tensorboard_log=str(tmp_path)).learn(
        40 * 3, log_interval=4, callback=callback
    )
    found = events(tmp_path)
    scalars, pool = found.Tags()["scalars"], policy == "QPLEXPoolPolicy"
    assert groups(scalars) == {"team", "critic", "lambda"} | ({"pool"} if pool else set())
    pictures = {"pool/by_agent", "pool/differences"} if pool else set()
    assert set(found.Tags()["images"]) == {"critic/calibration"} | pictures
    assert all(math.isfinite(event.value) for tag in scalars for event in found.Scalars(tag))
    layout = found.Tensors("custom_scalars__config__")[0].tensor_proto.string_val[0].decode(errors="replace")
    assert "Mixer" in layout and "Knowledge source" not in layout
    told = found.PluginTagToContent("hparams")["_hparams_/session_start_info"]
    assert b"target_update_interval" in told and b"n_kernels" in told


def rows_of(env: VecEnv) -> dict[str, th.Tensor]:
    obs = env.reset()
    assert isinstance(obs, dict)
    return {key: th.as_tensor(value) for key, value in obs.items()}


@th.no_grad()
def test_values_of_vdn_are_sums_of_best_values_of_those_who_take_part() -> None:
    env = telling_env()
    policy = make_qplex(env, mixer="vdn").policy
    obs = rows_of(env)
    view = QReader(policy).step(obs)
    best = policy.own_q_values(obs).max(dim=1).values.view(4, 3)
    best[:, 2] = 0  # joins later
    np.testing.assert_allclose(view["values"].view(4, 3), best.sum(dim=1, keepdim=True).expand(4, 3), rtol=1e-6)
    assert view["actions"].tolist() == policy.predict({key: value.numpy() for key, value in obs.items()})[0].tolist()


@pytest.mark.parametrize("policy", ["QPLEXPolicy", "QPLEXPoolPolicy", "QPLEXPolicy-gru"])
def test_the_team_plays_as_when_it_is_evaluated(policy: str) -> None:
    env = telling_env()
    team = make_qplex(env, policy).policy
    recording = record_episodes(team, env, 8, seed=3, gamma=0.5)
    env.seed(3)
    assert recording.episode_returns == evaluate_team(team, env, 8).returns
    assert recording.of_team  # so an agent's end is not the team's
    assert recording.ends.all(axis=1).tolist() == recording.ends.any(axis=1).tolist()


@pytest.mark.parametrize(("time_limit", "mean_return"), [("terminal", 2 * (1.5 + 1) / 2), ("bootstrap", None)])
def test_returns_are_the_teams(time_limit: Any, mean_return: float | None) -> None:
    """Two agents get 1 each at both steps; a time limit that does not terminate is followed by the next value."""
    env = make_team_env(ConstantReward(n_agents=2, length=2), n_envs=4, time_limit=time_limit)
    team = make_qplex(env).policy
    recording = record_episodes(team, env, 4, seed=0, gamma=0.5)
    assert recording.episode_returns == [4.0] * 4
    assert (recording.rewards == 2).all()
    returns = recording.returns
    if mean_return is not None:
        assert returns.mean() == mean_return
        return
    assert (recording.last_values[1] != 0).all() and (recording.last_values[0] == 0).all()
    np.testing.assert_allclose(returns[1], 2 + 0.5 * recording.last_values[1])


@pytest.mark.parametrize(("deaths", "cuts"), [({2: 1}, {}), ({}, {2: 1})])
def test_the_teams_value_after_a_time_limit_is_in_all_its_rows(deaths: dict[int, int], cuts: dict[int, int]) -> None:
    """Agent 2 ends after the first of three steps."""
    env = make_team_env(CounterEnv(n_agents=3, deaths=deaths, cuts=cuts), n_envs=2, time_limit="bootstrap")
    recording = record_episodes(make_qplex(env).policy, env, 2, seed=0, gamma=0.5)
    assert recording.ends.tolist() == [[False] * 6, [False] * 6, [True] * 6]
    of_teams = recording.last_values[2].reshape(2, 3)
    assert (of_teams == of_teams[:, :1]).all() and (of_teams != 0).all() and of_teams[0, 0] != of_teams[1, 0]
    paid = recording.rewards.reshape(3, 2, 3)[:, :, 0]
    expected = paid[0] + 0.5 * paid[1] + 0.25 * paid[2] + 0.125 * of_teams[:, 0]
    np.testing.assert_allclose(recording.returns[0].reshape(2, 3), expected[:, np.newaxis].repeat(3, 1), rtol=1e-6)


# --- arguments --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", [{"every_game_steps": 0}, {"n_eval_episodes": 2.5}, {"seed": -1}])
def test_bad_arguments(arguments: dict[str, Any]) -> None:
    ((name, value),) = arguments.items()
    with pytest.raises(ValueError, match=f"{name} must be .*got {value!r}"):
        InspectionCallback(ToyTeams(), **arguments)


def test_environments_that_do_not_fit() -> None:
    env = ToyTeams()
    probes = [make_team_env(DelayedReward(), n_envs=1, time_limit=limit) for limit in ("terminal", "bootstrap")]
    cases: list[tuple[Any, Any, str]] = [
        (env, env, "eval_env is the training environment"),
        (env, ToyTeams(n_agents=2), "eval_env to have the observation_space of the training"),
        (probes[0], probes[1], r"as training does \(time_limit='terminal'\), got 'bootstrap'"),
    ]
    for training, evaluation, message in cases:
        with pytest.raises(ValueError, match=message):
            learn(None, InspectionCallback(evaluation), env=training)
