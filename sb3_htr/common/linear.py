"""Linear layers through oneDNN, whose float32 products on processors that are not Intel's are twice as fast as MKL's."""

from typing import Any

import torch as th
from torch import nn
from torch.nn import functional as F

# Smaller products are left to MKL, which begins sooner; by measurement
MIN_ROWS, MIN_COLUMNS = 64, 32


class _OneDNNLinear(th.autograd.Function):
    """
    ``F.linear`` of a batch of rows.

    The operation is the one that torch's compiler uses. It has no gradient of its own.
    """

    @staticmethod
    def forward(ctx: Any, x: th.Tensor, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
        # Of a slice of columns, as a context is one of the stored rows, oneDNN's product takes a hundred times as long
        x = x.contiguous()
        ctx.save_for_backward(x, weight)
        return _product(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, grad: th.Tensor) -> tuple[th.Tensor | None, th.Tensor | None, th.Tensor | None]:
        x, weight = ctx.saved_tensors
        grad = grad.contiguous()
        return (
            _product(grad, weight.t(), None) if ctx.needs_input_grad[0] else None,
            _product_of_columns(grad, x) if ctx.needs_input_grad[1] else None,
            grad.sum(dim=0) if ctx.needs_input_grad[2] else None,
        )


def _product(x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
    """x @ weight.T + bias."""
    result: th.Tensor = th.ops.mkldnn._linear_pointwise(x, weight, bias, "none", [], "")
    return result


def _product_of_columns(a: th.Tensor, b: th.Tensor) -> th.Tensor:
    """a.T @ b, for which oneDNN copies both factors: too much for thin ones."""
    return _product(a.t(), b.t(), None) if min(a.shape[1], b.shape[1]) >= MIN_COLUMNS else a.t() @ b


def _suits_onednn(x: th.Tensor) -> bool:
    fits = x.is_cpu and x.dtype == th.float32 and x.dim() == 2 and len(x) >= MIN_ROWS
    return fits and th.backends.mkldnn.is_available()


class Linear(nn.Linear):
    """
    ``nn.Linear`` with the same parameters and results, for batches of rows (n, in_features).

    Elsewhere than on a CPU with oneDNN, for few rows, for other than float32, and where
    ``torch.set_float32_matmul_precision`` allows less than that, it is ``nn.Linear``.
    """

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: (n, in_features)
        :return: (n, out_features)
        """
        if _suits_onednn(x) and th.get_float32_matmul_precision() == "highest":
            result: th.Tensor = _OneDNNLinear.apply(x, self.weight, self.bias)
            return result
        return F.linear(x, self.weight, self.bias)


def with_fast_linear(module: nn.Module) -> nn.Module:
    """
    :param module: its linear layers are replaced by :class:`Linear`, with the same parameters
    :return: the module
    """
    for name, child in module.named_children():
        if type(child) is nn.Linear:
            layer = Linear(child.in_features, child.out_features)
            layer.weight, layer.bias = child.weight, child.bias
            setattr(module, name, layer)
        else:
            with_fast_linear(child)
    return module
