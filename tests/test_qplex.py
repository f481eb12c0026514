"""QPLEX as an algorithm of Stable-Baselines3: learning, units, exploration, saving, export, known answers, mixers."""

from __future__ import annotations

import copy
import csv
import random
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_saf import PQN, QPLEX, Actor, GameStepsCallback, LightEncoder, evaluate_team, export_actors, make_team_env
from sb3_saf.envs.joint_observation import CentralizedValueWrapper, TimeLimit
from sb3_saf.qplex.learning import team_errors
from sb3_saf.qplex.mixers import JointChoice, Mixer, QMIXMixer, QPLEXMixer, VDNMixer
from sb3_saf.qplex.policies import q_values
from tests.probe_envs import ONE_STEP, MatrixGame, TwoStates
from tests.toy_envs import TellingEnv
from tests.toy_teams import ToyTeams
from tests.weights import weights_of

#: Policies, with the kind of their memory.
POLICIES = ["QPLEXPolicy", "QPLEXPoolPolicy", "QPLEXPolicy-gru", "QPLEXPolicy-lstm"]
#: Small and quick.
QUICK: dict[str, Any] = {
    "buffer_size": 200,
    "learning_starts": 20,
    "batch_size": 16,
    "train_freq": 8,
    "target_update_interval": 24,
    "device": "cpu",
}
SMALL_NETS: dict[str, Any] = {"net_arch": [16], "mixer_hidden": 16, "kernel_arch": (16,)}


def toy_env(n_games: int = 4) -> CentralizedValueWrapper:
    """Create games of three agents and five steps, with time limits that terminate."""
    return telling_env(n_games, masks=None, joins={}, deaths={})


def telling_env(n_games: int = 4, time_limit: TimeLimit = "terminal", **kwargs: Any) -> CentralizedValueWrapper:
    """Create games whose agents join and die, with a state, and masks whose violation fails the test."""
    settings: dict[str, Any] = {"n_agents": 3, "max_cycles": 5, "deaths": {1: 3}, "joins": {2: 1}} | kwargs
    masks = settings.get("masks", "observation") is not None
    return make_team_env(
        TellingEnv(**settings), n_envs=n_games, seed=0, time_limit=time_limit, state=True, action_masks=masks
    )


def make_model(env: Any = None, policy: str = "QPLEXPolicy", **kwargs: Any) -> QPLEX:
    nets = SMALL_NETS | kwargs.pop("policy_kwargs", {})
    policy, _, memory = policy.partition("-")
    if memory:
        nets = {"memory": memory, "memory_size": 8, "sequence_length": 4, "burn_in": 2} | nets
    return QPLEX(policy, toy_env() if env is None else env, **(QUICK | {"seed": 0, "policy_kwargs": nets} | kwargs))


# --- games with known answers -----------------------------------------------------------------------------------------


def test_qplex_learns_the_joint_action_worth_8() -> None:
    """From 1,000 uniformly drawn ones: 20 of 20 seeds (QMIX: 1, VDN: none, whose payoff is 0), see docs/qplex.md."""
    env = make_team_env(MatrixGame(), n_envs=8, active=False)
    nets = {"n_kernels": 10, "kernel_arch": (64, 64), "mixer_hidden": 64, "net_arch": [128, 128]}
    model = make_model(
        env, mixer="qplex", learning_rate=1e-3, policy_kwargs=nets, buffer_size=1_000, learning_starts=1_000,
        batch_size=32,
    )  # fmt: skip
    model.learn(1_000 * 2)
    model.learning_starts, model.gradient_steps = 0, 400
    model.train(400)
    row, column = model.predict(env.reset(), deterministic=True)[0][:2]
    assert ONE_STEP[row, column] == 8.0


def test_qplex_finds_the_value_of_two_states() -> None:
    """
    With gamma = 0.9 the value is 10. Off-policy learning with additive factorisation, as VDN's, diverges there (arXiv
    2006.00587): with uniform data its iteration is V <- 3/4 + 1.125 V.
    """
    env = make_team_env(TwoStates(length=10), n_envs=8, active=False, time_limit="bootstrap")
    model = make_model(
        env, mixer="qplex", gamma=0.9, learning_rate=2e-3, buffer_size=800, learning_starts=800, batch_size=64,
        exploration_final_eps=1.0, target_update_interval=8, tau=0.05,
    )  # fmt: skip
    model.learn(800 * 2)
    model.learning_starts, model.gradient_steps = 0, 1
    for _ in range(500):
        model.train(1, 64)
        model._on_step()
    steps = model._buffer().sample(400)
    stays = (steps.now.own[:, 0, 1] == 1) & (steps.actions == 0).all(dim=1)
    assert 8.0 < team_errors(model.policy, steps, 0.9).q_tot[stays].mean().item() < 12.0


# --- the loss ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("policy", "kind"), [("QPLEXPolicy", "all"), ("QPLEXPoolPolicy", "features"), ("QPLEXPolicy-lstm", "all")]
)
def test_unique_rows_give_the_numbers_of_every_row(policy: str, kind: str) -> None:
    errors = []
    for encode_once in (True, False):
        env = telling_env() if kind == "all" else ToyTeams()
        model = make_model(env, policy, policy_kwargs={"encode_once": encode_once})
        model.learn(30 * 3)
        th.manual_seed(5)
        np.random.seed(5)  # noqa: NPY002
        buffer = model._buffer()
        samples = buffer.sample_sequences(2, 8, 8) if policy.endswith("lstm") else buffer.sample(16)
        errors.append(team_errors(model.policy, samples, 0.9))
    assert th.allclose(errors[0].td, errors[1].td, atol=1e-4)


def test_the_target_is_double_q_learning_by_hand() -> None:
    """VDN row by row: y = r + gamma (1 - done) sum_i Q_target_i(the best legal action of the online Q_i)."""
    env = telling_env(time_limit="bootstrap")
    model = make_model(env, mixer="vdn", learning_starts=10)
    model.learn(60 * 3)
    samples, policy = model._buffer().sample(40), model.policy
    for parameter in policy.target_networks.parameters():  # so that their best actions differ
        parameter.data.add_(th.randn_like(parameter))
    error = team_errors(policy, samples, gamma=0.9)
    assert samples.now.active is not None and samples.after.active is not None and samples.after.masks is not None
    assert not samples.after.active.all()
    differs = 0
    for i in range(40):
        q_tot = value = 0.0
        for agent in range(3):
            now = policy.actor(policy.features_extractor(samples.now.own[i, agent][None]))[0]
            after = policy.features_extractor(samples.after.own[i, agent][None])
            online = policy.actor(after)[0].masked_fill(~samples.after.masks[i, agent], -th.inf)
            target = policy.target.actor(policy.target.encoder(samples.after.own[i, agent][None]))[0]
            legal = target.masked_fill(~samples.after.masks[i, agent], -th.inf)
            differs += int(legal.argmax() != online.argmax()) * (1 - int(samples.dones[i]))
            q_tot += float(now[samples.actions[i, agent]].detach()) * bool(samples.now.active[i, agent])
            value += float(target[online.argmax()].detach()) * bool(samples.after.active[i, agent])
        y = float(samples.rewards[i]) + 0.9 * (1 - float(samples.dones[i])) * value
        assert float(error.q_tot[i].detach()) == pytest.approx(q_tot, abs=1e-3)
        assert float(error.td[i].detach()) == pytest.approx(q_tot - y, abs=1e-2)
    assert differs > 4


def test_the_gradient_goes_into_the_online_networks_alone() -> None:
    model = make_model(ToyTeams(), "QPLEXPoolPolicy")
    model.learn(30 * 3)
    policy = model.policy
    policy.optimizer.zero_grad()
    team_errors(policy, model._buffer().sample(64), 0.9).loss.backward()
    online, target = policy.parameter_pairs()
    assert all(parameter.grad is not None for parameter in online)
    assert float(policy.actor.signature_keys.grad.abs().sum()) > 0  # type: ignore[union-attr, operator]
    assert not any(parameter.requires_grad for parameter in target)
    parts: dict[str, Any] = {"detach_state": True}
    attached = {}
    for detach in (True, False):
        parts["detach_state"] = detach
        one = make_model(ToyTeams(), policy_kwargs=parts)
        one.learn(16 * 3)
        one.policy.optimizer.zero_grad()
        np.random.seed(0)  # noqa: NPY002
        team_errors(one.policy, one._buffer().sample(64), 0.9).loss.backward()
        gradient = next(one.policy.features_extractor.parameters()).grad
        assert gradient is not None
        attached[detach] = gradient
    assert not th.equal(attached[True], attached[False])


@pytest.mark.parametrize("kind", ["gru", "lstm"])
def test_memory_in_training_is_memory_in_play(kind: str) -> None:
    """Q values of sequences from the start of episodes equal those of predict, step by step."""
    model = make_model(ToyTeams(length=4, n_games=1), f"QPLEXPolicy-{kind}", buffer_size=12, batch_size=8)
    model.learn(12 * 3)
    policy, buffer = model.policy, model._buffer()
    net = policy.actor_memory
    assert net is not None
    samples = buffer.sample_sequences(1, 12, 0)
    info = samples.sequences
    assert info is not None
    features = policy.encode_with(policy.features_extractor, samples.now.own.flatten(0, 1))
    agents = th.arange(3).repeat(12)
    inputs = net.inputs(features, info.last_actions.flatten(), agents).view(12, 3, -1)
    latents, _ = net(inputs, th.zeros(3, net.state_dim), info.resets.unsqueeze(1).expand(12, 3))
    trained = q_values(policy.actor, latents.flatten(0, 1), agents).view(12, 3, -1).argmax(dim=2)
    state: Any = None
    for t in range(12):
        obs = {"obs": samples.now.own[t].numpy(), "agent": np.arange(3)}
        actions, state = policy.predict(obs, state, np.full(3, t % 4 == 0))
        assert np.array_equal(actions, trained[t])
        state = (state[0], samples.actions[t].numpy())  # the actions that were taken


def test_agents_that_join_have_no_last_action() -> None:
    model = make_model(telling_env(1), "QPLEXPolicy-gru", buffer_size=20, batch_size=8)
    model.learn(20 * 3)
    samples = model._buffer().sample_sequences(1, 20, 0)
    assert samples.sequences is not None and samples.now.active is not None
    none = samples.sequences.resets.unsqueeze(1) | ~samples.now.active.roll(1, 0)
    assert th.equal(samples.sequences.last_actions < 0, none) and none[:, 2].sum() > none[:, 0].sum()


class NormalizedEncoder(BaseFeaturesExtractor):
    def __init__(self, observation_space: spaces.Box):
        super().__init__(observation_space, observation_space.shape[0])
        self.layers = nn.Sequential(nn.BatchNorm1d(self.features_dim), nn.Dropout(0.5))

    def forward(self, x: th.Tensor) -> th.Tensor:
        return self.layers(x)


def test_targets_are_computed_without_dropout_and_by_copied_statistics() -> None:
    model = make_model(policy_kwargs={"features_extractor_class": NormalizedEncoder}).learn(64 * 3)
    assert model.policy.features_extractor.training and not model.policy.target_networks.training
    polyak_update(*model.policy.parameter_pairs(), 1.0)
    learned, target = (one.encoder.state_dict() for one in (model.policy.online, model.policy.target))
    name = "layers.0.running_var"
    assert th.equal(learned[name], target[name]) and not th.equal(target[name], th.ones(3))


# --- playing ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", POLICIES)
def test_agents_learn_where_some_die_join_and_may_not_do_everything(policy: str) -> None:
    """TellingEnv fails at an illegal action."""
    env = telling_env(time_limit="bootstrap")
    model = make_model(env, policy)
    before = weights_of(model)
    model.learn(60 * 3)
    assert before != weights_of(model)
    for player in (model, model.policy):
        assert evaluate_team(player, env, 4, deterministic=False).lengths == [5] * 4


def test_each_agent_tosses_its_own_coin() -> None:
    model = make_model()
    obs = toy_env(40).reset()
    greedy, _ = model.predict(obs, deterministic=True)
    model.exploration_rate = 0.5
    differs = np.array([model.predict(obs)[0] != greedy for _ in range(50)])
    # 4 actions: exploring with 1/2 changes 3/8 of the actions. A common draw for all would change 3/4 of them or none.
    assert differs.mean() == pytest.approx(0.375, abs=0.03)
    assert differs.mean(axis=1).std() < 0.1
    model.exploration_rate = 0.0
    assert np.array_equal(model.predict(obs)[0], greedy)


def test_units_are_game_steps() -> None:
    env = toy_env(4)
    model = make_model(env, learning_starts=40, train_freq=16, gradient_steps=2, target_update_interval=24)
    seen = []

    class Watch(BaseCallback):
        def _on_step(self) -> bool:
            seen.append((self.num_timesteps // 3, model._n_updates, len(model._buffer().seen["obs"])))
            return True

    model.learn(100 * 3, callback=Watch())
    assert model.num_timesteps == 300 and model._buffer().n_stored == 100
    # Updates after 48, 64, 80, 96 game steps, two each; the callback sees them one step later.
    assert [steps for (steps, n, _), (_, m, _) in zip(seen[1:], seen, strict=False) if n > m] == [52, 68, 84, 100]
    assert model._n_updates == 8
    assert seen[0][2] == 200 // 4 + 1
    assert model.exploration_rate == pytest.approx(0.05)


@pytest.mark.parametrize("n_games", [3, 16])
def test_updates_do_not_depend_on_the_number_of_games(n_games: int) -> None:
    model = make_model(toy_env(n_games), train_freq=8, learning_starts=0)
    model.learn(96 * 3)
    assert model._n_updates == 12
    model = make_model(toy_env(n_games), learning_starts=1000, target_update_interval=8, tau=0.1)
    online, targets = model.policy.parameter_pairs()
    for parameters, value in ((online, 1.0), (targets, 0.0)):
        for parameter in parameters:
            parameter.data.fill_(value)
    with pytest.warns(UserWarning, match="nothing is learned in 48 game steps with learning_starts=1,000"):
        model.learn(48 * 3)
    assert targets[0].flatten()[0].item() == pytest.approx(1 - 0.9**6)


def test_logs_tell_what_is_learned(tmp_path: Path) -> None:
    from stable_baselines3.common.logger import configure

    model = make_model()
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(100 * 3, GameStepsCallback(), log_interval=8)
    model.logger.close()
    header, *lines = (tmp_path / "progress.csv").read_text().splitlines()
    wanted = {"train/q_tot", "train/td_error", "train/loss", "rollout/exploration_rate", "rollout/replay_buffer_size"}
    wanted |= {f"lambda/agent_{i}" for i in range(3)} | {"time/game_steps", "rollout/ep_rew_mean"}
    assert wanted <= set(header.split(","))
    assert len(lines) == 100 // 5 // 8  # once for every 8 team episodes
    for row in csv.DictReader([header, *lines]):
        of_agents = [float(row[name]) for name in row if name.startswith("rollout/ep_rew_mean/")]
        assert len(of_agents) == 3 and sum(of_agents) == pytest.approx(float(row["rollout/ep_rew_mean"]), rel=1e-4)


# --- saving -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", POLICIES)
def test_save_load_and_continue_is_the_run_without_a_break(policy: str, tmp_path: Path) -> None:
    """Model, replay buffer, games and random numbers are restored."""
    model = make_model(ToyTeams(), policy).learn(60 * 3)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    numbers = random.getstate(), np.random.get_state(), th.get_rng_state()  # noqa: NPY002
    games = copy.deepcopy(model.env)
    again = QPLEX.load(tmp_path / "model", env=games, force_reset=False, device="cpu")
    with pytest.warns(UserWarning, match="buffer is unpickled, which runs code from it"):
        again.load_replay_buffer(tmp_path / "buffer")
    before = weights_of(model)
    for each in (model, again):
        random.setstate(numbers[0])
        np.random.set_state(numbers[1])  # noqa: NPY002
        th.set_rng_state(numbers[2])
        each.learn(60 * 3, reset_num_timesteps=False)
    assert weights_of(model) == weights_of(again) != before
    assert again.num_timesteps == 120 * 3


def test_replay_buffers_of_other_teams_are_refused(tmp_path: Path) -> None:
    make_model(toy_env(2)).learn(20 * 3).save_replay_buffer(tmp_path / "buffer")
    for other, words in (
        (toy_env(4), r"spaces \(12, .*got TeamReplayBuffer of \(6, "),
        (telling_env(2), "'active'.*got"),
    ):
        model = make_model(other)
        with pytest.warns(UserWarning, match="unpickled"), pytest.raises(ValueError, match=words):
            model.load_replay_buffer(tmp_path / "buffer")
        assert model._buffer().n_envs == model.n_envs
    with pytest.raises(ValueError, match="PQN keeps no steps between rollouts"):
        PQN("PQNPolicy", toy_env(2)).load_replay_buffer(tmp_path / "buffer")


# --- export; with masks and heads: test_pqn.py ------------------------------------------------------------------------


def test_exported_actors_act_greedily(tmp_path: Path) -> None:
    env = make_team_env("TeamSupport", n_envs=4, n_agents=3, grid_size=9, n_treasures=3)
    model = make_model(env, "QPLEXPoolPolicy-lstm", policy_kwargs={"features_extractor_class": LightEncoder})
    memory = model.policy.actor_memory
    assert memory is not None
    for parameter in [*model.policy.actor.parameters(), *memory.parameters()]:  # they begin with values close to zero
        parameter.data.add_(th.randn_like(parameter) * 0.3)
    export_actors(model, tmp_path / "actor")
    actors = [Actor.load(tmp_path / "actor", agent=agent) for agent in range(3)]
    of_teams, of_one = [actor.new_memory() for actor in actors], actors[0].new_memory()
    obs: Any = env.reset()
    state: Any = None
    for _ in range(4):
        expected, state = model.predict(obs, state, deterministic=True)
        for agent, actor in enumerate(actors):
            own = obs["obs"][agent::3]
            again = copy.deepcopy(of_teams[agent])
            assert np.array_equal(actor.act(own, memory=of_teams[agent]), expected[agent::3])
            assert np.array_equal(actor.act(own, deterministic=False, memory=again), expected[agent::3])
        assert actors[0].act(obs["obs"][0], memory=of_one) == expected[0]
        with pytest.raises(ValueError, match="highest value: nothing is drawn"):
            actors[0].probabilities(obs["obs"][::3], memory=of_teams[0])
        obs = env.step(expected)[0]
    assert np.array_equal(of_teams[2].states["last_action"].argmax(axis=1), expected[2::3])


def test_acting_reads_nothing_but_own_observations() -> None:
    env = toy_env()
    model, obs = make_model(env).learn(40 * 3), env.reset()
    assert np.array_equal(model.predict(obs["obs"], deterministic=True)[0], model.predict(obs, deterministic=True)[0])
    alone = [model.predict(own, deterministic=True)[0] for own in obs["obs"]]
    assert np.array_equal(alone, model.predict(obs, deterministic=True)[0])
    with pytest.raises(ValueError, match="'agent'"):
        make_model(env, "QPLEXPolicy-lstm").predict(obs["obs"], deterministic=True)


# --- errors -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"mixer": "qmixx"}, "mixer must be one of 'vdn', 'qmix', 'qplex', got 'qmixx'"),
        ({"batch_size": 300}, "batch_size must be at most buffer_size, got 300 and 200 game steps"),
        ({"train_freq": (1, "episode")}, "number of game steps"),
        ({"max_grad_norm": -1.0}, "max_grad_norm must be above 0, got -1.0"),
        ({"gamma": 1.5}, "gamma must be from 0 to 1, got 1.5"),
        ({"exploration_final_eps": 2}, "exploration_final_eps must be from 0 to 1, got 2"),
        ({"tau": 0.0}, "tau must be above 0 and at most 1, got 0.0"),
        ({"gradient_steps": 0}, "gradient_steps must be at least 1, or -1, got 0"),
        ({"learning_starts": -5}, "learning_starts must be at least 0, got -5"),
        ({"replay_buffer_class": dict}, "TeamReplayBuffer"),
        ({"policy_kwargs": {"heads": "own"}}, "heads must be one of"),
    ],
)
def test_bad_settings(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_model(**kwargs)


def test_bad_environments() -> None:
    with pytest.raises(ValueError, match="make_team_env"):
        QPLEX("QPLEXPolicy", "CartPole-v1")
    with pytest.raises(ValueError, match="QPLEX needs Discrete actions"):
        make_model(ToyTeams(action_space=spaces.Box(-1.0, 1.0, (2,), np.float32)))
    with pytest.raises(ValueError, match="QPLEX needs Discrete actions"):
        make_model(ToyTeams(action_space=spaces.Discrete(3, start=1)))
    model = make_model()
    model.set_env(VecNormalize(toy_env(), norm_obs=False))
    with pytest.raises(ValueError, match="QPLEX does not train on VecNormalize"):
        model.learn(3)
    with pytest.raises(ValueError, match="expected one of QPLEX's policies"):
        make_model(policy="QPLEXPolice")


# --- mixers, by enumeration -------------------------------------------------------------------------------------------


STATE_DIM, N_ACTIONS = 6, 3


def make_mixer(name: str, n_agents: int) -> Mixer:
    if name == "vdn":
        return VDNMixer()
    if name == "qmix":
        return QMIXMixer(STATE_DIM, n_agents)
    return QPLEXMixer(STATE_DIM, n_agents, N_ACTIONS)


def joint_values(
    mixer: Mixer, values: th.Tensor, state: th.Tensor, active: th.Tensor | None
) -> tuple[th.Tensor, th.Tensor]:
    """Return Q_tot (G, A**N) of all joint actions, and the joint actions (A**N, N), from values (G, N, A)."""
    n_steps, n_agents, n_actions = values.shape
    joint = th.tensor(list(product(range(n_actions), repeat=n_agents)))
    best = values.max(dim=2).values
    columns = []
    for actions in joint:
        each = actions.expand(n_steps, -1)
        chosen = values.gather(2, each.unsqueeze(2)).squeeze(2)
        columns.append(mixer(state, JointChoice(chosen, best, each, active)).q_tot)
    return th.stack(columns, dim=1), joint


@pytest.mark.parametrize("name", ["vdn", "qmix", "qplex"])
@pytest.mark.parametrize("n_agents", [1, 2, 4])
@pytest.mark.parametrize("idle", [False, True])
def test_the_best_joint_action_is_everyones_own_best(name: str, n_agents: int, idle: bool) -> None:
    mixer, n_steps = make_mixer(name, n_agents), 50
    values = 3 * th.randn(n_steps, n_agents, N_ACTIONS)
    illegal = th.rand(values.shape) < 0.3
    illegal[:, :, 1] &= ~illegal.all(dim=2)
    active = th.rand(n_steps, n_agents) < 0.6 if idle else None
    with th.no_grad():
        legal_values = values.masked_fill(illegal, -th.inf)
        q_tot, joint = joint_values(mixer, values.masked_fill(illegal, -50.0), 2 * th.randn(n_steps, STATE_DIM), active)
    is_legal = ~illegal.gather(2, joint.t().expand(n_steps, -1, -1)).any(dim=1)
    found = joint[q_tot.masked_fill(~is_legal, -th.inf).argmax(dim=1)]
    own = legal_values.argmax(dim=2)
    counted = th.ones_like(own, dtype=th.bool) if active is None else active
    assert th.equal(found[counted], own[counted])


@pytest.mark.parametrize("n_agents", [2, 3])
def test_qmix_never_falls_when_an_agents_value_rises(n_agents: int) -> None:
    mixer, n_steps = make_mixer("qmix", n_agents), 200
    chosen = th.randn(n_steps, n_agents, requires_grad=True)
    actions = th.zeros(n_steps, n_agents, dtype=th.long)
    mixer(th.randn(n_steps, STATE_DIM), JointChoice(chosen, chosen, actions)).q_tot.sum().backward()
    assert chosen.grad is not None and (chosen.grad >= 0).all() and (chosen.grad > 0).any()


def test_qplex_is_the_published_sum() -> None:
    """Sum V' + sum lambda A', where advantages have no gradient for the agents."""
    mixer, n_steps, n_agents = QPLEXMixer(STATE_DIM, 3, N_ACTIONS), 40, 3
    state, values = th.randn(n_steps, STATE_DIM), th.randn(n_steps, n_agents, N_ACTIONS, requires_grad=True)
    actions = th.randint(N_ACTIONS, (n_steps, n_agents))
    chosen, best = values.gather(2, actions.unsqueeze(2)).squeeze(2), values.max(dim=2).values
    mixed = mixer(state, JointChoice(chosen, best, actions))
    scale, shift = mixer.scale(state).abs() + 1e-10, mixer.shift(state)
    assert mixed.weights is not None and (mixed.weights > 0).all()
    expected = (scale * best + shift + mixed.weights * scale * (chosen - best)).sum(dim=1)
    assert th.allclose(mixed.q_tot, expected, atol=1e-5)
    mixed.q_tot.sum().backward()
    assert values.grad is not None
    assert th.allclose(values.grad.gather(2, actions.unsqueeze(2)).squeeze(2), scale)
    assert int((values.grad != 0).sum()) == n_steps * n_agents
    assert all(parameter.grad is not None for parameter in mixer.parameters())


@pytest.mark.parametrize(("n_agents", "state_dim"), [(2, 128), (5, 320)])
def test_lambda_tells_joint_actions_apart_from_the_start(n_agents: int, state_dim: int) -> None:
    """
    Standard deviation of log lambda over joint actions, and of its remainder after fitting a sum over agents.

    Measured for (2, 128): 0.33 and 0.06. With torch's default initialisation: 0.005 and 0.0007.
    """
    mixer = QPLEXMixer(state_dim, n_agents, N_ACTIONS)
    joint = th.tensor(list(product(range(N_ACTIONS), repeat=n_agents)))
    nothing = th.zeros(joint.shape)
    with th.no_grad():
        weights = mixer.advantage_weights(
            th.randn(1, state_dim).expand(len(joint), -1), JointChoice(nothing, nothing, joint)
        ).log()
    actions = th.nn.functional.one_hot(joint, N_ACTIONS).flatten(1).to(weights.dtype)
    rest = weights - actions @ th.linalg.lstsq(actions, weights, driver="gelsd").solution
    assert weights.std(dim=0).mean() > 0.08
    assert rest.std(dim=0).mean() > 0.02


@pytest.mark.parametrize("name", ["vdn", "qmix", "qplex"])
def test_agents_that_take_no_part_do_not_count(name: str) -> None:
    mixer = make_mixer(name, 2)
    active = th.tensor([[True, False]])
    state = th.randn(1, STATE_DIM)
    totals = [
        mixer(state, JointChoice(th.tensor([[1.0, x]]), th.tensor([[2.0, y]]), th.tensor([[0, a]]), active)).q_tot
        for x, y, a in ((0.0, 0.0, 0), (-5.0, 7.0, 2))
    ]
    assert th.equal(*totals)
