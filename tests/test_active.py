"""Agents that die or join, action masks and states: from the environment to the loss."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import DictRolloutBuffer

from sb3_saf import (
    IPPOPolicy,
    MAPPOPolicy,
    RandomPolicy,
    SAFMaskablePolicy,
    SAFPolicy,
    TeamRolloutBuffer,
    check_team_env,
    evaluate_team,
    make_team_env,
)
from sb3_saf.buffers.replay import TeamReplayBuffer
from sb3_saf.checkpoints.states import environment_state
from sb3_saf.envs.joint_observation import CentralizedValueWrapper
from sb3_saf.inspection.recording import record_episodes
from sb3_saf.networks.critic import ValueNormalizer
from sb3_saf.teams.rows import TeamSpaces
from tests.team_venv import Array
from tests.toy_envs import CounterEnv, DictEnv, Game, TellingEnv

N_AGENTS, N_ACTIONS = 3, 4
#: Agent 0 is active for steps 1 to 3, agent 1 from the observation after step 2, agent 2 until a time limit.
LIVES: dict[str, Any] = {"n_agents": N_AGENTS, "max_cycles": 5, "deaths": {0: 3}, "joins": {1: 2}}
#: Active agents in the observation after 0, 1, ... steps.
ACTIVE = [[1, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1], [0, 1, 1]]
POLICIES: list[type[Any]] = [SAFPolicy, MAPPOPolicy, IPPOPolicy]


def legal(agent: int, step: int) -> list[int]:
    return [int((action + agent + step) % 2 == 0) for action in range(N_ACTIONS)]


def expected_masks(step: int) -> list[list[int]]:
    """Masks of inactive agents allow only action 0."""
    return [legal(i, step) if ACTIVE[step][i] else [1, 0, 0, 0] for i in range(N_AGENTS)]


def first_legal(obs: dict[str, Array]) -> Array:
    return np.argmax(obs["action_mask"], axis=1)


def telling_env(n_envs: int = 2, game: Any = TellingEnv, **kwargs: Any) -> CentralizedValueWrapper:
    return make_team_env(game, n_envs, seed=0, state=True, **{**LIVES, **kwargs})


# --- content of rows --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("masks", "n_cpus"), [("observation", 1), ("info", 2)])
def test_rows_tell_who_is_active_what_is_legal_and_the_state(masks: str, n_cpus: int) -> None:
    env = telling_env(masks=masks, n_cpus=n_cpus, time_limit="bootstrap")
    assert (
        env.observation_space
        == TeamSpaces(
            spaces.Box(0, np.inf, (3,)), N_AGENTS, True, N_ACTIONS, spaces.Box(0, 100, (2,)), has_starts=True
        ).to_dict_space()
    )
    obs: Any = env.reset()
    for step in range(5):
        assert obs["active"].tolist() == [ACTIVE[step]] * 6
        played = ACTIVE[step - 1] if step else [0] * N_AGENTS
        assert obs["episode_start"].tolist() == [1 - flag for flag in played] * 2
        assert obs["action_mask"].tolist() == expected_masks(step) * 2
        assert obs["state"].tolist() == [[step, sum(ACTIVE[step])]] * 6
        # An inactive agent sees zeros, and other agents see zeros in its place.
        shown = [[step, i] if ACTIVE[step][i] else [0, 0] for i in range(N_AGENTS)]
        assert obs["obs"][:, :2].tolist() == shown * 2
        np.testing.assert_array_equal(obs["team"][0], obs["obs"][:3])
        assert all(value[0] in env.observation_space[key] for key, value in obs.items())  # type: ignore[index]
        obs, rewards, dones, infos = env.step(first_legal(obs))
        acted = ACTIVE[step]
        gained = [(10 * (step + 1) + i + (i + step) % 2) * acted[i] for i in range(N_AGENTS)]
        assert rewards.tolist() == gained * 2
    assert dones.all()
    assert obs["active"].tolist() == [ACTIVE[0]] * 6, "a new episode begins"
    assert [info["TimeLimit.truncated"] for info in infos] == [False, True, True] * 2
    last = infos[4]["terminal_observation"]
    assert last["active"].tolist() == [0, 1, 1], "those whom the time limit stopped"
    assert last["action_mask"].tolist() == legal(1, 5)
    assert infos[0]["terminal_observation"]["action_mask"].tolist() == [1, 0, 0, 0]
    assert last["state"].tolist() == [5, 0]
    assert last["team"][:, :2].tolist() == [[0, 0], [5, 1], [5, 2]]
    env.close()


class SilentAtTheEnd(TellingEnv):
    """Gives no masks after the last step."""

    def _with_masks(self, infos: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        return super()._with_masks(infos) if self.agents else infos


def test_all_actions_are_legal_after_the_last_step_if_it_tells_nothing() -> None:
    """The value that follows a time limit is that of the best of them, not of action 0."""
    env = make_team_env(SilentAtTheEnd, seed=0, time_limit="bootstrap", masks="info", **LIVES)
    obs: Any = env.reset()
    for _ in range(5):
        obs, _, _, infos = env.step(first_legal(obs))
    last = [info["terminal_observation"]["action_mask"].tolist() for info in infos]
    assert last == [[1, 0, 0, 0], [1, 1, 1, 1], [1, 1, 1, 1]]


def test_whoever_ends_with_the_last_step_is_not_active_after_it() -> None:
    env = telling_env(1, deaths={0: 5}, joins={}, time_limit="bootstrap")
    obs: Any = env.reset()
    for _ in range(5):
        obs, _, _, infos = env.step(first_legal(obs))
    assert [info["terminal_observation"]["active"].tolist() for info in infos] == [[0, 1, 1]] * 3


def test_nothing_is_told_that_is_not_there_or_not_wanted() -> None:
    names = {"obs", "team", "agent", "episode_start"}
    small: dict[str, Any] = {"n_agents": 2, "grid_size": 10, "n_treasures": 5, "view_size": 5}
    assert set(make_team_env("TeamSupport", **small).observation_space.spaces) == names  # type: ignore[attr-defined]
    plain = make_team_env(TellingEnv, active=False, action_masks=False, **LIVES)
    assert set(plain.observation_space.spaces) == names  # type: ignore[attr-defined]
    assert plain.team_spaces.own == spaces.Box(0, np.inf, (3,)), "the observation without the mask"
    assert set(make_team_env(CounterEnv).reset()) == {*names, "active"}
    assert set(make_team_env(TellingEnv, action_masks=True, masks="info").reset()) == {*names, "active", "action_mask"}


def rows_with(**entries: Any) -> TeamSpaces:
    return TeamSpaces.of_rows(spaces.Dict(obs=spaces.Discrete(3), **entries), spaces.Discrete(2), 2)


def policy_of(kind: Any, n_actions: int = 4, state: Any = None, **kwargs: Any) -> Any:
    return kind(telling_spaces(state=state), spaces.Discrete(n_actions), lambda _: 0.0, **kwargs)


@pytest.mark.filterwarnings("ignore:.* allows nothing, which training refuses")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: make_team_env(CounterEnv, state=True), r"state=True needs .*state\(\)"),
        (
            lambda: make_team_env(CounterEnv, action_masks=True).reset(),
            "'action_mask' .*agent_0 .*got None",
        ),
        (lambda: make_team_env(DictEnv, action_masks=True), r"got Box\(.*pass action_masks=False"),
        (lambda: telling_env(stuck=0).reset(), "legal action .* at step 0 for agent 0 of game 0"),
        (lambda: rows_with(active=spaces.Discrete(3)), r"'active' .*Discrete\(2\), got Discrete\(3\)"),
        (
            lambda: rows_with(action_mask=spaces.MultiBinary(3)),
            r"'action_mask' .*got MultiBinary\(3\)",
        ),
        (
            lambda: policy_of(MAPPOPolicy, critic_input="state"),
            r"critic_input='state' .*state=True\)",
        ),
        (lambda: policy_of(SAFPolicy, critic_input="state"), "critic_input .*'own', 'team', got 'state'"),
        (lambda: policy_of(IPPOPolicy, n_actions=5), r"'action_mask' .*got MultiBinary\(4\)"),
    ],
)
def test_wrong_calls(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_random_teams_take_legal_actions_each_as_often() -> None:
    env = telling_env(1)
    obs: Any = env.reset()
    policy = RandomPolicy(env.action_space, seed=0)
    counts = np.sum([np.eye(N_ACTIONS)[policy.predict(obs)[0]] for _ in range(2000)], axis=0)
    assert counts[1].tolist() == [2000, 0, 0, 0]  # inactive
    assert counts[0] == pytest.approx([1000, 0, 1000, 0], abs=100)
    assert evaluate_team(policy, env, 3).lengths == [5, 5, 5]


# --- the rollout buffer -----------------------------------------------------------------------------------------------


def telling_spaces(n_agents: int = N_AGENTS, state: Any = spaces.Box(0, 100, (2,))) -> spaces.Dict:  # noqa: B008
    return TeamSpaces(spaces.Box(-1, 1, (3,)), n_agents, True, N_ACTIONS, state).to_dict_space()


def fill(buffers: list[Any], env: CentralizedValueWrapper, n_steps: int, zero_values: bool) -> tuple[Array, Array]:
    """Play first legal actions with arbitrary values; return active rows (T + 1, B) and values (T + 1, B)."""
    rng = np.random.default_rng(0)
    obs: Any = env.reset()
    starts = np.ones(env.num_envs, dtype=bool)
    active, values = [], []
    for step in range(n_steps + 1):
        rows = obs["active"][np.arange(env.num_envs), obs["agent"]]
        active.append(rows)
        values.append(rng.normal(size=env.num_envs) * (rows if zero_values or step == n_steps else 1))
        if step == n_steps:
            break
        actions = first_legal(obs)
        new_obs, rewards, dones, _ = env.step(actions)
        for buffer in buffers:
            value = th.tensor(values[-1], dtype=th.float32)
            buffer.add(dict(obs), actions.reshape(-1, 1), rewards, starts, value, th.zeros(env.num_envs))
        obs, starts = new_obs, dones
    for buffer in buffers:
        buffer.compute_returns_and_advantage(th.tensor(values[-1], dtype=th.float32), starts)
    return np.array(active), np.array(values)


def make_buffer(env: CentralizedValueWrapper, n_steps: int, kind: Any = TeamRolloutBuffer, **kwargs: Any) -> Any:
    space, n_rows = env.observation_space, env.num_envs
    return kind(n_steps, space, env.action_space, device="cpu", gae_lambda=0.9, gamma=0.97, n_envs=n_rows, **kwargs)


@pytest.mark.parametrize("n_steps", [3, 5, 8, 13])
def test_advantages_end_with_the_agent(n_steps: int) -> None:
    """Compare with a loop over each life of each agent, which uses no masks; n_steps=3 ends with a death."""
    env = telling_env()
    buffer = make_buffer(env, n_steps)
    active, values = fill([buffer], env, n_steps, zero_values=False)
    for row in range(env.num_envs):
        agent = row % N_AGENTS
        for start in range(0, n_steps, 5):
            life = [t for t in range(start, min(start + 5, n_steps)) if active[t, row]]
            rewards = [10 * (t - start + 1) + agent + (agent + t - start) % 2 for t in life]
            cut = bool(life) and life[-1] == n_steps - 1 and n_steps % 5 != 0 and active[n_steps, row]
            after = [*(values[t, row] for t in life[1:]), values[n_steps, row] if cut else 0.0]
            errors = [r + 0.97 * v - values[t, row] for r, v, t in zip(rewards, after, life, strict=True)]
            for k, t in enumerate(life):
                advantage = sum((0.97 * 0.9) ** (j - k) * errors[j] for j in range(k, len(life)))
                assert buffer.advantages[t, row] == pytest.approx(advantage, rel=1e-4, abs=1e-4)
                assert buffer.returns[t, row] == pytest.approx(advantage + values[t, row], rel=1e-4, abs=1e-4)


class PaidLater(Game):
    """The second agent is paid 2 and 8 after its steps 2 and 4; in step 2 it waits, or it has ended after step 1."""

    length = 4

    def __init__(self, ends: bool) -> None:
        self.ends = ends

    def see(self, agent: Any) -> Any:
        return np.full(2, self.t / 4, np.float32)

    def change(self, out: list[Any]) -> None:
        out[0]["b"] = self.see("b")
        out[1]["b"] = {2: 2.0, 4: 8.0}.get(self.t, 0.0)
        is_away = self.t == 1 or self.ends
        out[2]["b"] = self.ends and self.t == 1
        self.agents = ["a"] if is_away else ["a", "b"]


@pytest.mark.parametrize("ends", [False, True])
def test_recorded_returns_are_those_of_the_buffer(ends: bool) -> None:
    env = make_team_env(PaidLater, 1, seed=0, ends=ends)
    settings: dict[str, Any] = {"n_steps": 4, "batch_size": 8, "n_epochs": 1, "gamma": 0.5, "learning_rate": 0.0}
    for lam in (1.0, 0.4):
        model = PPO("IPPOPolicy", env, rollout_buffer_class=TeamRolloutBuffer, gae_lambda=lam, seed=0, **settings)
        model.learn(8)
        recording = record_episodes(model.policy, env, 1, gamma=0.5)
        buffer: Any = model.rollout_buffer
        rows = buffer.active.reshape(4, 2) == 1
        assert rows[:, 1].tolist() == [True, False, not ends, not ends]
        np.testing.assert_allclose(recording.targets(lam)[:4][rows], buffer.returns[rows], rtol=1e-5)
    assert recording.returns[:4, 1][rows[:, 1]].tolist() == ([2.0] if ends else [2.0, 4.0, 8.0])


@pytest.mark.parametrize("n_steps", [3, 8, 13])
def test_returns_of_the_dead_go_on_where_their_team_is_paid(n_steps: int) -> None:
    """With one reward and one value for the team, advantages are those of agents that never end."""
    env = telling_env()
    team, immortal = (make_buffer(env, n_steps, ends="team") for _ in range(2))
    fill([team, immortal], env, n_steps, zero_values=True)
    rng = np.random.default_rng(1)
    active, after = team.active.copy(), np.array(ACTIVE[n_steps % 5])
    shape = (n_steps, 2, 1)
    values, rewards, last = rng.normal(size=shape), rng.normal(size=shape), rng.normal(size=(2, 1))
    # Values that follow a time limit of the team are added to the rewards of those who take part.
    over = np.vstack([team.episode_starts[1:], np.zeros((1, env.num_envs))]).reshape(active.shape)
    followed = over * rng.normal(size=shape)
    for buffer, playing, then in ((team, active, after), (immortal, np.ones_like(active), np.ones_like(after))):
        buffer.active = playing
        buffer.values = (values * playing).reshape(n_steps, -1).astype(np.float32)
        buffer.rewards = (rewards + followed * playing).reshape(n_steps, -1).astype(np.float32)
        last_values = th.tensor((last * then).reshape(-1), dtype=th.float32)
        buffer.compute_returns_and_advantage(last_values, np.zeros(env.num_envs))
    rows = active.reshape(n_steps, -1) == 1
    assert not rows.all()
    np.testing.assert_allclose(team.advantages[rows], immortal.advantages[rows], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(team.returns[rows], immortal.returns[rows], rtol=1e-5, atol=1e-5)
    with pytest.raises(ValueError, match=r"ends must be .*'own'"):
        make_buffer(env, n_steps, ends="all")


def test_minibatches_leave_out_who_takes_no_part_and_keep_the_rest() -> None:
    env = telling_env()
    team, stock = make_buffer(env, 8), make_buffer(env, 8, DictRolloutBuffer)
    active, _ = fill([team, stock], env, 8, zero_values=True)
    # If values of idle rows are zero, as our policies return them, SB3's recursion gives the same.
    rows = active[:8] == 1
    np.testing.assert_array_equal(team.advantages[rows], stock.advantages[rows])

    def by_row(buffer: Any) -> list[Any]:
        found = []
        for sample in buffer.get(6):
            parts = [*(value for _, value in sorted(sample.observations.items())), *sample[1:]]
            flags = sample.observations["active"].numpy()[np.arange(len(parts[0])), sample.observations["agent"][:, 0]]
            found += [
                row for row, flag in zip(zip(*(p.tolist() for p in parts), strict=True), flags, strict=True) if flag
            ]
        return sorted(found)

    assert by_row(team) == by_row(stock)
    samples = list(team.get(6))
    assert sum(len(sample.actions) for sample in samples) == rows.sum() < 8 * 6
    for sample in samples:
        assert len(sample.actions) <= 6
        seen = sample.observations
        assert seen["active"].gather(1, seen["agent"]).all()
        # Teams stay together: a team has as many rows as active agents.
        for joint in seen["team"].unique(dim=0):
            members = (seen["team"] == joint).flatten(1).all(dim=1)
            assert members.sum() == seen["active"][members][0].sum()
    assert {key: value.dtype for key, value in samples[0].observations.items()} == {
        key: value.dtype for key, value in next(stock.get(6)).observations.items()
    }


def test_minibatches_without_anybody_are_skipped() -> None:
    class Nobody(CentralizedValueWrapper):
        """All agents of game 0 are inactive."""

        def _joint_observation(self, obs: Any) -> Any:
            joint = super()._joint_observation(obs)
            joint["active"][:N_AGENTS] = 0
            return joint

    env = Nobody(telling_env().venv)
    buffer = make_buffer(env, 5)
    fill([buffer], env, 5, zero_values=True)
    assert all(len(sample.actions) for sample in buffer.get(3))
    buffer.active[:] = 0
    with pytest.raises(ValueError, match="expected agents that take part, got none in 5 steps of 2 games"):
        next(buffer.get(3))


@pytest.mark.parametrize("key", ["active", "state"])
@pytest.mark.parametrize("kind", ["rollout", "replay"])
def test_rows_of_a_game_that_disagree_are_refused(key: str, kind: str) -> None:
    env = telling_env()
    obs: Any = env.reset()
    zeros = np.zeros(6, np.float32)
    if kind == "rollout":
        buffer: Any = make_buffer(env, 5)
        step: Any = (obs, zeros, zeros, zeros, th.zeros(6), th.zeros(6))
    else:
        buffer = TeamReplayBuffer(9, env.observation_space, env.action_space, n_envs=6)
        step = (obs, obs, zeros, zeros, zeros, [{}] * 6)
    buffer.add(*step)
    obs[key][4, 0] += 1
    with pytest.raises(ValueError, match=f"expected one '{key}' for all rows of a game, but the rows of game 1 differ"):
        buffer.add(*step)


# --- policies ---------------------------------------------------------------------------------------------------------


def make_policy(kind: type[Any], **kwargs: Any) -> Any:
    th.manual_seed(0)
    policy = kind(telling_spaces(), spaces.Discrete(N_ACTIONS), lambda _: 1e-3, net_arch=[8], **kwargs)
    for parameter in policy.parameters():  # the small last layer of actors would hide differences
        th.nn.init.normal_(parameter, std=0.5)
    return policy


def random_rows(n_games: int = 6) -> dict[str, th.Tensor]:
    """Return rows of teams with inactive agents; the first two games differ only in these."""
    generator = th.Generator().manual_seed(1)
    own = th.rand(n_games, N_AGENTS, 3, generator=generator) * 2 - 1
    own[1] = own[0]
    active = th.rand(n_games, N_AGENTS, generator=generator) < 0.6
    active[:2] = th.tensor([[True, True, True], [True, True, False]])
    mask = th.rand(n_games * N_AGENTS, N_ACTIONS, generator=generator) < 0.5
    mask[:, 2] |= ~mask.any(dim=1)
    return {
        "obs": own.flatten(0, 1),
        "team": own.repeat_interleave(N_AGENTS, dim=0),
        "agent": th.arange(N_AGENTS).repeat(n_games),
        "active": active.to(th.int8).repeat_interleave(N_AGENTS, dim=0),
        "action_mask": mask.to(th.int8),
        "state": th.rand(n_games, 2, generator=generator).repeat_interleave(N_AGENTS, dim=0),
    }


def is_active(obs: dict[str, th.Tensor]) -> th.Tensor:
    return obs["active"].gather(1, obs["agent"].unsqueeze(1)).squeeze(1) == 1


@pytest.mark.parametrize("kind", POLICIES)
@pytest.mark.parametrize("heads", ["shared", "per_agent"])
def test_values_do_not_depend_on_what_idle_agents_see_and_theirs_are_zero(kind: Any, heads: str) -> None:
    policy = make_policy(kind, heads=heads)
    obs = random_rows()
    values = policy.predict_values(obs)
    idle = ~is_active(obs)
    assert (values[idle] == 0).all()
    assert (values[~idle] != 0).all()
    other = {**obs, "team": th.where(obs["active"].unsqueeze(2) == 1, obs["team"], 0.77)}
    other["obs"] = th.where(idle.unsqueeze(1), 0.77, obs["obs"])
    th.testing.assert_close(policy.predict_values(other), values, rtol=0, atol=1e-6)
    th.testing.assert_close(policy.forward(other)[1], values, rtol=0, atol=1e-6)
    slow = make_policy(kind, heads=heads, encode_once=False)
    th.testing.assert_close(slow.predict_values(obs), values, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", [SAFPolicy, MAPPOPolicy])
def test_equal_views_with_other_agents_active_are_other_teams(kind: Any) -> None:
    obs = random_rows()
    values = make_policy(kind).predict_values(obs).squeeze(1)
    assert (obs["team"][0] == obs["team"][3]).all()
    assert not th.isclose(values[:2], values[3:5], atol=1e-4).any()


@pytest.mark.parametrize(
    "kwargs", [{"selection": "gumbel"}, {"n_policies": 1, "heads": "per_agent"}, {"n_policies": 2}]
)
def test_other_actors_keep_to_legal_actions_with_finite_gradients(kwargs: dict[str, Any]) -> None:
    policy = make_policy(SAFPolicy, **kwargs)
    obs = random_rows()
    allowed = obs["action_mask"] == 1
    for _ in range(20):
        assert allowed.gather(1, policy.forward(obs)[0].unsqueeze(1)).all()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        _, log_prob, entropy = policy.evaluate_actions(obs, policy.forward(obs)[0])
    (log_prob.mean() + entropy.mean()).backward()
    gradients = [p.grad for p in policy.actor.parameters() if p.grad is not None]
    assert gradients
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_predict_needs_the_mask_and_at_least_one_legal_action() -> None:
    policy = make_policy(MAPPOPolicy)
    obs = {key: value.numpy() for key, value in random_rows().items()}
    own = {"obs": obs["obs"], "action_mask": obs["action_mask"]}
    actions, _ = policy.predict(own, deterministic=True)
    np.testing.assert_array_equal(actions, policy.predict(obs, deterministic=True)[0])
    single, _ = policy.predict({key: value[4] for key, value in own.items()}, deterministic=True)
    assert single == actions[4]
    for incomplete in (obs["obs"], {"obs": obs["obs"]}):
        with pytest.raises(ValueError, match=r"expected 'action_mask' beside 'obs'.*pass \{'obs': ..., 'action_mask'"):
            policy.predict(incomplete)
    with pytest.raises(ValueError, match="masks of actions in the rows"):
        policy.predict(own, action_masks=own["action_mask"])
    own["action_mask"][5] = 0
    with pytest.raises(ValueError, match="at least one legal action in each 'action_mask', got none in row 5 of 18"):
        policy.predict(own)


def test_mappos_critic_on_the_state_reads_the_state_alone() -> None:
    policy = make_policy(MAPPOPolicy, critic_input="state")
    obs = random_rows()
    values = policy.predict_values(obs)
    assert len(values.unique()) == int(is_active(obs).sum()) + 1, "one for each game and agent, and zero"
    others = {key: value for key, value in obs.items() if key not in ("obs", "team")}
    th.testing.assert_close(policy.predict_values({**others, "obs": -obs["obs"], "team": -obs["team"]}), values)
    assert not th.allclose(policy.predict_values({**obs, "state": obs["state"] + 1}), values)
    assert not [
        name
        for name, _ in policy.named_parameters()
        if "encoder" in name and not name.startswith(("value_net", "features_extractor", "pi_features", "vf_features"))
    ]


# --- training ---------------------------------------------------------------------------------------------------------


def make_model(policy: str = "SAFPolicy", env: Any = None, algorithm: Any = PPO, **kwargs: Any) -> Any:
    """Create a model with rollouts of 10 steps of 6 rows."""
    settings: dict[str, Any] = {"n_steps": 10, "batch_size": 30, "n_epochs": 2}
    if algorithm is PPO:
        settings["rollout_buffer_class"] = TeamRolloutBuffer
    return algorithm(policy, env or telling_env(), seed=3, device="cpu", **settings | kwargs)


@pytest.mark.parametrize(
    ("policy", "policy_kwargs", "time_limit"),
    [
        ("SAFPolicy", {}, "bootstrap"),
        ("SAFPolicy", {}, "terminal"),
        ("MAPPOPolicy", {"critic_input": "state"}, "bootstrap"),
        ("IPPOPolicy", {}, "terminal"),
    ],
)
def test_ppo_trains_saves_and_loads(policy: str, policy_kwargs: Any, time_limit: str, tmp_path: Path) -> None:
    """The environment fails the test at the first illegal action; warnings of idle rows are errors."""
    model = make_model(policy, telling_env(time_limit=time_limit), policy_kwargs=policy_kwargs).learn(120)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
    model.save(tmp_path / "model")
    loaded = PPO.load(tmp_path / "model", env=telling_env(), device="cpu")
    obs: Any = telling_env().reset()
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])
    assert evaluate_team(loaded, telling_env(), 4).lengths == [5] * 4
    loaded.learn(60, reset_num_timesteps=False)


def test_idle_rows_do_not_touch_the_loss() -> None:
    def after_training(spoil: bool) -> list[th.Tensor]:
        model = make_model()
        callback = model._setup_learn(60)[1]
        assert model.env is not None
        model.collect_rollouts(model.env, callback, model.rollout_buffer, 10)
        buffer: Any = model.rollout_buffer
        idle = buffer.active.reshape(10, 6) == 0
        assert 0 < idle.sum() < 60
        if spoil:
            for name in ("advantages", "returns", "values", "log_probs"):
                getattr(buffer, name)[idle] = 1e6
        np.random.seed(0)  # noqa: NPY002 - the order of minibatches
        model.train()
        return list(model.policy.parameters())

    for clean, spoiled in zip(after_training(False), after_training(True), strict=True):
        th.testing.assert_close(clean, spoiled, rtol=0, atol=0)


@pytest.mark.parametrize("policy", ["SAFPolicy", "MAPPOPolicy", "IPPOPolicy"])
def test_minibatches_without_idle_rows_are_judged_as_rows_of_their_teams(policy: str) -> None:
    model = make_model(policy, n_epochs=1).learn(60)
    model.policy.set_training_mode(False)
    for sample in model.rollout_buffer.get(12):
        obs = cast(Any, sample.observations)
        assert obs.teams.rows is not None and len(obs["obs"]) < obs.teams.active.numel()
        plain = dict(obs.items())
        order = th.randperm(len(plain["obs"]))
        shuffled = {key: value[order] for key, value in plain.items()}
        expected = model.policy.predict_values(shuffled)
        th.testing.assert_close(model.policy.predict_values(obs)[order], expected, rtol=1e-5, atol=1e-6)


def test_sb3s_buffer_warns_once_that_idle_rows_enter_the_loss() -> None:
    model = make_model(rollout_buffer_class=DictRolloutBuffer)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(120)
    told = [str(w.message) for w in caught if "take no part" in str(w.message)]
    assert len(told) == 1
    assert "rollout_buffer_class=sb3_saf.TeamRolloutBuffer" in told[0]


# --- masks from two sources, value normalisation ----------------------------------------------------------------------


class TwiceMaskedEnv(TellingEnv):
    """Observations have masks that allow every second action; a method returns masks that forbid the lower of those."""

    def action_masks(self) -> dict[str, Any]:
        return {agent: np.arange(N_ACTIONS) >= 2 for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> Any:
        assert all(action >= 2 for action in actions.values()), actions
        return super().step(actions)


class ShownMasksEnv(TellingEnv):
    """Masks in observations or infos, without a method that returns them."""

    @property
    def action_masks(self) -> Any:
        raise AttributeError("this game has no action_masks()")


def test_an_action_must_be_allowed_by_both_masks() -> None:
    env = telling_env(game=TwiceMaskedEnv, deaths={}, joins={})
    check_team_env(partial(TwiceMaskedEnv, **{**LIVES, "deaths": {}, "joins": {}}))
    assert environment_state(env), "in the trial of copies, too"
    model = make_model("SAFMaskablePolicy", env, MaskablePPO).learn(60)
    buffer = model.rollout_buffer
    taken = buffer.actions.reshape(-1).astype(int)
    assert (taken >= 2).all(), "the environment's action_masks() forbid 0 and 1"
    shown = buffer.observations["action_mask"].reshape(-1, N_ACTIONS)
    assert shown[np.arange(len(taken)), taken].all()
    assert len(np.unique(taken)) == 2

    policy = model.policy
    assert isinstance(policy, SAFMaskablePolicy)
    rows, _ = policy.obs_to_tensor(env.reset())
    assert isinstance(rows, dict)
    asked = th.tensor([[False, False, True, True]]).expand(6, -1)
    distribution = policy.get_distribution(rows, asked)
    likelihoods = th.stack([distribution.log_prob(th.full((6,), a)).exp() for a in range(N_ACTIONS)], dim=1)
    both = asked & (rows["action_mask"] != 0)
    assert both.sum(dim=1).eq(1).all()
    th.testing.assert_close(likelihoods, both.float())


def test_values_are_normalised_by_the_returns_of_those_who_take_part() -> None:
    """The variance would differ if idle rows, whose returns are all the mean, were counted."""
    model = make_model("MAPPOPolicy", policy_kwargs={"normalize_values": True}).learn(60)
    buffer: Any = model.rollout_buffer
    is_active = buffer.active.reshape(10, 6) == 1
    returns = buffer.returns[is_active].astype(np.float64)
    normalizer = model.policy.value_normalizer
    assert isinstance(normalizer, ValueNormalizer)
    assert int(normalizer.count) == is_active.sum() == 2 * 2 * (3 + 3 + 5)
    assert float(normalizer.mean) == pytest.approx(returns.mean(), rel=1e-5)
    assert float(normalizer.var) == pytest.approx(returns.var(), rel=1e-4)
    assert abs(buffer.returns.var() - returns.var()) > 1.0
    obs: Any = telling_env().reset()
    values = model.policy.predict_values(model.policy.obs_to_tensor(obs)[0]).detach().flatten()
    idle = obs["active"][np.arange(6), obs["agent"]] == 0
    assert (values[idle] == 0).all(), "zero on the raw scale, not the mean of returns"


@pytest.mark.parametrize("masks", ["observation", "info"])
def test_maskable_ppo_finds_the_masks_that_observations_show(masks: str) -> None:
    """The game has no method action_masks(), and fails the test at the first illegal action."""
    env = telling_env(game=ShownMasksEnv, masks=masks, deaths={}, joins={})
    assert is_masking_supported(env)
    obs: Any = env.reset()
    np.testing.assert_array_equal(get_action_masks(env), obs["action_mask"] == 1)
    model = make_model("MAPPOMaskablePolicy", env, MaskablePPO).learn(60)
    assert evaluate_team(model, env, 2).lengths == [5, 5]
    assert not is_masking_supported(telling_env(game=ShownMasksEnv, masks=None))
