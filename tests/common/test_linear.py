"""Fast linear layers are linear layers."""

import copy

import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from sb3_htr.common.linear import MIN_ROWS, Linear, with_fast_layers
from sb3_htr.common.matmul import matmul_precision


def gradients(layer: nn.Module, x: th.Tensor, loss_weight: th.Tensor) -> list[th.Tensor]:
    """Output, and gradients of a loss with respect to input, weight and bias."""
    x = x.clone().requires_grad_()
    output = layer(x)
    (output * loss_weight).sum().backward()
    grads = [parameter.grad for parameter in (x, *layer.parameters())]
    return [output.detach(), *(grad for grad in grads if grad is not None)]


@given(st.integers(1, 3 * MIN_ROWS), st.integers(1, 70), st.integers(1, 70), st.booleans(), st.integers(0, 99))
def test_results_and_gradients_are_those_of_torch(n: int, n_in: int, n_out: int, strided: bool, seed: int) -> None:
    th.manual_seed(seed)
    ours, torchs = Linear(n_in, n_out), nn.Linear(n_in, n_out)
    torchs.load_state_dict(ours.state_dict())
    x = th.randn(n, n_in + 3)[:, :n_in] if strided else th.randn(n, n_in)
    loss_weight = th.randn(n, n_out)
    for actual, expected in zip(gradients(ours, x, loss_weight), gradients(torchs, x, loss_weight), strict=True):
        th.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("dtype", [th.float64, th.bfloat16])
def test_other_types_and_lower_precision_are_left_to_torch(dtype: th.dtype) -> None:
    layer, x = Linear(8, 8).to(dtype), th.randn(2 * MIN_ROWS, 8, dtype=dtype)
    th.testing.assert_close(layer(x), nn.functional.linear(x, layer.weight, layer.bias), rtol=0, atol=0)
    layer, x = Linear(64, 64), th.randn(2 * MIN_ROWS, 64)
    with matmul_precision("medium"):
        th.testing.assert_close(layer(x), nn.functional.linear(x, layer.weight, layer.bias), rtol=0, atol=0)


def test_replaced_layers_keep_their_parameters() -> None:
    module = nn.Sequential(nn.Linear(3, 4), nn.Sequential(nn.ReLU(), nn.Linear(4, 2)))
    before = copy.deepcopy(module.state_dict())
    parameters = list(module.parameters())
    assert with_fast_layers(module) is module
    assert isinstance(module[0], Linear) and isinstance(module[1][1], Linear)  # type: ignore[index]
    assert all(a is b for a, b in zip(module.parameters(), parameters, strict=True))
    assert all(th.equal(before[name], value) for name, value in module.state_dict().items())
