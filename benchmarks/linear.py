"""Float32 products of a linear layer: through oneDNN, as ``sb3_htr.common.linear`` has them, against torch's own."""

from functools import partial
from unittest import mock

import numpy as np
import torch as th
from _common import Figure, by_turns, faster, make_model, seconds, write
from torch import nn
from torch.nn import functional as F

from sb3_htr.common import linear
from sb3_htr.common.linear import Linear, Stack, _product, find_onednn

# Rows and units: a critic and the encoder at the paper's sizes, a critic of the fast profile
SHAPES = [(4096, 300), (16384, 200), (1024, 128)]
OWN = "torch's own"


def public_product(x: th.Tensor, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
    """
    :param x: (n, in_features)
    :param weight: (out_features, in_features)
    :param bias: (out_features,)
    :return: (n, out_features), through oneDNN as torch's documentation has it: with copies into its layout and back
    """
    return F.linear(x.to_mkldnn(), weight, bias).to_dense()


def main() -> None:
    """One thread."""
    th.set_num_threads(1)
    linear.onednn = find_onednn()  # also on a processor where it is not the faster one
    figures = []
    for n, units in SHAPES:
        x, weight, bias = th.randn(n, units), th.randn(units, units), th.randn(units)
        exact = F.linear(x.double(), weight.double(), bias.double())
        errors = [float((f(x, weight, bias) - exact).abs().max()) for f in (_product, F.linear)]
        times = by_turns(
            {
                "ours": partial(seconds, partial(_product, x, weight, bias), 20),
                "torch": partial(seconds, partial(F.linear, x, weight, bias), 20),
                "public": partial(seconds, partial(public_product, x, weight, bias), 20),
            }
        )
        ours, theirs = (2e-9 * n * units**2 / float(np.median(times[key])) for key in ("ours", "torch"))
        name = f"{n} x {units} by {units} x {units}, largest error {errors[0]:.0e} (torch {errors[1]:.0e})"
        figures.append(Figure(name, "GFLOP/s", ours, theirs, faster(times["ours"], times["torch"]), None, OWN))
        public = 2e-9 * n * units**2 / float(np.median(times["public"]))
        name = f"{n} x {units} by {units} x {units}"
        figures.append(Figure(name, "GFLOP/s", ours, public, faster(times["ours"], times["public"]), None, "Tensor.to_mkldnn"))
    write("linear", [*figures, context_figure(), changing_rows_figure(), update_figure()])


def context_figure() -> Figure:
    """First layer of the ant's encoder with its gradient: a context is a slice of the columns of the stored rows."""
    n, columns, context_dim, units = 1536, 69, 38, 128
    context = th.randn(n, columns)[:, :context_dim]
    layers = {"ours": Linear(context_dim, units), "torch": nn.Linear(context_dim, units)}

    def forward_and_backward(layer: nn.Linear) -> None:
        layer(context).sum().backward()

    times = by_turns({key: partial(seconds, partial(forward_and_backward, layer), 20) for key, layer in layers.items()})
    ours, theirs = (4e-9 * n * context_dim * units / float(np.median(times[key])) for key in ("ours", "torch"))
    name = f"{n} x {context_dim} of {columns} columns by {context_dim} x {units}, with its gradient"
    return Figure(name, "GFLOP/s", ours, theirs, faster(times["ours"], times["torch"]), None, OWN)


def changing_rows_figure() -> Figure:
    """Four networks with their gradients, on batches that differ in size, as they do where episodes end early."""
    widths, counts = (7, 9, 13, 13), iter(np.random.default_rng(0).integers(800, 1500, 100_000).tolist())
    networks = [Stack(Linear(n, 128), nn.ReLU(), Linear(128, 128), nn.ReLU(), Linear(128, 8)) for n in widths]

    def forward_and_backward() -> None:
        n = next(counts)
        for network, width in zip(networks, widths, strict=True):
            network(th.randn(n, width)).sum().backward()

    def unpadded() -> float:
        with mock.patch.object(linear, "_n_padding", lambda _: 0):
            return seconds(forward_and_backward, 50)

    times = by_turns({"ours": partial(seconds, forward_and_backward, 50), "unpadded": unpadded})
    ours, theirs = (1 / float(np.median(times[key])) for key in ("ours", "unpadded"))
    name = "four networks on 800 to 1,500 rows, another number each time"
    return Figure(name, "passes/s", ours, theirs, faster(times["ours"], times["unpadded"]), None, "without rows of zeros")


def update_figure() -> Figure:
    """Updates of the fast profile, most of which are products of such layers."""
    model = make_model()
    products = {"ours": linear.onednn, "torch": None}

    def updates(name: str) -> float:
        with mock.patch.object(linear, "onednn", products[name]):
            return seconds(partial(model.train, 30, model.batch_size), 1) / 30

    times = by_turns({name: partial(updates, name) for name in products})
    ours, theirs = (1 / float(np.median(times[name])) for name in products)
    return Figure("updates of the fast profile", "updates/s", ours, theirs, faster(times["ours"], times["torch"]), None, OWN)


if __name__ == "__main__":
    main()
