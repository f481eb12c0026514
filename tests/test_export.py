"""Exported actors act as their models, with masks, memory and what the game gives; weights of models as tensors."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_saf import (
    Actor,
    CentralizedValueWrapper,
    ExportError,
    IPPOPolicy,
    LightEncoder,
    MAPPOPolicy,
    SAFPolicy,
    export_actors,
    game_seeds,
    load_weights,
    make_team_env,
    save_weights,
)
from sb3_saf.policies.base import TeamActorCriticPolicy
from sb3_saf.teams.conversion import mask_in
from sb3_saf.teams.rows import TeamSpaces
from tests import test_contrib
from tests.contrib_teams import random_masks
from tests.test_conversion import Kinds
from tests.test_policies import ACTIONS, SMALL, constant, equal_weights, make_model, make_policy
from tests.toy_envs import CounterEnv, Game
from tests.toy_teams import PICTURE, VECTOR, CodeSpace, samples

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}
#: Packages that an exported actor needs not, nor what these are made of.
ABSENT = ("stable_baselines3", "sb3_contrib", "gymnasium", "pettingzoo", "supersuit", "cloudpickle", "torch", "onnx")
AGENT = 2
GREY = spaces.Box(0, 255, (40, 36), np.uint8)
WIDE = spaces.Box(-5, 5, (1,), np.float32)


class Exported(NamedTuple):
    """A policy and the actor of agent 2."""

    policy: Any
    folder: Path
    actor: Actor


class OwnEncoder(BaseFeaturesExtractor):
    """An encoder of a user."""

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 4):
        super().__init__(observation_space, features_dim)
        self.net = nn.Linear(5, features_dim)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.net(observations).sin()


def masked(policy_class: type[TeamActorCriticPolicy], **kwargs: Any) -> TeamActorCriticPolicy:
    """Create a policy for rows with masks of three actions."""
    th.manual_seed(0)
    space = TeamSpaces(VECTOR, 3, n_masked_actions=3).to_dict_space()
    policy = policy_class(space, ACTIONS["discrete"], constant, **cast(Any, SMALL | kwargs))
    with th.no_grad():
        for parameter in policy.actor.parameters():
            parameter.add_(0.6 * th.randn_like(parameter))
    return policy


def remembering(name: str, action: str, **kwargs: Any) -> Any:
    """Create a policy whose memory matters."""
    policy = test_contrib.make_policy(name, ACTIONS[action], noise=1.0, memory_size=6, **kwargs)
    with th.no_grad():
        for parameter in policy.actor_memory.parameters():
            parameter.add_(th.randn_like(parameter))
        for parameter_name, parameter in policy.actor.named_parameters():
            if parameter_name.endswith("bias"):
                parameter.zero_()  # or its actions would not depend on observations
    return policy


def plain(policy_class: type[TeamActorCriticPolicy], own: spaces.Space[Any], action: str, **kwargs: Any) -> Any:
    return make_policy(policy_class, own, ACTIONS[action], noise=0.6, **kwargs)


def sure() -> Any:
    """Create a policy of flags with large logits, except for the first observation of :func:`rows_of`."""
    policy = plain(MAPPOPolicy, spaces.Discrete(5), "multi-binary", seed=2)
    rows = {key: th.as_tensor(value) for key, value in rows_of(policy, 1).items()}
    output = list(policy.actor.modules())[-1]
    with th.no_grad():
        output.weight.mul_(20)
        output.bias.sub_(policy.get_distribution(rows).distribution.logits[0] + th.tensor([0.5, -0.5]))
    return policy


def maskable(name: str, action: str) -> Any:
    return test_contrib.make_policy(name, ACTIONS[action], noise=0.6)


_PAIRS = {"features_extractor_class": LightEncoder, "actor_identity": True}
#: Every kind of actor, action, observation, mask and memory at least once.
POLICIES: dict[str, Callable[[], Any]] = {
    "pool, codes": lambda: plain(SAFPolicy, CodeSpace(), "discrete"),
    "pool with identity, pictures": lambda: plain(SAFPolicy, PICTURE, "multi-discrete", **_PAIRS),
    "gumbel pool, box": lambda: plain(SAFPolicy, spaces.MultiBinary(4), "box", selection="gumbel"),
    "shared, sure choices": sure,
    "heads, grey pictures": lambda: plain(IPPOPolicy, GREY, "box", heads="per_agent"),
    "own encoder": lambda: plain(MAPPOPolicy, VECTOR, "discrete", features_extractor_class=OwnEncoder),
    "masked rows": lambda: masked(SAFPolicy, selection="gumbel", latent_dim=8, projection_arch=(10,)),
    "maskable": lambda: maskable("SAFMaskablePolicy", "multi-discrete"),
    "pool with memory": lambda: remembering("SAFPolicy", "discrete", memory="gru"),
    "heads with memory": lambda: remembering("MAPPOPolicy", "box", memory="lstm", heads="per_agent"),
}


@pytest.fixture(scope="module")
def exports(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Exported]:
    """Export each policy once: writing takes seconds."""
    made: dict[str, Exported] = {}

    def get(name: str) -> Exported:
        if name not in made:
            policy = POLICIES[name]()
            folder = export_actors(policy, tmp_path_factory.mktemp("export") / "actor")
            made[name] = Exported(policy, folder, Actor.load(folder, agent=AGENT))
        return made[name]

    return get


def rows_of(policy: Any, count: int, seed: int = 0) -> dict[str, np.ndarray]:
    return {"obs": samples(policy.team_spaces.own, count, seed), "agent": np.full(count, AGENT)}


# --- the same actions -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in POLICIES if "mask" not in name and "memory" not in name])
def test_decides_as_the_model_does(name: str, exports: Callable[[str], Exported]) -> None:
    policy, _, actor = exports(name)
    rows = rows_of(policy, 40)
    obs, actions = rows["obs"], samples(policy.action_space, 40)
    expected = policy.predict(rows, deterministic=True)[0]
    found = actor.act(obs)
    assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose([actor.act(one) for one in obs[:5]], expected[:5], rtol=1e-5, atol=1e-6)
    assert len(np.unique(expected, axis=0)) > 1
    if "gumbel" not in name:  # two evaluations may draw different policies
        tensors = {key: th.as_tensor(value) for key, value in rows.items()}
        with th.no_grad():
            distribution = policy.get_distribution(tensors)
            likelihoods = distribution.log_prob(th.as_tensor(actions).float())  # SB3's MultiBinary takes floats
        np.testing.assert_allclose(actor.log_prob(obs, actions), likelihoods, rtol=1e-5, atol=1e-5)
        assert "sure" not in name or likelihoods.min() < -20
        if isinstance(policy.action_space, spaces.Discrete):
            probabilities = distribution.distribution.probs.numpy()
            np.testing.assert_allclose(actor.probabilities(obs), probabilities, atol=2e-6)
            np.testing.assert_allclose(actor.probabilities(obs[3]), probabilities[3], atol=2e-6)


@pytest.mark.parametrize(
    "name", ["pool, codes", "pool with identity, pictures", "gumbel pool, box", "shared, sure choices"]
)
def test_draws_as_the_model_does(name: str, exports: Callable[[str], Exported]) -> None:
    policy, _, actor = exports(name)
    count, rows = 4_000, rows_of(policy, 1)
    obs = np.repeat(rows["obs"], count, axis=0)
    th.manual_seed(0)
    expected = policy.predict({"obs": obs, "agent": np.full(count, AGENT)}, deterministic=False)[0].reshape(count, -1)
    found = actor.act(obs, deterministic=False, rng=4)
    np.testing.assert_array_equal(actor.act(obs, deterministic=False, rng=np.random.default_rng(4)), found)
    assert not np.array_equal(actor.act(obs, deterministic=False), actor.act(obs, deterministic=False))
    found = found.reshape(count, -1)
    assert (abs(found.mean(axis=0) - expected.mean(axis=0)) < 5 * expected.std(axis=0) * (2 / count) ** 0.5).all()
    np.testing.assert_allclose(found.std(axis=0), expected.std(axis=0), rtol=0.15, atol=0.05)


def test_an_actor_of_tile_codes_takes_pixels(exports: Callable[[str], Exported]) -> None:
    actor, space = exports("pool, codes").actor, CodeSpace()
    codes = samples(space, 10)
    pictures = space.atlas[codes].swapaxes(2, 3).reshape(10, 12, 12, 3)
    np.testing.assert_array_equal(actor.act(pictures), actor.act(codes))
    np.testing.assert_array_equal(actor.act(np.moveaxis(pictures, -1, 1)), actor.act(codes))
    assert actor.act(pictures[3]) == actor.act(codes[3]) == actor.act(codes[3].astype(float).tolist())
    pictures[2, 5, 9, 0] ^= 1
    with pytest.raises(ValueError, match="the tile in row 1, column 2 is none of the 20 tiles"):
        actor.act(pictures)


def test_the_critic_is_not_written(exports: Callable[[str], Exported]) -> None:
    policy, folder, _ = exports("own encoder")
    assert sorted(path.name for path in folder.iterdir()) == ["act.py", "actor.onnx"]
    data = (folder / "actor.onnx").read_bytes()
    for network, is_written in ((policy.actor, True), (policy.value_net, False)):
        for layer in network.modules():
            if isinstance(layer, nn.Linear):
                assert (layer.weight.detach().numpy().tobytes() in data) == is_written


# --- masks ------------------------------------------------------------------------------------------------------------


def test_masks_of_rows_are_required(exports: Callable[[str], Exported]) -> None:
    policy, _, actor = exports("masked rows")
    obs, masks = samples(VECTOR, 40), random_masks(ACTIONS["discrete"], 40, np.random.default_rng(0))
    rows = {"obs": obs, "agent": np.full(40, AGENT), "action_mask": masks.astype(np.int8)}
    expected = policy.predict(rows, deterministic=True)[0]
    np.testing.assert_array_equal(actor.act(obs, action_mask=masks), expected)
    np.testing.assert_array_equal(actor.act({"observation": obs, "action_mask": masks}), expected)  # PettingZoo's form
    assert actor.act(obs[0], action_mask=masks[0].tolist()) == expected[0]
    free = actor.act(obs, action_mask=np.ones((40, 3)))
    assert not masks[np.arange(40), free].all(), "masks make a difference"
    drawn = np.stack([actor.act(obs, deterministic=False, rng=seed, action_mask=masks) for seed in range(20)])
    assert np.take_along_axis(masks, drawn.T, axis=1).all() and len(np.unique(drawn)) == 3
    for wrong, message in (
        (None, "action_mask, 3 zeros and ones for each observation"),
        ([1, 0], r"action_mask .* got shape \(2,\)"),
        ([[1, 0, 1], [1, 1, 1]], r"action_mask .* got shape \(2, 3\)"),
        ([1, 0, 2], "action_mask"),
        ([0, 0, 0], r"at least one legal action .* got \[\[0, 0, 0\]\]"),
    ):
        with pytest.raises(ValueError, match=message):
            actor.act(obs[0], action_mask=wrong)


def test_masks_of_maskable_ppo_are_optional(exports: Callable[[str], Exported]) -> None:
    policy, _, actor = exports("maskable")
    obs, masks = samples(VECTOR, 40), random_masks(policy.action_space, 40, np.random.default_rng(0))
    masks[0] = False  # nothing is allowed: MaskablePPO's policies then ignore the mask
    expected = policy.predict(obs, deterministic=True, action_masks=masks)[0]
    np.testing.assert_array_equal(actor.act(obs, action_mask=masks), expected)
    assert not np.array_equal(actor.act(obs), expected), "without masks everything is allowed"
    np.testing.assert_array_equal(actor.act(obs), policy.predict(obs, deterministic=True)[0])
    actions = samples(policy.action_space, 40)
    with th.no_grad():
        distribution = policy.get_distribution(th.as_tensor(obs), action_masks=masks)
        likelihoods = distribution.log_prob(th.as_tensor(actions).float())  # SB3's MultiBinary takes floats
    np.testing.assert_allclose(actor.log_prob(obs, actions, action_mask=masks), likelihoods, rtol=1e-5, atol=1e-5)


def test_an_actor_without_masks_refuses_one(exports: Callable[[str], Exported]) -> None:
    with pytest.raises(ValueError, match="without masks of actions: leave them out"):
        exports("own encoder").actor.act(np.zeros(5), action_mask=[1, 1, 1])


# --- memory -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pool with memory", "heads with memory"])
def test_with_a_memory_it_acts_as_the_model(name: str, exports: Callable[[str], Exported]) -> None:
    policy, _, actor = exports(name)
    assert actor.has_memory
    for _ in range(2):  # episodes
        memory, state, starts = actor.new_memory(), None, np.ones(20, bool)
        alone = [actor.new_memory() for _ in range(5)]
        for step in range(6):
            rows = rows_of(policy, 20, seed=step)
            obs = rows["obs"]
            expected, state = policy.predict(rows, state, starts, deterministic=True)
            likelihoods = actor.log_prob(obs, expected, memory=memory)
            np.testing.assert_array_equal(actor.log_prob(obs, expected, memory=memory), likelihoods)  # memory is kept
            np.testing.assert_allclose(actor.act(obs, memory=memory), expected, atol=1e-5)
            for own, hidden in zip(memory.states.values(), state, strict=True):
                np.testing.assert_allclose(own, hidden, atol=1e-4)
            singly = [actor.act(own, memory=mine) for own, mine in zip(obs, alone, strict=False)]
            np.testing.assert_allclose(singly, expected[:5], atol=1e-5)
            starts[:] = False
    forgetful = actor.log_prob(obs, expected, memory=actor.new_memory())
    assert np.abs(forgetful - likelihoods).max() > 0.01, "memory makes a difference"


class Named(Game):
    """Agents of any name, the last of which waits every second step."""

    def __init__(self, names: Any) -> None:
        self.possible_agents = list(names)

    def see(self, agent: Any) -> Any:
        return np.array([self.t / 4, self.possible_agents.index(agent) / 4], np.float32)

    def action_space(self, agent: Any) -> spaces.Space[Any]:
        return WIDE

    def change(self, out: list[Any]) -> None:
        self.agents = self.possible_agents[: -1 if self.t % 2 else None]
        out[0] = {agent: self.see(agent) for agent in self.possible_agents}


def test_agents_of_any_name_keep_their_own_memory_while_they_play(tmp_path: Path) -> None:
    names = [("x", 1), ("x", np.int64(4))]
    env = make_team_env(Named, 1, seed=0, names=names)
    model: Any = PPO("IPPOPolicy", env, seed=0, policy_kwargs={"memory": "gru", "actor_identity": True})
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.5 * th.randn_like(parameter))
    actor = Actor.load(export_actors(model, tmp_path))
    game, memory, state = Named(names), actor.new_memory(), None
    alone: dict[Any, Any] = {}
    observations, _ = game.reset()
    while game.agents:
        turned = {agent: observations[agent] for agent in reversed(game.agents)}
        going = dict.fromkeys(turned, False)
        with_starts, _ = model.predict(turned, state, going, deterministic=True)
        expected, state = model.predict(turned, state, deterministic=True)
        assert repr(with_starts) == repr(expected)
        assert repr(model.predict(turned, state, dict.fromkeys(turned, True), deterministic=True)) == repr(
            model.predict(turned, deterministic=True)
        )
        alone = {agent: alone.get(agent) or actor.new_memory() for agent in turned}  # those that waited begin anew
        likelihoods = actor.log_prob(turned, expected, memory=memory)
        for likelihood, (agent, own) in zip(likelihoods, turned.items(), strict=True):
            single = Actor(actor.session, actor.description, names.index(agent))
            assert single.log_prob(own, expected[agent], memory=alone[agent]) == pytest.approx(likelihood, abs=1e-4)
            single.act(own, memory=alone[agent])
        acted = actor.act(turned, memory=memory)
        assert acted == {agent: pytest.approx(action, rel=1e-4, abs=1e-5) for agent, action in expected.items()}
        observations, *_ = game.step(expected)
        observations = {agent: game.see(agent) for agent in game.agents}
    rows = np.stack(list(turned.values()))
    for call in (
        lambda: model.predict(rows, state),
        lambda: model.predict(turned, (np.zeros((2, 8)),)),
        lambda: model.predict(rows, None, dict.fromkeys(names, False)),
    ):
        with pytest.raises(ValueError, match="in the form of observations"):
            call()
    with pytest.raises(ValueError, match="expected episode_start of each observed agent, got none of"):
        model.predict(turned, state, {"zz": True})
    with pytest.raises(ValueError, match="expected episode_start of 1 agents, got 4"):
        model.predict(turned, state, np.zeros(4))
    with pytest.raises(ValueError, match="expected episode_start of 1 rows, one for each agent, got 4"):
        model.predict({"obs": rows, "agent": [0] * len(rows)}, None, np.zeros(4))
    with pytest.raises(ValueError, match=r"observations in the form of the episode so far.*make a new memory"):
        Actor(actor.session, actor.description, 0).act(rows[0], memory=memory)


def test_names_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    model: Any = PPO("IPPOPolicy", make_team_env(Named, 1, seed=0, names=[frozenset("a"), frozenset("b")]), seed=0)
    with pytest.raises(ExportError, match=r"text, numbers or tuples of these, got .*frozenset"):
        export_actors(model, tmp_path)


def test_wrong_memories(exports: Callable[[str], Exported]) -> None:
    actor, obs = exports("heads with memory").actor, samples(VECTOR, 3)
    with pytest.raises(ValueError, match=r"memory = actor.new_memory\(\) at the start of each .*got memory=None"):
        actor.act(obs)
    memory = actor.new_memory()
    actor.act(obs, memory=memory)
    with pytest.raises(ValueError, match="expected memory of 1 observations at once, got one of 3"):
        actor.act(obs[0], memory=memory)
    plain = exports("own encoder").actor
    assert not plain.has_memory
    for call in (plain.new_memory, lambda: plain.act(obs, memory=memory)):
        with pytest.raises(ValueError, match="MAPPOPolicy has no memory"):
            call()


# --- what the game gives ----------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:the pictures in the agents' observations are read as plain numbers")
@pytest.mark.parametrize(("kind", "masks"), [("nested", "info"), ("pictures", "observation")])
def test_acts_on_what_the_game_gives(kind: str, masks: str, tmp_path: Path) -> None:
    env = make_team_env(partial(Kinds, kind, masks), seed=0)
    heads = {"heads": "per_agent", "n_policies": 1}
    model: Any = PPO("SAFPolicy", env, seed=0, device="cpu", policy_kwargs=heads)
    with th.no_grad():
        for parameter in model.policy.actor.parameters():
            parameter.add_(0.5 * th.randn_like(parameter))
    folder = export_actors(model, tmp_path)
    actor, game = Actor.load(folder), Kinds(kind, masks)
    alone = {agent: Actor.load(folder, agent=agent) for agent in game.possible_agents}
    observations, infos = game.reset(seed=game_seeds(0, 1)[0])
    rows, _ = model.policy.obs_to_tensor(env.reset())
    with th.no_grad():
        probabilities = model.policy.get_distribution(rows).distribution.probs.numpy()
    given: Any = observations if masks != "info" else (observations, infos)
    for choice in range(3):  # as the games count them: those of some agents begin with 2
        actions = {agent: cast(Any, game.action_space(agent)).start + choice for agent in game.possible_agents}
        likelihoods = np.exp(actor.log_prob(given, actions))
        np.testing.assert_allclose(likelihoods, probabilities[:, choice], atol=1e-5)
        for index, (agent, action) in enumerate(actions.items()):
            found = alone[agent].log_prob(observations[agent], action, action_mask=mask_in(infos[agent]))
            np.testing.assert_allclose(np.exp(found), likelihoods[index], atol=1e-5)
    with pytest.raises(ValueError, match=r"expected \{agent: action\} of \['agent', 'b', 'c'\]"):
        actor.log_prob(given, [1, 1, 1])
    while game.agents:
        expected, _ = model.predict((observations, infos), deterministic=True)
        given = observations if masks != "info" else (observations, infos)
        found = actor.act(given)
        assert found.keys() == expected.keys()
        for agent, action in expected.items():
            np.testing.assert_allclose(found[agent], action, atol=1e-5)
            mask = mask_in(infos[agent])
            np.testing.assert_allclose(alone[agent].act(observations[agent], action_mask=mask), action, atol=1e-5)
        drawn = actor.act(given, deterministic=False, rng=0)
        observations, _, _, _, infos = game.step(drawn)  # which checks the actions
        observations = {agent: observations[agent] for agent in game.agents}


# --- programs with nothing but the files ------------------------------------------------------------------------------


#: A program beside ``act.py``; its arguments are the agent, modules to hide, and a file of observations and masks.
BESIDE = """
import json, sys
sys.modules.update(dict.fromkeys(sys.argv[2].split()))
import numpy as np
from act import Actor

actor, given = Actor.load(".", agent=int(sys.argv[1])), np.load(sys.argv[3])
memory = actor.new_memory() if actor.has_memory else None
masks = given["masks"] if "masks" in given else [None] * len(given["obs"])
actions = [actor.act(own, action_mask=mask, memory=memory) for own, mask in zip(given["obs"], masks)]
print(json.dumps(np.stack(actions).tolist()))
"""


@pytest.mark.parametrize("name", ["heads, grey pictures", "heads with memory", "masked rows"])
def test_the_file_acts_as_the_model_without_other_packages(
    name: str, exports: Callable[[str], Exported], tmp_path: Path
) -> None:
    policy, folder, actor = exports(name)
    given = {"obs": samples(policy.team_spaces.own, 7)}
    if "mask" in name:
        given["masks"] = random_masks(spaces.Discrete(3), 7, np.random.default_rng(0))
    np.savez(tmp_path / "given.npz", **given)  # type: ignore[arg-type]
    hidden = " ".join((*ABSENT, "sb3_saf", "hecogrid_envs", "safetensors", "msgspec"))
    command = [sys.executable, "-c", BESIDE, str(AGENT), hidden, str(tmp_path / "given.npz")]
    answer = subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder)
    memory = actor.new_memory() if actor.has_memory else None
    masks = given.get("masks", [None] * 7)
    expected = [actor.act(own, action_mask=mask, memory=memory) for own, mask in zip(given["obs"], masks, strict=True)]
    np.testing.assert_allclose(json.loads(answer.stdout), expected, atol=1e-6)


def test_without_stable_baselines_the_package_says_what_is_missing() -> None:
    code = f"import sys; sys.modules.update(dict.fromkeys({ABSENT!r})); import sb3_saf; "
    code += "print(sb3_saf.Actor.__name__); sb3_saf.SAFPolicy"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=ENVIRONMENT)
    assert answer.stdout == "Actor\n"
    assert "sb3_saf.SAFPolicy needs stable_baselines3, which is not installed" in answer.stderr


# --- what cannot be exported, and bad input ---------------------------------------------------------------------------


def test_other_policies_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match=r"expected model with SAFPolicy, .*, got ActorCriticPolicy"):
        export_actors(PPO("MlpPolicy", "CartPole-v1", device="cpu"), tmp_path / "actor")
    broken = make_policy(SAFPolicy)
    with th.no_grad():
        next(broken.actor.parameters()).fill_(float("nan"))
    with pytest.raises(ExportError, match="has NaN or infinity"):
        export_actors(broken, tmp_path / "actor")
    with pytest.raises(ExportError, match="counting from 0"):
        export_actors(make_policy(SAFPolicy, action_space=spaces.Discrete(3, start=1)), tmp_path / "actor")
    assert list(tmp_path.iterdir()) == []


def test_a_network_with_other_numbers_is_not_written(
    exports: Callable[[str], Exported], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, folder, _ = exports("own encoder")
    graph = (folder / "actor.onnx").read_bytes()
    monkeypatch.setattr("sb3_saf.export.writer._written", lambda *_: graph)
    assert (export_actors(policy, tmp_path / "same") / "actor.onnx").read_bytes() == graph
    extract = policy.extract_features
    monkeypatch.setattr(policy, "extract_features", lambda *args: extract(*args) + 0.5)
    with pytest.raises(ExportError, match="does more than its encoder and actor"):
        export_actors(policy, tmp_path / "actor")
    assert not (tmp_path / "actor").exists()


def test_an_export_without_its_normalisation_warns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = VecNormalize(make_team_env(CounterEnv, n_envs=2, seed=0).venv, norm_obs_keys=["obs"])
    policy: Any = PPO("IPPOPolicy", CentralizedValueWrapper(rows), device="cpu").policy

    def written(network: Any, inputs: Any, _: Any) -> bytes:
        assert network(inputs)[0].shape == (16,)
        raise ExportError("not written here")

    monkeypatch.setattr("sb3_saf.export.writer._written", written)
    with pytest.warns(UserWarning, match="normalise what the actors observe"), pytest.raises(ExportError, match="here"):
        export_actors(policy, tmp_path / "actor")  # it has no games to look at


def test_files_of_another_kind_are_refused(exports: Callable[[str], Exported], tmp_path: Path) -> None:
    data = (exports("own encoder").folder / "actor.onnx").read_bytes()
    for content in (
        data[: len(data) // 2],
        b"",
        b"no graph",
        *(data.replace(name, b"x" * len(name)) for name in (b"sb3_saf", b"n_agents", b"conversions")),
    ):
        (tmp_path / "actor.onnx").write_bytes(content)
        with pytest.raises(ValueError, match=r"actor.onnx to be written by sb3_saf.export_actors, got"):
            Actor.load(tmp_path)
    with pytest.raises(ValueError, match=r"nowhere.actor.onnx to be written by sb3_saf.export_actors"):
        Actor.load(tmp_path / "nowhere")


def test_an_agent_that_matters_must_be_named(exports: Callable[[str], Exported]) -> None:
    _, folder, _ = exports("heads, grey pictures")
    with pytest.raises(ValueError, match=r"agent= of Actor.load, 0 to 2"):
        Actor.load(folder).act(samples(GREY, 1)[0])
    for agent in (3, -1, True, "zero"):
        with pytest.raises(ValueError, match=r"agent must be a whole number in 0\.\.2"):
            Actor.load(folder, agent=agent)


@pytest.mark.parametrize(
    ("name", "observation", "message"),
    [
        ("own encoder", np.zeros(4), r"observation of shape \(4,\)"),
        ("own encoder", [np.nan] * 5, "observation has NaN"),
        ("own encoder", ["a"] * 5, "observation of float32.* does not fit"),
        ("pool, codes", np.full((3, 3), 20), "observation of at least 0 and below 20"),
        ("pool, codes", np.full((3, 3), -1), "observation of uint8.* does not fit"),
        ("shared, sure choices", 5, "observation of at least 0 and below 5"),
    ],
)
def test_observations_of_another_kind_are_refused(
    name: str, observation: Any, message: str, exports: Callable[[str], Exported]
) -> None:
    with pytest.raises(ValueError, match=message):
        exports(name).actor.act(observation)


# --- weights ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("by", ["save", "save_weights"])
def test_weights_are_read_without_unpickling(by: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, other = make_model(), make_model(seed=1)
    path = tmp_path / "model"
    if by == "save":
        model.save(path)
    else:
        path = save_weights(model, path)
    assert not equal_weights(model.policy, other.policy)

    def forbidden(*args: object, **kwargs: object) -> None:
        raise AssertionError("unpickled")

    for name in ("cloudpickle.loads", "pickle.loads", "pickle.load"):
        monkeypatch.setattr(name, forbidden)
    load_weights(other, path)
    assert equal_weights(model.policy, other.policy)


class Bomb:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def zip_with(path: Path, value: object) -> Path:
    """Write a file as SB3's ``save`` does."""
    buffer = io.BytesIO()
    th.save(value, buffer)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("policy.pth", buffer.getvalue())
    return path


def test_wrong_files_change_nothing_and_run_nothing(tmp_path: Path) -> None:
    policy = make_policy(SAFPolicy)
    before = {name: tensor.clone() for name, tensor in policy.state_dict().items()}
    name = next(iter(before))
    cases = {
        "does not hold the tensors": {**before, name: Bomb(tmp_path / "ran")},
        "must map names": [1, 2],
        "lacks the tensor": {n: t for n, t in before.items() if n != name},
        "the network does not have": {**before, "zzz": before[name]},
        "expected '.*' of shape": {**before, name: th.zeros(3)},
        "has NaN": {**before, name: before[name] * float("nan")},
        "got int": {**before, name: 3},
    }
    for message, value in cases.items():
        with pytest.raises(ExportError, match=message):
            load_weights(policy, zip_with(tmp_path / "model.zip", value))
    for path in (tmp_path / "model.zip", tmp_path / "model.safetensors"):
        path.write_bytes(b"no such file")
        with pytest.raises(ExportError, match="does not hold the tensors"):
            load_weights(policy, path)
    with pytest.raises(ExportError, match="found no file"):
        load_weights(policy, tmp_path / "nowhere")
    assert not (tmp_path / "ran").exists()
    assert all(th.equal(tensor, before[key]) for key, tensor in policy.state_dict().items())
