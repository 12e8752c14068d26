"""Updates per second on a GPU, as one CUDA graph and operation by operation."""

import sys
from functools import partial

import numpy as np
import torch as th
from _common import Figure, by_turns, faster, make_model, seconds, write

from sb3_htr import PEARL

N_UPDATES = 200


def update_seconds(model: PEARL) -> float:
    """
    :param model: has collected
    :return: duration of an update, of as many as follow a rollout; with what is captured, and all that the GPU computes
    """

    def train() -> None:
        model.train(N_UPDATES, model.batch_size)  # asks for what is logged, which is there when all else is

    return seconds(train, 1) / N_UPDATES


def main() -> None:
    """The fast profile. Another device than ``cuda`` may be named, on which nothing is captured."""
    device = sys.argv[1] if len(sys.argv) > 1 else "cuda"
    if device.startswith("cuda") and not th.cuda.is_available():
        print("There is no GPU that torch could use, so nothing was measured.")
        return
    against = "operation by operation"
    models = {
        against: make_model(cuda_graph=False, device=device),
        "one CUDA graph": make_model(cuda_graph=True, device=device),
    }
    times = by_turns({name: partial(update_seconds, model) for name, model in models.items()})
    eager, graphed = times.values()
    ours, theirs = (1 / float(np.median(duration)) for duration in (graphed, eager))
    write("gpu", [Figure("fast profile, one CUDA graph", "updates/s", ours, theirs, faster(graphed, eager), 5.0, against)])


if __name__ == "__main__":
    main()
