"""The same critics and pool in sb3-contrib's TRPO and MaskablePPO."""

from __future__ import annotations

import copy
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TRPO, MaskablePPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

import sb3_saf
from sb3_saf.networks.actor import PolicyPool
from sb3_saf.networks.distributions import distribution_of, masked_parameters, mixture_of
from sb3_saf.policies.base import TeamMaskablePolicy
from sb3_saf.registration import DECLARATIONS
from tests import test_policies
from tests.contrib_teams import MaskedTeams, choices_of, is_allowed, random_masks
from tests.test_policies import ACTIONS, SMALL, SMALL_SAF, VARIANTS
from tests.toy_teams import VECTOR, ToyTeams, team_rows

#: All algorithms declared for MaskablePPO.
FAMILIES = sorted(one.name for one in DECLARATIONS if MaskablePPO in one.policies)
MASKABLE = [name for name in ACTIONS if name != "box"]
ALGORITHMS: dict[str, type[OnPolicyAlgorithm]] = {"": TRPO, "Maskable": MaskablePPO}
NAMES = [f"{family}{kind}Policy" for kind in ALGORITHMS for family in FAMILIES]
#: Policy classes by name; `sb3_saf` need not export all algorithms.
CLASSES: dict[str, Any] = {
    policy.__name__: policy for one in DECLARATIONS for policies in one.policies.values() for policy in policies
}


def kind_of(name: str) -> str:
    return next(kind for kind in ("Maskable", "") if name.endswith(f"{kind}Policy"))


def sizes_of(name: str) -> dict[str, Any]:
    """Arguments of a small policy."""
    return SMALL | (SMALL_SAF if name.startswith("SAF") else {})


def make_policy(
    name: str, action_space: spaces.Space[Any] = ACTIONS["discrete"], noise: float = 0.3, **kwargs: Any
) -> Any:
    """Create a small policy for three agents, by its name, for rows that tell where episodes begin."""
    return test_policies.make_policy(CLASSES[name], VECTOR, action_space, noise=noise, has_starts=True, **kwargs)


def make_venv(name: str, action: str = "discrete") -> ToyTeams:
    return MaskedTeams(ACTIONS[action]) if "Maskable" in name else ToyTeams(action_space=ACTIONS[action])


def make_model(name: str, venv: ToyTeams | None = None, seed: int = 0, **kwargs: Any) -> Any:
    """Create an algorithm on 4 games of 3 agents; a rollout has 8 steps (96 rows), an episode 5."""
    settings: dict[str, Any] = {"n_steps": 8, "batch_size": 32, "device": "cpu", "seed": seed}
    settings |= {} if kind_of(name) == "" else {"n_epochs": 2}
    policy_kwargs = sizes_of(name) | kwargs.pop("policy_kwargs", {})
    venv = make_venv(name) if venv is None else venv
    return ALGORITHMS[kind_of(name)](name, venv, policy_kwargs=policy_kwargs, **(settings | kwargs))


def unchanged(before: th.nn.Module, after: th.nn.Module) -> set[str]:
    """Names of parameters with an output whose weights did not change."""
    old, new = dict(before.named_parameters()), dict(after.named_parameters())
    return {
        name
        for name in new
        if not (new[name] - old[name]).flatten(1 if new[name].dim() > 1 else 0).abs().sum(dim=-1).min() > 0
    }


# --- both algorithms ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "action"),
    [
        *((name, "discrete") for name in NAMES),
        *(("SAFPolicy", action) for action in list(ACTIONS)[1:]),
        *(("SAFMaskablePolicy", action) for action in MASKABLE[1:]),
    ],
)
def test_every_weight_is_trained(name: str, action: str) -> None:
    model = make_model(name, make_venv(name, action))
    before = copy.deepcopy(model.policy)
    model.learn(96)
    assert unchanged(before, model.policy) == set()
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


# --- TRPO -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["IPPOPolicy", "MAPPOPolicy", "SAFPolicy"])
def test_trpos_policy_step_moves_actor_and_encoder_and_its_value_step_the_critic(name: str) -> None:
    # The policy step does not use the learning rate; without line search there is no policy step.
    for settings, critic_moves in (({"learning_rate": 0.0}, False), ({"line_search_max_iter": 0}, True)):
        model = make_model(name, **settings)
        before = copy.deepcopy(model.policy)
        model.learn(96)
        expected = {n for n, _ in model.policy.named_parameters() if ("value" in n) != critic_moves}
        assert unchanged(before, model.policy) == expected


def test_trpo_refuses_policies_that_are_drawn_anew() -> None:
    for action in ("discrete", "multi-discrete"):
        venv = ToyTeams(action_space=ACTIONS[action])
        with pytest.raises(ValueError, match=r"TRPO's KL divergence\) says nothing; use selection='mixture'"):
            make_model("SAFPolicy", venv, policy_kwargs={"selection": "gumbel"}).learn(96)


def random_mixtures(space: spaces.Space[Any], n_parameters: int) -> list[tuple[th.Tensor, th.Tensor]]:
    return [(th.randn(7, 4).log_softmax(dim=1), th.randn(7, 4, n_parameters)) for _ in range(2)]


@pytest.mark.parametrize("action", ["multi-discrete", "multi-binary"])
def test_the_pools_divergence_bounds_that_of_its_actions(action: str) -> None:
    space = ACTIONS[action]
    first, second = random_mixtures(space, 5 if action == "multi-discrete" else 2)
    one, other = (mixture_of(space, *mixture).distribution for mixture in (first, second))
    assert isinstance(one, th.distributions.Distribution) and isinstance(other, th.distributions.Distribution)
    found = th.distributions.kl_divergence(one, other)
    joint_actions = [th.tensor([action] * 7) for action in product(*map(range, choices_of(space)))]

    def log_probs(mixture: tuple[th.Tensor, th.Tensor], of_each_policy: bool) -> th.Tensor:
        log_weights, parameters = mixture
        by_policy = th.stack(
            [
                th.stack([distribution_of(space, parameters[:, u]).log_prob(a.float()) for a in joint_actions], dim=1)
                for u in range(4)
            ],
            dim=1,
        )
        both = (log_weights.unsqueeze(2) + by_policy).flatten(1)
        return both if of_each_policy else both.view(7, 4, -1).logsumexp(dim=1)

    exact = {}
    for of_each_policy in (True, False):
        p, q = (log_probs(mixture, of_each_policy) for mixture in (first, second))
        exact[of_each_policy] = (p.exp() * (p - q)).sum(dim=1)
    th.testing.assert_close(found, exact[True])
    assert (found > exact[False]).all()
    th.testing.assert_close(th.distributions.kl_divergence(one, one), th.zeros(7))


def test_the_pools_divergence_for_continuous_actions() -> None:
    first, second = random_mixtures(ACTIONS["box"], 4)
    one, other = (mixture_of(ACTIONS["box"], *mixture).distribution for mixture in (first, second))
    assert isinstance(one, th.distributions.Distribution) and isinstance(other, th.distributions.Distribution)
    (w, a), (v, b) = first, second
    mean, std, other_mean, other_std = a[..., :2], a[..., 2:].exp(), b[..., :2], b[..., 2:].exp()
    normals = (other_std / std).log() + (std**2 + (mean - other_mean) ** 2) / (2 * other_std**2) - 0.5
    expected = (w.exp() * (w - v + normals.sum(dim=2))).sum(dim=1)
    th.testing.assert_close(th.distributions.kl_divergence(one, other), expected)


# --- MaskablePPO ------------------------------------------------------------------------------------------------------


def enumerated(policy: TeamMaskablePolicy, obs: dict[str, th.Tensor], masks: np.ndarray) -> tuple[th.Tensor, th.Tensor]:
    """Enumerate all joint actions (J, D), and their exact probabilities for each row (B, J), by definition."""
    pool, choices = policy.actor, choices_of(policy.action_space)
    assert isinstance(pool, PolicyPool)
    log_weights, parameters = pool.evaluate(policy.features_extractor(obs["obs"]))
    if isinstance(policy.action_space, spaces.MultiBinary):
        parameters = th.stack([th.zeros_like(parameters), parameters], dim=3).flatten(2)  # logits of off and on
    weights = parameters.exp() * th.tensor(masks).unsqueeze(1)
    factors = [part / part.sum(dim=2, keepdim=True) for part in th.split(weights, choices, dim=2)]
    joint = list(product(*map(range, choices)))
    by_action = [
        sum(
            log_weights[:, u].exp() * th.stack([f[:, u, a] for f, a in zip(factors, action, strict=True)]).prod(dim=0)
            for u in range(pool.n_policies)
        )
        for action in joint
    ]
    return th.tensor(joint), th.stack(by_action, dim=1)  # type: ignore[arg-type]


@pytest.mark.parametrize("action", MASKABLE)
def test_masked_mixture_against_enumeration(action: str) -> None:
    space = ACTIONS[action]
    policy, obs = make_policy("SAFMaskablePolicy", space), team_rows(VECTOR, n_views=12)
    masks = random_masks(space, 12, np.random.default_rng(0))
    joint, expected = enumerated(policy, obs, masks)
    th.testing.assert_close(expected.sum(dim=1), th.ones(12))
    shape = (12, *(space.shape or ()))
    for action_index, joint_action in enumerate(joint):
        actions = joint_action.expand(12, -1).reshape(shape).float()
        _, log_prob, entropy = policy.evaluate_actions(obs, actions, masks)
        th.testing.assert_close(log_prob.exp(), expected[:, action_index], rtol=1e-5, atol=1e-7)
        forbidden = ~is_allowed(space, actions.numpy(), masks)
        assert (log_prob.exp()[forbidden] == 0).all()
    th.testing.assert_close(entropy, -th.special.xlogy(expected, expected).sum(dim=1), rtol=1e-5, atol=1e-6)
    modes, values, log_prob = policy(obs, deterministic=True, action_masks=masks)
    assert th.equal(modes.reshape(12, -1).long(), joint[expected.argmax(dim=1)])
    th.testing.assert_close(log_prob.exp(), expected.max(dim=1).values, rtol=1e-5, atol=1e-7)
    th.testing.assert_close(values, policy.predict_values(obs))


@pytest.mark.parametrize("action", MASKABLE)
def test_training_keeps_to_the_masks_and_sees_the_likelihoods_of_the_rollout(action: str) -> None:
    venv = MaskedTeams(ACTIONS[action])
    model = make_model("SAFMaskablePolicy", venv, n_epochs=1, learning_rate=0.0, policy_kwargs={"ortho_init": False})
    model.learn(192)
    assert (venv.n_actions, venv.n_forbidden) == (192, 0)
    for batch in model.rollout_buffer.get(24):
        actions = batch.actions.long().flatten() if action == "discrete" else batch.actions
        _, log_prob, _ = model.policy.evaluate_actions(batch.observations, actions, batch.action_masks)
        assert ((log_prob - batch.old_log_prob).exp() - 1).abs().max() < 1e-5


def test_masks_that_allow_nothing_teach_nothing() -> None:
    for space in (ACTIONS[name] for name in MASKABLE):
        policy, obs = make_policy("SAFMaskablePolicy", space), team_rows(VECTOR)
        n_choices, n_joint = sum(choices_of(space)), np.prod(choices_of(space))
        nothing = np.zeros((12, n_choices), dtype=bool)
        actions, _, log_prob = policy(obs, action_masks=nothing)
        th.testing.assert_close(log_prob, th.full((12,), -float(np.log(n_joint))))
        policy.evaluate_actions(obs, actions, nothing)[1].sum().backward()
        assert all(p.grad is None or p.grad.abs().max() < 1e-6 for p in policy.actor.parameters())


@pytest.mark.parametrize(("policy_class", "kwargs"), VARIANTS)
def test_masked_actions_depend_on_own_observation_and_own_mask_only(policy_class: Any, kwargs: dict[str, Any]) -> None:
    name = policy_class.__name__.replace("Policy", "MaskablePolicy")
    policy, obs = make_policy(name, **kwargs), team_rows(VECTOR)
    others = obs | {"team": team_rows(VECTOR, n_views=12, seed=1)["team"]}
    masks = random_masks(ACTIONS["discrete"], 12, np.random.default_rng(0))
    other_masks = random_masks(ACTIONS["discrete"], 12, np.random.default_rng(1))
    other_masks[7] = masks[7]
    outcomes = []
    for rows, given in ((obs, masks), (others, masks), (obs, other_masks)):
        th.manual_seed(3)
        actions, _, acted = policy(rows, action_masks=given)
        th.manual_seed(3)
        log_prob = policy.evaluate_actions(rows, actions, given)[1]
        outcomes.append((actions, log_prob, acted))
    assert all(th.equal(one, other) for one, other in zip(outcomes[0], outcomes[1], strict=True))
    th.manual_seed(3)
    kept = policy.evaluate_actions(obs, outcomes[0][0], other_masks)[1]
    assert th.equal(kept[7], outcomes[0][1][7])
    assert not th.equal(kept, outcomes[0][1])


def test_malformed_masks_are_refused() -> None:
    policy, obs = make_policy("SAFMaskablePolicy", ACTIONS["multi-binary"]), team_rows(VECTOR)
    with pytest.raises(ValueError, match=r"action masks of shape \(12, 4\), one flag for each choice .*got \(12, 3\)"):
        policy(obs, action_masks=np.ones((12, 3)))
    with pytest.raises(ValueError, match=r"continuous actions cannot be masked"):
        masked_parameters(ACTIONS["box"], th.zeros(1, 4), th.ones(1, 2, dtype=th.bool))


def test_value_normalisation_is_refused_where_no_buffer_can_update_it() -> None:
    env = sb3_saf.make_team_env("TeamTogether", n_envs=2, n_agents=3, grid_size=8, n_treasures=5)
    with pytest.raises(ValueError, match="normalize_values"):
        MaskablePPO("SAFMaskablePolicy", env, policy_kwargs={"normalize_values": True})
