"""Exported actors: content of the files, who can read them, and untrusted files."""

from __future__ import annotations

import io
import json
import os
import pickle
import random
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, cast

import msgspec
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from safetensors.torch import load, save
from sb3_saf.export.manifest import MANIFEST_FILE, ONNX_FILE, WEIGHTS_FILE, DataFile, Manifest, checksum
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

import hecogrid_envs
from sb3_saf import (
    Actor,
    CentralizedValueWrapper,
    ExportError,
    IPPOPolicy,
    LightEncoder,
    MAPPOPolicy,
    MLPEncoder,
    PaperCNN,
    SAFPolicy,
    export_actors,
    load_weights,
    make_team_env,
)
from sb3_saf.export import files as export_files
from sb3_saf.policies.base import TeamActorCriticPolicy
from tests.lone_agent import TRAINING, Absent
from tests.test_policies import ACTIONS, equal_weights, make_model, make_policy
from tests.toy_envs import CounterEnv
from tests.toy_teams import PICTURE, VECTOR, CodeSpace, samples

ROOT = Path(__file__).resolve().parents[1]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}
#: Every kind of actor.
ACTORS: dict[str, tuple[type[TeamActorCriticPolicy], dict[str, Any]]] = {
    "mixture": (SAFPolicy, {}),
    "gumbel": (SAFPolicy, {"selection": "gumbel"}),
    "one policy": (SAFPolicy, {"n_policies": 1}),
    "shared": (MAPPOPolicy, {}),
    "per agent": (IPPOPolicy, {"heads": "per_agent"}),
}
OWN: dict[str, spaces.Space[Any]] = {
    "vector": VECTOR,
    "picture": PICTURE,
    "codes": CodeSpace(),
    "discrete": spaces.Discrete(5),
    "multi-discrete": spaces.MultiDiscrete([3, 4]),
    "multi-binary": spaces.MultiBinary(4),
    "small bytes": spaces.Box(0, 3, (3, 9, 9), np.uint8),
    "large picture": spaces.Box(0, 255, (3, 72, 64), np.uint8),
    "float picture": spaces.Box(0.0, 1.0, (9, 9, 3), np.float64),
}


def exported(policy: TeamActorCriticPolicy | PPO, folder: Path, **kwargs: Any) -> Path:
    """Create an export without ONNX, whose writing takes a second."""
    return export_actors(policy, folder, **({"onnx": False} | kwargs))


def predicted(policy: TeamActorCriticPolicy, obs: np.ndarray, agent: int, deterministic: bool = True) -> np.ndarray:
    """Return the trained model's actions, given only an agent's own observation and index."""
    return policy.predict({"obs": obs, "agent": np.full(len(obs), agent)}, deterministic=deterministic)[0]


# --- the same actions -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("kind", ACTORS)
def test_decides_and_draws_as_the_model_does(kind: str, action: str, tmp_path: Path) -> None:
    policy_class, kwargs = ACTORS[kind]
    policy = make_policy(policy_class, action_space=ACTIONS[action], noise=0.6, **kwargs)
    folder, obs = exported(policy, tmp_path / "actor"), samples(VECTOR, 20)
    for agent in range(3):
        np.testing.assert_array_equal(Actor.load(folder, agent=agent).act(obs), predicted(policy, obs, agent))
    actor, drawn = Actor.load(folder, agent=1), []
    for seed, own in enumerate(obs):
        wanted, _ = policy.predict({"obs": own, "agent": np.asarray(1)}, deterministic=True)
        found = actor.act(own)
        np.testing.assert_allclose(found, wanted, atol=1e-6)
        assert (type(found), found.dtype, found.shape) == (type(wanted), wanted.dtype, wanted.shape)
        th.manual_seed(seed)
        drawn.append(predicted(policy, own[np.newaxis], 1, deterministic=False)[0])
        th.manual_seed(seed)
        np.testing.assert_allclose(actor.act(own, deterministic=False), drawn[-1], atol=1e-5)
        np.testing.assert_allclose(actor.act(own, deterministic=False, rng=seed), drawn[-1], atol=1e-5)
    assert not np.array_equal(drawn, actor.act(obs))  # so that sampled actions differ from the most likely ones
    if action == "discrete":
        n_draws = 4_000
        repeated = np.repeat(obs[:1], n_draws, axis=0)
        actions = actor.act(repeated, deterministic=False, rng=np.random.default_rng(0))
        probabilities = actor.probabilities(obs[0])
        deviation = 5 * np.sqrt(probabilities * (1 - probabilities) / n_draws)
        assert (np.abs(np.bincount(actions, minlength=3) / n_draws - probabilities) < deviation).all()


@pytest.mark.parametrize("own", OWN)
@pytest.mark.parametrize("encoder", [None, PaperCNN, LightEncoder, MLPEncoder])
def test_every_encoder_reads_every_space_that_it_can(
    own: str, encoder: type[BaseFeaturesExtractor] | None, tmp_path: Path
) -> None:
    space = OWN[own]
    extractor: dict[str, Any] = {"features_dim": 12}
    if encoder is LightEncoder and own in ("small bytes", "float picture"):
        extractor["tile_size"] = 3
    sizes: dict[str, Any] = {} if encoder is None else {"features_extractor_class": encoder}
    try:
        policy = make_policy(SAFPolicy, space, noise=0.6, features_extractor_kwargs=extractor, **sizes)
    except ValueError:
        assert encoder in (PaperCNN, LightEncoder)
        return
    actor = Actor.load(exported(policy, tmp_path / "actor"))
    obs = samples(space, 30)
    np.testing.assert_array_equal(actor.act(obs), predicted(policy, obs, 0))
    with th.no_grad():
        probs = cast(Any, policy.get_distribution(th.as_tensor(obs))).distribution.probs
    np.testing.assert_allclose(actor.probabilities(obs), probs, atol=1e-6)
    # The summation order differs between a single view and a batch; the large image has 14,000 numbers.
    np.testing.assert_allclose([actor.probabilities(one) for one in obs], probs, atol=5e-6)


@pytest.mark.parametrize("normalize_images", [True, False])
def test_pictures_may_come_with_channels_last(normalize_images: bool, tmp_path: Path) -> None:
    policy = make_policy(SAFPolicy, PICTURE, noise=0.6, normalize_images=normalize_images)
    actor = Actor.load(exported(policy, tmp_path / "actor"))
    obs = samples(PICTURE, 20)
    last = np.moveaxis(obs, 1, -1)
    expected = policy.predict(last, deterministic=True)[0]
    assert len(set(expected.tolist())) > 1
    np.testing.assert_array_equal(actor.act(last), expected)
    np.testing.assert_array_equal([actor.act(one) for one in last], expected)


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("kind", ["mixture", "one policy"])
def test_likelihoods_are_the_models(kind: str, action: str, tmp_path: Path) -> None:
    policy_class, kwargs = ACTORS[kind]
    policy = make_policy(policy_class, action_space=ACTIONS[action], noise=0.6, **kwargs)
    actor = Actor.load(exported(policy, tmp_path / "actor"))
    obs = samples(VECTOR, 30)
    actions = samples(ACTIONS[action], 30)
    with th.no_grad():
        given = th.as_tensor(actions).float() if action == "multi-binary" else th.as_tensor(actions)
        expected = policy.get_distribution(th.as_tensor(obs)).log_prob(given)
    np.testing.assert_allclose(actor.log_prob(obs, actions), expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(actor.log_prob(obs[3], actions[3]), expected[3], rtol=1e-5, atol=1e-6)


def test_nothing_of_the_critic_is_written(tmp_path: Path) -> None:
    policy = make_policy(SAFPolicy)
    folder = exported(policy, tmp_path / "actor")
    before = (folder / WEIGHTS_FILE).read_bytes()
    tensors = load(before)
    assert {name.partition(".")[0] for name in tensors} == {"encoder", "actor"}
    parts = (policy.features_extractor, policy.actor)
    assert sum(tensor.numel() for tensor in tensors.values()) == sum(
        parameter.numel() for part in parts for parameter in part.parameters()
    )
    with th.no_grad():
        for parameter in policy.value_net.parameters():
            parameter.add_(1.0)
    assert (exported(policy, folder) / WEIGHTS_FILE).read_bytes() == before


def test_a_saved_loaded_and_exported_model_predicts_the_same(tmp_path: Path) -> None:
    model = make_model(n_steps=10)
    model.learn(120)
    model.save(tmp_path / "model")
    loaded = PPO.load(tmp_path / "model", device="cpu")
    actor = Actor.load(exported(loaded, tmp_path / "actor"))
    obs = samples(VECTOR, 50)
    np.testing.assert_array_equal(actor.act(obs), model.predict(obs, deterministic=True)[0])


def test_an_export_without_its_normalisation_warns(tmp_path: Path) -> None:
    rows = VecNormalize(make_team_env(CounterEnv, n_envs=2, seed=0).venv, norm_obs_keys=["obs"])
    model = PPO("MAPPOPolicy", CentralizedValueWrapper(rows), device="cpu")
    with pytest.warns(UserWarning, match="normalise what the actors observe"):
        exported(model, tmp_path / "actor")
    rows.norm_obs = False
    exported(model, tmp_path / "actor")  # warnings are errors


# --- ONNX -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[TeamActorCriticPolicy, Path]]:
    """Create exports with ONNX, one for each kind of graph."""
    pairs = {"features_extractor_class": LightEncoder, "actor_identity": True}
    cases: dict[str, tuple[spaces.Space[Any], str, dict[str, Any]]] = {
        "mixture": (CodeSpace(), "discrete", {}),
        "mixture of pairs": (PICTURE, "multi-discrete", pairs),
        "gumbel": (VECTOR, "box", {}),
        "per agent": (OWN["multi-discrete"], "multi-binary", {}),
    }
    made = {}
    for name, (own, action, kwargs) in cases.items():
        policy_class, sizes = ACTORS[name.partition(" of ")[0]]
        policy = make_policy(policy_class, own, ACTIONS[action], noise=0.6, **sizes, **kwargs)
        made[name] = policy, export_actors(policy, tmp_path_factory.mktemp("onnx") / "actor")
    return made


@pytest.mark.parametrize("name", ["mixture", "mixture of pairs", "gumbel", "per agent"])
def test_onnx_gives_torchs_numbers(folders: dict[str, tuple[TeamActorCriticPolicy, Path]], name: str) -> None:
    policy, folder = folders[name]
    obs = samples(policy.team_spaces.own, 33)
    torch_actor, onnx_actor = Actor.load(folder, agent=2), Actor.load(folder, agent=2, runtime="onnx")
    actions = samples(policy.action_space, 33)
    found, expected = onnx_actor.log_prob(obs, actions), torch_actor.log_prob(obs, actions)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(onnx_actor.act(obs), predicted(policy, obs, 2), atol=1e-5)
    one = onnx_actor.act(obs[0], deterministic=False, rng=3)
    np.testing.assert_array_equal(one, onnx_actor.act(obs[0], deterministic=False, rng=3))
    repeated = np.repeat(obs[:1], 4_000, axis=0)
    draws = [actor.act(repeated, deterministic=False, rng=4) for actor in (onnx_actor, torch_actor)]
    means, spreads = ([reduce(draw.reshape(4_000, -1), axis=0) for draw in draws] for reduce in (np.mean, np.std))
    assert (np.abs(means[0] - means[1]) < 5 * spreads[1] * (2 / 4_000) ** 0.5 + 1e-6).all()
    np.testing.assert_allclose(spreads[0], spreads[1], rtol=0.15, atol=0.05)


@pytest.mark.parametrize("name", ["mixture", "gumbel", "per agent"])
def test_the_script_beside_the_graph_needs_nothing_else(
    folders: dict[str, tuple[TeamActorCriticPolicy, Path]], name: str, tmp_path: Path
) -> None:
    policy, folder = folders[name]
    obs = samples(policy.team_spaces.own, 7)
    np.save(tmp_path / "obs.npy", obs)
    absent = TRAINING | {"sb3_saf", "torch", "safetensors", "onnx"}
    code = (
        f"import sys, runpy; sys.path.insert(0, {str(ROOT / 'tests')!r}); from lone_agent import Absent; "
        f"sys.meta_path.insert(0, Absent({absent!r})); sys.path.pop(0); "
        f"sys.argv = ['act.py', {str(tmp_path / 'obs.npy')!r}, '--agent', '1']; "
        f"runpy.run_path({str(folder / 'act.py')!r}, run_name='__main__')"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    np.testing.assert_allclose(json.loads(answer.stdout), predicted(policy, obs, 1), atol=1e-5)


class OwnEncoder(BaseFeaturesExtractor):
    """An encoder that exported files cannot name."""

    def __init__(self, observation_space: spaces.Space[Any], features_dim: int = 4):
        super().__init__(observation_space, features_dim)
        self.net = nn.Linear(5, features_dim)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.net(observations).sin()


def test_encoders_of_ones_own_are_exported_as_onnx_alone(tmp_path: Path) -> None:
    policy = make_policy(
        MAPPOPolicy, noise=0.6, features_extractor_class=OwnEncoder, features_extractor_kwargs={"features_dim": 6}
    )
    with pytest.raises(ExportError, match="OwnEncoder with Tanh can be exported as ONNX only"):
        exported(policy, tmp_path / "actor")
    folder = export_actors(policy, tmp_path / "actor")
    assert sorted(path.name for path in folder.iterdir()) == ["act.py", MANIFEST_FILE, ONNX_FILE]
    with pytest.raises(ExportError, match='runtime="onnx"'):
        Actor.load(folder)
    obs = samples(VECTOR, 30)
    np.testing.assert_array_equal(Actor.load(folder, runtime="onnx").act(obs), predicted(policy, obs, 0))


def test_an_export_without_onnx_says_so(tmp_path: Path) -> None:
    folder = exported(make_policy(MAPPOPolicy), tmp_path / "actor")
    with pytest.raises(ExportError, match=r'without actor.onnx; load it with runtime="torch"'):
        Actor.load(folder, runtime="onnx")


# --- files of earlier versions ----------------------------------------------------------------------------------------

EARLIER = ROOT / "tests" / "golden" / "format_2"


@pytest.mark.parametrize(
    ("name", "runtime"), [("pool", "torch"), ("pool", "onnx"), ("gumbel", "torch"), ("per_agent_memory", "torch")]
)
def test_exports_of_format_version_2_act_as_they_did(name: str, runtime: Literal["torch", "onnx"]) -> None:
    expected = json.loads((EARLIER / "answers.json").read_text())[name]
    actor = Actor.load(EARLIER / name, agent=1, runtime=runtime)
    memories = [actor.new_memory() if actor.has_memory else None for _ in range(2)]
    obs = np.array(expected["observation"], actor.manifest.observation.dtype)
    found = actor.act(obs, memory=memories[0])
    np.testing.assert_allclose(found, expected["actions"], atol=1e-5)
    np.testing.assert_allclose(actor.log_prob(obs, found, memory=memories[1]), expected["log_prob"], atol=1e-4)


def test_weights_saved_by_an_earlier_version_are_read() -> None:
    model = make_model(seed=1)
    load_weights(model, EARLIER / "model.zip")
    expected = json.loads((EARLIER / "answers.json").read_text())["model"]["actions"]
    assert model.predict(samples(VECTOR, 6), deterministic=True)[0].tolist() == expected


# --- agent's index, and pixels for an actor of tile codes -------------------------------------------------------------


@pytest.mark.parametrize("policy_class", [MAPPOPolicy, SAFPolicy])
def test_an_actor_that_reads_who_acts_is_told(policy_class: type[TeamActorCriticPolicy], tmp_path: Path) -> None:
    policy = make_policy(policy_class, noise=0.6, actor_identity=True)
    folder, obs = exported(policy, tmp_path / "actor"), samples(VECTOR, 20)
    with pytest.raises(ValueError, match="say which one acts"):
        Actor.load(folder)
    probabilities = []
    for agent in range(3):
        actor = Actor.load(folder, agent=agent)
        rows = {"obs": th.as_tensor(obs), "agent": th.full((20,), agent)}
        with th.no_grad():
            expected = cast(Any, policy.get_distribution(rows)).distribution.probs
        np.testing.assert_allclose(actor.probabilities(obs), expected, atol=1e-5)
        np.testing.assert_array_equal(actor.act(obs), predicted(policy, obs, agent))
        probabilities.append(expected.numpy())
    assert np.abs(probabilities[0] - probabilities[2]).max() > 0.01


@pytest.mark.parametrize("encoder", [None, LightEncoder, MLPEncoder])
def test_an_actor_of_tile_codes_takes_pixels(
    encoder: type[BaseFeaturesExtractor] | None,
    folders: dict[str, tuple[TeamActorCriticPolicy, Path]],
    tmp_path: Path,
) -> None:
    space = CodeSpace()
    if encoder is None:
        folder, runtimes = folders["mixture"][1], ["torch", "onnx"]
    else:
        policy = make_policy(SAFPolicy, space, noise=0.6, features_extractor_class=encoder)
        folder, runtimes = exported(policy, tmp_path / "actor"), ["torch"]
    codes = samples(space, 10)
    pictures = space.atlas[codes].swapaxes(2, 3).reshape(10, 12, 12, 3)
    for runtime in runtimes:
        actor = Actor.load(folder, runtime=cast(Any, runtime))
        np.testing.assert_array_equal(actor.act(pictures), actor.act(codes))
        np.testing.assert_array_equal(actor.act(np.moveaxis(pictures, -1, 1)), actor.act(codes))
        assert actor.act(pictures[3]) == actor.act(codes[3])
    pictures[2, 5, 9, 0] ^= 1
    with pytest.raises(ValueError, match="the tile in row 1, column 2 is none of the 20 tiles that this agent was"):
        actor.act(pictures)


# --- processes with only their own observation ------------------------------------------------------------------------


class LoneAgent:
    """A process with one agent, in which the packages for training are hidden."""

    def __init__(self, folder: Path, runtime: str, agent: int):
        command = [sys.executable, str(ROOT / "tests" / "lone_agent.py"), str(folder), runtime, str(agent)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT
        )

    def ask(self, observation: np.ndarray, **more: Any) -> None:
        assert self.process.stdin
        question = {"observation": observation.tolist(), "dtype": str(observation.dtype), **more}
        self.process.stdin.write(json.dumps(question) + "\n")
        self.process.stdin.flush()

    def answer(self) -> dict[str, Any]:
        assert self.process.stdout
        return json.loads(self.process.stdout.readline())


def test_agents_in_processes_of_their_own_play_an_episode_as_the_model_would(tmp_path: Path) -> None:
    runtimes = ["torch", "onnx"]
    level: dict[str, Any] = {"n_agents": len(runtimes), "grid_size": 9, "n_treasures": 6}
    games, heads = make_team_env("TeamSupport", n_envs=1, **level), {"heads": "per_agent"}
    model = PPO("MAPPOPolicy", games, policy_kwargs=heads, seed=0, device="cpu")
    with th.no_grad():
        for parameter in model.policy.actor.parameters():  # type: ignore[union-attr]
            parameter.add_(0.2 * th.randn_like(parameter))
    folder = export_actors(model, tmp_path / "actor")
    agents = [LoneAgent(folder, runtime, agent) for agent, runtime in enumerate(runtimes)]
    env = hecogrid_envs.tasks.team_support.parallel_env(**level)
    observations, _ = env.reset(seed=3)
    seen: set[int] = set()
    steps = 0
    while env.agents:
        own = np.stack([observations[name] for name in env.agents])
        for agent, view in zip(agents, own, strict=True):
            agent.ask(view)
        team: dict[str, np.ndarray] = {"obs": own, "agent": np.arange(len(own))}
        expected, _ = model.predict(team, deterministic=True)
        tensors, _ = model.policy.obs_to_tensor(team)
        with th.no_grad():
            wanted = cast(Any, model.policy.get_distribution(tensors)).distribution.probs.numpy()
        answers = [agent.answer() for agent in agents]
        assert [answer["action"] for answer in answers] == expected.tolist()
        np.testing.assert_allclose([answer["probabilities"] for answer in answers], wanted, atol=1e-6)
        assert [answer["loaded"] for answer in answers] == [[] for _ in answers]
        observations, *_ = env.step(dict(zip(env.agents, expected, strict=True)))
        seen |= set(expected.tolist())
        steps += 1
    assert steps == 50
    assert len(seen) > 1
    for agent in agents:
        agent.process.communicate(timeout=60)
        assert agent.process.returncode == 0


def test_without_stable_baselines_the_package_says_what_is_missing() -> None:
    code = (
        f"import sys; sys.path.insert(0, {str(ROOT / 'tests')!r}); from lone_agent import Absent, TRAINING; "
        "sys.meta_path.insert(0, Absent(TRAINING)); import sb3_saf; print(sb3_saf.Actor.__name__); sb3_saf.SAFPolicy"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=ENVIRONMENT)
    assert answer.stdout == "Actor\n"
    assert "sb3_saf.SAFPolicy needs stable_baselines3, which is not installed" in answer.stderr


def test_absent_packages_are_absent() -> None:
    with pytest.raises(ModuleNotFoundError):
        Absent({"some_package"}).find_spec("some_package.module", None)


# --- what cannot be exported, invalid folders -------------------------------------------------------------------------


def test_other_policies_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match=r"expected a model with SAFPolicy, .*, got ActorCriticPolicy"):
        export_actors(PPO("MlpPolicy", "CartPole-v1", device="cpu"), tmp_path / "actor")
    broken = make_policy(SAFPolicy)
    with th.no_grad():
        next(broken.actor.parameters()).fill_(float("nan"))
    with pytest.raises(ExportError, match="has NaN or infinity"):
        exported(broken, tmp_path / "actor")
    with pytest.raises(ExportError, match="counting from 0"):
        exported(make_policy(SAFPolicy, action_space=spaces.Discrete(3, start=1)), tmp_path / "actor")
    assert list(tmp_path.iterdir()) == []


def test_a_network_with_other_numbers_is_not_written(tmp_path: Path) -> None:
    policy = make_policy(SAFPolicy)
    extract = policy.extract_features
    policy.extract_features = lambda *args: extract(*args) + 0.5  # type: ignore[method-assign]
    with pytest.raises(ExportError, match="does more than its encoder and actor show"):
        exported(policy, tmp_path / "actor")


def test_folders_are_replaced_only_if_they_are_exports(tmp_path: Path) -> None:
    one, other = make_policy(SAFPolicy), make_policy(SAFPolicy, seed=1)
    folder = exported(one, tmp_path / "new" / "actor")
    first = (folder / WEIGHTS_FILE).read_bytes()
    exported(other, folder)
    second = (folder / WEIGHTS_FILE).read_bytes()
    assert first != second
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(ExportError, match="has other files beside"):
        exported(one, folder)
    assert (folder / WEIGHTS_FILE).read_bytes() == second
    exported(one, folder, overwrite=True)
    assert sorted(path.name for path in folder.iterdir()) == [MANIFEST_FILE, WEIGHTS_FILE]
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    exported(one, foreign)  # an empty folder may be used
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ExportError, match="expected a folder to write to"):
        exported(one, tmp_path / "file", overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "foreign", "new"]
    assert sorted(path.name for path in folder.parent.iterdir()) == ["actor"]


def test_an_interrupted_export_leaves_the_earlier_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = exported(make_policy(SAFPolicy), tmp_path / "actor")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}

    def full(path: Path, data: bytes) -> None:
        path.write_bytes(data[: len(data) // 2])
        raise OSError("No space left on device")

    monkeypatch.setattr(export_files, "_write_durably", full)
    with pytest.raises(OSError, match="No space left"):
        exported(make_policy(SAFPolicy, seed=1), folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["actor"]


# --- errors -----------------------------------------------------------------------------------------------------------


def test_agents_with_policies_of_their_own_must_be_named(tmp_path: Path) -> None:
    folder = exported(make_policy(IPPOPolicy, heads="per_agent"), tmp_path / "actor")
    with pytest.raises(ValueError, match=r"say which one acts, Actor.load\(folder, agent=0\) to 2"):
        Actor.load(folder)
    for agent in (3, -1, True, "0"):
        with pytest.raises(ValueError, match=r"agent must be a whole number in 0\.\.2"):
            Actor.load(folder, agent=cast(int, agent))


@pytest.mark.parametrize(
    ("own", "observation", "message"),
    [
        ("vector", np.zeros(4), "expected one own observation of shape"),
        ("vector", np.zeros((2, 2, 5)), "expected one own observation of shape"),
        ("vector", [np.nan] * 5, "has NaN or infinity"),
        ("vector", ["a"] * 5, "does not fit"),
        ("codes", np.full((3, 3), 20), "below 20"),
        ("codes", np.full((3, 3), -1), "does not fit"),
        ("codes", np.full((3, 3), 0.5), "does not fit"),
        ("discrete", 5, "below 5"),
        ("multi-discrete", [2, 4], r"below \[3, 4\]"),
    ],
)
def test_observations_of_another_kind_are_refused(own: str, observation: Any, message: str, tmp_path: Path) -> None:
    actor = Actor.load(exported(make_policy(SAFPolicy, OWN[own]), tmp_path / "actor"))
    with pytest.raises(ValueError, match=message):
        actor.act(observation)


def test_whole_numbers_may_come_as_lists(tmp_path: Path) -> None:
    actor = Actor.load(exported(make_policy(SAFPolicy, OWN["codes"]), tmp_path / "actor"))
    codes = samples(OWN["codes"], 1)[0]
    codes.flags.writeable = False
    assert actor.act(codes) == actor.act(codes.tolist()) == actor.act(codes.astype(float))


# --- untrusted files --------------------------------------------------------------------------------------------------


@pytest.fixture
def export(tmp_path: Path) -> Path:
    return exported(make_policy(SAFPolicy, CodeSpace(), features_extractor_class=LightEncoder), tmp_path / "actor")


def rewrite(folder: Path, change: Callable[[dict[str, Any]], object], weights: bytes | None = None) -> None:
    """Change the manifest and update its checksum, as an attacker would."""
    manifest = Manifest.from_json((folder / MANIFEST_FILE).read_bytes())
    if weights is not None:
        (folder / WEIGHTS_FILE).write_bytes(weights)
        manifest = msgspec.structs.replace(manifest, files={WEIGHTS_FILE: DataFile.of(weights)})
    entries = json.loads(manifest.to_json())
    del entries["checksum"]
    change(entries)
    (folder / MANIFEST_FILE).write_text(with_checksum(entries))


def with_checksum(entries: dict[str, Any]) -> str:
    return json.dumps({**entries, "checksum": checksum(entries)})


def test_nothing_is_unpickled(export: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*args: object, **kwargs: object) -> None:
        raise AssertionError("unpickled")

    for module, name in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"), (th, "load"), (np, "load")):
        monkeypatch.setattr(module, name, forbidden)
    assert Actor.load(export).act(np.zeros((3, 3), np.uint8)).shape == ()


CHANGES: dict[str, Callable[[dict[str, Any]], object]] = {
    "format version 4": lambda m: m.update(format_version=4),
    "is not of an exported actor": lambda m: m.update(format="pickle"),
    "Invalid enum value 'os.system' - at `$.encoder.name`": lambda m: m["encoder"].update(name="os.system"),
    "`$.actor.name`": lambda m: m["actor"].update(name="builtins.eval"),
    "`$.actor.activation`": lambda m: m["actor"].update(activation="Module"),
    "unknown field `extra`": lambda m: m.update(extra=1),
    "missing required field `n_agents`": lambda m: m.pop("n_agents"),
    "'../../etc/passwd' - at `key` in `$.files`": lambda m: m["files"].update(
        {"../../etc/passwd": m["files"][WEIGHTS_FILE]}
    ),
    "<= 1048576 - at `$.encoder.hidden`": lambda m: m["encoder"].update(hidden=(1 << 20) + 1),
    "of shape (1048576, 144)": lambda m: m["encoder"].update(hidden=1 << 20),
    "describes at least 4": lambda m: m["actor"].update(n_policies=1 << 20),
    "describes at least 32": lambda m: m["actor"].update(hidden=[1] * 4096),
    "has 1099511627776 entries": lambda m: m["observation"].update(shape=[1 << 20, 1 << 20]),
    "whole tiles": lambda m: m["encoder"].update(tile_size=5),
    "without an entry in its atlas": lambda m: m["observation"].update(high=20),
    "Expected `bool`, got `int` - at `$.reads_agent`": lambda m: m.update(reads_agent=1),
    "`$.observation.dtype`": lambda m: m["observation"].update(dtype="O"),
    "or have the shape (3, 3)": lambda m: m["observation"].update(low=[[[]]] * 9),
    "one number of uint8 or nested lists": lambda m: m["observation"].update(low={}),
    "got `array` - at `$.observation`": lambda m: m.update(observation=[]),
    "names neither": lambda m: m.update(files={}, encoder=None, actor=None),
}


@pytest.mark.parametrize("message", CHANGES)
def test_malformed_manifests_are_refused(export: Path, message: str) -> None:
    rewrite(export, CHANGES[message])
    with pytest.raises(ExportError) as caught:
        Actor.load(export)
    assert message in str(caught.value)


def test_damaged_files_are_recognised(export: Path) -> None:
    weights = (export / WEIGHTS_FILE).read_bytes()
    for damaged in (weights[:-1], weights + b"0", b"", bytes([weights[0] ^ 1]) + weights[1:]):
        (export / WEIGHTS_FILE).write_bytes(damaged)
        with pytest.raises(ExportError, match=r"length and checksum|more than"):
            Actor.load(export)
    (export / WEIGHTS_FILE).write_bytes(weights)
    Actor.load(export)
    text = (export / MANIFEST_FILE).read_text()
    for wrong in (
        text.replace('"Tanh"', '"ReLU"'),
        "[" * 100_000,
        "{}",
        "",
        '{"format": NaN}',
        '{"a": 1, "a": 1}',
        "\xff",
    ):
        (export / MANIFEST_FILE).write_bytes(wrong.encode("latin-1"))
        with pytest.raises(ExportError):
            Actor.load(export)


def test_missing_files_and_pipes_do_not_hang(export: Path) -> None:
    (export / WEIGHTS_FILE).unlink()
    with pytest.raises(ExportError, match="cannot read"):
        Actor.load(export)
    if hasattr(os, "mkfifo"):
        os.mkfifo(export / WEIGHTS_FILE)
        with pytest.raises(ExportError, match="not a regular file"):
            Actor.load(export)
    for name in ("nowhere", "with\0zero"):
        with pytest.raises(ExportError, match="cannot read"):
            Actor.load(export.parent / name)


def huge_header() -> bytes:
    header = json.dumps({"a": {"dtype": "F32", "shape": [1 << 40, 1 << 20], "data_offsets": [0, 1 << 62]}}).encode()
    return len(header).to_bytes(8, "little") + header


def test_weights_that_do_not_fit_are_refused(export: Path) -> None:
    weights = (export / WEIGHTS_FILE).read_bytes()
    tensors = load(weights)
    name = "actor.signature_keys"
    keys = tensors[name]
    cases = {
        "lacks the tensor 'actor.signature_keys'": save({n: t for n, t in tensors.items() if n != name} | {"x": keys}),
        "does not have: 'extra'": save(tensors | {"extra": keys.clone()}),
        "expected 'actor.signature_keys' of shape (4, 8)": save(tensors | {name: keys[:2].contiguous()}),
        "torch.float64": save(tensors | {name: keys.double()}),
        "NaN or infinity": save(tensors | {name: keys * float("inf")}),
        "not a valid safetensors file": huge_header(),
    }
    cases["not a valid safetensors file: "] = (1 << 60).to_bytes(8, "little") + b"{}"
    for message, content in cases.items():
        rewrite(export, lambda manifest: None, content)
        with pytest.raises(ExportError) as caught:
            Actor.load(export)
        assert message in str(caught.value)
    rewrite(export, lambda manifest: None, weights)
    Actor.load(export)


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Change, remove or duplicate a few bytes."""
    result = bytearray(data)
    for _ in range(rng.choice((1, 1, 3))):
        place = rng.randrange(len(result))
        change = rng.randrange(4)
        if change == 0:
            result[place] ^= 1 << rng.randrange(8)
        elif change == 1:
            result[place] = rng.randrange(256)
        elif change == 2:
            del result[place : place + rng.randrange(1, 30)]
        else:
            result[place:place] = result[place : place + 20]
    return bytes(result)


def walk(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield every place in nested containers."""
    for key in list(value) if isinstance(value, dict) else range(len(value)):
        yield value, key
        if isinstance(value[key], (dict, list)):
            yield from walk(value[key])


ODD_VALUES: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1 << 20,
    1 << 80,
    0.5,
    "",
    "inf",
    "../x",
    [],
    [1],
    [[1, 2], [3]],
    {},
    {"a": 1},
)


def test_mutated_exports_give_our_own_error_or_an_actor_that_works(export: Path) -> None:
    originals = {name: (export / name).read_bytes() for name in (MANIFEST_FILE, WEIGHTS_FILE)}
    observation = np.zeros((3, 3), np.uint8)
    expected = Actor.load(export).probabilities(observation)
    rng = random.Random(0)
    refused = 0
    for number in range(int(os.environ.get("MUTATIONS", "200"))):
        for name, data in originals.items():
            (export / name).write_bytes(data)
        kind = number % 4
        if kind == 0:  # damaged
            name = rng.choice(list(originals))
            (export / name).write_bytes(mutated(originals[name], rng))
        elif kind == 1:  # weights changed on purpose
            header = int.from_bytes(originals[WEIGHTS_FILE][:8], "little") + 8
            weights = mutated(originals[WEIGHTS_FILE][:header], rng) + originals[WEIGHTS_FILE][header:]
            rewrite(export, lambda manifest: None, weights)
        else:  # the manifest changed on purpose

            def change(manifest: dict[str, Any]) -> None:
                container, key = rng.choice(list(walk(manifest)))
                container[key] = rng.choice(ODD_VALUES)

            rewrite(export, change)
        try:
            found = Actor.load(export).probabilities(observation)
        except ExportError:
            refused += 1
        else:
            assert kind > 0 or np.array_equal(found, expected)
    assert refused > 150


# --- weights of saved models ------------------------------------------------------------------------------------------


def test_weights_come_out_of_a_saved_model_without_unpickling_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, other = make_model(), make_model(seed=1)
    model.save(tmp_path / "model")
    assert not equal_weights(model.policy, other.policy)

    def forbidden(*args: object, **kwargs: object) -> None:
        raise AssertionError("unpickled")

    monkeypatch.setattr("cloudpickle.loads", forbidden)
    monkeypatch.setattr(pickle, "loads", forbidden)
    load_weights(other, tmp_path / "model")
    assert equal_weights(model.policy, other.policy)
    load_weights(make_policy(SAFPolicy), tmp_path / "model.zip")


class Bomb:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def zip_with(path: Path, entry: bytes, name: str = "policy.pth") -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, entry)
    return path


def saved(value: object) -> bytes:
    buffer = io.BytesIO()
    th.save(value, buffer)
    return buffer.getvalue()


def packed(entry: bytes) -> bytes:
    """Compress the file of tensors."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(entry)) as old, zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as new:
        for info in old.infolist():
            new.writestr(info.filename, old.read(info))
    return buffer.getvalue()


def test_hostile_models_change_nothing_and_run_nothing(tmp_path: Path) -> None:
    policy = make_policy(SAFPolicy)
    before = {name: tensor.clone() for name, tensor in policy.state_dict().items()}
    name = next(iter(before))
    cases = {
        "does not hold tensors alone": saved({**before, name: Bomb(tmp_path / "ran")}),
        "must map names": saved([1, 2]),
        "lacks the tensor": saved({n: t for n, t in before.items() if n != name}),
        "the network does not have": saved({**before, "zzz": before[name]}),
        "expected ": saved({**before, name: th.zeros(3)}),
        "has NaN": saved({**before, name: before[name] * float("nan")}),
        "no plain tensor": saved({**before, name: 3}),
        "unpacks to more": packed(saved(before)),
        "has more than": b"\0" * (1 << 24),
        "alone": b"",
    }
    for message, entry in cases.items():
        with pytest.raises(ExportError, match=message):
            load_weights(policy, zip_with(tmp_path / "model.zip", entry))
    with pytest.raises(ExportError, match="not a model saved by"):
        load_weights(policy, zip_with(tmp_path / "model.zip", b"", "data"))
    (tmp_path / "model.zip").write_bytes(b"no zip")
    with pytest.raises(ExportError, match="not a model saved by"):
        load_weights(policy, tmp_path / "model.zip")
    with pytest.raises(ExportError, match="found no file"):
        load_weights(policy, tmp_path / "nowhere")
    assert not (tmp_path / "ran").exists()
    assert all(th.equal(tensor, before[key]) for key, tensor in policy.state_dict().items())


def test_mutated_models_give_our_own_error_or_their_weights(tmp_path: Path) -> None:
    model = make_model()
    model.save(tmp_path / "model.zip")
    original = (tmp_path / "model.zip").read_bytes()
    other = make_model(seed=1)
    rng = random.Random(0)
    refused = 0
    for number in range(int(os.environ.get("MUTATIONS", "100"))):
        if number % 2:
            (tmp_path / "model.zip").write_bytes(mutated(original, rng))
        else:  # inside the zip, which its checksum does not cover
            zip_with(tmp_path / "model.zip", mutated(saved(model.policy.state_dict()), rng))
        try:
            load_weights(other, tmp_path / "model.zip")
        except ExportError:
            refused += 1
        assert all(bool(tensor.isfinite().all()) for tensor in other.policy.state_dict().values())
    assert refused > 40
