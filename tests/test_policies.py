"""SAFPolicy, MAPPOPolicy and IPPOPolicy in SB3's algorithms."""

from __future__ import annotations

import copy
from itertools import product
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.buffers import DictRolloutBuffer
from stable_baselines3.common.distributions import CategoricalDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
)
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import nn

from sb3_saf import IPPOPolicy, MAPPOPolicy, SAFPolicy, TeamRolloutBuffer
from sb3_saf.buffers.rollout import compute_together
from sb3_saf.networks.layers import Linear, NormalizedReLU, mlp, side_by_side
from sb3_saf.policies.base import TeamActorCriticPolicy
from sb3_saf.policies.mappo import JointCritic, MAPPOParts
from sb3_saf.registration import DECLARATIONS
from sb3_saf.teams.rows import TeamSpaces
from tests.toy_teams import PICTURE, VECTOR, CodeSpace, ToyTeams, gather_rows, team_rows, to_numpy

#: All policies declared for PPO, sorted by name.
POLICIES: list[type[TeamActorCriticPolicy]] = sorted(
    (cast(Any, policy) for one in DECLARATIONS for policy in one.policies.get(PPO, ())), key=lambda one: one.__name__
)
NAMES = [policy.__name__ for policy in POLICIES]
ACTIONS: dict[str, spaces.Space[Any]] = {
    "discrete": spaces.Discrete(3),
    "multi-discrete": spaces.MultiDiscrete([3, 2]),
    "multi-binary": spaces.MultiBinary(2),
    "box": spaces.Box(-1.0, 1.0, (2,), np.float32),
}
#: All options of a policy that change what is computed.
VARIANTS: list[tuple[type[TeamActorCriticPolicy], dict[str, Any]]] = [
    (IPPOPolicy, {}),
    (IPPOPolicy, {"heads": "per_agent"}),
    (MAPPOPolicy, {}),
    (MAPPOPolicy, {"agent_identity": False}),
    (MAPPOPolicy, {"heads": "per_agent"}),
    (SAFPolicy, {}),
    (SAFPolicy, {"heads": "per_agent"}),
    (SAFPolicy, {"critic_input": "team"}),
    (SAFPolicy, {"critic_input": "team", "heads": "per_agent"}),
    (SAFPolicy, {"selection": "gumbel"}),
    (SAFPolicy, {"n_policies": 1}),
    (SAFPolicy, {"n_policies": 1, "heads": "per_agent"}),
    (SAFPolicy, {"knowledge_source": False}),
    (IPPOPolicy, {"actor_identity": True}),
    (SAFPolicy, {"actor_identity": True}),
]
VARIANTS += [(policy, {}) for policy in POLICIES if policy not in dict(VARIANTS)]
#: Encoders are independent of the rest: every policy on vectors, one on images and on codes.
VARIANTS_AND_SPACES: list[tuple[type[TeamActorCriticPolicy], dict[str, Any], spaces.Space[Any]]] = [
    *((*variant, VECTOR) for variant in VARIANTS),
    (SAFPolicy, {}, PICTURE),
    (SAFPolicy, {}, CodeSpace()),
]
SMALL: dict[str, Any] = {"net_arch": [16], "features_extractor_kwargs": {"features_dim": 12}}
SMALL_SAF: dict[str, Any] = {"latent_dim": 8, "projection_arch": (10,)}


def constant(_: float) -> float:
    return 1e-3


def make_policy(
    policy_class: type[TeamActorCriticPolicy],
    own: spaces.Space[Any] = VECTOR,
    action_space: spaces.Space[Any] = ACTIONS["discrete"],
    seed: int = 0,
    noise: float = 0.3,
    has_starts: bool = False,
    **kwargs: Any,
) -> TeamActorCriticPolicy:
    """Create a small policy for three agents; noise on the actor's small first weights makes every part matter."""
    th.manual_seed(seed)
    sizes: dict[str, Any] = SMALL | (SMALL_SAF if policy_class.__name__.startswith("SAF") else {})
    space = TeamSpaces(own, 3, has_starts=has_starts).to_dict_space()
    policy = policy_class(space, action_space, constant, **(sizes | kwargs))
    with th.no_grad():
        for parameter in policy.actor.parameters():
            parameter.add_(noise * th.randn_like(parameter))
    return policy


def make_model(policy: str = "SAFPolicy", venv: VecEnv | None = None, seed: int = 0, **kwargs: Any) -> PPO:
    sizes = SMALL | (SMALL_SAF if policy == "SAFPolicy" else {}) | kwargs.pop("policy_kwargs", {})
    settings: dict[str, Any] = {"n_steps": 10, "batch_size": 40, "n_epochs": 2, "device": "cpu"}
    return PPO(policy, venv or ToyTeams(), seed=seed, policy_kwargs=sizes, **(settings | kwargs))


def probabilities(policy: TeamActorCriticPolicy, obs: Any) -> th.Tensor:
    distribution = policy.get_distribution(obs)
    assert isinstance(distribution, CategoricalDistribution)
    return distribution.distribution.probs


def equal_weights(one: th.nn.Module, other: th.nn.Module) -> bool:
    first, second = one.state_dict(), other.state_dict()
    return first.keys() == second.keys() and all(th.equal(first[key], second[key]) for key in first)


# --- registration -----------------------------------------------------------------------------------------------------


def test_names_are_registered_with_every_algorithm() -> None:
    for declaration in DECLARATIONS:
        for algorithm, policies in declaration.policies.items():
            aliases = algorithm.policy_aliases
            assert [aliases[policy.__name__] for policy in policies] == list(policies)
            for name in (declaration.name, declaration.name.lower(), f"{declaration.name}Policy"):
                assert aliases[name] is policies[0]
    assert issubclass(A2C.policy_aliases["MlpPolicy"], ActorCriticPolicy)


# --- the actor reads its own observation only -------------------------------------------------------------------------


@pytest.mark.parametrize(("policy_class", "kwargs", "own"), VARIANTS_AND_SPACES)
def test_no_other_agents_observation_changes_an_action_by_a_bit(
    policy_class: type[TeamActorCriticPolicy], kwargs: dict[str, Any], own: spaces.Space[Any]
) -> None:
    policy = make_policy(policy_class, own, chunk_size=4, **kwargs)
    obs = team_rows(own)
    other = team_rows(own, n_views=12, seed=1)["team"]
    all_actions = [th.full((12,), action) for action in range(3)]
    for rows in (range(12), [7]):
        one = gather_rows(obs, list(rows))
        two = one | {"team": other[list(rows)]}
        outcomes = []
        for variant in (one, two):
            th.manual_seed(3)
            log_probs = []
            for action in all_actions:
                # With "gumbel", all sample the same policy.
                th.manual_seed(3)
                log_probs.append(policy.evaluate_actions(variant, action[list(rows)])[1])
            th.manual_seed(3)
            actions, _, log_prob = policy(variant)
            outcomes.append([*log_probs, actions, log_prob])
        assert all(th.equal(a, b) for a, b in zip(*outcomes, strict=True))
        if kwargs.get("selection") != "gumbel":
            assert th.equal(probabilities(policy, one), probabilities(policy, two))
            stacked = th.stack(outcomes[0][:3], dim=1).exp()
            th.testing.assert_close(stacked, probabilities(policy, one), rtol=0, atol=1e-6)


def test_ippos_values_do_not_read_the_team() -> None:
    policy, obs = make_policy(IPPOPolicy), team_rows(VECTOR)
    del obs["team"]
    assert policy.predict_values(obs).shape == (12, 1)


# --- encoding unique observations once --------------------------------------------------------------------------------


def loss_and_gradients(
    policy: TeamActorCriticPolicy, obs: dict[str, th.Tensor]
) -> tuple[th.Tensor, dict[str, th.Tensor]]:
    th.manual_seed(5)
    actions = th.randint(3, (len(obs["obs"]),))
    values, log_prob, entropy = policy.evaluate_actions(obs, actions)
    weights = th.randn(3, len(actions))
    assert entropy is not None
    loss = (weights[0] * values[:, 0] + weights[1] * log_prob + weights[2] * entropy).mean()
    policy.zero_grad()
    loss.backward()
    gradients = {name: p.grad.clone() for name, p in policy.named_parameters() if p.grad is not None}
    return loss.detach(), gradients


@pytest.mark.parametrize(("policy_class", "kwargs", "own"), VARIANTS_AND_SPACES)
def test_naive_encoding_gives_the_same_loss_and_gradients(
    policy_class: type[TeamActorCriticPolicy], kwargs: dict[str, Any], own: spaces.Space[Any]
) -> None:
    policy = make_policy(policy_class, own, chunk_size=3, encode_once=True, **kwargs)
    naive = make_policy(policy_class, own, chunk_size=None, encode_once=False, **kwargs)
    naive.load_state_dict(policy.state_dict())
    obs = team_rows(own, n_games=10)
    for rows in (th.arange(30), th.randperm(30)[:17], th.tensor([4])):
        loss, gradients = loss_and_gradients(policy, gather_rows(obs, rows))
        expected_loss, expected = loss_and_gradients(naive, gather_rows(obs, rows))
        th.testing.assert_close(loss, expected_loss, rtol=1e-5, atol=1e-6)
        assert gradients.keys() == expected.keys()
        for name, gradient in gradients.items():
            scale = expected[name].abs().max().clamp_min(1.0)
            assert (gradient - expected[name]).abs().max() <= 1e-5 * scale, name


@pytest.mark.parametrize(("policy_class", "kwargs"), [(MAPPOPolicy, {}), (SAFPolicy, {"heads": "per_agent"})])
@pytest.mark.parametrize("encode_once", [True, False])
def test_rows_that_look_like_a_whole_team_may_be_of_another(
    policy_class: type[TeamActorCriticPolicy], kwargs: dict[str, Any], encode_once: bool
) -> None:
    """Agents are in order, and row 0's team equals rows 0 to 2; but row 1 is of another team."""
    policy, obs = make_policy(policy_class, encode_once=encode_once, **kwargs), team_rows(VECTOR, n_views=50)
    values = policy.predict_values(obs)
    obs["team"][1, 0] = obs["obs"][9]
    other = policy.predict_values(obs)
    th.testing.assert_close(other[1:2], policy.predict_values(gather_rows(obs, [1])), rtol=0, atol=1e-6)
    assert abs(other[1] - values[1]) > 1e-5


def test_each_unique_observation_is_encoded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = make_policy(SAFPolicy, chunk_size=4, encode_once=True)
    encoded: list[tuple[float, ...]] = []
    forward = policy.features_extractor.forward

    def counting(observations: th.Tensor) -> th.Tensor:
        encoded.extend(map(tuple, observations.tolist()))
        assert len(observations) <= 4
        return forward(observations)

    monkeypatch.setattr(policy.features_extractor, "forward", counting)
    obs = team_rows(VECTOR, n_games=20, n_views=9)
    policy(obs)
    assert len(encoded) == len(set(encoded)) == 9
    encoded.clear()
    policy(gather_rows(obs, [0, 1]))  # of the team's views, those that the rows have not
    assert len(encoded) == len(set(encoded)) <= 3


@pytest.mark.parametrize(("policy_class", "kwargs"), VARIANTS)
def test_rows_do_not_depend_on_their_neighbours(
    policy_class: type[TeamActorCriticPolicy], kwargs: dict[str, Any]
) -> None:
    policy, obs = make_policy(policy_class, **kwargs), team_rows(VECTOR)
    values = policy.predict_values(obs)
    assert values.shape == (12, 1)
    order = th.randperm(12)
    th.testing.assert_close(policy.predict_values(gather_rows(obs, order)), values[order], rtol=0, atol=1e-6)
    for row in range(12):
        th.testing.assert_close(policy.predict_values(gather_rows(obs, [row])), values[[row]], rtol=0, atol=1e-6)
    th.testing.assert_close(policy(obs)[1], values, rtol=0, atol=1e-6)
    th.testing.assert_close(policy.evaluate_actions(obs, th.zeros(12).long())[0], values, rtol=0, atol=1e-6)


# --- definitions of the algorithms ------------------------------------------------------------------------------------


def test_mappos_critic_reads_all_views_and_whose_value_is_asked() -> None:
    policy, obs = make_policy(MAPPOPolicy), team_rows(VECTOR)
    head = policy.value_net.value_head.heads[0]  # type: ignore[union-attr, index]
    z = policy.features_extractor(obs["team"].flatten(0, 1)).view(12, -1)
    joint = th.cat([z, th.eye(3)[obs["agent"]]], dim=1)
    th.testing.assert_close(policy.predict_values(obs), head(joint), rtol=0, atol=1e-6)  # type: ignore[operator]


@pytest.mark.parametrize("policy_class", POLICIES)
def test_per_agent_heads_are_each_agents_own(policy_class: type[TeamActorCriticPolicy]) -> None:
    policy = make_policy(policy_class, heads="per_agent")
    obs = team_rows(VECTOR)
    values, before = policy.predict_values(obs), policy.evaluate_actions(obs, th.zeros(12).long())[1]
    with th.no_grad():
        for name, parameter in policy.named_parameters():
            if "heads.1." in name:
                parameter.add_(0.5 * th.randn_like(parameter))
    after, of_agent = policy.predict_values(obs), obs["agent"] == 1
    assert th.equal(after[~of_agent], values[~of_agent])
    assert (after[of_agent] != values[of_agent]).all()
    changed = policy.evaluate_actions(obs, th.zeros(12).long())[1] != before
    # SAF's pool is shared by all agents.
    assert changed.tolist() == ([False] * 12 if policy_class is SAFPolicy else of_agent.tolist())


@pytest.mark.parametrize("heads", ["shared", "per_agent"])
def test_saf_without_pool_and_knowledge_source_is_mappo(heads: str) -> None:
    saf = make_policy(SAFPolicy, n_policies=1, knowledge_source=False, heads=heads)
    mappo = make_policy(MAPPOPolicy, heads=heads)
    mappo.load_state_dict(saf.state_dict())
    obs, actions = team_rows(VECTOR), th.zeros(12).long()
    for one, other in zip(saf.evaluate_actions(obs, actions), mappo.evaluate_actions(obs, actions), strict=True):
        assert one is not None and other is not None
        assert th.equal(one, other)


def test_ippo_and_mappo_differ_in_the_critic_only_and_start_alike() -> None:
    ippo, mappo = make_policy(IPPOPolicy, noise=0.0), make_policy(MAPPOPolicy, noise=0.0)
    assert equal_weights(ippo.actor, mappo.actor)
    assert equal_weights(ippo.features_extractor, mappo.features_extractor)
    shapes = [[p.shape for name, p in policy.named_parameters() if "value" not in name] for policy in (ippo, mappo)]
    assert shapes[0] == shapes[1]


@pytest.mark.parametrize("policy_class", POLICIES)
def test_actor_and_critic_both_train_the_encoder(policy_class: type[TeamActorCriticPolicy]) -> None:
    policy, obs = make_policy(policy_class), team_rows(VECTOR)
    values, log_prob, _ = policy.evaluate_actions(obs, th.zeros(12).long())
    for output in (values, log_prob, policy.predict_values(obs)):
        policy.zero_grad()
        output.sum().backward(retain_graph=True)
        for name, parameter in policy.features_extractor.named_parameters():
            assert parameter.grad is not None and parameter.grad.abs().max() > 0, name


@pytest.mark.parametrize(("policy_class", "kwargs"), VARIANTS)
def test_all_that_is_saved_is_trained(policy_class: type[TeamActorCriticPolicy], kwargs: dict[str, Any]) -> None:
    policy = make_policy(policy_class, CodeSpace(), **kwargs)
    trained = {name for name, p in policy.named_parameters(remove_duplicate=False) if p.requires_grad}
    assert set(policy.state_dict()) == trained


# --- spaces and arguments ---------------------------------------------------------------------------------------------


OWN_SPACES = [VECTOR, PICTURE, CodeSpace(), spaces.Discrete(6), spaces.MultiDiscrete([3, 2]), spaces.MultiBinary(3)]


@pytest.mark.parametrize("own", OWN_SPACES)
@pytest.mark.parametrize("agent_dtype", [th.int64, th.float32])
def test_rows_as_buffers_hand_them_over(own: spaces.Space[Any], agent_dtype: th.dtype) -> None:
    policy, obs = make_policy(SAFPolicy, own), team_rows(own)
    stored = obs | {"agent": obs["agent"].to(agent_dtype).unsqueeze(1)}
    if isinstance(own, spaces.Discrete):
        stored["obs"] = stored["obs"].unsqueeze(1)
    actions = th.zeros(12).long()
    for one, other in zip(policy.evaluate_actions(obs, actions), policy.evaluate_actions(stored, actions), strict=True):
        assert one is not None and other is not None
        assert th.equal(one, other)


def test_any_features_extractor_gets_the_own_space_and_what_sb3_prepares() -> None:
    own = spaces.Box(0, 255, (3, 36, 36), np.uint8)
    policy, obs = make_policy(MAPPOPolicy, own, features_extractor_class=NatureCNN), team_rows(own)
    expected = policy.features_extractor(obs["obs"].float() / 255.0)
    th.testing.assert_close(policy.extract_features(obs), expected, rtol=0, atol=1e-5)
    raw = make_policy(MAPPOPolicy, own, features_extractor_class=NatureCNN, normalize_images=False)
    raw.load_state_dict(policy.state_dict())
    th.testing.assert_close(raw.extract_features(obs), raw.features_extractor(obs["obs"].float()), rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match="encodes with its own features_extractor"):
        policy.extract_features(obs, raw.features_extractor)


@pytest.mark.parametrize(
    ("extractor", "own"),
    [(CombinedExtractor, VECTOR), (NatureCNN, CodeSpace()), (FlattenExtractor, CodeSpace()), (NatureCNN, PICTURE)],
)
def test_an_extractor_for_another_space_is_refused_with_those_that_fit(
    extractor: type[BaseFeaturesExtractor], own: spaces.Space[Any]
) -> None:
    with pytest.raises(ValueError, match=rf"{extractor.__name__} does not take it \(.+\); leave it out \(Observ"):
        make_policy(MAPPOPolicy, own, features_extractor_class=extractor, features_extractor_kwargs={})


def test_net_arch_for_actor_and_critic() -> None:
    policy = make_policy(IPPOPolicy, net_arch={"pi": [5], "vf": [6, 7]})
    sizes = [tuple(p.shape) for name, p in policy.named_parameters() if name.endswith("weight") and "head" in name]
    assert sizes == [(5, 12), (3, 5), (6, 12), (7, 6), (1, 7)]
    with pytest.raises(ValueError, match="net_arch must be a list or have the keys 'pi' and 'vf', got the keys"):
        make_policy(IPPOPolicy, net_arch={"pi": [5]})


def test_orthogonal_initialisation_and_gains() -> None:
    th.manual_seed(0)
    policy = SAFPolicy(TeamSpaces(PICTURE, 3).to_dict_space(), spaces.Discrete(4), constant)
    gains = {
        "features_extractor.encoder.net.0": 2**0.5,
        "features_extractor.encoder.net.5": 2**0.5,
        "actor.policies.2.net.0": 2**0.5,
        "actor.policies.2.net.4": 0.01,
        "actor.query_net.2": 2**0.5,
        "value_net.value_head.head.2": 2**0.5,
        "value_net.value_head.head.4": 1.0,
        "value_net.knowledge_source.read_attention.key": 1.0,
    }
    for name, gain in gains.items():
        weight = policy.get_parameter(f"{name}.weight").detach().flatten(1)
        th.testing.assert_close(th.linalg.svdvals(weight), th.full((min(weight.shape),), gain), rtol=1e-3, atol=1e-6)
    assert all(
        (layer.bias == 0).all() for layer in policy.modules() if isinstance(layer, Linear) and layer.bias is not None
    )
    plain = SAFPolicy(TeamSpaces(VECTOR, 3).to_dict_space(), spaces.Discrete(4), constant, ortho_init=False)
    assert (plain.get_parameter("actor.policies.0.net.0.bias") != 0).any()


BAD_ARGUMENTS: list[tuple[dict[str, Any], str]] = [
    ({"heads": "own"}, r"heads must be one of 'shared', 'per_agent', got 'own'"),
    ({"selection": "max"}, r"selection must be one of 'mixture', 'gumbel', got 'max'"),
    ({"critic_input": "all"}, r"critic_input must be one of 'own', 'team', got 'all'"),
    ({"n_policies": 0}, r"n_policies must be an integer of at least 1, got 0"),
    ({"n_slots": 2.5}, r"n_slots must be an integer of at least 1, got 2.5"),
    ({"knowledge_source": "no"}, r"knowledge_source must be True or False, got 'no'"),
    ({"actor_identity": 1}, r"actor_identity must be True or False, got 1"),
    ({"use_sde": True}, r"team policies have no state-dependent exploration \(gSDE\): leave use_sde=False"),
    ({"share_features_extractor": False}, r"share the features extractor .*: leave share_features_extractor=True"),
]


@pytest.mark.parametrize(("kwargs", "message"), BAD_ARGUMENTS)
def test_bad_arguments(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_policy(SAFPolicy, **kwargs)


def test_unknown_arguments_are_refused() -> None:
    with pytest.raises(TypeError, match="n_policies"):
        make_policy(MAPPOPolicy, n_policies=3)


@pytest.mark.parametrize("name", NAMES)
def test_an_unwrapped_environment_is_refused_with_what_to_do(name: str) -> None:
    with pytest.raises(ValueError, match=r"make_team_env.*CentralizedValueWrapper") as error:
        PPO(name, "CartPole-v1", device="cpu")
    assert "got Box" in str(error.value)


# --- predict ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy_class", POLICIES)
def test_predict_takes_whole_rows_and_plain_own_observations(policy_class: type[TeamActorCriticPolicy]) -> None:
    policy, obs = make_policy(policy_class, noise=1.0), to_numpy(team_rows(VECTOR, n_views=12))
    actions, _ = policy.predict(obs, deterministic=True)
    plain, _ = policy.predict(obs["obs"], deterministic=True)
    assert actions.shape == (12,)
    assert len(set(actions.tolist())) > 1
    np.testing.assert_array_equal(plain, actions)
    for row in range(12):
        single = {key: value[row] for key, value in obs.items()}
        for given in (single, obs["obs"][row], {"obs": obs["obs"][row]}):
            action, state = policy.predict(given, deterministic=True)
            assert action.shape == () and action == actions[row] and state is None


def test_predict_takes_pictures_of_either_layout() -> None:
    policy, obs = make_policy(SAFPolicy, PICTURE), to_numpy(team_rows(PICTURE, n_views=12))
    actions, _ = policy.predict(obs["obs"], deterministic=True)
    channels_last = obs["obs"].transpose(0, 2, 3, 1)
    np.testing.assert_array_equal(policy.predict(channels_last, deterministic=True)[0], actions)
    assert policy.predict(channels_last[3], deterministic=True)[0] == actions[3]


def test_a_model_of_tile_codes_takes_the_pixels_of_the_same_game() -> None:
    policy, codes = make_policy(SAFPolicy, CodeSpace(), noise=1.0), to_numpy(team_rows(CodeSpace(), n_views=12))["obs"]
    pixels = CodeSpace().atlas[codes].swapaxes(2, 3).reshape(12, 12, 12, 3)
    expected, _ = policy.predict(codes, deterministic=True)
    assert len(set(expected.tolist())) > 1
    np.testing.assert_array_equal(policy.predict(pixels, deterministic=True)[0], expected)
    assert policy.predict(pixels[5], deterministic=True)[0] == expected[5]
    assert policy.predict({"a": pixels[5], "b": pixels[6]}, deterministic=True)[0] == {
        "a": expected[5],
        "b": expected[6],
    }
    with pytest.raises(ValueError, match="tile in row 0, column 0 is none of the 20 tiles"):
        policy.predict(pixels ^ 1)


def test_predict_needs_the_agent_with_heads_per_agent() -> None:
    policy, obs = make_policy(MAPPOPolicy, heads="per_agent"), to_numpy(team_rows(VECTOR))
    with pytest.raises(ValueError, match=r"expected the observation to have 'agent', which .* reads, got 'obs'"):
        policy.predict(obs["obs"])
    expected, _ = policy.predict(obs, deterministic=True)
    own = {key: obs[key] for key in ("obs", "agent")}
    np.testing.assert_array_equal(policy.predict(own, deterministic=True)[0], expected)
    action, _ = policy.predict({"obs": obs["obs"][2], "agent": 2}, deterministic=True)
    assert action == expected[2]


def test_malformed_observations_are_refused() -> None:
    policy, obs = make_policy(MAPPOPolicy), to_numpy(team_rows(VECTOR))
    by_agent = make_policy(MAPPOPolicy, heads="per_agent")
    with pytest.raises(ValueError, match=r"expected observations with the keys 'obs', 'team', 'agent', got 'other'"):
        policy.predict(obs | {"other": obs["obs"]})
    with pytest.raises(ValueError, match=r"'agent' must be in 0..2, got"):
        by_agent.predict(obs | {"agent": obs["agent"] + 1})
    with pytest.raises(ValueError, match=r"as many rows under each key of an observation, got 'obs' 12, 'agent' 1"):
        by_agent.predict({"obs": obs["obs"], "agent": np.array(1)})
    with pytest.raises(ValueError, match=r"'obs' must be finite, got nan"):
        policy.predict(obs["obs"] * np.float32(np.nan))
    with pytest.raises(ValueError, match=r"'obs' must be tile codes in 0..19, got 255"):
        make_policy(SAFPolicy, CodeSpace()).predict(np.full((3, 3), 255, dtype=np.uint8))
    with pytest.raises(ValueError, match=r"Unexpected observation shape"):
        policy.predict(obs["obs"][:, :3])
    with pytest.raises(ValueError, match=r"to have 'team', which the critic reads, got 'obs'"):
        policy.predict_values({"obs": th.tensor(obs["obs"])})
    with pytest.raises(ValueError, match=r"to have 'team', which the critic reads, got an array"):
        policy.predict_values(th.tensor(obs["obs"]))
    with pytest.raises(ValueError, match=r"to have 'obs', which the actor reads, got nothing"):
        policy.predict({"team": obs["team"]})


# --- in PPO -----------------------------------------------------------------------------------------------------------


def first_ratios(batch_size: int, **kwargs: Any) -> th.Tensor:
    """Return PPO's probability ratios in a first epoch, whose weights are those of the rollout."""
    model = make_model(batch_size=batch_size, n_epochs=1, learning_rate=0.0, **kwargs)
    model.learn(240)
    is_discrete, ratios = isinstance(model.action_space, spaces.Discrete), []
    for samples in model.rollout_buffer.get(batch_size):
        actions = samples.actions.long().flatten() if is_discrete else samples.actions
        ratios.append((model.policy.evaluate_actions(samples.observations, actions)[1] - samples.old_log_prob).exp())
    return th.cat(ratios).detach()


@pytest.mark.parametrize("action_space", ACTIONS.values(), ids=list(ACTIONS))
def test_the_ratio_is_one_before_the_weights_change(action_space: spaces.Space[Any]) -> None:
    ratios = first_ratios(24, venv=ToyTeams(action_space=action_space))
    assert len(ratios) == 120
    assert (ratios - 1).abs().max() < 1e-6


def test_rounded_actions_have_other_likelihoods() -> None:
    """SB3's buffer stores actions as the space has them; ours as they were drawn."""
    space = spaces.Box(-5, 5, (2,), np.int32)
    with pytest.raises(
        ValueError, match=r"rounds drawn actions to int32.*rollout_buffer_class=sb3_saf\.TeamRolloutBuffer"
    ):
        make_model(venv=ToyTeams(action_space=space))
    ratios = first_ratios(24, venv=ToyTeams(action_space=space), rollout_buffer_class=TeamRolloutBuffer)
    assert (ratios - 1).abs().max() < 1e-6


def test_values_of_observations_that_were_normalised_above_the_teams() -> None:
    """Rollout and minibatches read the same entries, whether whole teams or shuffled rows of SB3's buffer."""
    env = VecNormalize(ToyTeams(spaces.Box(3.0, 9.0, (5,))), norm_obs_keys=["obs", "team"], norm_reward=False)
    model = make_model("MAPPOPolicy", env, learning_rate=0.0)
    model.learn(120)
    for samples in model.rollout_buffer.get(24):
        values = model.policy.predict_values(samples.observations)
        th.testing.assert_close(values.flatten(), samples.old_values, rtol=0, atol=1e-5)
    rows = {key: value[[0, 4, 8]] for key, value in team_rows(VECTOR).items()}  # of three games, in the agents' order
    for encode_once in (True, False):
        policy = make_policy(MAPPOPolicy, encode_once=encode_once)
        policy.set_training_mode(False)
        with th.no_grad():
            steps = [policy(part)[1] for part in (rows, team_rows(VECTOR, n_games=1), rows)]
            known = [policy.predict_values(part) for part in (rows, team_rows(VECTOR, n_games=1), rows)]
            for found, value in zip(compute_together(steps), known, strict=True):
                th.testing.assert_close(found, value)


def test_with_gumbel_it_is_not() -> None:
    # Newly sampled policies are compared with those that acted. (They are initially equal, so make them differ.)
    ratios = first_ratios(120, policy_kwargs={"selection": "gumbel", "ortho_init": False})
    assert (ratios - 1).abs().max() > 1e-2


@pytest.mark.parametrize(
    ("name", "kwargs", "action"),
    [
        *((name, {}, "discrete") for name in NAMES),
        *((name, {}, "box") for name in NAMES),
        ("SAFPolicy", {"selection": "gumbel"}, "discrete"),
        ("SAFPolicy", {"selection": "gumbel"}, "box"),
        ("SAFPolicy", {}, "multi-discrete"),
        ("MAPPOPolicy", {}, "multi-binary"),
    ],
)
def test_ppo_learns_and_no_weight_is_dead(name: str, kwargs: dict[str, Any], action: str) -> None:
    venv = ToyTeams(action_space=ACTIONS[action])
    model = make_model(name, venv, policy_kwargs=kwargs, batch_size=120, n_epochs=1)
    before = copy.deepcopy(model.policy)
    model.learn(120)
    assert model.num_timesteps == 120
    assert not equal_weights(before, model.policy)
    for parameter_name, parameter in model.policy.named_parameters():
        assert parameter.isfinite().all()
        assert parameter.grad is not None, parameter_name
        assert parameter.grad.flatten(1 if parameter.dim() > 1 else 0).abs().sum(dim=-1).min() > 0, parameter_name


@pytest.mark.parametrize(
    ("name", "kwargs", "own", "action"),
    [
        ("IPPOPolicy", {"actor_identity": True}, VECTOR, "discrete"),
        ("MAPPOPolicy", {}, CodeSpace(), "box"),
        ("SAFPolicy", {}, VECTOR, "discrete"),
        ("SAFPolicy", {"critic_input": "team", "heads": "per_agent"}, CodeSpace(), "box"),
    ],
)
def test_an_update_is_the_same_with_both_buffers_and_encodings(
    name: str, kwargs: dict[str, Any], own: spaces.Space[Any], action: str
) -> None:
    """Loss and gradients of one step, with SB3's buffer and ours, encoding equal views once or not."""
    models, gradients = [], []
    for buffer_class, encode_once in product((None, TeamRolloutBuffer), (True, False)):
        parts = kwargs | {"encode_once": encode_once, "chunk_size": 7 if encode_once else None}
        settings: dict[str, Any] = {"ent_coef": 0.01, "clip_range_vf": 0.2, "max_grad_norm": 1e6}  # no clipping
        settings |= {"batch_size": 120, "n_epochs": 1, "rollout_buffer_class": buffer_class, "policy_kwargs": parts}
        model = make_model(name, ToyTeams(own, ACTIONS[action]), **settings)
        models.append(model.learn(120, log_interval=None))  # type: ignore[arg-type]  # None keeps what was logged
        gradients.append({key: p.grad for key, p in model.policy.named_parameters() if p.grad is not None})
    reference, expected = models[0], gradients[0]
    assert type(reference.rollout_buffer) is DictRolloutBuffer
    assert expected.keys() == dict(reference.policy.named_parameters()).keys()
    for model, found in zip(models[1:], gradients[1:], strict=True):
        # The same rollout: rewards depend on views and actions. (SB3's buffer reorders the other arrays.)
        rewards, same = model.rollout_buffer.rewards, reference.rollout_buffer.rewards
        np.testing.assert_allclose(rewards, same, rtol=1e-5, atol=5e-6)  # bootstrapped values in float32
        for tag in ("train/loss", "train/value_loss", "train/policy_gradient_loss", "train/entropy_loss"):
            logged, right = (m.logger.name_to_value[tag] for m in (model, reference))
            assert logged == pytest.approx(right, rel=1e-5, abs=1e-6), tag
        for key, gradient in found.items():
            scale = expected[key].abs().max().clamp_min(1.0)
            assert (gradient - expected[key]).abs().max() <= 1e-5 * scale, key


# --- saving -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("policy_class", "kwargs"), VARIANTS)
def test_policy_saves_and_loads(
    policy_class: type[TeamActorCriticPolicy], kwargs: dict[str, Any], tmp_path: Path
) -> None:
    policy = make_policy(policy_class, CodeSpace(), encode_once=False, chunk_size=5, **kwargs)
    policy.save(str(tmp_path / "policy"))
    loaded = policy_class.load(str(tmp_path / "policy"), device="cpu")
    assert equal_weights(policy, loaded)
    assert (loaded.parts, loaded.encode_once, loaded.chunk_size) == (policy.parts, False, 5)
    obs = team_rows(CodeSpace())
    assert th.equal(loaded.predict_values(obs), policy.predict_values(obs))


def test_parts_can_be_replaced() -> None:
    class DoubledCritic(JointCritic):
        def values(self, states: th.Tensor) -> th.Tensor:
            return 2.0 * super().values(states)

    class DoubledParts(MAPPOParts):
        def critic(self, spec: Any) -> DoubledCritic:
            return DoubledCritic(spec, self)

    class DoubledPolicy(MAPPOPolicy):
        parts_class = DoubledParts

        def __init__(self, observation_space: Any, action_space: Any, lr_schedule: Schedule, **kwargs: Any):
            super().__init__(observation_space, action_space, lr_schedule, **kwargs)

    doubled, plain = make_policy(DoubledPolicy), make_policy(MAPPOPolicy)
    obs = team_rows(VECTOR)
    assert th.equal(doubled.predict_values(obs), 2.0 * plain.predict_values(obs))


@pytest.mark.parametrize("activation", [nn.PReLU, NormalizedReLU, nn.Tanh])
def test_nets_side_by_side_have_activations_of_their_own(activation: type[nn.Module]) -> None:
    nets = [mlp((5, 7, 7, 3), activation) for _ in range(4)]
    with th.no_grad():
        for number, net in enumerate(nets):
            for parameter in net.parameters():
                parameter.add_(0.1 * number)
        x = th.randn(6, 5)
        th.testing.assert_close(side_by_side([nets[:3], nets[3:]], x)[0][1], nets[1](x))
