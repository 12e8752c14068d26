"""Updates and trainings on a GPU, operation by operation and with CUDA graphs, against a core of the CPU beside it."""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch as th
from _common import ENV_ID, PAPER_SIZES, ROUNDS, Figure, by_turns, faster, make_model, seconds, write

from sb3_htr import PEARL
from sb3_htr.common.vec_env import make_task_vec_env

CORE, OPERATIONS, GRAPH = "one core of the CPU", "GPU, operation by operation", "GPU, one CUDA graph"
# Updates that are timed together. As a graph: as many as follow a rollout, as one is captured anew for them
N_OPERATIONS, N_GRAPH = 50, 200
# Of models; and how many updates are timed together on the CPU
SIZES: dict[str, tuple[dict[str, Any], int]] = {
    "fast profile": ({}, 50),
    "HTR-SER (K = 0.8), paper's sizes": (PAPER_SIZES, 10),
    "plain PEARL (K = 0), paper's sizes": ({"relabel_probability": 0.0, **PAPER_SIZES}, 4),
}
# Two rollouts, and what is learnt after each; with all that is done once, and no evaluation
TRAINING_STEPS, TRAINING_ROUNDS = 8_000, 2


def update_seconds(model: PEARL, n_updates: int) -> float:
    """
    :param model: has collected
    :param n_updates: how many are timed
    :return: duration of an update; with what is captured, and all that the GPU computes
    """

    def train() -> None:
        model.train(n_updates, model.batch_size)  # asks for what is logged, which is there when all else is

    return seconds(train, 1) / n_updates


def step_seconds(**kwargs: Any) -> float:
    """
    :param kwargs: for PEARL
    :return: duration of a training, for each env step
    """
    model = PEARL("MlpPolicy", make_task_vec_env(ENV_ID, 20, seed=0), seed=0, **kwargs)
    duration = seconds(lambda: model.learn(TRAINING_STEPS, log_interval=None), 1)
    return duration / model.num_timesteps


def figures(name: str, unit: str, durations: dict[str, Callable[[], float]], n_rounds: int) -> list[Figure]:
    """
    :param name: of what is timed
    :param unit: of rates
    :param durations: of the three ways to compute it
    :param n_rounds: how often each is timed
    :return: each way on the GPU against the core, and the graph against single operations
    """
    times = by_turns(durations, n_rounds)
    rates = {way: 1 / float(np.median(duration)) for way, duration in times.items()}
    compared = ((OPERATIONS, CORE, None), (GRAPH, CORE, None), (GRAPH, OPERATIONS, 5.0))
    return [
        Figure(f"{name}: {way}", unit, rates[way], rates[other], faster(times[way], times[other]), goal, other)
        for way, other, goal in compared
    ]


def main() -> None:
    """All sizes, and a training. Another device than ``cuda`` may be named, on which nothing is captured."""
    device = sys.argv[1] if len(sys.argv) > 1 else "cuda"
    if device.startswith("cuda") and not th.cuda.is_available():
        print("There is no GPU that torch could use, so nothing was measured.")
        return
    th.set_num_threads(1)
    ways: dict[str, dict[str, Any]] = {
        CORE: {"device": "cpu"},
        OPERATIONS: {"device": device, "cuda_graph": False},
        GRAPH: {"device": device, "cuda_graph": True},
    }
    measured: list[Figure] = []
    for name, (sizes, n_core) in SIZES.items():
        together = {CORE: n_core, OPERATIONS: N_OPERATIONS, GRAPH: N_GRAPH}
        durations: dict[str, Callable[[], float]] = {}
        for way, kwargs in ways.items():
            durations[way] = partial(update_seconds, make_model(**kwargs, **sizes), together[way])
        measured += figures(name, "updates/s", durations, ROUNDS)
        write("gpu", measured)  # what there is; a machine with a GPU is often lent for minutes
    durations = {way: partial(step_seconds, **kwargs) for way, kwargs in ways.items()}
    measured += figures(f"training of {ENV_ID}", "env steps/s", durations, TRAINING_ROUNDS)
    write("gpu", measured)


if __name__ == "__main__":
    main()
