"""Exported actors with action masks, and exported actors with memory."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch as th
from sb3_contrib import RecurrentPPO

from sb3_saf import Actor, ExportError, MAPPOPolicy, SAFPolicy, export_actors, make_team_env
from sb3_saf.policies.base import TeamActorCriticPolicy
from sb3_saf.teams.rows import TeamSpaces
from tests import test_contrib
from tests.contrib_teams import random_masks
from tests.test_contrib import MASKABLE
from tests.test_export import LoneAgent, exported, rewrite
from tests.test_policies import ACTIONS, SMALL, SMALL_SAF, constant, make_policy
from tests.toy_envs import TellingEnv
from tests.toy_teams import VECTOR, samples

STEPS = 6


def masked_policy(policy_class: type[TeamActorCriticPolicy] = SAFPolicy, **kwargs: Any) -> TeamActorCriticPolicy:
    """Create a policy for an environment whose observations have masks of three actions."""
    th.manual_seed(0)
    sizes: dict[str, Any] = SMALL | (SMALL_SAF if policy_class is SAFPolicy else {})
    space = TeamSpaces.of(VECTOR, 3, n_masked_actions=3).to_dict_space()
    policy = policy_class(space, ACTIONS["discrete"], constant, **(sizes | kwargs))
    with th.no_grad():
        for parameter in policy.actor.parameters():
            parameter.add_(0.6 * th.randn_like(parameter))
    return policy


# --- masks ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("policy_class", "kwargs"),
    [(SAFPolicy, {}), (SAFPolicy, {"selection": "gumbel"}), (MAPPOPolicy, {}), (MAPPOPolicy, {"heads": "per_agent"})],
)
def test_with_masks_of_the_environment_it_acts_as_the_model(
    policy_class: type[TeamActorCriticPolicy], kwargs: dict[str, Any], tmp_path: Path
) -> None:
    policy = masked_policy(policy_class, **kwargs)
    actor = Actor.load(exported(policy, tmp_path / "actor"), agent=1)
    obs, masks = samples(VECTOR, 40), random_masks(ACTIONS["discrete"], 40, np.random.default_rng(0))
    rows = {"obs": obs, "agent": np.ones(40, int), "action_mask": masks.astype(np.int8)}
    expected = policy.predict(rows, deterministic=True)[0]
    np.testing.assert_array_equal(actor.act(obs, action_mask=masks), expected)
    np.testing.assert_array_equal(actor.act({"observation": obs, "action_mask": masks}), expected)  # PettingZoo's form
    unmasked = Actor.load(exported(make_policy(policy_class, noise=0.6, **kwargs), tmp_path / "actor"), agent=1)
    assert not np.array_equal(unmasked.act(obs), expected), "masks make a difference"
    for row in range(10):
        th.manual_seed(row)
        drawn = policy.predict({key: value[row] for key, value in rows.items()}, deterministic=False)[0]
        assert actor.act(obs[row], deterministic=False, rng=row, action_mask=masks[row].tolist()) == drawn


@pytest.mark.parametrize("action", MASKABLE)
@pytest.mark.parametrize("name", ["SAFMaskablePolicy", "MAPPOMaskablePolicy"])
def test_with_masks_of_maskable_ppo_it_acts_as_the_model(name: str, action: str, tmp_path: Path) -> None:
    space = ACTIONS[action]
    policy = test_contrib.make_policy(name, space, noise=0.6)
    actor = Actor.load(exported(policy, tmp_path / "actor"), agent=2)
    obs, masks = samples(VECTOR, 40), random_masks(space, 40, np.random.default_rng(0))
    masks[0] = False  # nothing is allowed: MaskablePPO's policies then ignore the mask
    expected = policy.predict(obs, deterministic=True, action_masks=masks)[0]
    np.testing.assert_array_equal(actor.act(obs, action_mask=masks), expected)
    assert not np.array_equal(actor.act(obs), expected), "without masks everything is allowed"
    np.testing.assert_array_equal(actor.act(obs), policy.predict(obs, deterministic=True)[0])
    with th.no_grad():
        distribution = policy.get_distribution(th.as_tensor(obs), action_masks=masks)
        actions = th.as_tensor(samples(space, 40))
        wanted = policy._likelihood(distribution, actions)
    np.testing.assert_allclose(actor.log_prob(obs, actions, action_mask=masks), wanted, rtol=1e-5, atol=1e-5)
    if action == "discrete":
        probabilities = actor.probabilities(obs, action_mask=masks)
        np.testing.assert_allclose(probabilities, distribution.distribution.probs, atol=1e-6)
        assert (probabilities[1:][~masks[1:]] == 0).all()


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (None, "this actor was trained to keep to masks: pass action_mask, 3 zeros and ones per observation"),
        ([1, 0], "expected 3 zeros and ones for each of 1 observations as action_mask, got shape (2,)"),
        ([[1, 0, 1], [1, 1, 1]], "for each of 1 observations as action_mask, got shape (2, 3)"),
        ([1, 0, 2], "expected 3 zeros and ones"),
        ([0, 0, 0], "expected at least one legal action in each action_mask, got [[0, 0, 0]]"),
    ],
)
def test_wrong_masks(mask: Any, message: str, tmp_path: Path) -> None:
    actor = Actor.load(exported(masked_policy(), tmp_path / "actor"))
    for method in (actor.act, actor.probabilities):
        with pytest.raises(ValueError, match=re.escape(message)):
            method(samples(VECTOR, 1)[0], action_mask=mask)


def test_a_mask_for_an_actor_without(tmp_path: Path) -> None:
    actor = Actor.load(exported(make_policy(SAFPolicy), tmp_path / "actor"))
    with pytest.raises(ValueError, match="was trained without masks of actions"):
        actor.act(samples(VECTOR, 1)[0], action_mask=[1, 1, 1])


# --- memory -----------------------------------------------------------------------------------------------------------


def remembering(policy_name: str, action: str = "discrete", **kwargs: Any) -> Any:
    """Create a policy whose memory matters."""
    policy = test_contrib.make_policy(policy_name, ACTIONS[action], noise=1.0, **kwargs)
    with th.no_grad():
        for parameter in policy.lstm_actor.parameters():
            parameter.add_(th.randn_like(parameter))
        for name, parameter in policy.actor.named_parameters():
            if name.endswith("bias"):
                parameter.zero_()  # or its actions would not depend on observations
    return policy


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize(
    ("name", "kwargs"),
    [
        ("SAFLstmPolicy", {}),
        ("SAFLstmPolicy", {"n_lstm_layers": 2, "lstm_kwargs": {"bias": False}}),
        ("MAPPOLstmPolicy", {"heads": "per_agent"}),
    ],
)
def test_with_a_memory_it_acts_as_the_model(name: str, kwargs: dict[str, Any], action: str, tmp_path: Path) -> None:
    policy = remembering(name, action, **kwargs)
    actor = Actor.load(exported(policy, tmp_path / "actor"), agent=1)
    assert actor.has_memory
    for _ in range(2):  # episodes
        memory, state, starts = actor.new_memory(), None, np.ones(20, bool)
        alone = [actor.new_memory() for _ in range(5)]
        for step in range(STEPS):
            obs = samples(VECTOR, 20, seed=step)
            rows = {"obs": obs, "agent": np.ones(20, int)}
            expected, state = policy.predict(rows, state, starts, deterministic=True)
            likelihoods = actor.log_prob(obs, expected, memory=memory)
            np.testing.assert_array_equal(actor.act(obs, memory=memory), expected)
            np.testing.assert_allclose(np.asarray(memory.hidden), state[0], atol=1e-6)
            np.testing.assert_allclose(np.asarray(memory.cell), state[1], atol=1e-6)
            singly = [actor.act(own, memory=mine) for own, mine in zip(obs, alone, strict=False)]
            np.testing.assert_allclose(singly, expected[:5], atol=1e-5)
            starts[:] = False
    forgetful = actor.log_prob(obs, expected, memory=actor.new_memory())
    assert np.abs(forgetful - likelihoods).max() > 0.01, "memory makes a difference"


def test_likelihoods_do_not_move_the_memory(tmp_path: Path) -> None:
    actor = Actor.load(exported(remembering("SAFLstmPolicy"), tmp_path / "actor"))
    obs, memory = samples(VECTOR, 4), actor.new_memory()
    first = actor.probabilities(obs, memory=memory)
    np.testing.assert_array_equal(actor.probabilities(obs, memory=memory), first)
    actor.act(obs, memory=memory)
    assert not np.allclose(actor.probabilities(obs, memory=memory), first)


def test_wrong_memories(tmp_path: Path) -> None:
    obs = samples(VECTOR, 3)
    actor = Actor.load(exported(test_contrib.make_policy("MAPPOLstmPolicy"), tmp_path / "actor"))
    with pytest.raises(ValueError, match=r"memory = actor.new_memory\(\) at the start of each .*got memory=None"):
        actor.act(obs)
    memory = actor.new_memory()
    actor.act(obs, memory=memory)
    with pytest.raises(ValueError, match="this memory is of 3 observations at once, got 1; give each agent and each"):
        actor.act(obs[0], memory=memory)
    plain = Actor.load(exported(make_policy(SAFPolicy), tmp_path / "plain"))
    assert not plain.has_memory
    for call in (plain.new_memory, lambda: plain.act(obs, memory=memory)):
        with pytest.raises(ValueError, match="SAFPolicy acts on single observations and has no memory"):
            call()


def test_other_lstms_are_refused(tmp_path: Path) -> None:
    policy = test_contrib.make_policy("MAPPOLstmPolicy")
    policy.lstm_actor.bidirectional = True
    with pytest.raises(ExportError, match="expected an LSTM that goes forward"):
        exported(policy, tmp_path / "actor")


@pytest.mark.parametrize(
    ("message", "changes"),
    [
        ("describes at least", {"n_layers": 4000}),
        ("more than 1048576 numbers", {"n_layers": 4000, "hidden_size": 300}),
        ("of shape (28, 12)", {"hidden_size": 7}),
        ("lacks the tensor 'memory.bias_hh_l1'", {"n_layers": 2}),
        ("Expected `bool`, got `int` - at `$.memory.bias`", {"bias": 0}),
    ],
)
def test_malformed_memories_are_refused(message: str, changes: dict[str, Any], tmp_path: Path) -> None:
    folder = exported(test_contrib.make_policy("SAFLstmPolicy"), tmp_path / "actor")
    rewrite(folder, lambda manifest: manifest["memory"].update(changes))
    with pytest.raises(ExportError) as caught:
        Actor.load(folder)
    assert message in str(caught.value)


def test_boxes_have_no_masks(tmp_path: Path) -> None:
    folder = exported(make_policy(SAFPolicy, action_space=ACTIONS["box"]), tmp_path / "actor")
    rewrite(folder, lambda manifest: manifest.update(action_mask="optional"))
    with pytest.raises(ExportError, match="actions of a box cannot be masked"):
        Actor.load(folder)


# --- ONNX, and its example script -------------------------------------------------------------------------------------


def run_script(folder: Path, observations: np.ndarray, *options: str) -> list[Any]:
    np.save(folder.parent / "obs.npy", observations)
    command = [sys.executable, str(folder / "act.py"), str(folder.parent / "obs.npy"), *options]
    answer = subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder.parent)
    return json.loads(answer.stdout)


def test_onnx_with_a_memory(tmp_path: Path) -> None:
    policy = remembering("MAPPOLstmPolicy", heads="per_agent")
    folder = export_actors(policy, tmp_path / "actor")
    by_torch, by_onnx = Actor.load(folder, agent=1), Actor.load(folder, agent=1, runtime="onnx")
    memories = by_torch.new_memory(), by_onnx.new_memory()
    episode = []
    for step in range(STEPS):
        obs = samples(VECTOR, 9, seed=step)
        expected = by_torch.act(obs, memory=memories[0])
        np.testing.assert_array_equal(by_onnx.act(obs, memory=memories[1]), expected)
        np.testing.assert_allclose(np.asarray(memories[1].hidden), np.asarray(memories[0].hidden), atol=1e-5)
        episode.append((obs, expected))
    seen, done = (np.stack(part, axis=1) for part in zip(*episode, strict=True))  # (9, steps, ...)
    row = int(np.argmax([len(set(actions)) for actions in done.tolist()]))
    assert len(set(done[row].tolist())) > 1
    assert run_script(folder, seen[row], "--agent", "1") == done[row].tolist()


def test_onnx_with_masks(tmp_path: Path) -> None:
    policy = masked_policy()
    folder = export_actors(policy, tmp_path / "actor")
    obs, masks = samples(VECTOR, 12), random_masks(ACTIONS["discrete"], 12, np.random.default_rng(0))
    expected = policy.predict({"obs": obs, "action_mask": masks.astype(np.int8)}, deterministic=True)[0]
    np.testing.assert_array_equal(Actor.load(folder, runtime="onnx").act(obs, action_mask=masks), expected)
    np.save(tmp_path / "masks.npy", masks)
    assert run_script(folder, obs, "--action-mask", str(tmp_path / "masks.npy")) == expected.tolist()


# --- processes with only their own observation ------------------------------------------------------------------------


def test_agents_in_processes_of_their_own_play_as_the_model_would(tmp_path: Path) -> None:
    """With masks and memory, one agent by torch, one by ONNX."""
    env = make_team_env(lambda: TellingEnv(n_agents=2, max_cycles=6), n_envs=1, seed=0)
    model = RecurrentPPO("SAFLstmPolicy", env, seed=0, device="cpu", policy_kwargs={"lstm_hidden_size": 8})
    with th.no_grad():
        for parameter in cast(Any, model.policy).actor.parameters():
            parameter.add_(0.3 * th.randn_like(parameter))
    folder = export_actors(model, tmp_path / "actor")
    agents = [LoneAgent(folder, runtime, agent) for agent, runtime in enumerate(("torch", "onnx"))]
    rows, state, starts = env.reset(), None, np.ones(2, bool)
    seen = []
    for _ in range(12):  # two episodes
        own = {key: rows[key] for key in ("obs", "agent", "action_mask")}
        for agent, lone in enumerate(agents):
            mask = own["action_mask"][agent].tolist()
            lone.ask(own["obs"][agent], action_mask=mask, start=bool(starts[agent]))
        expected, state = model.predict(own, state, starts, deterministic=True)
        answers = [lone.answer() for lone in agents]
        assert [answer["action"] for answer in answers] == expected.tolist()
        assert [answer["loaded"] for answer in answers] == [[], []]
        assert all(own["action_mask"][agent, action] == 1 for agent, action in enumerate(expected))
        seen += expected.tolist()
        observations, _, starts, _ = env.step(expected)
        rows = cast("dict[str, np.ndarray]", observations)
    assert len(set(seen)) > 1
    for lone in agents:
        lone.process.communicate(timeout=60)
        assert lone.process.returncode == 0
