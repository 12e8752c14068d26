"""Updates per second at the paper's sizes, against PEARL's reference implementation and against the arithmetic they need."""

import os
from functools import partial
from itertools import pairwise

import numpy as np
import torch as th
from _common import PAPER_SIZES, Figure, by_turns, faster, make_model, seconds, write

from sb3_htr import PEARL
from sb3_htr.common.linear import _product

# katerakelly/oyster, by number of threads: updates/s, and FLOP/s of sgemm on the machine where that was recorded (107 to 114
# and 213 to 228 GFLOP/s). It is bound by sgemm, so its rate on this machine is taken to be in proportion
RECORDED = {1: (2.10, 110.5e9), 2: (3.59, 220.5e9)}
REFERENCE = "katerakelly/oyster, recorded, scaled by the rate of sgemm"


def minimal_flop(batch: int, context: int, units: list[int], encoder_units: list[int]) -> float:
    """
    The floating point operations of an update on the Point Robot that no implementation of PEARL's losses can leave away.

    :param batch: transitions for actor and critics
    :param context: transitions for the encoder
    :param units: hidden units of actor and critics
    :param encoder_units: of the encoder
    :return: 2 for each multiplication of a matrix product; nothing else is counted, nor the model of rewards
    """
    obs_dim, action_dim, latent_dim = 2, 2, 5
    actor = [obs_dim + latent_dim, *units, 2 * action_dim]
    critic = [obs_dim + latent_dim + action_dim, *units, 1]
    encoder = [obs_dim + action_dim + 1, *encoder_units, 2 * latent_dim]

    def forward(units: list[int]) -> float:
        return 2.0 * sum(i * o for i, o in pairwise(units))

    def backward(units: list[int], weights: bool, n_inputs: int) -> float:
        """With gradients of the weights or not, and of this many inputs."""
        to_inputs = forward(units[1:]) + 2.0 * n_inputs * units[1]
        return to_inputs + (forward(units) if weights else 0.0)

    encoding = context * (forward(encoder) + backward(encoder, True, 0))
    targets = batch * (forward(actor) + 2 * forward(critic))
    critics = batch * 2 * (forward(critic) + backward(critic, True, latent_dim))
    acting = batch * (forward(actor) + backward(actor, True, 0))
    judging = batch * 2 * (forward(critic) + backward(critic, False, action_dim))
    return encoding + targets + critics + acting + judging


# At the paper's sizes, without relabelling; and of 64 whole episodes, by default
PAPER_FLOP = minimal_flop(16 * 256, 16 * 1024, [300] * 3, [200] * 3)
FAST_FLOP = minimal_flop(64 * 20, 64 * 20, [128] * 2, [128] * 2)


def sgemm_seconds() -> float:
    """
    :return: duration of one floating point operation of float32 matrix products of the critics' and the encoder's shapes
    """
    flop = [(4096, 300), (16384, 200)]
    pairs = [(th.randn(rows, units), th.randn(units, units)) for rows, units in flop]
    total = sum(2.0 * rows * units**2 for rows, units in flop)
    return seconds(lambda: [a @ b for a, b in pairs], 8) / total


def product_seconds() -> float:
    """
    :return: the same of the products that layers of the fast profile use
    """
    x, weight = th.randn(64 * 20, 128), th.randn(128, 128)
    return seconds(lambda: _product(x, weight), 100) / (2.0 * len(x) * weight.numel())


def update_seconds(model: PEARL, n: int) -> float:
    """
    :param model: has collected
    :param n: number of updates
    :return: duration of one
    """
    return seconds(lambda: model.train(n, model.batch_size), 1) / n


def figures(n_threads: int) -> list[Figure]:
    """
    :param n_threads: threads of torch
    :return: the figures with so many
    """
    th.set_num_threads(n_threads)
    models = {
        "plain PEARL (K = 0), float32": make_model(relabel_probability=0.0, **PAPER_SIZES),
        "plain PEARL (K = 0), bfloat16 products": make_model(
            relabel_probability=0.0, matmul_precision="medium", **PAPER_SIZES
        ),
        "HTR-SER (K = 0.8), float32": make_model(**PAPER_SIZES),
        "fast profile, float32": make_model(),
        "fast profile, bfloat16 products": make_model(matmul_precision="medium"),
    }
    n_updates = dict(zip(models, (2, 3, 8, 30, 30), strict=True))
    durations = {name: partial(update_seconds, model, n_updates[name]) for name, model in models.items()}
    times = by_turns({"sgemm": sgemm_seconds, "product": product_seconds, **durations})
    limit = PAPER_FLOP * times["sgemm"]
    rate, sgemm = RECORDED[n_threads]
    reference = sgemm * times["sgemm"] / rate
    arithmetic = f"{PAPER_FLOP / 1e9:.1f} GFLOP of sgemm at {1e-9 / np.median(times['sgemm']):.0f} GFLOP/s"
    fast_arithmetic = f"{FAST_FLOP / 1e9:.2f} GFLOP at {1e-9 / np.median(times['product']):.0f} GFLOP/s"
    plain, plain_bf16, htr, fast, fast_bf16 = models
    alternatives = {
        (plain, arithmetic): (limit, 0.8),
        (plain, REFERENCE): (reference, 1.3 if n_threads == 1 else 1.45),
        (plain_bf16, REFERENCE): (reference, 2.0),
        (htr, REFERENCE): (reference, 4.0),
        (fast, fast_arithmetic): (FAST_FLOP * times["product"], 0.6),
    }
    result = []
    for (name, against), (other, goal) in alternatives.items():
        ours, theirs = (1 / float(np.median(duration)) for duration in (times[name], other))
        ratio = faster(times[name], other)
        result.append(Figure(f"{name}, {n_threads} thread(s)", "updates/s", ours, theirs, ratio, goal, against))
    result.append(Figure(f"{fast_bf16}, {n_threads} thread(s)", "updates/s", 1 / float(np.median(times[fast_bf16]))))
    return result


def main() -> None:
    """One thread, then two where there are two cores."""
    write("update", [figure for n in RECORDED if n <= (os.cpu_count() or 1) for figure in figures(n)])


if __name__ == "__main__":
    main()
