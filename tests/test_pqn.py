"""PQN-VDN: returns, known answers, the same results as one step at a time, saving, what it refuses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_saf import PQN, Actor, LightEncoder, evaluate_team, export_actors, make_team_env
from sb3_saf.qplex.learning import greedy_q_tot, joint_values
from sb3_saf.qplex.mixers import MIXER_NAMES
from sb3_saf.qplex.pqn import lambda_returns
from tests.probe_envs import TwoStates
from tests.test_qplex import telling_env, toy_env
from tests.weights import weights_of


def make_model(env: Any = None, **kwargs: Any) -> PQN:
    quick: dict[str, Any] = {"rollout_steps": 5, "batch_size": 8, "device": "cpu", "seed": 0}
    nets = {"net_arch": [16], "mixer_hidden": 16, "kernel_arch": (16,)}
    return PQN("PQNPolicy", toy_env() if env is None else env, **(quick | {"policy_kwargs": nets} | kwargs))


# --- returns ----------------------------------------------------------------------------------------------------------


def test_lambda_returns_mix_returns_of_every_length() -> None:
    """The return is the weighted mean of k-step returns, those that reach an end or the rollout's end with the rest."""
    rng, gamma, td_lambda = np.random.default_rng(0), 0.9, 0.7
    rewards, following = rng.normal(size=(2, 6))
    ends, terminal = np.zeros(6, dtype=bool), np.zeros(6)
    ends[1] = terminal[1] = ends[3] = True  # an end, and a time limit
    expected = []
    for start in range(6):
        last = next((step for step in range(start, 6) if ends[step]), 5)
        total, discounted = 0.0, []
        for k, step in enumerate(range(start, last + 1)):
            total += gamma**k * rewards[step]
            discounted.append(total + gamma ** (k + 1) * (1 - terminal[step]) * following[step])
        weights = [(1 - td_lambda) * td_lambda**k for k in range(len(discounted) - 1)]
        expected.append(np.dot([*weights, 1 - sum(weights)], discounted))
    columns = [th.as_tensor(part).unsqueeze(1) for part in (rewards, following, terminal, ends)]
    returns = lambda_returns(columns[0], columns[1], columns[2], columns[3], gamma, td_lambda)
    np.testing.assert_allclose(returns.squeeze(1).numpy(), expected)


def test_values_on_policy_do_not_diverge() -> None:
    """VDN would diverge on this game from uniform data in a replay buffer (arXiv 2006.00587); its value is 10."""
    env = make_team_env(TwoStates(length=10), n_envs=8, active=False, time_limit="bootstrap")
    model = make_model(env, gamma=0.9, learning_rate=2e-3, td_lambda=0.3, rollout_steps=8, batch_size=32)
    model.learn(4_000 * 2)
    actions, _ = model.predict(env.reset(), deterministic=True)
    assert not actions.any()  # both stay where they are paid
    obs: Any = env.step(actions)[0]
    values = model.policy.own_q_values(model.policy.obs_to_tensor(obs)[0]).max(dim=1).values
    assert values.sum().item() / 8 == pytest.approx(10, abs=1)


@pytest.mark.parametrize("mixer", MIXER_NAMES)
def test_values_of_stored_steps_are_those_of_rows(mixer: Any) -> None:
    """Agents that join and die, masks and a state; the sum of the best values is that of the greedy joint action."""
    model = make_model(telling_env(), mixer=mixer, rollout_steps=6)
    model.learn(4 * 3)
    policy = model.policy
    obs: Any = telling_env().reset()
    rows: Any = policy.obs_to_tensor(obs)[0]
    n_actions = rows["action_mask"].shape[1]
    rows["action_mask"] = th.eye(n_actions)[th.arange(len(rows["action_mask"])) % n_actions]  # one legal action each
    masks = rows["action_mask"].view(-1, 3, n_actions) != 0
    with th.no_grad():
        expected = greedy_q_tot(policy, rows, policy.own_q_values(rows))[::3]
        values = joint_values(policy, policy.team_steps(rows)._replace(masks=masks))
    th.testing.assert_close(values, expected)


# --- learning ---------------------------------------------------------------------------------------------------------


def test_it_learns_team_support() -> None:
    """A random team collects 1.0 to 1.6 of 6 treasures, this one 5.5 after 8,000 game steps; here it trains 5,000."""
    games: dict[str, Any] = {"n_agents": 3, "grid_size": 8, "n_treasures": 6, "n_keys": 2, "max_cycles": 20}
    env = make_team_env("TeamSupport", n_envs=32, seed=0, **games)
    encoder = {"features_extractor_class": LightEncoder}
    model = PQN("PQNPolicy", env, gamma=0.9, td_lambda=0.65, policy_kwargs=encoder, batch_size=128, seed=0)
    model.learn(5_000 * env.n_agents)
    tests = make_team_env("TeamSupport", n_envs=64, seed=10_000, **games)
    assert evaluate_team(model, tests, 64).mean > 3.5


class StopAfterStep(BaseCallback):
    """Ends the training after ``n_steps`` steps."""

    def __init__(self, n_steps: int) -> None:
        super().__init__()
        self.n_steps = n_steps

    def _on_step(self) -> bool:
        return self.n_calls < self.n_steps


def test_each_rollout_is_learned_from_once(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(rollout_steps=4, batch_size=8, n_epochs=2)
    model.learn(3 * 4 * 4 * 3)  # three rollouts of 4 steps in 4 games of 3 agents
    assert model._n_updates == 3 * 2 * 2
    assert model._buffer().size() == 0
    before = weights_of(model)
    model.learn(4 * 4 * 3, StopAfterStep(2))
    assert weights_of(model) == before
    assert model._buffer().size() == 2  # the last step is stored, too
    ends: list[th.Tensor] = []

    def spy(*parts: Any) -> th.Tensor:
        ends.append(parts[3])
        return lambda_returns(*parts)

    monkeypatch.setattr("sb3_saf.qplex.pqn.lambda_returns", spy)
    model.learn(1)  # to the end of a rollout; games begin anew
    assert weights_of(model) != before and model.num_timesteps == 4 * 4 * 3
    assert ends[0].tolist() == [[False] * 4, [True] * 4, [False] * 4, [False] * 4]
    model = make_model(rollout_steps=4, batch_size=8)
    model.learn(4 * 4 * 3, StopAfterStep(4))  # a whole rollout is stored, and its first step makes room for another
    model.learn(1)
    assert ends[-1].tolist() == [[False] * 4, [False] * 4, [True] * 4, [False] * 4]


def test_a_batch_is_at_most_the_rollout() -> None:
    model = make_model(rollout_steps=5, batch_size=1000, n_epochs=2)
    model.learn(5 * 4 * 3)
    assert model._n_updates == 2


def test_saved_and_exported_teams_act_alike(tmp_path: Path) -> None:
    model = make_model(telling_env(), rollout_steps=4, policy_kwargs={"net_arch": [16], "heads": "per_agent"})
    model.learn(40 * 3)
    model.save(tmp_path / "team.zip")
    loaded = PQN.load(tmp_path / "team.zip", device="cpu")
    assert (loaded.rollout_steps, loaded.td_lambda, loaded.policy.parts.mixer) == (4, 0.5, "vdn")
    obs: Any = telling_env(n_games=16).reset()
    actions, _ = model.predict(obs, deterministic=True)
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], actions)
    with th.no_grad():  # so that all actions are somebody's best
        for parameter in model.policy.actor.parameters():
            parameter.add_(th.randn_like(parameter))
    folder, rng = export_actors(model, tmp_path / "actors"), np.random.default_rng(0)
    actors = [Actor.load(folder, agent=agent) for agent in range(3)]
    chosen = set()
    for _ in range(20):
        masks = (rng.random(obs["action_mask"].shape) < 0.5).astype(np.int8)
        masks[np.arange(len(masks)), rng.integers(masks.shape[1], size=len(masks))] = 1
        expected = model.predict({**obs, "action_mask": masks}, deterministic=True)[0]
        for agent, actor in enumerate(actors):
            acted = actor.act(obs["obs"][agent::3], action_mask=masks[agent::3])
            np.testing.assert_array_equal(acted, expected[agent::3])
        chosen |= set(expected.tolist())
    assert len(chosen) > 2


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"td_lambda": 1.5}, "td_lambda must be from 0 to 1, got 1.5"),
        ({"rollout_steps": 0}, "rollout_steps must be an integer of at least 1"),
        ({"policy_kwargs": {"memory": "gru"}}, "PQN has neither memory nor a pool"),
    ],
)
def test_invalid_settings(kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make_model(**kwargs)


def test_names_of_other_policies() -> None:
    with pytest.raises(ValueError, match="expected one of PQN's policies, 'PQNPolicy', got 'SAFPolicy'"):
        PQN("SAFPolicy", toy_env())
