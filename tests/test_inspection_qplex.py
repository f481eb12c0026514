"""The inspection callback with QPLEX: team values, best actions, heads of a pool; training does not change."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import VecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_saf import QPLEX, InspectionCallback, evaluate_team, make_team_env
from sb3_saf.inspection.recording import QReader, record_episodes
from sb3_saf.networks.actor import PolicyPool
from tests.probe_envs import ConstantReward
from tests.toy_envs import TellingEnv

NETS: dict[str, Any] = {"net_arch": [8], "mixer_hidden": 8, "kernel_arch": (8,), "features_extractor_kwargs": {}}
QUICK: dict[str, Any] = {"buffer_size": 200, "learning_starts": 8, "batch_size": 8, "train_freq": 4, "gamma": 0.5}


def telling(**kwargs: Any) -> VecEnv:
    """Create four games whose agents join and die, with legal actions and a state; illegal actions fail."""
    settings: dict[str, Any] = {"n_agents": 3, "max_cycles": 5, "deaths": {1: 3}, "joins": {2: 1}} | kwargs
    return make_team_env(TellingEnv(**settings), n_envs=4, seed=0, state=True)


def model_on(env: VecEnv, policy: str = "QPLEXPolicy", folder: Path | None = None, **parts: Any) -> QPLEX:
    nets = NETS | parts
    policy, _, memory = policy.partition("-")
    if memory:
        nets |= {"memory": memory, "memory_size": 8, "sequence_length": 4, "burn_in": 2}
    logs = None if folder is None else str(folder)
    return QPLEX(policy, env, seed=1, device="cpu", policy_kwargs=nets, tensorboard_log=logs, **QUICK)


@pytest.mark.parametrize("policy", ["QPLEXPolicy", "QPLEXPoolPolicy", "QPLEXPolicy-gru"])
def test_the_page(policy: str, tmp_path: Path) -> None:
    callback = InspectionCallback(telling(), every_game_steps=20, n_eval_episodes=4)
    model_on(telling(), policy, tmp_path).learn(40 * 3, log_interval=4, callback=callback)
    (file,) = tmp_path.glob("*/events.*")
    found = EventAccumulator(str(file)).Reload()
    scalars, pool = found.Tags()["scalars"], policy == "QPLEXPoolPolicy"
    groups = {tag.split("/")[0] for tag in scalars} - {"rollout", "time", "train"}
    assert groups == {"team", "critic", "lambda"} | ({"pool"} if pool else set())
    pictures = {"pool/by_agent", "pool/differences"} if pool else set()
    assert set(found.Tags()["images"]) == {"critic/calibration"} | pictures
    assert all(math.isfinite(event.value) for tag in scalars for event in found.Scalars(tag))
    layout = found.Tensors("custom_scalars__config__")[0].tensor_proto.string_val[0].decode(errors="replace")
    assert "Mixer" in layout and "Knowledge source" not in layout
    told = found.PluginTagToContent("hparams")["_hparams_/session_start_info"]
    assert b"target_update_interval" in told and b"n_kernels" in told


def test_training_ends_with_the_same_weights_to_the_last_bit() -> None:
    alone = model_on(telling(), "QPLEXPoolPolicy").learn(60 * 3)
    callback = InspectionCallback(telling(), every_game_steps=7, n_eval_episodes=2, pictures=False)
    watched = model_on(telling(), "QPLEXPoolPolicy")
    with pytest.warns(UserWarning, match="writes no TensorBoard file"):
        watched.learn(60 * 3, callback=callback)
    for name, weights in alone.policy.state_dict().items():
        assert th.equal(weights, watched.policy.state_dict()[name]), name


def rows_of(env: VecEnv) -> dict[str, th.Tensor]:
    obs = env.reset()
    assert isinstance(obs, dict)
    return {key: th.as_tensor(value) for key, value in obs.items()}


@th.no_grad()
def test_values_of_vdn_are_sums_of_best_values_of_those_who_take_part() -> None:
    env = telling()
    policy = model_on(env, mixer="vdn").policy
    obs = rows_of(env)
    view = QReader(policy).step(obs, np.ones(12, dtype=bool))
    best = policy.own_q_values(obs).max(dim=1).values.view(4, 3)
    best[:, 2] = 0  # joins later
    np.testing.assert_allclose(view.values.view(4, 3), best.sum(dim=1, keepdim=True).expand(4, 3), rtol=1e-6)
    assert view.actions.tolist() == policy.predict({key: value.numpy() for key, value in obs.items()})[0].tolist()


@pytest.mark.parametrize("policy", ["QPLEXPolicy", "QPLEXPoolPolicy", "QPLEXPolicy-gru"])
def test_the_team_plays_as_when_it_is_evaluated(policy: str) -> None:
    env = telling()
    team = model_on(env, policy).policy
    recording = record_episodes(team, env, 8, seed=3, gamma=0.5)
    env.seed(3)
    assert recording.episode_returns == evaluate_team(team, env, 8).returns
    assert recording.of_team  # so an agent's end is not the team's
    assert recording.ends.all(axis=1).tolist() == recording.ends.any(axis=1).tolist()


@pytest.mark.parametrize(("time_limit", "mean_return"), [("terminal", 2 * (1.5 + 1) / 2), ("bootstrap", None)])
def test_returns_are_the_teams(time_limit: Any, mean_return: float | None) -> None:
    """Two agents get 1 each at both steps; a time limit that does not terminate is followed by the next value."""
    env = make_team_env(ConstantReward(n_agents=2, length=2), n_envs=4, time_limit=time_limit)
    team = model_on(env).policy
    recording = record_episodes(team, env, 4, seed=0, gamma=0.5)
    assert recording.episode_returns == [4.0] * 4
    assert (recording.rewards == 2).all()
    returns = recording.returns
    if mean_return is not None:
        assert returns.mean() == mean_return
        return
    assert (recording.last_values[1] != 0).all() and (recording.last_values[0] == 0).all()
    np.testing.assert_allclose(returns[1], 2 + 0.5 * recording.last_values[1])


@th.no_grad()
def test_heads_of_a_pool_differ_where_their_best_actions_do() -> None:
    env = telling(masks=None, joins={}, deaths={})
    team = model_on(env, "QPLEXPoolPolicy", n_policies=2).policy
    obs = rows_of(env)
    view = QReader(team).step(obs, np.ones(12, dtype=bool))
    assert view.pool_weights is not None and view.pool_actions is not None
    np.testing.assert_allclose(view.pool_weights.sum(dim=1), 1, rtol=1e-5)
    assert isinstance(team.actor, PolicyPool)
    log_weights, of_heads = team.actor.evaluate(team.extract_features(obs))
    np.testing.assert_allclose(view.pool_weights, log_weights.exp())
    assert th.equal(view.pool_actions.argmax(dim=2), of_heads.argmax(dim=2))
    assert (view.pool_actions == 0).sum(dim=2).eq(1).all()
