"""
Linear layers, and stacks of them, through oneDNN, whose float32 products on processors that are not Intel's are twice as fast
as MKL's, which torch takes.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_htr.common.versions import processor

# Products of fewer multiplications are left to MKL, which begins sooner, and batches of fewer rows to torch.nn; by measurement
MIN_MULTIPLICATIONS, MIN_ROWS = 2**20, 64


def find_onednn() -> Callable[[th.Tensor, th.Tensor, th.Tensor | None, str], th.Tensor] | None:
    """
    The one place that knows of torch's private operation, which torch's compiler uses. It has no gradient of its own.

    :return: ``(x, weight, bias, activation)`` to ``activation(x @ weight.T + bias)``, where the activation is ``"none"`` or
        ``"relu"``; None where this torch has no such operation, or another one of that name
    """

    def product(x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None, activation: str) -> th.Tensor:
        result: th.Tensor = th.ops.mkldnn._linear_pointwise(x, weight, bias, activation, [], "")
        return result

    x, weight, bias = th.tensor([[1.0, 2.0], [3.0, -4.0]]), th.tensor([[1.0, -1.0]]), th.tensor([0.5])
    try:
        result = product(x, weight, bias, "relu")
    except (AttributeError, RuntimeError):
        return None
    return product if result.tolist() == [[0.0], [7.5]] else None


def faster_than_torch() -> Callable[[th.Tensor, th.Tensor, th.Tensor | None, str], th.Tensor] | None:
    """
    :return: as :func:`find_onednn`; None on Intel's processors, too. There MKL's products are as fast as oneDNN's, and need no
        copies of what is transposed
    """
    return None if "Intel" in processor() else find_onednn()


#: None leaves all products to torch
onednn = faster_than_torch()


class _Layer(NamedTuple):
    """
    What is beside the parameters of a linear layer.

    :param eps: of the layer normalization that follows, None without one
    :param rectified: whether ReLU follows
    """

    eps: float | None = None
    rectified: bool = False

    @property
    def n_parameters(self) -> int:
        """Weight and bias, and those of the normalization."""
        return 2 if self.eps is None else 4


class _Stack(th.autograd.Function):
    """
    Layers as one operation for autograd.

    Beside the products, memory is what takes time in an update: ReLU is a part of a product, or done in place.
    """

    @staticmethod
    def forward(ctx: Any, x: th.Tensor, layers: list[_Layer], *parameters: th.Tensor) -> th.Tensor:
        saved: list[th.Tensor | None] = []
        remaining = iter(parameters)
        for layer in layers:
            weight, *others = (next(remaining) for _ in range(layer.n_parameters))
            y, kept = _forward(x, layer, weight, *others)
            # Without ReLU, the output is not needed again: whoever gets it may overwrite it, as with torch's layers
            saved += [x, y if layer.rectified else None, weight, *others[1:], *kept]
            x = y
        ctx.layers = layers
        ctx.save_for_backward(*saved)
        return x

    @staticmethod
    def backward(ctx: Any, grad: th.Tensor) -> tuple[th.Tensor | None, ...]:
        if th.is_grad_enabled():
            raise RuntimeError(
                "Fast layers have no second derivatives (create_graph): use torch.nn.Linear and torch.nn.Sequential."
            )
        saved = iter(ctx.saved_tensors)
        steps = [(layer, [next(saved) for _ in range(3 if layer.eps is None else 8)]) for layer in ctx.layers]
        needs_x, _, *needed = ctx.needs_input_grad
        grads: list[th.Tensor | None] = []
        for i, (layer, (x, y, weight, *normal)) in reversed(list(enumerate(steps))):
            learns = needed[-layer.n_parameters :]
            del needed[-layer.n_parameters :]
            # The gradient of the output belongs to others, and those of layers within to nobody else
            if layer.rectified:
                own = grad if i < len(steps) - 1 else th.empty_like(y)
                grad = th.ops.aten.threshold_backward.grad_input(grad, y, 0, grad_input=own)
            of_normalization: list[th.Tensor | None] = []
            if layer.eps is not None:
                gain, shift, h, mean, rstd = normal
                masks = [True, *learns[2:]]
                grad, *of_normalization = th.ops.aten.native_layer_norm_backward(
                    grad, h, h.shape[1:], mean, rstd, gain, shift, masks
                )
            grad = grad.contiguous()
            of_weight = _product_of_columns(grad, x) if learns[0] else None
            of_bias = grad.sum(dim=0) if learns[1] else None
            grads = [of_weight, of_bias, *of_normalization, *grads]
            if i > 0 or needs_x:
                grad = _product(grad, weight.t())
        return (grad if needs_x else None, None, *grads)


def _forward(
    x: th.Tensor,
    layer: _Layer,
    weight: th.Tensor,
    bias: th.Tensor,
    gain: th.Tensor | None = None,
    shift: th.Tensor | None = None,
) -> tuple[th.Tensor, tuple[th.Tensor, ...]]:
    """Output of a layer, and what its normalization keeps for the backward pass."""
    if layer.eps is None:
        return _product(x, weight, bias, layer.rectified), ()
    h = _product(x, weight, bias)
    y, mean, rstd = th.native_layer_norm(h, h.shape[1:], gain, shift, layer.eps)
    return (y.relu_() if layer.rectified else y), (h, mean, rstd)


def _product(x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None = None, rectified: bool = False) -> th.Tensor:
    """x @ weight.T + bias."""
    if onednn is None or len(x) * weight.numel() <= MIN_MULTIPLICATIONS:
        result = F.linear(x, weight, bias)
        return result.relu_() if rectified else result
    return onednn(x, weight, bias, "relu" if rectified else "none")


def _product_of_columns(a: th.Tensor, b: th.Tensor) -> th.Tensor:
    """a.T @ b. The thinner factor comes first: that is up to four times as fast."""
    if a.shape[1] > b.shape[1]:
        return _product(b.t(), a.t()).t()
    return _product(a.t(), b.t())


def _run(x: th.Tensor, layers: list[_Layer], parameters: list[th.Tensor]) -> th.Tensor:
    # Of a slice of columns, as a context is one of the stored rows, oneDNN's product takes a hundred times as long
    x = x.contiguous()
    if n_padding := _n_padding(len(x)):
        return _run(F.pad(x, (0, 0, 0, n_padding)), layers, parameters)[: len(x)]
    if th.is_grad_enabled():
        result: th.Tensor = _Stack.apply(x, layers, *parameters)
        return result
    remaining = iter(parameters)
    for layer in layers:
        x, _ = _forward(x, layer, *(next(remaining) for _ in range(layer.n_parameters)))
    return x


def _n_padding(n: int) -> int:
    """
    Rows of zeros behind n rows, a sixteenth of them at most above 1024. oneDNN prepares a product for each shape, which takes
    longer than the product, and keeps the latest thousand.
    """
    return -n % max(MIN_ROWS, 1 << n.bit_length() - 5)


_leave_to_torch = False


@contextmanager
def left_to_torch() -> Iterator[None]:
    """
    Layers are ``torch.nn``'s for a while, where the number of rows is another one each time. What oneDNN prepares for each,
    up to half a megabyte for a product, it keeps, and preparing takes as long as it saves.
    """
    global _leave_to_torch
    before, _leave_to_torch = _leave_to_torch, True
    try:
        yield
    finally:
        _leave_to_torch = before


def _suits_onednn(x: th.Tensor) -> bool:
    wanted = onednn is not None and not _leave_to_torch and th.get_float32_matmul_precision() == "highest"
    return wanted and x.is_cpu and x.dtype == th.float32 and x.dim() == 2 and len(x) >= MIN_ROWS


class Linear(nn.Linear):
    """
    ``nn.Linear`` with the same parameters and results, for batches of rows (n, in_features).

    On a GPU, on Intel's processors, where torch has no such operation, for few rows, for other than float32, and where
    ``torch.set_float32_matmul_precision`` allows less than that, it is ``nn.Linear``.
    """

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: (n, in_features)
        :return: (n, out_features)
        """
        if _suits_onednn(x) and self.bias is not None:
            return _run(x, [_Layer()], [self.weight, self.bias])
        return F.linear(x, self.weight, self.bias)


class Stack(nn.Sequential):
    """
    ``nn.Sequential`` with the same parameters and results, for linear layers, layer normalization and ReLU. Of other modules,
    of those with hooks or computed weights, and where :class:`Linear` is ``nn.Linear``, it is ``nn.Sequential``.
    """

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: (n, in_features)
        :return: (n, out_features)
        """
        layers = self._layers() if _suits_onednn(x) else None
        return super().forward(x) if layers is None else _run(x, layers, [p for layer in self for p in layer.parameters()])

    def _layers(self) -> list[_Layer] | None:
        """What the modules are as layers, None if they are none."""
        layers: list[_Layer] = []
        for module in self:
            last = layers[-1] if layers else None
            if _has_hooks(module):
                return None
            if type(module) is Linear and module.bias is not None:
                layers.append(_Layer())
            elif type(module) is nn.LayerNorm and last == _Layer() and module.bias is not None:
                layers[-1] = _Layer(eps=module.eps)
            elif type(module) is nn.ReLU and last is not None and not last.rectified:
                layers[-1] = last._replace(rectified=True)
            else:
                return None
        return layers


def _has_hooks(module: nn.Module) -> bool:
    """As torch's spectral and weight normalization and its pruning add to a layer. Parametrizations change its class."""
    return bool(module._forward_pre_hooks or module._forward_hooks or module._backward_pre_hooks or module._backward_hooks)


def with_fast_layers(module: nn.Module) -> nn.Module:
    """
    :param module: its linear layers become :class:`Linear`, and sequences :class:`Stack`, with the same parameters
    :return: the module, or what it became
    """
    for name, child in module.named_children():
        setattr(module, name, with_fast_layers(child))
    if type(module) is nn.Linear:
        layer = Linear(module.in_features, module.out_features, module.bias is not None)
        layer.weight, layer.bias = module.weight, module.bias
        return layer
    return Stack(*module) if type(module) is nn.Sequential else module
