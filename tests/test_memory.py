"""Policies with memory, trained by stock PPO, A2C and TRPO with TeamRolloutBuffer."""

from __future__ import annotations

import copy
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch as th
from sb3_contrib import TRPO, MaskablePPO, RecurrentPPO
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import obs_as_tensor

from benchmarks.memory import share_right, trained
from sb3_saf import QPLEX, CentralizedValueWrapper, InspectionCallback, TeamRolloutBuffer, evaluate_team, make_team_env
from sb3_saf.inspection.recording import record_episodes
from sb3_saf.networks.memory import Memory
from tests.team_venv import TeamVenv
from tests.test_policies import NAMES as POLICIES
from tests.weights import DyingGame, weights_of

KINDS = ("gru", "lstm")
SMALL: dict[str, Any] = {"net_arch": [16], "memory_size": 8}


def vector(game: int, agent: int, episode: int, step: int) -> np.ndarray:
    """What an agent sees: different everywhere, of size one."""
    return np.sin(np.array([game + 1, agent + 1, episode + 1, step + 1]) * np.array([3.1, 1.7, 2.3, 4.9]))


def make_env(lengths: tuple[int, ...] = (3, 5, 7), **kwargs: Any) -> CentralizedValueWrapper:
    time_limit = kwargs.pop("time_limit", "terminal")
    return CentralizedValueWrapper(TeamVenv(lengths, see=vector, **kwargs), time_limit=time_limit)


def make_model(policy: str = "SAFPolicy", kind: str | None = "gru", env: Any = None, **kwargs: Any) -> Any:
    """Make a model with a small memory; rollouts have 16 steps, sequences 8."""
    env = make_env() if env is None else env
    algorithm = kwargs.pop("algorithm", PPO)
    arguments: dict[str, Any] = {"n_steps": 16, "seed": 0, "device": "cpu", "rollout_buffer_class": TeamRolloutBuffer}
    if algorithm is not A2C:
        arguments["batch_size"] = 8 * env.num_envs
    if algorithm is PPO:
        arguments["n_epochs"] = 2
    policy_kwargs = {**SMALL, "memory": kind, **kwargs.pop("policy_kwargs", {})}
    buffer = {"rollout_buffer_kwargs": {"sequence_length": 8}} if kind is not None else {}
    return algorithm(policy, env, policy_kwargs=policy_kwargs, **{**arguments, **buffer, **kwargs})


def collected(model: Any) -> Any:
    """Collect one rollout without an update; two more steps of the memory's life precede it."""
    model.n_epochs = 0
    model.train = lambda: None
    model.learn(2 * model.n_steps * model.env.num_envs)
    return model


def weights(model: Any) -> dict[str, th.Tensor]:
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


# --- sequences --------------------------------------------------------------------------------------------------------


def test_advantages_can_be_computed_again() -> None:
    """As by a callback that changes rewards at the end of a rollout; until then nobody reads values."""
    model = collected(make_model())
    buffer, model.n_epochs = model.rollout_buffer, 1
    known, memories = buffer.advantages.copy(), buffer.memories
    buffer.rewards += 1
    buffer.compute_returns_and_advantage(th.zeros(buffer.n_envs), np.ones(buffer.n_envs))
    assert buffer.memories is memories
    assert (buffer.advantages > known).all()
    PPO.train(model)
    buffer.reset()
    model.policy.set_training_mode(False)
    with th.no_grad():
        actions, values, log_probs = model.policy(obs_as_tensor(model._last_obs, model.device))
    rows = model._last_obs, actions.numpy(), np.zeros(buffer.n_envs), np.zeros(buffer.n_envs)
    buffer.add(*rows, values, log_probs)
    assert np.isnan(buffer.values[0]).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("game", ["dying", "staggered"])
def test_updates_see_the_values_and_likelihoods_of_the_rollout(policy: str, kind: str, game: str) -> None:
    """Across cuts, beginnings, deaths and joins; the second rollout goes on with the memory of the first."""
    env: Any = make_team_env(DyingGame, 3, seed=0) if game == "dying" else make_env()
    model = collected(make_model(policy, kind, env, policy_kwargs={"normalize_values": True}))
    n_rows = 0
    for sample in model.rollout_buffer.get(model.batch_size):
        values, log_prob, _ = model.policy.evaluate_actions(sample.observations, sample.actions.long().flatten())
        th.testing.assert_close(log_prob, sample.old_log_prob, rtol=0, atol=2e-6)
        th.testing.assert_close(values.flatten(), sample.old_values, rtol=2e-6, atol=2e-6)
        n_rows += len(values)
    active = env.num_envs * 16 if model.rollout_buffer.active is None else int(model.rollout_buffer.active.sum())
    assert n_rows == active, "rows of inactive agents are left out, all others occur once"


@pytest.mark.parametrize("kind", KINDS)
def test_memory_is_that_of_the_agents_own_episode(kind: str) -> None:
    """Against an LSTM or GRU that reads one episode of one agent by itself, in games of 3, 5 and 7 steps."""
    env, model = make_env(), make_model("MAPPOPolicy", kind, make_env())
    policy = model.policy
    seen: list[list[th.Tensor]] = [[] for _ in range(9)]
    policy.set_training_mode(False)
    obs: Any = env.reset()
    for step in range(20):
        starts = [step % length == 0 for length in (3, 5, 7) for _ in range(3)]
        with th.no_grad():
            features = policy.extract_features(obs_as_tensor(obs, policy.device))
            policy(obs_as_tensor(obs, policy.device))
            for row, begins in enumerate(starts):
                seen[row] = [features[row], *([] if begins else seen[row])]
                outputs, _ = policy.actor_memory.rnn(th.stack(seen[row][::-1]).unsqueeze(1))
                th.testing.assert_close(policy.running.actor[row, :8], outputs[-1, 0], rtol=0, atol=1e-6)
        obs = env.step(np.zeros(9, dtype=int))[0]


@pytest.mark.parametrize("kind", KINDS)
def test_the_compiled_loops_are_pytorchs(kind: Any) -> None:
    """Outputs and gradients, with episodes that begin in between; PyTorch's is used where TRPO differentiates twice."""
    th.manual_seed(0)
    net, inputs = Memory(kind, 5, 7), th.randn(9, 6, 5)
    memory = th.randn(6, net.state_dim)
    starts, weight = th.rand(9, 6) < 0.3, th.randn(9, 6, 7)
    assert starts[1:].any(dim=1).sum() > 3
    results = []
    for twice in (False, True):
        leaves = [part.clone().requires_grad_() for part in (inputs, memory)]
        outputs, after = net(*leaves, starts, twice)
        loss = (outputs * weight).sum() + after.square().sum()
        every = net.every(leaves[0], leaves[1], starts)
        assert th.equal(every[:, :, :7], outputs) or twice
        results.append([outputs, after, *th.autograd.grad(loss, [*leaves, *net.parameters()])])
    for one, other in zip(*results, strict=True):
        th.testing.assert_close(one, other, rtol=1e-5, atol=2e-6)


def test_a_teams_memory_goes_on_when_an_agent_joins() -> None:
    env = make_team_env(DyingGame, 1, seed=0)
    policy = make_model("MAPPOPolicy", env=env).policy
    policy.set_training_mode(False)
    obs: Any = env.reset()
    for step in range(9):  # c joins in step 2, the next episode begins with step 7
        tensors, memory = obs_as_tensor(obs, policy.device), copy.deepcopy(policy.running)
        with th.no_grad():
            values = policy(tensors)[1] + 0
            if step:
                memory.critic.zero_()
                with policy.remembering(memory):
                    forgetful = policy(tensors)[1] + 0
                assert th.equal(values, forgetful) == (step == 7)
        obs = env.step(obs["action_mask"].argmax(axis=1))[0]


@pytest.mark.parametrize("policy", POLICIES)
def test_games_do_not_mix(policy: str) -> None:
    """Values of a batch are those of each game alone, and permuting games permutes values."""
    model = make_model(policy, env=make_env((5, 5, 5, 5)))
    env, rows = make_env((5, 5, 5, 5)), np.arange(12).reshape(4, 3)
    order = np.array([2, 0, 3, 1])

    def played(choose: np.ndarray) -> np.ndarray:
        """Values of the steps of some games, (T, E, N)."""
        obs: Any = env.reset()
        values, memory = [], type(model.policy.running)()
        with model.policy.remembering(memory), th.no_grad():
            model.policy.set_training_mode(False)
            for _ in range(7):
                some = {key: part[rows[choose].reshape(-1)] for key, part in obs.items()}
                values.append(model.policy(obs_as_tensor(some, model.device))[1].numpy().reshape(-1, 3))
                obs = env.step(np.zeros(12, dtype=int))[0]
        return np.stack(values)

    together = played(np.arange(4))
    np.testing.assert_allclose(played(order), together[:, order], rtol=0, atol=1e-6)
    for game in range(4):
        np.testing.assert_allclose(played(np.array([game]))[:, 0], together[:, game], rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("policy", POLICIES)
def test_actions_depend_on_the_agents_own_history_to_the_last_bit(policy: str, kind: str) -> None:
    model, rng = make_model(policy, kind), np.random.default_rng(0)
    own = rng.normal(size=(6, 9, 4)).astype(np.float32)
    others = own.copy()
    others[:, 1::3] = rng.normal(size=(6, 3, 4))  # all agents 1
    kept = np.arange(9) % 3 != 1

    def log_probs(views: np.ndarray) -> list[th.Tensor]:
        found, memory = [], None
        for obs in views:
            obs = th.as_tensor(obs)
            with th.no_grad():
                features = model.policy.encode_own({"obs": obs})
                latents, memory = model.policy.remember(features.of_rows(), memory)
                found.append(model.policy._distribution({"obs": obs}, features, latents=latents).log_prob(th.zeros(9)))
        return found

    for one, other in zip(log_probs(own), log_probs(others), strict=True):
        assert th.equal(one[kept], other[kept]) and not th.equal(one, other)


def test_one_update_is_that_of_recurrent_ppo() -> None:
    """With equal weights and whole episodes, every weight after one update agrees to 1e-5 with sb3-contrib's."""
    arguments: dict[str, Any] = {"n_steps": 5, "batch_size": 60, "n_epochs": 1, "seed": 0, "device": "cpu"}
    ours = make_model(
        "IPPOPolicy",
        "lstm",
        make_env((5, 5, 5, 5)),
        rollout_buffer_kwargs={},
        policy_kwargs={"features_extractor_class": FlattenExtractor},
        **arguments,
    )
    sizes: dict[str, Any] = {"net_arch": [16], "lstm_hidden_size": 8}
    theirs = RecurrentPPO("MlpLstmPolicy", TeamVenv((5,) * 4, see=vector), policy_kwargs=sizes, **arguments)
    places = {
        "actor_memory.rnn": "lstm_actor",
        "value_net.memory.rnn": "lstm_critic",
        "actor.head.net.0": "mlp_extractor.policy_net.0",
        "actor.head.net.2": "action_net",
        "value_net.value_head.head.0": "mlp_extractor.value_net.0",
        "value_net.value_head.head.2": "value_net",
    }
    names = {name: f"{places[name.rsplit('.', 1)[0]]}.{name.rsplit('.', 1)[1]}" for name in weights(ours)}
    theirs.policy.load_state_dict({names[name]: value for name, value in weights(ours).items()})
    before = weights(ours)

    update, ours.train = ours.train, lambda: None
    ours.learn(60)
    theirs._setup_learn(60)
    ours_buffer: Any = ours.rollout_buffer
    buffer: Any = theirs.rollout_buffer
    buffer.reset()
    state = th.zeros(1, 12, 8)
    for t in range(5):
        step = [getattr(ours_buffer, name)[t] for name in ("actions", "rewards", "episode_starts")]
        known = [th.as_tensor(getattr(ours_buffer, name)[t]) for name in ("values", "log_probs")]
        obs, states = ours_buffer.observations["obs"][t], RNNStates((state, state), (state, state))
        buffer.add(obs, *step, *known, lstm_states=states)  # unused: every sequence is a whole episode
    buffer.returns, buffer.advantages = ours_buffer.returns.copy(), ours_buffer.advantages.copy()
    # sb3-contrib cuts one episode at a random place; at this one it cuts between two.
    seed = next(seed for seed in range(1000) if np.random.RandomState(seed).randint(60) % 5 == 0)
    np.random.seed(seed)  # noqa: NPY002
    theirs.train()
    update()
    after, expected = weights(ours), theirs.policy.state_dict()
    for name, value in after.items():
        th.testing.assert_close(value, expected[names[name]], rtol=0, atol=1e-5)
        assert not th.equal(value, before[name]), name


@pytest.mark.parametrize("policy", POLICIES)
def test_last_observations_are_bootstrapped_with_the_memory_of_their_row(policy: str) -> None:
    env = make_env((3, 5, 7), time_limit="bootstrap")
    model = collected(make_model(policy, env=env, gamma=0.5, seed=1))
    buffer, rows = model.rollout_buffer, env.num_envs
    again = make_env((3, 5, 7), time_limit="bootstrap")
    obs: Any = again.reset()
    memory = type(model.policy.running)()
    n_ends = 0
    with th.no_grad(), model.policy.remembering(memory):
        for step in range(32):
            model.policy(obs_as_tensor(obs, model.device))
            obs, rewards, dones, infos = again.step(np.zeros(rows, dtype=int))
            for row in np.flatnonzero(dones):
                alone = copy.deepcopy(memory)
                last = model.policy.obs_to_tensor(infos[row]["terminal_observation"])[0]
                with model.policy.remembering(alone):
                    value = float(model.policy.predict_values(last))
                if step >= 16:
                    assert buffer.rewards[step - 16, row] == pytest.approx(rewards[row] + 0.5 * value, rel=1e-5)
                    n_ends += 1
                # The same as the next step of all games, in which this row sees its last observation.
                rows_of_game = slice(row // 3 * 3, row // 3 * 3 + 3)
                lasts = [infos[one]["terminal_observation"] for one in range(rows)[rows_of_game]]
                full = {key: part.copy() for key, part in obs.items()}
                for key in full:
                    full[key][rows_of_game] = [one[key] for one in lasts]
                values = model.policy.predict_values(obs_as_tensor(full, model.device))
                assert float(values[row]) == pytest.approx(value, abs=1e-6)
    assert n_ends > 20


# --- algorithms -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("policy", "algorithm", "critic_memory"),
    [*product(POLICIES, [PPO], [True, False]), ("SAFPolicy", A2C, True), ("MAPPOPolicy", TRPO, True)],
)
def test_every_weight_is_trained(policy: str, algorithm: Any, critic_memory: bool) -> None:
    env = make_team_env(DyingGame, 4, seed=0, time_limit="bootstrap")
    model = make_model(policy, "lstm", env, algorithm=algorithm, policy_kwargs={"critic_memory": critic_memory})
    before = weights(model)
    model.learn(3 * 16 * env.num_envs)
    assert all(th.isfinite(value).all() for value in model.policy.state_dict().values())
    assert not [name for name, value in weights(model).items() if th.equal(value, before[name])]
    has_memory = any("value_net.memory" in name for name in before)
    assert has_memory == critic_memory


def test_evaluations_and_inspections_between_change_nothing_and_see_the_policy_that_remembers(tmp_path: Any) -> None:
    class Evaluate(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls % 7 == 0:
                states = th.get_rng_state(), np.random.get_state()  # noqa: NPY002
                evaluate_team(self.model, make_env(), 4, warn=False)
                th.set_rng_state(states[0])
                np.random.set_state(states[1])  # noqa: NPY002
            return True

    inspection = InspectionCallback(make_env(), n_eval_episodes=6, every_game_steps=40, pictures=False)
    plain, evaluated, inspected = (
        make_model(tensorboard_log=str(tmp_path)).learn(48 * 9, callback=callback)
        for callback in (None, Evaluate(), inspection)
    )
    assert weights_of(plain) == weights_of(evaluated) == weights_of(inspected)
    recorded = record_episodes(inspected.policy, make_env(), 6, gamma=0.9)
    assert np.isfinite(recorded.values).all()


# --- learning ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "memory", "n_episodes"),
    [
        ("ippo", "lstm", 2_000),
        ("qplex", "gru", 3_000),
    ],
)
def test_a_cue_in_the_first_step_is_answered_in_the_last(method: str, memory: str, n_episodes: int) -> None:
    """With masks, and an agent that may have left before; ``python -m benchmarks.memory`` is the whole ladder."""
    assert share_right(trained(method, memory, 3, n_episodes=n_episodes), 3) > 0.95


# --- acting -----------------------------------------------------------------------------------------------------------


def test_predict_is_what_the_rollout_did() -> None:
    model, env = make_model("SAFPolicy", "lstm"), make_env()
    obs: Any = env.reset()
    state, starts = None, np.ones(9, dtype=bool)
    for _ in range(12):
        with th.no_grad():
            model.policy.set_training_mode(False)
            wanted = model.policy(obs_as_tensor(obs, model.device), deterministic=True)[0]
        own = {"obs": obs["obs"]}
        found, after = model.predict(own, state, starts, deterministic=True)
        rows, state = model.predict(obs, state, deterministic=True)
        assert found.tolist() == rows.tolist() == wanted.tolist()
        np.testing.assert_array_equal(after[0], state[0])
        assert state[0].shape == (9, 16)
        obs, _, starts, _ = env.step(found)


def test_states_of_other_rows_and_masks_that_no_row_has_are_refused() -> None:
    model, obs = make_model("SAFPolicy", "lstm"), make_env().reset()
    _, (state,) = model.predict(obs)
    for wrong in (state[:-1], np.tile(state, (2, 1)), state[:, :8]):
        with pytest.raises(ValueError, match=r"expected a state of shape \(9, 16\), a row for each observation, got"):
            model.predict(obs, (wrong,))
    qplex = QPLEX("QPLEXPolicy", make_env(), policy_kwargs={"memory": "gru", "memory_size": 16})
    _, parts = qplex.predict(obs)
    assert parts is not None
    with pytest.raises(ValueError, match=r"expected a state of shape \(9, 16\), a row for each observation, got"):
        qplex.predict(obs, tuple(part[:-1] for part in parts))
    with pytest.raises(ValueError, match="without masks of actions: leave them out"):
        model.policy.predict(obs, (state,), action_masks=np.ones((9, 5)))


def test_predict_remembers_by_agent() -> None:
    env = make_team_env(DyingGame, 1, seed=0)
    model = make_model("IPPOPolicy", env=env)
    game = DyingGame()
    observations, infos = game.reset(seed=3)
    state, alone = dict[str, Any](), dict[str, Any]()
    while observations:
        agents = list(observations)[::-1]
        seen = {
            agent: {"observation": observations[agent], "action_mask": infos[agent]["action_mask"]} for agent in agents
        }
        actions, state = model.predict(seen, state=state, deterministic=True)
        assert list(actions) == list(state) == agents
        for agent in agents:
            entries = {"obs": seen[agent]["observation"], "action_mask": seen[agent]["action_mask"]}
            action, alone[agent] = model.predict(entries, state=alone.get(agent), deterministic=True)
            assert action == actions[agent]
            np.testing.assert_allclose(alone[agent][0][0], state[agent][0], rtol=0, atol=1e-7)
        observations, _, ends, cuts, infos = game.step(actions)
        over = {agent for agent in observations if ends[agent] or cuts[agent]}
        observations = {agent: view for agent, view in observations.items() if agent not in over}


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: make_model(kind="elman"), "memory"),
        (lambda: make_model(policy_kwargs={"memory_size": 0}), "memory_size"),
        (lambda: make_model(rollout_buffer_kwargs={"sequence_length": 5}), "sequence_length"),
        (lambda: MaskablePPO("SAFMaskablePolicy", make_env(), policy_kwargs={"memory": "gru"}), "memory"),
        (
            lambda: PPO("SAFPolicy", make_env(), n_steps=8, batch_size=72, policy_kwargs={"memory": "gru"}).learn(72),
            "TeamRolloutBuffer",
        ),
    ],
)
def test_errors_name_the_argument(make: Any, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        make()
