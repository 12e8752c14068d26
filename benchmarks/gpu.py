"""Updates per second on a GPU, as one CUDA graph and operation by operation."""

import sys
from functools import partial

import numpy as np
import torch as th
from _common import Figure, by_turns, faster, make_model, seconds, write

from sb3_htr import PEARL
from sb3_htr.pearl.graphed_update import FixedUpdate

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
    against, filled, graph = "operation by operation", "operation by operation, filled up and in one copy", "one CUDA graph"
    models = {name: make_model(cuda_graph=name != against, device=device) for name in (against, filled, graph)}
    models[filled]._fixed_update = lambda _: FixedUpdate(models[filled]._gradient_step, models[filled].device)  # type: ignore
    times = by_turns({name: partial(update_seconds, model) for name, model in models.items()})
    rates = {name: 1 / float(np.median(duration)) for name, duration in times.items()}
    figures = [
        Figure(
            f"fast profile, {name}",
            "updates/s",
            rates[name],
            rates[against],
            faster(times[name], times[against]),
            goal,
            against,
        )
        for name, goal in ((filled, None), (graph, 5.0))
    ]
    write("gpu", figures)


if __name__ == "__main__":
    main()
