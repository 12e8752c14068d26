"""Fast linear layers are linear layers."""

import copy
from types import SimpleNamespace
from typing import Any

import pytest
import torch as th
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn.utils import parametrize, prune

from sb3_htr.common import linear
from sb3_htr.common.linear import MIN_ROWS, Linear, Stack, find_onednn, left_to_torch, with_fast_layers
from sb3_htr.pearl.matmul import matmul_precision

LAYERS = {
    "encoder": [nn.Linear(5, 40), nn.ReLU(), nn.Linear(40, 64), nn.ReLU(), nn.Linear(64, 10)],
    "critic": [
        nn.Linear(5, 40),
        nn.LayerNorm(40),
        nn.ReLU(),
        nn.Linear(40, 50),
        nn.LayerNorm(50),
        nn.ReLU(),
        nn.Linear(50, 1),
    ],
    "actor": [nn.Linear(5, 40), nn.ReLU(), nn.Linear(40, 64), nn.ReLU()],
    "normalized last": [nn.Linear(5, 64), nn.LayerNorm(64, eps=0.1)],
    "other activations": [nn.Linear(5, 64), nn.Tanh(), nn.Linear(64, 2)],
}


# What layers are made with on this processor
HERE = linear.onednn


@pytest.fixture(autouse=True)
def on_every_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Layers are tested on those, too, where they are torch's own."""
    monkeypatch.setattr(linear, "onednn", find_onednn())


@pytest.fixture
def everything_through_onednn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small products too."""
    monkeypatch.setattr(linear, "MIN_MULTIPLICATIONS", 0)


def gradients(layer: nn.Module, x: th.Tensor, loss_weight: th.Tensor) -> list[th.Tensor]:
    """Output, and gradients of a loss with respect to input, weight and bias."""
    x = x.clone().requires_grad_()
    output = layer(x)
    (output * loss_weight).sum().backward()
    grads = [parameter.grad for parameter in (x, *layer.parameters())]
    return [output.detach(), *(grad for grad in grads if grad is not None)]


@pytest.mark.usefixtures("everything_through_onednn")
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(1, 3 * MIN_ROWS), st.integers(1, 70), st.integers(1, 70), st.booleans(), st.integers(0, 99))
def test_results_and_gradients_are_those_of_torch(n: int, n_in: int, n_out: int, strided: bool, seed: int) -> None:
    th.manual_seed(seed)
    ours, torchs = Linear(n_in, n_out), nn.Linear(n_in, n_out)
    torchs.load_state_dict(ours.state_dict())
    x = th.randn(n, n_in + 3)[:, :n_in] if strided else th.randn(n, n_in)
    loss_weight = th.randn(n, n_out)
    for actual, expected in zip(gradients(ours, x, loss_weight), gradients(torchs, x, loss_weight), strict=True):
        th.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-4)


@pytest.fixture
def onednn_rows(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Rows of each product that oneDNN is asked for."""
    rows, fastest = list[int](), find_onednn()
    assert fastest is not None

    def product(x: th.Tensor, *others: Any) -> th.Tensor:
        rows.append(len(x))
        return fastest(x, *others)

    monkeypatch.setattr(linear, "onednn", product)
    return rows


def test_onednn_meets_few_shapes_however_many_rows_there_are(onednn_rows: list[int]) -> None:
    """It prepares something for each, which takes time and memory."""
    layer = Linear(128, 128)
    with th.no_grad():
        for n in range(MIN_ROWS, 2_000):
            assert layer(th.zeros(n, 128)).shape == (n, 128)
    assert 10 < len(set(onednn_rows)) < 50
    assert max(onednn_rows) < 2_100


@pytest.mark.usefixtures("everything_through_onednn")
def test_what_is_left_to_torch_prepares_nothing_in_onednn(onednn_rows: list[int]) -> None:
    stack, x = with_fast_layers(nn.Sequential(nn.Linear(8, 8), nn.ReLU(), nn.Linear(8, 2))), th.ones(MIN_ROWS, 8)
    with left_to_torch():
        left = stack(x)
        assert onednn_rows == []
    th.testing.assert_close(stack(x), left, rtol=1e-5, atol=1e-5)
    assert onednn_rows == [MIN_ROWS] * 2


@pytest.mark.parametrize("dtype", [th.float64, th.bfloat16])
@pytest.mark.usefixtures("everything_through_onednn")
def test_other_types_and_lower_precision_are_left_to_torch(dtype: th.dtype) -> None:
    layer, x = Linear(8, 8).to(dtype), th.randn(2 * MIN_ROWS, 8, dtype=dtype)
    th.testing.assert_close(layer(x), nn.functional.linear(x, layer.weight, layer.bias), rtol=0, atol=0)
    layer, x = Linear(64, 64), th.randn(2 * MIN_ROWS, 64)
    with matmul_precision("medium"):
        th.testing.assert_close(layer(x), nn.functional.linear(x, layer.weight, layer.bias), rtol=0, atol=0)


@pytest.mark.parametrize("n_rows", [MIN_ROWS - 1, 4 * MIN_ROWS])
@pytest.mark.parametrize("name", LAYERS)
@pytest.mark.usefixtures("everything_through_onednn")
def test_a_stack_is_a_sequence(name: str, n_rows: int) -> None:
    th.manual_seed(0)
    sequence = nn.Sequential(*copy.deepcopy(LAYERS[name]))
    stack = with_fast_layers(copy.deepcopy(sequence))
    assert isinstance(stack, Stack)
    x = th.randn(n_rows, 5)
    loss_weight = th.randn_like(sequence(x))
    actual, expected = (gradients(layers, x, loss_weight) for layers in (stack, sequence))
    th.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-4)
    with th.no_grad():
        th.testing.assert_close(stack(x), expected[0], rtol=1e-4, atol=1e-4)


def test_what_does_not_learn_has_no_gradient_and_passes_one_on() -> None:
    stack = with_fast_layers(nn.Sequential(*copy.deepcopy(LAYERS["critic"]))).requires_grad_(False)
    x = th.randn(2 * MIN_ROWS, 5, requires_grad=True)
    stack(x).sum().backward()
    assert x.grad is not None and x.grad.abs().sum() > 0
    assert all(parameter.grad is None for parameter in stack.parameters())


def test_a_gradient_that_others_have_is_not_overwritten() -> None:
    stack = with_fast_layers(nn.Sequential(*copy.deepcopy(LAYERS["actor"])))
    output = stack(th.randn(2 * MIN_ROWS, 5))
    given = th.randn_like(output)
    before = given.clone()
    output.backward(given)
    assert th.equal(given, before)


def test_an_output_may_be_overwritten_as_that_of_torch_may() -> None:
    layers = nn.Sequential(nn.Linear(5, 8), nn.ELU(inplace=True), nn.Linear(8, 3))
    x = th.randn(2 * MIN_ROWS, 5)
    grads = []
    for network in (copy.deepcopy(layers), with_fast_layers(copy.deepcopy(layers))):
        y = network(x)
        y += 1
        y.square().sum().backward()
        grads.append([parameter.grad for parameter in network.parameters()])
    th.testing.assert_close(*grads, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "takes_onednn"),
    [("AMD EPYC", True), ("Intel(R) Xeon(R) Processor", False), ("Intel64 Family 6, GenuineIntel", False), ("arm", True)],
)
def test_products_are_left_to_torch_where_these_are_as_fast(
    name: str, takes_onednn: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert (HERE is None) is (linear.faster_than_torch() is None)
    monkeypatch.setattr(linear, "processor", lambda: name)
    assert (linear.faster_than_torch() is not None) is takes_onednn


def test_a_torch_without_the_private_operation_uses_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    assert find_onednn() is not None, "the tested version of torch has it"
    layer, x = Linear(64, 64), th.randn(1024, 64)
    expected = layer(x).detach()
    for namespace in (SimpleNamespace(), SimpleNamespace(_linear_pointwise=lambda x, *_: x)):
        with monkeypatch.context() as patch:
            patch.setattr(th.ops, "mkldnn", namespace)
            assert find_onednn() is None
            patch.setattr(linear, "onednn", find_onednn())
            th.testing.assert_close(layer(x), nn.functional.linear(x, layer.weight, layer.bias), rtol=0, atol=0)
    th.testing.assert_close(expected, nn.functional.linear(x, layer.weight, layer.bias), rtol=1e-4, atol=1e-4)


def test_replaced_layers_keep_their_parameters() -> None:
    module = nn.ModuleList([nn.Linear(3, 4), nn.Sequential(nn.ReLU(), nn.Linear(4, 2))])
    before = copy.deepcopy(module.state_dict())
    parameters = list(module.parameters())
    assert with_fast_layers(module) is module
    assert isinstance(module[0], Linear) and isinstance(module[1], Stack) and isinstance(module[1][1], Linear)
    assert all(a is b for a, b in zip(module.parameters(), parameters, strict=True))
    assert all(th.equal(before[name], value) for name, value in module.state_dict().items())


def test_second_derivatives_are_refused() -> None:
    layer, x = Linear(8, 8), th.randn(MIN_ROWS, 8, requires_grad=True)
    with pytest.raises(RuntimeError, match=r"no second derivatives \(create_graph\)"):
        th.autograd.grad(layer(x).sum(), x, create_graph=True)


@pytest.mark.parametrize("what", ["hook", "spectral_norm", "prune", "parametrization"])
def test_what_torch_adds_to_a_layer_is_kept(what: str) -> None:
    """A stack reads the layers' weights: one with a hook, or whose weight is computed, is left to torch."""
    th.manual_seed(0)
    layer = nn.Linear(5, 40)
    plain = nn.Sequential(layer, nn.ReLU(), nn.Linear(40, 3)).eval()
    stack = with_fast_layers(copy.deepcopy(plain))
    x = th.randn(2 * MIN_ROWS, 5)
    for module in (plain, stack):
        first = module[0]  # type: ignore[index]
        if what == "hook":
            first.register_forward_hook(lambda _, __, y: y + 1)
        elif what == "spectral_norm":
            th.manual_seed(1)
            nn.utils.spectral_norm(first).eval()
        elif what == "prune":
            prune.ln_structured(first, "weight", amount=0.5, n=2, dim=0)
        else:
            parametrize.register_parametrization(first, "weight", nn.Tanh())
    th.testing.assert_close(stack(x), plain(x))


@pytest.mark.usefixtures("everything_through_onednn")
def test_a_layer_may_come_twice() -> None:
    layer = Linear(8, 8)
    layers, x = (layer, nn.ReLU(), layer), th.randn(2 * MIN_ROWS, 8)
    th.testing.assert_close(Stack(*layers)(x), nn.Sequential(*layers)(x), rtol=1e-4, atol=1e-4)
