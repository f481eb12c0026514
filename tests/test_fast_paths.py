"""What is computed fast equals what is computed plainly, with its gradients."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from sb3_saf import QPLEX, LightEncoder, PaperCNN, TeamRolloutBuffer, make_team_env, make_vec_env
from sb3_saf.buffers.rollout import LaterValues, compute_together
from sb3_saf.networks import row_encoder
from sb3_saf.networks.distributions import LeanCategorical
from sb3_saf.networks.encoders import PixelInput
from sb3_saf.networks.knowledge_source import Attention
from sb3_saf.networks.layers import mlp
from sb3_saf.networks.row_encoder import RowEncoder, UniqueRows, unique_rows
from sb3_saf.networks.tanh import Tanh
from sb3_saf.networks.tile_sums import Places, places_of_convolution, places_of_linear, rectified_sums, used_codes
from sb3_saf.teams.checks import NonFiniteError
from tests.toy_envs import late_env
from tests.toy_teams import CodeSpace, ToyTeams

# --- layers -----------------------------------------------------------------------------------------------------------


def gradients(function: Callable[..., th.Tensor], *inputs: th.Tensor) -> list[th.Tensor]:
    """Return the output, and the gradients of a nonlinear function of it."""
    leaves = [one.clone().requires_grad_() for one in inputs]
    output = function(*leaves)
    return [output.detach(), *th.autograd.grad(output.sin().sum(), leaves)]


def test_the_tanh_is_the_tanh() -> None:
    x = th.linspace(-12, 12, 100_001)
    assert (Tanh()(x).double() - x.double().tanh()).abs().max() < 4e-7
    assert Tanh()(th.tensor([th.inf, -th.inf, 0.0])).tolist() == [1.0, -1.0, 0.0]
    assert Tanh()(th.tensor([th.nan])).isnan()
    of_columns = th.randn(7, 5).t()
    for found, expected in zip(gradients(Tanh(), of_columns), gradients(th.tanh, of_columns), strict=True):
        th.testing.assert_close(found, expected, rtol=0, atol=2e-6)
    assert [type(mlp([2, 3, 1], activation)[1]) for activation in (nn.Tanh, nn.ReLU)] == [Tanh, nn.ReLU]


def test_the_tanh_can_be_differentiated_twice() -> None:
    x = th.randn(5, requires_grad=True)
    (first,) = th.autograd.grad(Tanh()(x).sum(), x, create_graph=True)
    (second,) = th.autograd.grad(first.sum(), x)
    y = x.tanh()
    th.testing.assert_close(second, -2 * y * (1 - y**2), rtol=0, atol=2e-6)


@pytest.mark.parametrize("queries", [th.randn(9, 5, 16), th.randn(3, 16)], ids=["of each group", "the same for all"])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("of_weights", [False, True])
def test_compiled_attention_is_attention(queries: th.Tensor, masked: bool, of_weights: bool) -> None:
    sources = th.randn(9, 4, 16)
    active = th.rand(9, 4) > 0.4 if masked else None
    if active is not None:
        active[2] = False

    single = Attention(16)
    nn.init.zeros_(single.out.bias)

    def attend(queries: th.Tensor, sources: th.Tensor) -> th.Tensor:
        module = single if queries.dtype == th.float32 else copy.deepcopy(single).double()  # double is not compiled
        values, weights = module(queries, sources, active)
        return weights if of_weights else values

    found, expected = gradients(attend, queries, sources), gradients(attend, queries.double(), sources.double())
    for one, other in zip(found, expected, strict=True):
        th.testing.assert_close(one.double(), other, rtol=1e-4, atol=1e-5)
    if active is not None:
        assert not found[0][2].any()


def test_nan_probabilities_are_refused() -> None:
    logits = th.zeros(7, 5)
    logits[3, 2] = th.nan
    with pytest.raises(NonFiniteError, match=r"probabilities of actions are NaN.*lower the learning rate"):
        LeanCategorical(5).proba_distribution(logits).sample()


# --- gathered rows, on several threads --------------------------------------------------------------------------------


@pytest.fixture
def two_threads() -> Iterator[None]:
    """Set torch to two threads for one test."""
    before = th.get_num_threads()
    th.set_num_threads(2)
    yield
    th.set_num_threads(before)


def _trained(algorithm: type[Any], policy: str, memory: str | None = None, **kwargs: Any) -> th.Tensor:
    env = make_team_env("TeamSupport", n_envs=16, seed=0, n_agents=5, grid_size=12, n_treasures=20)
    policy_kwargs: dict[str, Any] = {"features_extractor_class": LightEncoder}
    policy_kwargs |= {} if memory is None else {"memory": memory}
    model = algorithm(policy, env, seed=0, policy_kwargs=policy_kwargs, device="cpu", **kwargs)
    parameters = list(model.policy.parameters())
    before = th.nn.utils.parameters_to_vector(parameters).detach().clone()
    model.learn(2_000)
    after = th.nn.utils.parameters_to_vector(parameters).detach()
    assert not th.equal(before, after)
    return after


_PPO = {"n_steps": 25, "batch_size": 2_000, "n_epochs": 1, "rollout_buffer_class": TeamRolloutBuffer}
_QPLEX: dict[str, Any] = {"batch_size": 128, "learning_starts": 350}


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize(
    ("algorithm", "policy", "kwargs"),
    [
        (PPO, "SAFPolicy", _PPO | {"memory": "gru"}),
        (QPLEX, "QPLEXPolicy", _QPLEX),
    ],
)
def test_a_training_repeats_on_two_threads(algorithm: type[Any], policy: str, kwargs: dict[str, Any]) -> None:
    assert th.equal(_trained(algorithm, policy, **kwargs), _trained(algorithm, policy, **kwargs))


# --- first layers by tile lookup --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "places",
    [places_of_linear(6), places_of_convolution(2, 3, tile=4, kernel=4, stride=2)],
    ids=["linear", "convolution"],
)
def test_gradients_of_first_and_second_order(places: Places) -> None:
    _, views = used_codes(th.randint(11, (3, 6)))
    table = th.randn(int(views.max()) + 1, int(places.way.max()) + 1, 2, dtype=th.float64, requires_grad=True)
    bias = th.randn(2, dtype=th.float64, requires_grad=True)

    def square(table: th.Tensor, bias: th.Tensor) -> th.Tensor:
        """Square the output, because a linear function has no second derivative."""
        return rectified_sums(views, table, bias, places) ** 2

    assert (square(table, bias) == 0).any()
    assert th.autograd.gradcheck(square, (table, bias))
    assert th.autograd.gradgradcheck(square, (table, bias))


@pytest.mark.parametrize("encoder_class", [LightEncoder, PaperCNN])
@pytest.mark.parametrize("params", [{}, {"view_size": 5}, {"view_tile_size": 8}, {"view_tile_size": 5}], ids=str)
def test_encoders_by_looking_up_and_by_pixels(
    encoder_class: type[LightEncoder | PaperCNN], params: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    space = make_vec_env("KeyForTreasure", 1, seed=0, observation="tiles", **params).observation_space
    assert isinstance(space, spaces.Box)
    space.seed(1)
    codes = th.tensor(np.stack([space.sample() for _ in range(20)]))
    encoder = encoder_class(space)
    results = []
    for looks_up in (True, False):
        monkeypatch.setattr(PixelInput, "looks_up", lambda pixels, observations, answer=looks_up: answer)
        encoder.zero_grad()
        features = encoder(codes)
        features.square().sum().backward()
        results.append([features.detach(), *(weight.grad for weight in encoder.parameters())])
    for found, expected in zip(*results, strict=True):
        th.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


# --- unique rows ------------------------------------------------------------------------------------------------------


def reference(x: th.Tensor) -> tuple[list[int], list[int]]:
    """Find unique rows with a dict of their bytes."""
    seen: dict[bytes, int] = {}
    index: list[int] = []
    inverse: list[int] = []
    for row, value in enumerate(x):
        key = value.contiguous().view(-1).view(th.uint8).numpy().tobytes()
        if key not in seen:
            seen[key] = len(index)
            index.append(row)
        inverse.append(seen[key])
    return index, inverse


def assert_matches_reference(x: th.Tensor, found: UniqueRows) -> None:
    index, inverse = reference(x)
    assert found.index.tolist() == index
    assert found.inverse.tolist() == inverse
    assert found.index.dtype == found.inverse.dtype == th.int64


DTYPES = [th.uint8, th.int64, th.float32, th.float64, th.bool, th.bfloat16]


@given(
    n_rows=st.integers(1, 60),
    shape=st.sampled_from([(), (1,), (3,), (7, 7), (2, 4), (33,)]),
    dtype=st.sampled_from(DTYPES),
    n_values=st.integers(1, 30),
    seed=st.integers(0, 2**31),
)
def test_agrees_with_a_dict_of_bytes(
    n_rows: int, shape: tuple[int, ...], dtype: th.dtype, n_values: int, seed: int
) -> None:
    generator = th.Generator().manual_seed(seed)
    pool = th.randint(0, 100, (n_values, *shape), generator=generator).to(dtype)
    x = pool[th.randint(n_values, (n_rows,), generator=generator)]
    assert_matches_reference(x, unique_rows(x))


def test_edges() -> None:
    assert [part.tolist() for part in unique_rows(th.zeros(0, 3))] == [[], []]
    assert [part.tolist() for part in unique_rows(th.zeros(2, 0))] == [[0], [0, 0]]
    assert unique_rows(th.tensor([[0.0], [-0.0], [0.0]])).inverse.tolist() == [0, 1, 0]
    assert unique_rows(th.tensor([[float("nan")], [float("nan")]])).inverse.tolist() == [0, 0]
    transposed = th.arange(12).view(3, 4).t() // 6
    assert_matches_reference(transposed, unique_rows(transposed))
    unaligned = th.randint(0, 2, (67,), dtype=th.uint8)[3:].view(8, 8)
    assert_matches_reference(unaligned, unique_rows(unaligned))


def test_exact_although_every_hash_collides(monkeypatch: pytest.MonkeyPatch) -> None:
    x = th.randint(0, 4, (60, 2))
    monkeypatch.setattr(row_encoder, "_hash_row", lambda words, row: np.uint64(7))
    monkeypatch.setattr(row_encoder, "_find_unique", row_encoder._find_unique.py_func)
    assert_matches_reference(x, unique_rows(x))


@pytest.mark.parametrize(("once", "device"), [(False, "cpu"), (True, "meta")])
def test_without_a_search_every_row_is_encoded(once: bool, device: str) -> None:
    seen: list[th.Tensor] = []

    def encode(observations: th.Tensor) -> th.Tensor:
        seen.append(observations)
        return observations.flatten(1)

    x = th.zeros(3, 2, device=device)
    encoder = RowEncoder(encode, once)
    assert encoder.rows(x).of_rows().shape == (3, 2) and seen[0] is x
    assert [len(part) for part in encoder.find(x)] == [3, 3]


# --- values computed at the end of a rollout --------------------------------------------------------------------------


class Eager(BaseCallback):
    """Computes the values at every step."""

    def __init__(self) -> None:
        super().__init__()
        self.values: list[np.ndarray] = []
        self.kinds: set[type] = set()

    def _on_step(self) -> bool:
        with th.no_grad():
            policy: Any = self.model.policy
            self.values.append(policy.predict_values(self.locals["obs_tensor"]).numpy()[:, 0])
        self.kinds.add(type(self.locals["values"]))
        return True


def joining() -> Any:
    return make_team_env(late_env, n_envs=2, seed=0)


@pytest.mark.parametrize(
    ("policy", "make", "normalize_values"),
    [
        ("IPPOPolicy", joining, False),
        ("MAPPOPolicy", joining, True),
        ("MAPPOPolicy", lambda: ToyTeams(CodeSpace()), False),
        ("SAFPolicy", joining, False),
        ("SAFPolicy", ToyTeams, True),
        ("SAFPolicy", lambda: ToyTeams(CodeSpace()), True),
    ],
)
def test_values_of_many_steps_are_those_of_each(policy: str, make: Callable[[], Any], normalize_values: bool) -> None:
    venv, eager = make(), Eager()
    settings: dict[str, Any] = {"n_steps": 30, "batch_size": 30 * venv.num_envs, "n_epochs": 1, "seed": 0}
    settings |= {"rollout_buffer_class": TeamRolloutBuffer, "policy_kwargs": {"normalize_values": normalize_values}}
    model = PPO(policy, venv, device="cpu", **settings)
    model.learn(2 * 30 * venv.num_envs, eager)
    assert eager.kinds == {LaterValues}
    values, expected = model.rollout_buffer.values, np.stack(eager.values[-30:])
    active = expected != 0  # the buffer's values of other rows are those of the wait until the agent acts again
    np.testing.assert_allclose(values[active], expected[active], rtol=1e-5, atol=1e-5)
    assert np.ptp(values[active]) > 1e-3


def test_a_step_whose_values_are_used_is_computed_alone_and_once() -> None:
    asked: list[int] = []

    def compute(steps: Any) -> list[th.Tensor]:
        asked.append(len(steps))
        return [th.full((3, 1), step) for step in steps]

    steps: Any = (1.0, 2.0, 3.0)
    one, *others = (LaterValues.of(step, th.zeros(3), compute) for step in steps)
    assert (one + one).tolist() == [[2.0]] * 3 and th.cat([one, one]).sum() == 6.0
    assert [float(values.mean()) for values in compute_together([one, *others])] == [1.0, 2.0, 3.0]
    assert asked == [1, 2]
