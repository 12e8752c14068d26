"""Updates per second on a GPU, operation by operation and as one CUDA graph, against a core of the CPU beside it."""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch as th
from _common import PAPER_SIZES, Figure, by_turns, faster, make_model, seconds, write

from sb3_htr import PEARL

# Updates that are timed together on a GPU: as many as follow a rollout, as a graph is captured anew for them
N_UPDATES = 200
CORE, OPERATIONS, GRAPH = "one core of the CPU", "GPU, operation by operation", "GPU, one CUDA graph"
# Of models; and how many updates are timed together on the CPU
SIZES: dict[str, tuple[dict[str, Any], int]] = {
    "fast profile": ({}, 50),
    "HTR-SER (K = 0.8), paper's sizes": (PAPER_SIZES, 10),
    "plain PEARL (K = 0), paper's sizes": ({"relabel_probability": 0.0, **PAPER_SIZES}, 4),
}


def update_seconds(model: PEARL, n_updates: int) -> float:
    """
    :param model: has collected
    :param n_updates: how many are timed
    :return: duration of an update; with what is captured, and all that the GPU computes
    """

    def train() -> None:
        model.train(n_updates, model.batch_size)  # asks for what is logged, which is there when all else is

    return seconds(train, 1) / n_updates


def figures(name: str, sizes: dict[str, Any], n_updates_cpu: int, device: str) -> list[Figure]:
    """
    :param name: of the sizes
    :param sizes: for the model
    :param n_updates_cpu: how many are timed together on the CPU
    :param device: ``cuda``, or another one, on which nothing is captured
    :return: of each way to compute an update
    """
    ways: dict[str, dict[str, Any]] = {
        CORE: {"device": "cpu"},
        OPERATIONS: {"device": device},
        GRAPH: {"device": device, "cuda_graph": True},
    }
    durations: dict[str, Callable[[], float]] = {}
    for way, kwargs in ways.items():
        n_updates = n_updates_cpu if kwargs["device"] == "cpu" else N_UPDATES
        durations[way] = partial(update_seconds, make_model(**kwargs, **sizes), n_updates)
    times = by_turns(durations)
    rates = {way: 1 / float(np.median(duration)) for way, duration in times.items()}
    compared = ((OPERATIONS, CORE, None), (GRAPH, CORE, None), (GRAPH, OPERATIONS, 5.0))
    return [
        Figure(f"{name}: {way}", "updates/s", rates[way], rates[other], faster(times[way], times[other]), goal, other)
        for way, other, goal in compared
    ]


def main() -> None:
    """All sizes. Another device than ``cuda`` may be named, on which nothing is captured."""
    device = sys.argv[1] if len(sys.argv) > 1 else "cuda"
    if device.startswith("cuda") and not th.cuda.is_available():
        print("There is no GPU that torch could use, so nothing was measured.")
        return
    th.set_num_threads(1)
    measured: list[Figure] = []
    for name, (sizes, n_updates_cpu) in SIZES.items():
        measured += figures(name, sizes, n_updates_cpu, device)
        write("gpu", measured)  # what there is; a machine with a GPU is often lent for minutes


if __name__ == "__main__":
    main()
