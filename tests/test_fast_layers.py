"""Compiled and merged layers give the numbers and the gradients of the plain ones."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest
import torch as th
from torch import nn

from sb3_saf.networks.distributions import LeanCategorical
from sb3_saf.networks.knowledge_source import Attention
from sb3_saf.networks.layers import mlp, side_by_side
from sb3_saf.networks.tanh import Tanh
from sb3_saf.teams.checks import NonFiniteError


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


def test_the_tanh_of_a_number_does_not_depend_on_its_place() -> None:
    x = th.randn(100)
    assert all(th.equal(Tanh()(x[i:]), Tanh()(x)[i:]) for i in range(100))


def test_the_tanh_can_be_differentiated_twice() -> None:
    x = th.randn(5, requires_grad=True)
    (first,) = th.autograd.grad(Tanh()(x).sum(), x, create_graph=True)
    (second,) = th.autograd.grad(first.sum(), x)
    y = x.tanh()
    th.testing.assert_close(second, -2 * y * (1 - y**2), rtol=0, atol=2e-6)


@pytest.mark.parametrize("hidden", [[], [8], [8, 9]])
@pytest.mark.parametrize("n_outputs", [3, 20])
def test_mlps_side_by_side_are_those_mlps(hidden: list[int], n_outputs: int) -> None:
    one = [mlp([6, 4, 2], nn.Tanh)]
    group = [mlp([6, *hidden, n_outputs], nn.Tanh) for _ in range(4)]
    x = th.randn(11, 6)

    def apart(x: th.Tensor) -> th.Tensor:
        return th.cat([one[0](x), *(net(x) for net in group)], dim=1)

    def together(x: th.Tensor) -> th.Tensor:
        (alone,), outputs = side_by_side([one, group], x)
        assert outputs.shape == (4, 11, n_outputs)
        return th.cat([alone, *outputs], dim=1)

    for found, expected in zip(gradients(together, x), gradients(apart, x), strict=True):
        th.testing.assert_close(found, expected, rtol=0, atol=1e-5)


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
        attended = module(queries, sources, active)
        return attended.weights if of_weights else attended.values

    found, expected = gradients(attend, queries, sources), gradients(attend, queries.double(), sources.double())
    for one, other in zip(found, expected, strict=True):
        th.testing.assert_close(one.double(), other, rtol=1e-4, atol=1e-5)
    if active is not None:
        assert not found[0][2].any()


@pytest.mark.parametrize("shape", [(1, 5), (400, 2), (48, 33)])
def test_actions_are_those_of_multinomial(shape: tuple[int, int]) -> None:
    distribution = LeanCategorical(shape[1]).proba_distribution(3 * th.randn(shape))
    th.manual_seed(1)
    found = distribution.sample(), th.rand(1)
    th.manual_seed(1)
    expected = th.multinomial(distribution.log_probs.exp(), 1, True).squeeze(1), th.rand(1)
    assert th.equal(found[0], expected[0]) and th.equal(found[1], expected[1])


def test_nan_probabilities_are_refused() -> None:
    logits = th.zeros(7, 5)
    logits[3, 2] = th.nan
    with pytest.raises(NonFiniteError, match=r"probabilities of actions are NaN.*lower the learning rate"):
        LeanCategorical(5).proba_distribution(logits).sample()
